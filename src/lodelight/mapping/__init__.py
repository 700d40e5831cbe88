"""The map and what keeps it: points, keyframes, places, loops, the file."""
