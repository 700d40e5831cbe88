"""What several commands say of an option they share."""

TOPIC_HELP = "Of a ROS bag: role=/topic, for cam0, cam1, ..., depth, imu, lights, truth; the others by their type."
