"""Where the camera is in a map: prediction, local map, pose, and finding it again when it was lost."""
