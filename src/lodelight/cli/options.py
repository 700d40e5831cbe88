"""What several commands say of an option they share."""

TOPIC_HELP = "Of a ROS bag: role=/topic, for cam0, cam1, ..., depth, imu, lights, truth; the others by their type."
VIEW_HELP = "Watch it in a window (extra viewer)."
WEB_HELP = "Watch it in a browser; prints the address, and serves until Ctrl-C."
RRD_HELP = "Record what would be seen, to scrub later: rerun FILE."
