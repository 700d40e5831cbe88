"""Printed codes on walls: image → `TagSighting`, its poses, and whether it may be believed."""
