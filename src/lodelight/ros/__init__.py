"""ROS nodes over `Slam.feed` and `Localizer.feed`. The core knows no ROS; `ros1` and `ros2` connect it."""
