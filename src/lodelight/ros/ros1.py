"""The node for ROS 1: `python -m lodelight.ros.ros1 _cameras:="[/camera/image_raw]" _depth:=/camera/depth/image_raw`.

rospy and the messages come with ROS (Debian: python3-rospy, python3-sensor-msgs and the others).
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import fields
from typing import Any

from lodelight.errors import LodelightError
from lodelight.ros.wiring import LATCHED, PUBLISHED, Parameters, message_types, run_node

QUEUE = 100  # samples of an IMU come faster than images


class Ros1:
    """See `wiring.Ros`."""

    def __init__(self) -> None:
        import rospy
        from std_srvs.srv import SetBool, SetBoolResponse, Trigger, TriggerResponse

        self._rospy = rospy
        self._services = (Trigger, TriggerResponse), (SetBool, SetBoolResponse)
        self.types = message_types()
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


if __name__ == "__main__":
    sys.exit(run_node(Ros1, "source your ROS 1, or install its Python packages"))
