"""What a node is made of, whichever ROS: parameters, topics and services, tied to the core.

A ROS is handed in as a `Ros`; nothing here imports one.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from types import SimpleNamespace
from typing import Any, Protocol

import numpy as np

from lodelight.errors import ConfigError, LodelightError
from lodelight.geometry.se3 import SE3
from lodelight.io.calibrations import load_rig
from lodelight.io.pictures import BadFrame
from lodelight.ros import messages
from lodelight.ros.core import NodeConfig, NodeCore, Output


class Ros(Protocol):
    """The few things that a node asks of its ROS.

    types : the message classes; kind : "Image", "CompressedImage", "CameraInfo", "Imu" or "Odometry"
    service : fn takes the request's `data` (None for a Trigger) and returns a text, or raises LodelightError
    """

    types: Any

    def stamp(self, t_ns: int) -> Any: ...
    def subscribe(self, topic: str, kind: str, callback: Callable[[Any], None]) -> None: ...
    def publish(self, name: str, message: Any) -> None: ...
    def service(self, name: str, switch: bool, fn: Callable[[Any], str]) -> None: ...
    def log(self, text: str, error: bool = False) -> None: ...


class Host(Ros, Protocol):
    """A ROS that a node lives in, from its parameters to its shutdown."""

    def parameters(self) -> Parameters: ...
    def spin(self) -> None: ...


@dataclass(frozen=True)
class Parameters:
    """A node's parameters, by their ROS names.

    cameras : image topics, one or two; a name that ends in /compressed is a CompressedImage
    infos : their CameraInfo topics; default: camera_info beside each image. Not used with a rig file
    depth, imu, lights : topics; "" is none. rig : rig.toml or another calibration file
    body_in_base : x y z qx qy qz qw of the rig's body on base_frame
    sensors, mode, map_file, anchors, settings : see NodeConfig
    """

    cameras: Sequence[str] = ("camera/image_raw",)
    infos: Sequence[str] = ()
    depth: str = ""
    imu: str = ""
    lights: str = ""
    rig: str = ""
    sensors: str = ""
    mode: str = "slam"
    map_file: str = ""
    anchors: str = ""
    settings: Sequence[str] = ()
    map_frame: str = "map"
    odom_frame: str = "odom"
    base_frame: str = "base_link"
    body_in_base: Sequence[float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)

    def check(self) -> None:
        if not 1 <= len(self.cameras) <= 2:
            raise ConfigError(f"cameras names {len(self.cameras)} topics; name one, or left and right")
        if len(self.body_in_base) != 7:
            raise ConfigError("body_in_base must be x y z qx qy qz qw")
        if self.imu and not self.rig:
            raise ConfigError("an IMU needs a rig file: CameraInfo does not say how it sits, nor how noisy it is")
        if len(self.cameras) == 1 and not self.depth and not self.imu and not self.map_file:
            raise ConfigError("one camera alone gives a map no scale; add depth, imu or a second camera, or map_file")

    @property
    def T_base_body(self) -> SE3:
        values = np.array([float(v) for v in self.body_in_base])
        return SE3.from_quat_xyzw(values[:3], values[3:])


@dataclass(eq=False)
class Wiring:
    """A node. The core begins when the rig is known: at once from a file, else with the first CameraInfo of each."""

    ros: Ros
    parameters: Parameters
    core: NodeCore | None = None
    _infos: dict[int, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        p = self.parameters
        p.check()
        if p.rig:
            self._begin(load_rig(p.rig))
        else:
            infos = p.infos or [_beside(topic) for topic in p.cameras]
            for i, topic in enumerate(infos):
                self.ros.subscribe(topic, "CameraInfo", partial(self._info, i))
        for i, topic in enumerate(p.cameras):
            kind = "CompressedImage" if topic.endswith("/compressed") else "Image"
            self.ros.subscribe(topic, kind, partial(self._image, f"cam{i}"))
        if p.depth:
            self.ros.subscribe(p.depth, "Image", partial(self._image, "depth"))
        if p.imu:
            self.ros.subscribe(p.imu, "Imu", self._imu)
        if p.lights:
            self.ros.subscribe(p.lights, "Odometry", self._light)
        for name in ("save_map", "load_map", "reset"):
            self.ros.service(name, False, partial(self._command, name))
        self.ros.service("localize_only", True, lambda on: self._ready().localize_only(bool(on)))

    def close(self) -> None:
        if self.core is not None:
            self.core.close()

    # -- in -----------------------------------------------------------------------------------------------------------

    def _info(self, i: int, message: Any) -> None:
        p = self.parameters
        if self.core is None and i not in self._infos:
            self._infos[i] = message
            if len(self._infos) == len(p.cameras):
                infos = [self._infos[k] for k in range(len(p.cameras))]
                try:
                    self._begin(messages.rig_of_infos(infos, list(p.cameras), bool(p.depth)))
                except LodelightError as error:
                    self.ros.log(f"{type(error).__name__}: {error}", error=True)

    def _begin(self, rig: Any) -> None:
        p = self.parameters
        config = NodeConfig(p.sensors, p.mode, p.map_file, p.anchors, tuple(p.settings))
        self.core = NodeCore(rig, config, self._publish, p.T_base_body, lambda text: self.ros.log(text, error=True))
        self.ros.log(f"{p.mode} with {self.core.sensors} begins")

    def _image(self, name: str, message: Any) -> None:
        if self.core is None:
            return
        rig = self.core.rig
        try:
            if name == "depth":
                if rig.depth is None:
                    return
                image: Any = messages.depth_image(message, rig.depth)
            else:
                camera = rig.cameras[int(name[3:])].camera
                image = messages.grey_image(message, (camera.width, camera.height))
        except BadFrame as bad:
            self.ros.log(f"an image of {name} is left out: {bad}", error=True)
            return
        self.core.image(name, messages.stamp_ns(message), image)

    def _imu(self, message: Any) -> None:
        if self.core is not None:
            gyro, accel = messages.vector(message.angular_velocity), messages.vector(message.linear_acceleration)
            self.core.imu(messages.stamp_ns(message), gyro, accel)

    def _light(self, message: Any) -> None:
        if self.core is not None:
            self.core.light(messages.light_fix(message))

    def _command(self, name: str, _: Any) -> str:
        return str(getattr(self._ready(), name)())

    def _ready(self) -> NodeCore:
        if self.core is None:
            raise ConfigError("no CameraInfo came yet")
        return self.core

    # -- out ----------------------------------------------------------------------------------------------------------

    def _publish(self, out: Output) -> None:
        p, ros = self.parameters, self.ros
        now = ros.stamp(out.estimate.t_ns)
        if out.estimate.localized:
            ros.publish("odom", messages.odometry(
                ros.types, now, p.odom_frame, p.base_frame, out.T_odom_base, out.covariance, out.velocity
            ))  # fmt: skip
            tf = ros.types.TFMessage()
            tf.transforms.append(messages.transform(ros.types, now, p.map_frame, p.odom_frame, out.T_map_odom))
            tf.transforms.append(messages.transform(ros.types, now, p.odom_frame, p.base_frame, out.T_odom_base))
            ros.publish("/tf", tf)
        if out.path:
            ros.publish("path", messages.path(ros.types, ros.stamp, p.map_frame, out.path))
        if out.cloud is not None:
            ros.publish("cloud", messages.cloud(ros.types, now, p.map_frame, out.cloud))
        if out.diagnostics:
            ros.publish("/diagnostics", messages.diagnostics(ros.types, now, out.diagnostics))


def _beside(topic: str) -> str:
    """Where drivers publish an image's CameraInfo."""
    namespace = topic.removesuffix("/compressed").rpartition("/")
    return f"{namespace[0]}{namespace[1]}camera_info"


PUBLISHED = {
    "odom": "Odometry", "path": "Path", "cloud": "PointCloud2", "/tf": "TFMessage", "/diagnostics": "DiagnosticArray"
}  # fmt: skip
LATCHED = ("path", "cloud")  # for those who listen later


def message_types() -> SimpleNamespace:
    """The message classes, which both ROS name alike. Raises ImportError where there is no ROS."""
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
    from geometry_msgs.msg import PoseStamped, TransformStamped
    from nav_msgs.msg import Odometry, Path
    from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu, PointCloud2, PointField
    from tf2_msgs.msg import TFMessage

    return SimpleNamespace(
        DiagnosticArray=DiagnosticArray, DiagnosticStatus=DiagnosticStatus, KeyValue=KeyValue,
        PoseStamped=PoseStamped, TransformStamped=TransformStamped, Odometry=Odometry, Path=Path,
        CameraInfo=CameraInfo, CompressedImage=CompressedImage, Image=Image, Imu=Imu, PointCloud2=PointCloud2,
        PointField=PointField, TFMessage=TFMessage,
    )  # fmt: skip


def run_node(host: Callable[[], Host], missing: str) -> int:
    """Runs until the node is shut down; returns an exit status. missing : what to do where there is no such ROS"""
    try:
        ros = host()
    except ImportError as error:
        print(f"lodelight: {error}; {missing}", file=sys.stderr)
        return 2
    try:
        wiring = Wiring(ros, ros.parameters())
    except LodelightError as error:
        print(f"lodelight: {type(error).__name__}: {error}", file=sys.stderr)
        return 2
    ros.spin()
    wiring.close()
    return 0
