"""Rotations, rigid motions, cameras, alignment, triangulation: no state, no I/O."""
