"""The node for ROS 1: `python -m lodelight.ros.ros1 _cameras:="[/camera/image_raw]" _depth:=/camera/depth/image_raw`.

rospy and the messages come with ROS (Debian: python3-rospy, python3-sensor-msgs and the others).
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import fields
from types import SimpleNamespace
from typing import Any

from lodelight.errors import LodelightError
from lodelight.ros.wiring import LATCHED, PUBLISHED, Parameters, Wiring

QUEUE = 100  # samples of an IMU come faster than images


class Ros1:
    """See `wiring.Ros`."""

    def __init__(self) -> None:
        import rospy
        from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
        from geometry_msgs.msg import PoseStamped, TransformStamped
        from nav_msgs.msg import Odometry, Path
        from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu, PointCloud2, PointField
        from std_srvs.srv import SetBool, SetBoolResponse, Trigger, TriggerResponse
        from tf2_msgs.msg import TFMessage

        self._rospy = rospy
        self._services = (Trigger, TriggerResponse), (SetBool, SetBoolResponse)
        self.types = SimpleNamespace(
            DiagnosticArray=DiagnosticArray, DiagnosticStatus=DiagnosticStatus, KeyValue=KeyValue,
            PoseStamped=PoseStamped, TransformStamped=TransformStamped, Odometry=Odometry, Path=Path,
            CameraInfo=CameraInfo, CompressedImage=CompressedImage, Image=Image, Imu=Imu, PointCloud2=PointCloud2,
            PointField=PointField, TFMessage=TFMessage,
        )  # fmt: skip
        rospy.init_node("lodelight")
        self._publishers = {
            name: rospy.Publisher(name, getattr(self.types, kind), queue_size=10, latch=name in LATCHED)
            for name, kind in PUBLISHED.items()
        }

    def parameters(self) -> Parameters:
        known = {f.name: self._rospy.get_param(f"~{f.name}", f.default) for f in fields(Parameters)}
        return Parameters(**known)

    def stamp(self, t_ns: int) -> Any:
        return self._rospy.Time(t_ns // 10**9, t_ns % 10**9)

    def subscribe(self, topic: str, kind: str, callback: Callable[[Any], None]) -> None:
        self._rospy.Subscriber(topic, getattr(self.types, kind), callback, queue_size=QUEUE, buff_size=1 << 24)

    def publish(self, name: str, message: Any) -> None:
        self._publishers[name].publish(message)

    def service(self, name: str, switch: bool, fn: Callable[[Any], str]) -> None:
        kind, response = self._services[switch]

        def answer(request: Any) -> Any:
            try:
                return response(success=True, message=fn(getattr(request, "data", None)))
            except LodelightError as error:
                return response(success=False, message=str(error))

        self._rospy.Service(f"~{name}", kind, answer)

    def log(self, text: str, error: bool = False) -> None:
        (self._rospy.logerr if error else self._rospy.loginfo)(text)

    def spin(self) -> None:
        self._rospy.spin()


def main() -> int:
    """Runs until the node is shut down; returns an exit status."""
    try:
        ros = Ros1()
    except ImportError as error:
        print(f"lodelight: {error}; source your ROS 1, or install its Python packages", file=sys.stderr)
        return 2
    try:
        wiring = Wiring(ros, ros.parameters())
    except LodelightError as error:
        print(f"lodelight: {type(error).__name__}: {error}", file=sys.stderr)
        return 2
    ros.spin()
    wiring.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
