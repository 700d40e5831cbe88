"""Visual-inertial odometry: images and IMU to a smooth path, in real time."""
