"""Bags as other people's robots record them: written with rosbags alone, nothing of this project's writer."""

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from recordings import HEIGHT, PERIOD_NS, START_NS, WIDTH, picture


class Robot:
    """A bag under construction. ros1, or ROS 2 as a folder of that storage."""

    def __init__(self, path, ros1=True, plugin=StoragePlugin.MCAP):
        self.ros1 = ros1
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        if ros1:
            text = "geometry_msgs/TransformStamped[] transforms\n"
            self.store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))
        self.writer = Writer1(path) if ros1 else Writer(path, version=9, storage_plugin=plugin)
        self.connections = {}

    def __enter__(self):
        self.writer.open()
        return self

    def __exit__(self, *exc):
        self.writer.close()

    def make(self, name, **fields):
        return self.store.types[name.replace("/", "/msg/")](**fields)

    def put(self, topic, t_ns, message):
        name = message.__msgtype__
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, name, typestore=self.store)
        raw = self.store.serialize_ros1(message, name) if self.ros1 else self.store.serialize_cdr(message, name)
        self.writer.write(self.connections[topic], t_ns, raw)

    def header(self, t_ns, frame):
        stamp = self.make("builtin_interfaces/Time", sec=t_ns // 10**9, nanosec=t_ns % 10**9)
        return self.make("std_msgs/Header", stamp=stamp, frame_id=frame, **({"seq": 0} if self.ros1 else {}))

    def image(self, t_ns, frame, pixels, encoding, padding=0):
        """padding : bytes added to every row, as some drivers do"""
        rows = np.ascontiguousarray(pixels).reshape(len(pixels), -1).view(np.uint8)
        rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=99)
        return self.make(
            "sensor_msgs/Image", header=self.header(t_ns, frame), height=pixels.shape[0], width=pixels.shape[1],
            encoding=encoding, is_bigendian=0, step=rows.shape[1], data=rows.ravel(),
        )  # fmt: skip

    def compressed(self, t_ns, frame, pixels, suffix=".png", format="png", head=b""):
        data = head + cv2.imencode(suffix, pixels)[1].tobytes()
        return self.make(
            "sensor_msgs/CompressedImage", header=self.header(t_ns, frame), format=format,
            data=np.frombuffer(data, np.uint8),
        )  # fmt: skip

    def info(self, t_ns, frame, fx=50.0, baseline_px=0.0, size=(WIDTH, HEIGHT), D=(0.1, -0.2, 0.001, 0.002, 0.03)):
        K = np.array([fx, 0, 31.5, 0, fx, 23.5, 0, 0, 1.0])
        P = np.array([fx, 0, 31.5, baseline_px, 0, fx, 23.5, 0, 0, 0, 1, 0.0])
        values = {"d": np.array(D), "k": K, "r": np.eye(3).ravel(), "p": P}
        roi = self.make("sensor_msgs/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        return self.make(
            "sensor_msgs/CameraInfo", header=self.header(t_ns, frame), width=size[0], height=size[1], binning_x=0,
            binning_y=0, roi=roi, distortion_model="plumb_bob",
            **({k.upper(): v for k, v in values.items()} if self.ros1 else values),
        )  # fmt: skip

    def vector(self, *xyz):
        x, y, z = map(float, xyz)
        return self.make("geometry_msgs/Vector3", x=x, y=y, z=z)

    def turn(self, x=0.0, y=0.0, z=0.0, w=1.0):
        return self.make("geometry_msgs/Quaternion", x=x, y=y, z=z, w=w)

    def imu(self, t_ns, frame="imu_link"):
        unknown = np.zeros(9)
        return self.make(
            "sensor_msgs/Imu", header=self.header(t_ns, frame), orientation=self.turn(), orientation_covariance=unknown,
            angular_velocity=self.vector(0.1, 0.2, 0.3), angular_velocity_covariance=unknown,
            linear_acceleration=self.vector(0, 0, 9.81), linear_acceleration_covariance=unknown,
        )  # fmt: skip

    def tf(self, t_ns, *edges):
        """edges : (parent, child, xyz, quaternion xyzw)"""
        made = [
            self.make(
                "geometry_msgs/TransformStamped", header=self.header(t_ns, parent), child_frame_id=child,
                transform=self.make("geometry_msgs/Transform", translation=self.vector(*xyz), rotation=self.turn(*q)),
            )
            for parent, child, xyz, q in edges
        ]  # fmt: skip
        return self.make("tf2_msgs/TFMessage", transforms=made)


OPTICAL = (-0.5, 0.5, -0.5, 0.5)  # a camera that looks along x of its parent


def drive(path, ros1=True, plugin=StoragePlugin.MCAP, n=6, jpeg=False, depth=False, right_lag_ns=0, imu_joined=True):
    """A stereo rig on base_link, 0.1 m apart, with an IMU; image i has the grey value 10 i + 5, its pair one more."""
    with Robot(path, ros1, plugin) as robot:
        edges = [
            ("base_link", "left_optical", (0.2, 0.05, 0.3), OPTICAL),
            ("base_link", "right_optical", (0.2, -0.05, 0.3), OPTICAL),
        ]
        if imu_joined:
            edges.append(("base_link", "imu_link", (0.0, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0)))
        robot.put("/tf_static", START_NS, robot.tf(START_NS, *edges))
        for k in range(-4, n * 10):
            t = START_NS + k * 5_000_000
            robot.put("/imu/data", t, robot.imu(t))
            if k < 0 or k % 10:
                continue
            i = k // 10
            for side, lag in (("left", 0), ("right", right_lag_ns)):
                stamp, frame = START_NS + i * PERIOD_NS + lag, f"{side}_optical"
                grey = picture(i) + (side == "right")
                robot.put(f"/stereo/{side}/camera_info", t, robot.info(stamp, frame))
                if jpeg:
                    name = f"/stereo/{side}/image_raw/compressed"
                    robot.put(name, t, robot.compressed(stamp, frame, grey, ".jpg", "mono8; jpeg compressed"))
                else:
                    robot.put(f"/stereo/{side}/image_raw", t, robot.image(stamp, frame, grey, "mono8", padding=8))
            if depth:
                z = np.full((HEIGHT, WIDTH), 1500 + i, np.uint16)
                robot.put("/depth/image_raw", t, robot.image(t, "left_optical", z, "16UC1"))
    return path
