"""The node for ROS 2: `python -m lodelight.ros.ros2 --ros-args -p cameras:="[/camera/image_raw]" -p rig:=rig.toml`.

rclpy and the messages come with ROS 2. Tested against a stand-in of the calls below, not against ROS 2 itself.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import fields
from typing import Any

from lodelight.errors import LodelightError
from lodelight.ros.wiring import LATCHED, PUBLISHED, Parameters, message_types, run_node

DEPTH = 100  # of the queues; samples of an IMU come faster than images


class Ros2:
    """See `wiring.Ros`."""

    def __init__(self) -> None:
        import rclpy
        from builtin_interfaces.msg import Time
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
        from std_srvs.srv import SetBool, Trigger

        self._rclpy, self._time, self._services = rclpy, Time, (Trigger, SetBool)
        self.types = message_types()
        rclpy.init()
        self._node = rclpy.create_node("lodelight")
        # a subscriber that asks for no more than best effort hears every publisher
        self._sensor_qos = QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._publishers = {
            name: self._node.create_publisher(getattr(self.types, kind), name, latched if name in LATCHED else 10)
            for name, kind in PUBLISHED.items()
        }

    def parameters(self) -> Parameters:
        known: dict[str, Any] = {}
        for f in fields(Parameters):
            default = list(f.default) or [""] if isinstance(f.default, tuple) else f.default
            value = self._node.declare_parameter(f.name, default).value
            known[f.name] = [v for v in value if v != ""] if isinstance(value, list | tuple) else value
        return Parameters(**known)

    def stamp(self, t_ns: int) -> Any:
        return self._time(sec=t_ns // 10**9, nanosec=t_ns % 10**9)

    def subscribe(self, topic: str, kind: str, callback: Callable[[Any], None]) -> None:
        self._node.create_subscription(getattr(self.types, kind), topic, callback, self._sensor_qos)

    def publish(self, name: str, message: Any) -> None:
        self._publishers[name].publish(message)

    def service(self, name: str, switch: bool, fn: Callable[[Any], str]) -> None:
        def answer(request: Any, response: Any) -> Any:
            try:
                response.success, response.message = True, fn(getattr(request, "data", None))
            except LodelightError as error:
                response.success, response.message = False, str(error)
            return response

        self._node.create_service(self._services[switch], f"~/{name}", answer)

    def log(self, text: str, error: bool = False) -> None:
        logger = self._node.get_logger()
        (logger.error if error else logger.info)(text)

    def spin(self) -> None:
        try:
            self._rclpy.spin(self._node)
        except KeyboardInterrupt:
            return
        finally:
            self._node.destroy_node()
            self._rclpy.try_shutdown()


if __name__ == "__main__":
    sys.exit(run_node(Ros2, "source your ROS 2"))
