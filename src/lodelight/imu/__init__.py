"""The inertial sensor: its samples, and what they say of the motion between two instants."""
