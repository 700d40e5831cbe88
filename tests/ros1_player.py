"""A recording played to the ROS 1 node, and what comes out of it: a process of its own, for rospy takes one over.

python ros1_player.py RECORDING OUT.json : frames go out one by one, each when the one before was answered.
"""

from __future__ import annotations

import json
import sys
import threading

sys.path.append("/usr/lib/python3/dist-packages")

import numpy as np
import rospy
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry, Path
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_srvs.srv import SetBool, Trigger
from tf2_msgs.msg import TFMessage

from lodelight.io.sources import open_source

got = {"odom": [], "tf": [], "path": 0, "cloud": 0, "diagnostics": [], "services": {}}
answered = threading.Condition()


def numbers(position, q):
    return [position.x, position.y, position.z, q.x, q.y, q.z, q.w]


def on_odom(m):
    with answered:
        stamp = m.header.stamp.secs * 10**9 + m.header.stamp.nsecs
        got["odom"].append([stamp, m.header.frame_id, m.child_frame_id,
                            *numbers(m.pose.pose.position, m.pose.pose.orientation), *m.pose.covariance])  # fmt: skip
        answered.notify()


def on_tf(m):
    for t in m.transforms:
        got["tf"].append([t.header.frame_id, t.child_frame_id,
                          *numbers(t.transform.translation, t.transform.rotation)])  # fmt: skip


def image(kind, pixels, stamp, frame):
    m = Image(encoding=kind, height=pixels.shape[0], width=pixels.shape[1], step=pixels.strides[0])
    m.header.stamp, m.header.frame_id, m.data = stamp, frame, pixels.tobytes()
    return m


def call(name, kind, *arguments):
    answer = rospy.ServiceProxy(f"/lodelight/{name}", kind)(*arguments)
    got["services"][name] = [answer.success, answer.message]


def wait_for(condition, what):
    for _ in range(600):
        if condition():
            return
        rospy.sleep(0.1)
    raise TimeoutError(what)


def main(recording_path, out):
    recording = open_source(recording_path)
    camera = recording.rig.cameras[0].camera
    rospy.init_node("player")
    rospy.Subscriber("/odom", Odometry, on_odom)
    rospy.Subscriber("/tf", TFMessage, on_tf)
    rospy.Subscriber("/path", Path, lambda m: got.update(path=max(got["path"], len(m.poses))))
    rospy.Subscriber("/cloud", PointCloud2, lambda m: got.update(cloud=max(got["cloud"], m.width)))
    rospy.Subscriber("/diagnostics", DiagnosticArray, lambda m: got["diagnostics"].append(
        {v.key: v.value for v in m.status[0].values} | {"level": m.status[0].level}))  # fmt: skip
    names = {"image": Image, "depth": Image, "camera_info": CameraInfo}
    to = {name: rospy.Publisher(f"/camera/{name}", kind, queue_size=10) for name, kind in names.items()}
    wait_for(lambda: all(p.get_num_connections() for p in to.values()), "the node listens")
    fx, fy, cx, cy = camera.params[:4].tolist()
    info = CameraInfo(height=camera.height, width=camera.width, distortion_model="plumb_bob", D=[0.0] * 5)
    info.K = [fx, 0, cx, 0, fy, cy, 0, 0, 1]
    info.P = [fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0]
    to["camera_info"].publish(info)
    rospy.wait_for_service("/lodelight/save_map", timeout=30)
    wait_for(lambda: bool(started()), "the core begins")
    frames = list(recording.messages("rgbd"))
    for i, frame in enumerate(frames):
        if i == len(frames) - 4:
            rospy.sleep(1.2)  # paths come once a second
        stamp = rospy.Time(frame.t_ns // 10**9, frame.t_ns % 10**9)
        before = len(got["odom"])
        to["image"].publish(image("mono8", frame.images[0], stamp, "camera"))
        to["depth"].publish(image("32FC1", frame.depth.astype(np.float32), stamp, "camera"))
        with answered:
            if not answered.wait_for(lambda before=before: len(got["odom"]) > before, timeout=60):
                raise TimeoutError(f"no answer to frame {i}")
        if i == len(frames) - 3:
            call("localize_only", SetBool, True)
    call("save_map", Trigger)
    call("load_map", Trigger)
    call("reset", Trigger)
    rospy.sleep(0.5)
    with open(out, "w") as file:
        json.dump(got, file)


def started():
    """Whether the node has its rig: reset is refused before."""
    return rospy.ServiceProxy("/lodelight/reset", Trigger)().success


if __name__ == "__main__":
    main(*sys.argv[1:])
