"""Recordings, rigs and trajectories in and out: one file per format."""
