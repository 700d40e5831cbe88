"""What is wrong with a recording or its calibration, and by how much."""
