"""Writing bags: ROS 1 (`.bag`), ROS 2 as MCAP (`.mcap`) or sqlite3 (`.db3`), one file each, by the end of the name.

    with BagWriter(path) as bag:
        bag.write("/odom", t_ns, bag.odometry(t_ns, T_world_body, covariance))

Messages are made by methods, so that a caller never meets what differs between ROS 1 and 2. The file appears under
its name when it is whole.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np

from lodelight.errors import SourceError
from lodelight.geometry.cameras import EQUIDISTANT, RADTAN, Camera
from lodelight.geometry.se3 import SE3
from lodelight.io.covariances import covariance_to_ros
from lodelight.io.stamps import NS_PER_S, seconds_text
from lodelight.types import AnyArray, Array, Bytes

SUFFIXES = (".bag", ".mcap", ".db3")
WORLD, BODY = "map", "body"
LATEST_S = 1 << 31  # ROS 2 counts seconds in 32 bits with a sign
TF_MESSAGE = "geometry_msgs/TransformStamped[] transforms\n"  # which the types of ROS 1 above lack
UNKNOWN_TWIST = 1e6 * np.eye(6).ravel()  # (1 km/s)^2; a filter takes zeros for certainty
FLOAT32 = 7  # of sensor_msgs/PointField


class BagWriter:
    """A new bag; a context. Raises SourceError where the file exists already or cannot be written.

    replace : a file that exists is replaced, once the new one is whole
    """

    def __init__(self, path: Path, replace: bool = False) -> None:
        self._dest = Path(path)
        if self._dest.suffix not in SUFFIXES:
            raise SourceError(f"{path}: the name of a bag ends in {', '.join(SUFFIXES)}")
        if self._dest.exists() and not replace:
            raise SourceError(f"{path} exists already; remove it or choose another name")
        self.ros1 = self._dest.suffix == ".bag"

    def __enter__(self) -> BagWriter:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self._store = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        if self.ros1:
            self._store.register(get_types_from_msg(TF_MESSAGE, "tf2_msgs/msg/TFMessage"))
        self._types = self._store.types
        self._connections: dict[str, Any] = {}
        try:
            self._dest.parent.mkdir(parents=True, exist_ok=True)
            self._folder = Path(mkdtemp(prefix=f".{self._dest.stem}-", dir=self._dest.parent))
        except OSError as error:
            raise SourceError(f"cannot write {self._dest}: {error.strerror}; choose another name") from None
        self._writer = self._open()
        self._writer.open()
        return self

    def _open(self) -> Any:
        if self.ros1:
            from rosbags.rosbag1 import Writer as Writer1

            return Writer1(self._folder / "whole.bag")
        from rosbags.rosbag2 import StoragePlugin, Writer

        plugin = StoragePlugin.MCAP if self._dest.suffix == ".mcap" else StoragePlugin.SQLITE3
        return Writer(self._folder / "whole", version=9, storage_plugin=plugin)

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        try:
            if kind is not None:
                self._writer.abort()
                return
            self._writer.close()
            whole = self._folder / ("whole.bag" if self.ros1 else f"whole/whole{self._dest.suffix}")
            os.replace(whole, self._dest)
        except OSError as error:
            raise SourceError(f"cannot write {self._dest}: {error.strerror}; make room") from None
        finally:
            shutil.rmtree(self._folder, ignore_errors=True)

    def write(self, topic: str, t_ns: int, message: Any, latched: bool = False) -> None:
        """Append; t_ns is when it counts as recorded. A latched message reaches those who listen later."""
        if not 0 <= t_ns < LATEST_S * NS_PER_S:
            raise SourceError(
                f"{self._dest}: a bag cannot hold the stamp {seconds_text(t_ns)} s, which is not in 0 to 2^31 s"
            )
        try:
            connection = self._connections.get(topic) or self._connect(topic, message.__msgtype__, latched)
            serialize = self._store.serialize_ros1 if self.ros1 else self._store.serialize_cdr
            self._writer.write(connection, t_ns, serialize(message, message.__msgtype__))
        except OSError as error:
            raise SourceError(f"cannot write {self._dest}: {error.strerror}; make room") from None

    def _connect(self, topic: str, msgtype: str, latched: bool) -> Any:
        if self.ros1:
            options: dict[str, Any] = {"latching": 1} if latched else {}
        else:
            options = {"offered_qos_profiles": [_transient_local()] if latched else []}
        connection = self._writer.add_connection(topic, msgtype, typestore=self._store, **options)
        self._connections[topic] = connection
        return connection

    # -- messages -------------------------------------------------------------------------------------------------

    def make(self, msgtype: str, **fields: Any) -> Any:
        """A message of a type such as `std_msgs/String`."""
        return self._types[msgtype.replace("/", "/msg/")](**fields)

    def header(self, t_ns: int, frame_id: str) -> Any:
        stamp = self.make("builtin_interfaces/Time", sec=t_ns // NS_PER_S, nanosec=t_ns % NS_PER_S)
        return self.make("std_msgs/Header", stamp=stamp, frame_id=frame_id, **({"seq": 0} if self.ros1 else {}))

    def text(self, text: str) -> Any:
        return self.make("std_msgs/String", data=text)

    def image(self, t_ns: int, frame_id: str, pixels: Bytes | AnyArray) -> Any:
        """(H, W) uint8 grey, uint16 mm or float32 m of depth."""
        encoding = {"uint8": "mono8", "uint16": "16UC1", "float32": "32FC1"}[pixels.dtype.name]
        height, width = pixels.shape
        little = np.ascontiguousarray(pixels).astype(pixels.dtype.newbyteorder("<"), copy=False)
        return self.make(
            "sensor_msgs/Image",
            header=self.header(t_ns, frame_id),
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=0,
            step=width * pixels.dtype.itemsize,
            data=little.view(np.uint8).reshape(-1),
        )

    def camera_info(self, t_ns: int, frame_id: str, lens: Camera) -> Any:
        """Double sphere is called that: ROS has no such model, and its readers then refuse it, as they should."""
        fx, fy, cx, cy = lens.params[:4].tolist()
        name = {RADTAN: "plumb_bob", EQUIDISTANT: "equidistant"}.get(lens.model, "double_sphere")
        values = {
            "d": np.array(lens.distortion, dtype=np.float64),
            "k": np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1], dtype=np.float64),
            "r": np.eye(3).ravel(),
            "p": np.array([fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0], dtype=np.float64),
        }
        roi = self.make("sensor_msgs/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        return self.make(
            "sensor_msgs/CameraInfo",
            header=self.header(t_ns, frame_id),
            height=lens.height,
            width=lens.width,
            distortion_model=name,
            binning_x=0,
            binning_y=0,
            roi=roi,
            **({key.upper(): value for key, value in values.items()} if self.ros1 else values),
        )

    def imu(self, t_ns: int, frame_id: str, gyro: Array, accel: Array) -> Any:
        """gyro rad/s, accel m/s^2; no orientation, which a covariance of -1 says."""
        unknown = np.zeros(9)
        return self.make(
            "sensor_msgs/Imu",
            header=self.header(t_ns, frame_id),
            orientation=self._quaternion((0.0, 0.0, 0.0, 1.0)),
            orientation_covariance=np.array([-1.0, *[0.0] * 8]),
            angular_velocity=self._vector(gyro.tolist()),
            angular_velocity_covariance=unknown,
            linear_acceleration=self._vector(accel.tolist()),
            linear_acceleration_covariance=unknown,
        )

    def odometry(
        self, t_ns: int, T_world_body: SE3, covariance: Array | None = None, world: str = WORLD, body: str = BODY
    ) -> Any:
        """covariance : (6, 6) in the chart of SE3.perturbed; the message has it in ROS's order and axes.

        No velocity: zeros of so large a covariance that a filter which reads them anyway learns nothing.
        """
        pose = self.make("geometry_msgs/PoseWithCovariance", pose=self.pose(T_world_body), covariance=np.zeros(36))
        if covariance is not None:
            pose.covariance = covariance_to_ros(T_world_body.R, covariance).ravel()
        zero = self.make("geometry_msgs/Twist", linear=self._vector((0, 0, 0)), angular=self._vector((0, 0, 0)))
        return self.make(
            "nav_msgs/Odometry",
            header=self.header(t_ns, world),
            child_frame_id=body,
            pose=pose,
            twist=self.make("geometry_msgs/TwistWithCovariance", twist=zero, covariance=UNKNOWN_TWIST),
        )

    def pose(self, T: SE3) -> Any:
        x, y, z = T.t.tolist()
        at = self.make("geometry_msgs/Point", x=x, y=y, z=z)
        return self.make("geometry_msgs/Pose", position=at, orientation=self._quaternion(T.quat_xyzw.tolist()))

    def path(self, stamps: Sequence[int], poses: Iterable[SE3], world: str = WORLD) -> Any:
        """All poses in one message, stamped with the last."""
        stamped = [
            self.make("geometry_msgs/PoseStamped", header=self.header(t, world), pose=self.pose(T))
            for t, T in zip(stamps, poses, strict=True)
        ]
        return self.make("nav_msgs/Path", header=self.header(stamps[-1] if stamps else 0, world), poses=stamped)

    def transforms(self, t_ns: int, edges: Iterable[tuple[str, str, SE3]]) -> Any:
        """A /tf or /tf_static message of (parent, child, T_parent_child)."""
        made = []
        for parent, child, T in edges:
            moved = self.make(
                "geometry_msgs/Transform",
                translation=self._vector(T.t.tolist()),
                rotation=self._quaternion(T.quat_xyzw.tolist()),
            )
            head = self.header(t_ns, parent)
            made.append(self.make("geometry_msgs/TransformStamped", header=head, child_frame_id=child, transform=moved))
        return self.make("tf2_msgs/TFMessage", transforms=made)

    def cloud(self, t_ns: int, xyz: AnyArray, world: str = WORLD) -> Any:
        """A PointCloud2 of (N, 3) m."""
        points = np.ascontiguousarray(xyz, dtype="<f4").reshape(-1, 3)
        named = [
            self.make("sensor_msgs/PointField", name=name, offset=4 * i, datatype=FLOAT32, count=1)
            for i, name in enumerate("xyz")
        ]
        return self.make(
            "sensor_msgs/PointCloud2",
            header=self.header(t_ns, world),
            height=1,
            width=len(points),
            fields=named,
            is_bigendian=False,
            point_step=12,
            row_step=12 * len(points),
            data=points.view(np.uint8).reshape(-1),
            is_dense=True,
        )

    def _vector(self, xyz: Iterable[float]) -> Any:
        x, y, z = xyz
        return self.make("geometry_msgs/Vector3", x=float(x), y=float(y), z=float(z))

    def _quaternion(self, xyzw: Iterable[float]) -> Any:
        x, y, z, w = xyzw
        return self.make("geometry_msgs/Quaternion", x=float(x), y=float(y), z=float(z), w=float(w))


def _transient_local() -> Any:
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    forever = QosTime(2147483647, 4294967295)
    return Qos(
        QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, forever, forever,
        QosLiveliness.AUTOMATIC, forever, False,
    )  # fmt: skip
