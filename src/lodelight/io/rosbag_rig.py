"""The rig of a bag: its own `rig.toml` where this project wrote it, else CameraInfo and the static transforms."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from lodelight.errors import CalibrationError
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.io.calibrations import matrix_camera
from lodelight.io.recording import Skipped
from lodelight.io.rig_toml import parse_rig
from lodelight.io.rosbag import Bag
from lodelight.io.rosbag_topics import RIG_TOPIC, Topics, camera_infos, info_of
from lodelight.io.schema import Section
from lodelight.rig import CameraSpec, DepthSpec, ImuSpec, Rig

LOOSE_TF = 300  # messages of /tf that are looked at for transforms that stay as they are


def written_rig(bag: Bag) -> Rig | None:
    """The rig a bag carries as text."""
    if bag.types.get(RIG_TOPIC) != "std_msgs/String":
        return None
    message = bag.first(RIG_TOPIC)
    return None if message is None else parse_rig(message.data, f"{bag.path} {RIG_TOPIC}")


class Frames:
    """The rigid part of a transform tree: from /tf_static, and what stays the same in the beginning of /tf."""

    def __init__(self, bag: Bag) -> None:
        self._parent: dict[str, tuple[str, SE3]] = {}
        moving: set[str] = set()
        for topic, limit in (("/tf", LOOSE_TF), ("/tf_static", None)):
            if not bag.types.get(topic, "").endswith("/TFMessage") and bag.types.get(topic) != "tf/tfMessage":
                continue
            for i, (_, _, message) in enumerate(bag.messages((topic,))):
                if limit is not None and i >= limit:
                    break
                for transform in message.transforms:
                    child, edge = _edge(transform)
                    known = self._parent.get(child)
                    if topic == "/tf" and known is not None and not _same(known, edge):
                        moving.add(child)
                    self._parent[child] = edge
        for child in moving:
            self._parent.pop(child, None)

    def between(self, a: str, b: str) -> SE3 | None:
        """T_a_b, None where nothing rigid joins the frames."""
        root_a, T_root_a = self._to_root(_plain(a))
        root_b, T_root_b = self._to_root(_plain(b))
        return T_root_a.inverse() @ T_root_b if root_a == root_b else None

    def _to_root(self, frame: str) -> tuple[str, SE3]:
        T, seen = SE3.identity(), {frame}
        while frame in self._parent:
            frame, T_parent = self._parent[frame]
            T = T_parent @ T
            if frame in seen:
                break
            seen.add(frame)
        return frame, T


def rig_of(bag: Bag, topics: Topics) -> tuple[Rig, Topics, tuple[Skipped, ...]]:
    """From CameraInfo and static transforms; the topics it serves; what was left out, as nothing says where it sits.

    The body is the IMU where the transforms join it to camera 0, else camera 0.
    Raises CalibrationError where camera 0 has no usable CameraInfo.
    """
    place = _Places(bag, topics)
    cameras: list[CameraSpec] = []
    kept: list[str] = []
    for topic in topics.cameras:
        info = place.info(topic)
        if info is None and not cameras:
            raise CalibrationError(f"{bag.path} has no CameraInfo for {topic}; give --rig FILE")
        T_body_cam = place.of_camera(topic)
        if info is None or T_body_cam is None:
            place.leave_out(topic, "it has no CameraInfo" if info is None else "")
            continue
        cameras.append(CameraSpec(f"cam{len(cameras)}", _lens(bag, topic, info), T_body_cam))
        kept.append(topic)
    depth = _depth(place, topics.depth, cameras[0]) if topics.depth else None
    lights = None
    if topics.lights is not None:
        info, T_body_lights = place.info(topics.lights), place.of(topics.lights)
        if info is not None and T_body_lights is not None:
            lights = CameraSpec("light0", _lens(bag, topics.lights, info), T_body_lights)
        else:
            place.leave_out(topics.lights, "it has no CameraInfo" if info is None else "")
    rig = Rig(tuple(cameras), depth=depth, imu=ImuSpec(rate_hz=0.0) if place.imu else None, lights=lights)
    topics = replace(
        topics,
        cameras=tuple(kept),
        depth=topics.depth if depth else None,
        imu=place.imu,
        lights=topics.lights if lights else None,
    )
    return rig, topics, tuple(place.left_out)


class _Places:
    """Where the sensors of a bag sit on its body, and what is told of those of which nothing says it."""

    def __init__(self, bag: Bag, topics: Topics) -> None:
        self.bag = bag
        self.left_out: list[Skipped] = []
        self._frames, self._infos = Frames(bag), camera_infos(bag)
        self._first = topics.cameras[0]
        self._frame_of: dict[str, str] = {
            topic: bag.first(topic).header.frame_id
            for topic in (*topics.cameras, topics.depth, topics.imu, topics.lights)
            if topic is not None
        }
        self.cam0 = self._body = self._frame_of[self._first]
        self.imu: str | None = None
        if topics.imu is not None:
            if self._frames.between(self._frame_of[topics.imu], self.cam0) is not None:
                self._body, self.imu = self._frame_of[topics.imu], topics.imu
            else:
                self.leave_out(topics.imu)

    def frame(self, topic: str) -> str:
        return self._frame_of[topic]

    def info(self, topic: str) -> Any | None:
        return info_of(self.bag, topic, self._infos, self._frame_of[topic])

    def of(self, topic: str) -> SE3 | None:
        """T_body_sensor, None where nothing says it."""
        return self._frames.between(self._body, self._frame_of[topic])

    def of_camera(self, topic: str) -> SE3 | None:
        """As `of`; of a pair that transforms do not hold apart (drivers may stamp both with one frame), by its P."""
        T_body_cam = self.of(topic)
        if topic == self._first or (T_body_cam is not None and self._frame_of[topic] != self.cam0):
            return T_body_cam
        T_cam0_cam = pair_by_projection(self.info(self._first), self.info(topic))
        T_body_cam0 = self.of(self._first)
        return None if T_cam0_cam is None or T_body_cam0 is None else T_body_cam0 @ T_cam0_cam

    def leave_out(self, topic: str, why: str = "") -> None:
        why = why or f"no static transform joins {self._frame_of[topic] or 'its frame'} to {self.cam0}"
        self.left_out.append(Skipped(None, f"{self.bag.path} {topic}", f"sensor is left out: {why}"))


def _depth(place: _Places, topic: str, cam0: CameraSpec) -> DepthSpec | None:
    """Registered where depth is in the frame of camera 0 and of its size, else with a lens and a place of its own."""
    info = place.info(topic)
    lens = cam0.camera if info is None else _lens(place.bag, topic, info)
    if place.frame(topic) == place.cam0 and (lens.width, lens.height) == (cam0.camera.width, cam0.camera.height):
        return DepthSpec(cam0.camera, cam0.T_body_cam)
    T_body_depth = place.of(topic)
    if info is None or T_body_depth is None:
        place.leave_out(topic, "it has no CameraInfo" if info is None else "")
        return None
    return DepthSpec(lens, T_body_depth, registered=False)


def _lens(bag: Bag, topic: str, info: Any) -> Camera:
    return lens_of_info(info, topic, str(bag.path))


def lens_of_info(info: Any, topic: str, source: str = "the") -> Camera:
    """The lens of a CameraInfo: of the rectified image where its topic says it is one.

    Raises CalibrationError, which names the source, where it is not calibrated or of a model not known here.
    """
    upper = hasattr(info, "K")  # ROS 1 writes K, D, P; ROS 2 k, d, p
    K, D, P = (getattr(info, name if upper else name.lower()) for name in "KDP")
    where = f"{source} CameraInfo of {topic}:"
    if not np.any(K):
        raise CalibrationError(f"{where} all zero: the camera was not calibrated; give --rig FILE")
    rectified = "rect" in topic.rsplit("/", 2)[-1] or "rect" in topic.rsplit("/", 2)[-2]
    table = {
        "image_width": int(info.width),
        "image_height": int(info.height),
        "distortion_model": info.distortion_model,
    }
    table |= {"K": np.asarray(K).tolist(), "D": np.asarray(D).tolist()}
    if rectified and np.any(P):
        table |= {"K": np.asarray(P).reshape(3, 4)[:, :3].ravel().tolist(), "D": []}
    if info.distortion_model == "double_sphere":  # this project's own name: ROS has none
        fx, _, cx, _, fy, cy = table["K"][:6]
        return Camera.create("double_sphere", info.width, info.height, (fx, fy, cx, cy), tuple(table["D"][:2]))
    if not table["distortion_model"]:
        table["distortion_model"] = "plumb_bob"
    return matrix_camera(Section(table, where))


def pair_by_projection(first: Any | None, other: Any | None) -> SE3 | None:
    """T_cam0_cam1 of a stereo pair from R and P, which is where ROS keeps it; None where they hold no baseline.

    p_rect = R p, and the rectified frames differ by P[3] / P[0] along x.
    """
    if first is None or other is None:
        return None
    upper = hasattr(first, "P")
    R0, R1 = (np.asarray(i.R if upper else i.r).reshape(3, 3) for i in (first, other))
    P0, P1 = (np.asarray(i.P if upper else i.p).reshape(3, 4) for i in (first, other))
    if P1[0, 0] <= 0 or P0[0, 0] <= 0 or P1[0, 3] == P0[0, 3]:
        return None
    shift = np.array([P1[0, 3] / P1[0, 0] - P0[0, 3] / P0[0, 0], 0.0, 0.0])
    if not (np.any(R0) and np.any(R1)):
        R0 = R1 = np.eye(3)
    return SE3.from_matrix(np.column_stack([R1.T @ R0, R1.T @ shift])).inverse()


def with_rates(rig: Rig, camera_hz: float, imu_hz: float) -> Rig:
    """The rates the stamps have, where nothing says them."""
    cameras = tuple(s if s.rate_hz > 0 or camera_hz <= 0 else replace(s, rate_hz=camera_hz) for s in rig.cameras)
    imu = rig.imu
    if imu is not None and imu.rate_hz <= 0:
        imu = replace(imu, rate_hz=imu_hz if imu_hz > 0 else ImuSpec.rate_hz)
    return replace(rig, cameras=cameras, imu=imu)


def _edge(transform: Any) -> tuple[str, tuple[str, SE3]]:
    t, q = transform.transform.translation, transform.transform.rotation
    T = SE3.from_quat_xyzw(np.array([t.x, t.y, t.z]), np.array([q.x, q.y, q.z, q.w]))
    return _plain(transform.child_frame_id), (_plain(transform.header.frame_id), T)


def _same(a: tuple[str, SE3], b: tuple[str, SE3]) -> bool:
    return a[0] == b[0] and bool(np.abs(a[1].matrix - b[1].matrix).max() < 1e-9)


def _plain(frame: str) -> str:
    return frame.lstrip("/")
