"""ROS nodes: the core alone, ROS 1 with a real master, ROS 2 against a stand-in of the calls that the node makes."""

from __future__ import annotations

import importlib
import itertools
import json
import os
import socket
import subprocess
import sys
import time
import types
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lodelight.anchors import Anchors
from lodelight.geometry.se3 import SE3
from lodelight.io.anchors_toml import write_anchors
from lodelight.io.rig_toml import write_rig
from lodelight.mapping.store import check_map, load_map, save_map
from lodelight.rig import ImuSpec
from lodelight.ros import messages
from lodelight.ros.core import NodeConfig, NodeCore
from lodelight.ros.frames import OdomFrame
from lodelight.ros.partners import Partners
from lodelight.ros.wiring import PUBLISHED, Parameters
from lodelight.slam import Slam
from tagged_wall import RIG, STEP_NS, T_WORLD_WALL, TAGS, frame, poses, surveyed, wall_picture, write_walk

DEBIAN = "/usr/lib/python3/dist-packages"
N_FRAMES = 14


@pytest.fixture(scope="module")
def frames():
    wall = wall_picture()
    return [frame(wall, T, (k + 1) * STEP_NS) for k, T in list(enumerate(poses(40)))[:N_FRAMES]]


def off_truth_m(t_ns, T_map_body):
    """Of poses against the wall's truth, both begun at their first frame."""
    truth = list(poses(40))
    first = truth[t_ns[0] // STEP_NS - 1]
    true = [first.inverse() @ truth[t // STEP_NS - 1] for t in t_ns]
    found = [T_map_body[0].inverse() @ T for T in T_map_body]
    return np.array([np.linalg.norm(a.t - b.t) for a, b in zip(found, true, strict=True)])


# -- the core -----------------------------------------------------------------------------------------------------


def test_odometry_is_smooth_while_the_map_is_corrected():
    odom = OdomFrame()
    step = SE3.exp(np.array([0.0, 0.0, 0.1, 0.2, 0.0, 0.0]))
    corrected = SE3.exp(np.array([0.02, -0.01, 0.3, 1.0, -2.0, 0.1]))
    T, before = SE3.identity(), None
    track = []
    for i in range(10):
        if before is not None and i == 5:  # a loop moves everything
            before = corrected @ before
            T = corrected @ T
        odom.update(i * 10**8, T, before)
        np.testing.assert_allclose((odom.T_map_odom @ odom.T_odom_base).matrix, T.matrix, atol=1e-12)
        track.append(odom.T_odom_base)
        before, T = T, T @ step
    for a, b in itertools.pairwise(track):
        np.testing.assert_allclose((a.inverse() @ b).matrix, step.matrix, atol=1e-12)
    np.testing.assert_allclose(odom.velocity, [*step.t * 10, 0.0, 0.0, 1.0], atol=1e-9)
    odom.update(10**9, SE3.exp(np.array([0.0, 0, 0, 9.0, 9.0, 9.0])), None)  # found again somewhere else
    np.testing.assert_allclose(odom.T_odom_base.matrix, track[-1].matrix)


def test_images_become_frames_whatever_the_order_they_come_in():
    partners, image = Partners(2, True), np.zeros((2, 2), np.uint8)
    ms = 1_000_000
    assert partners.add("depth", 12 * ms, image) is None
    assert partners.add("cam1", 2 * ms, image) is None
    made = partners.add("cam0", 0, image)
    assert (made.t_ns, len(made.images), made.depth is not None) == (0, 2, True)
    assert partners.add("cam0", 50 * ms, image) is None
    assert partners.add("cam1", 58 * ms, image) is None  # 8 ms are too far
    assert partners.add("depth", 50 * ms, image) is None
    assert partners.add("cam0", 100 * ms, image) is None
    assert partners.add("depth", 100 * ms, image) is None
    assert partners.add("cam1", 100 * ms, image).t_ns == 100 * ms
    assert partners.unmatched == 1


class Slow:
    """A system that takes its time."""

    def __init__(self, system):
        self.system = system

    def feed(self, message):
        time.sleep(0.05)
        return self.system.feed(message)

    def __getattr__(self, name):
        return getattr(self.system, name)


def test_frames_that_come_too_fast_are_dropped_and_counted(frames):
    outputs = []
    core = NodeCore(RIG, NodeConfig(), outputs.append)
    core.system = Slow(core.system)
    for f in frames:
        core.image("cam0", f.t_ns, f.images[0])
        core.image("depth", f.t_ns, f.depth)
    core.close()
    assert core.dropped > 0
    assert core.frames + core.dropped == len(frames)
    assert [o.estimate.t_ns for o in outputs] == sorted(o.estimate.t_ns for o in outputs)
    assert outputs[-1].estimate.t_ns == frames[-1].t_ns  # the newest is never dropped


def test_a_node_that_localizes_finds_itself_in_a_saved_map_and_leaves_it_alone(frames, tmp_path):
    slam = Slam(RIG)
    for f in frames:
        slam.feed(f)
    slam.close()
    save_map(slam.map, tmp_path / "map.lode")
    before, outputs = (tmp_path / "map.lode").read_bytes(), []
    core = NodeCore(RIG, NodeConfig(mode="localize", map_file=str(tmp_path / "map.lode")), outputs.append)
    for f in frames[4:9]:
        core.image("cam0", f.t_ns, f.images[0])
        core.image("depth", f.t_ns, f.depth)
        while core._came_s:
            time.sleep(0.005)
    assert core.localize_only(True) == "this node localizes only, always"
    assert core.reset() == "the camera is looked for anew"
    assert core.load_map().startswith(f"{len(slam.map.alive_keyframes)} keyframes")
    core.close()
    assert outputs[-1].estimate.localized
    found = [(o.estimate.t_ns, o.T_map_odom @ o.T_odom_base) for o in outputs if o.estimate.localized]
    path = slam.trajectory()
    for t_ns, T in found:
        off = path.pose(int(np.flatnonzero(path.t_ns == t_ns)[0])).inverse() @ T
        assert np.linalg.norm(off.t) < 0.01
    assert (tmp_path / "map.lode").read_bytes() == before


def test_a_map_that_tags_tie_to_the_world_is_saved_in_the_world(frames, tmp_path):
    write_anchors(tmp_path / "anchors.toml", Anchors(tuple(map(surveyed, TAGS))))
    config = NodeConfig(map_file=str(tmp_path / "map.lode"), anchors=str(tmp_path / "anchors.toml"))
    core = NodeCore(RIG, config, lambda out: None)
    for f in frames:
        core.image("cam0", f.t_ns, f.images[0])
        core.image("depth", f.t_ns, f.depth)
        while core._came_s:
            time.sleep(0.005)
    for _ in range(2):  # saving moves nothing that is at work
        core.save_map()
    core.close()
    assert core.system.tags.aligned
    saved, truth = load_map(tmp_path / "map.lode"), list(poses(40))
    for t_ns, p in zip(saved.keyframes.t_ns.tolist(), saved.keyframes.p, strict=True):
        assert np.linalg.norm(p - (T_WORLD_WALL @ truth[t_ns // STEP_NS - 1]).t) < 0.03


def test_samples_and_fixes_reach_the_system(tmp_path):
    rig = replace(RIG, imu=ImuSpec(time_offset_s=0.01))
    core = NodeCore(rig, NodeConfig(sensors="rgbd-inertial"), print)
    taken = []
    core.system = types.SimpleNamespace(feed=taken.append)
    core.imu(5_000, np.array([1.0, 2, 3]), np.array([0.0, 0, 9.81]))
    T = SE3.exp(np.array([0.1, 0.2, -0.3, 1.0, 2.0, 3.0]))
    covariance = np.diag([1e-4, 2e-4, 3e-4, 4e-4, 5e-4, 6e-4])
    names = ("Odometry",)
    messages_of = types.SimpleNamespace(**{n: type(n, (Fields,), {}) for n in names})
    stamp = types.SimpleNamespace(sec=1, nanosec=7)
    sent = messages.odometry(messages_of, stamp, "world", "body", T, covariance, np.zeros(6))
    core.light(messages.light_fix(sent))
    core.close()
    sample, fix = taken
    assert (sample.t_ns, sample.gyro.tolist()) == (10_005_000, [1.0, 2.0, 3.0])
    assert fix.t_ns == 1_000_000_007
    np.testing.assert_allclose(fix.T_world_body.matrix, T.matrix, atol=1e-12)
    np.testing.assert_allclose(fix.covariance, covariance, atol=1e-12)


# -- ROS 1 --------------------------------------------------------------------------------------------------------


def ros1_environment(tmp_path):
    """Environment for a master on loopback, or skip."""
    found = subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path.append({DEBIAN!r}); import rospy, sensor_msgs.msg, tf2_msgs.msg, "
         "nav_msgs.msg, std_srvs.srv, diagnostic_msgs.msg, rosmaster"], capture_output=True,
    ).returncode == 0  # fmt: skip
    if not found:
        pytest.skip("needs ROS 1 (apt-get install python3-rosmaster python3-rospy and message packages)")
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        port = s.getsockname()[1]
    tests, src = str(Path(__file__).parent), str(Path(__file__).parents[1] / "src")
    return port, {
        **os.environ, "ROS_MASTER_URI": f"http://127.0.0.1:{port}", "ROS_IP": "127.0.0.1", "ROS_HOME": str(tmp_path),
        "PYTHONPATH": os.pathsep.join([src, tests]), "OPENBLAS_NUM_THREADS": "1",
    }  # fmt: skip


def debian_python(module, *arguments):
    """A module run with Debian's packages behind those of this environment."""
    code = f"import sys, runpy; sys.path.append({DEBIAN!r}); runpy.run_module({module!r}, run_name='__main__', " \
           "alter_sys=True)"  # fmt: skip
    return [sys.executable, "-c", code, *arguments]


def test_the_ros_1_node_maps_what_is_played_to_it(tmp_path):
    port, env = ros1_environment(tmp_path)
    recording = write_walk(tmp_path / "walk", wall_picture(), 0, N_FRAMES)
    map_file, result = tmp_path / "map.lode", tmp_path / "result.json"
    master = subprocess.Popen(
        [sys.executable, "-c", f"import sys; sys.path.append({DEBIAN!r}); from rosmaster.main import rosmaster_main; "
         f"rosmaster_main(['--core', '-p', '{port}'])"], env=env, stdout=subprocess.DEVNULL,
    )  # fmt: skip
    node = subprocess.Popen(
        debian_python(
            "lodelight.ros.ros1", "_cameras:=[/camera/image]", "_depth:=/camera/depth", f"_map_file:={map_file}"
        ), env=env, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        player = subprocess.run(
            debian_python("ros1_player", str(recording), str(result)),
            env=env, capture_output=True, text=True, timeout=150,
        )  # fmt: skip
    finally:
        node.terminate()
        said = node.communicate(timeout=30)[1]
        master.terminate()
        master.wait(timeout=30)
    assert player.returncode == 0, player.stderr + said
    got = json.loads(result.read_text())
    odom = got["odom"]
    assert [row[0] for row in odom] == [(k + 1) * STEP_NS for k in range(N_FRAMES)]
    assert {(row[1], row[2]) for row in odom} == {("odom", "base_link")}
    ahead = [SE3.from_quat_xyzw(np.array(row[3:6]), np.array(row[6:10])) for row in odom]
    optical = SE3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))
    assert off_truth_m([row[0] for row in odom], [T @ optical for T in ahead]).max() < 0.01
    covariance = np.array(odom[5][10:]).reshape(6, 6)
    assert np.linalg.eigvalsh(covariance).min() > 0.0
    assert 1e-5 < np.sqrt(covariance[0, 0]) < 0.05
    edges = {(row[0], row[1]) for row in got["tf"]}
    assert edges == {("map", "odom"), ("odom", "base_link")}
    assert got["path"] > 1
    assert got["cloud"] > 300
    assert got["diagnostics"][0]["state"] == "tracking"
    assert {"latency_ms", "why", "dropped"} <= set(got["diagnostics"][0])
    assert {name: ok for name, (ok, _) in got["services"].items()} == dict.fromkeys(
        ("save_map", "load_map", "reset", "localize_only"), True
    )
    assert check_map(map_file) == []


# -- ROS 2 --------------------------------------------------------------------------------------------------------


class Fields:
    """A message: fields appear when they are written or looked into, as those of a made-up type."""

    def __init__(self, **fields):
        self.__dict__.update(fields)

    def __getattr__(self, name):
        if name.startswith("_"):
            raise AttributeError(name)
        value = [] if name in ("poses", "fields", "transforms", "status", "values") else Fields()
        self.__dict__[name] = value
        return value


class Ros2StandIn:
    """The calls of rclpy that the node makes, and no other."""

    def __init__(self, parameters):
        self.parameters = parameters
        self.subscriptions, self.published, self.services, self.said = {}, {}, {}, []

    def install(self, monkeypatch):
        def module(name, **content):
            made = types.ModuleType(name)
            made.__dict__.update(content)
            monkeypatch.setitem(sys.modules, name, made)

        def messages(package, kind, *names):
            module(package)
            module(f"{package}.{kind}", **{n: type(n, (Fields,), {}) for n in names})

        module("rclpy", init=lambda: None, create_node=lambda name: self, spin=lambda node: None,
               try_shutdown=lambda: None)  # fmt: skip
        module("rclpy.qos", QoSProfile=lambda **k: k, DurabilityPolicy=types.SimpleNamespace(TRANSIENT_LOCAL=1),
               ReliabilityPolicy=types.SimpleNamespace(BEST_EFFORT=2))  # fmt: skip
        messages("builtin_interfaces", "msg", "Time")
        messages("diagnostic_msgs", "msg", "DiagnosticArray", "DiagnosticStatus", "KeyValue")
        messages("geometry_msgs", "msg", "PoseStamped", "TransformStamped")
        messages("nav_msgs", "msg", "Odometry", "Path")
        names = ("CameraInfo", "CompressedImage", "Image", "Imu", "PointCloud2", "PointField")
        messages("sensor_msgs", "msg", *names)
        messages("std_srvs", "srv", "SetBool", "Trigger")
        messages("tf2_msgs", "msg", "TFMessage")

    def declare_parameter(self, name, default):
        return types.SimpleNamespace(value=self.parameters.get(name, default))

    def create_subscription(self, kind, topic, callback, qos):
        self.subscriptions[topic] = (kind.__name__, callback)

    def create_publisher(self, kind, name, qos):
        self.published[name] = []
        return types.SimpleNamespace(publish=self.published[name].append)

    def create_service(self, kind, name, answer):
        self.services[name] = answer

    def get_logger(self):
        return types.SimpleNamespace(info=self.said.append, error=self.said.append)

    def destroy_node(self):
        return None


def image2(encoding, pixels, t_ns):
    stamp = types.SimpleNamespace(sec=t_ns // 10**9, nanosec=t_ns % 10**9)
    return types.SimpleNamespace(
        header=types.SimpleNamespace(stamp=stamp, frame_id="camera"), encoding=encoding, height=pixels.shape[0],
        width=pixels.shape[1], step=pixels.strides[0], is_bigendian=0, data=bytearray(pixels.tobytes()),
    )  # fmt: skip


def test_the_ros_2_node_maps_what_is_played_to_a_stand_in(frames, tmp_path, monkeypatch):
    write_rig(tmp_path / "rig.toml", RIG)
    stand_in = Ros2StandIn({
        "cameras": ["/camera/image"], "depth": "/camera/depth", "rig": str(tmp_path / "rig.toml"),
        "map_file": str(tmp_path / "map.lode"),
    })  # fmt: skip
    stand_in.install(monkeypatch)
    ros2 = importlib.import_module("lodelight.ros.ros2")
    from lodelight.ros.wiring import Wiring

    node = ros2.Ros2()
    wiring = Wiring(node, node.parameters())
    assert set(stand_in.published) == set(PUBLISHED)
    assert {topic: kind for topic, (kind, _) in stand_in.subscriptions.items()} == {
        "/camera/image": "Image", "/camera/depth": "Image",
    }  # fmt: skip
    for f in frames:
        stand_in.subscriptions["/camera/image"][1](image2("mono8", f.images[0], f.t_ns))
        stand_in.subscriptions["/camera/depth"][1](image2("32FC1", f.depth, f.t_ns))
        deadline = time.monotonic() + 30
        while wiring.core._came_s and time.monotonic() < deadline:
            time.sleep(0.005)
    answer = Fields()
    stand_in.services["~/save_map"](Fields(), answer)
    assert answer.success, answer.message
    stand_in.services["~/localize_only"](Fields(data=True), answer)
    assert answer.message == "the map is not written to any more"
    wiring.close()
    odom = stand_in.published["odom"]
    t_ns = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in odom]
    assert t_ns == [f.t_ns for f in frames]
    found = [
        SE3.from_quat_xyzw(
            np.array([m.pose.pose.position.x, m.pose.pose.position.y, m.pose.pose.position.z]),
            np.array([getattr(m.pose.pose.orientation, a) for a in "xyzw"]),
        )
        for m in odom
    ]
    assert off_truth_m(t_ns, found).max() < 0.01
    assert len(stand_in.published["/tf"]) == len(frames)
    assert stand_in.published["cloud"][0].width > 300
    assert check_map(tmp_path / "map.lode") == []


def test_what_a_node_cannot_do_is_said(tmp_path, monkeypatch):
    from lodelight.errors import ConfigError, LodelightError

    for parameters, said in (
        (Parameters(), "gives a map no scale"),
        (Parameters(cameras=("a", "b", "c")), "names 3 topics"),
        (Parameters(depth="d", imu="i"), "needs a rig file"),
        (Parameters(depth="d", body_in_base=(1.0,)), "body_in_base"),
    ):
        with pytest.raises(ConfigError, match=said):
            parameters.check()
    with pytest.raises(ConfigError, match="needs a map"):
        NodeCore(RIG, NodeConfig(mode="localize"), print)
    core = NodeCore(RIG, NodeConfig(), print)
    with pytest.raises(LodelightError, match="map_file is not given"):
        core.save_map()
    core.close()
