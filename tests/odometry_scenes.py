"""A body that flies through a cloud of points with a camera and an IMU: tracks and samples with known truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from lodelight.features.klt import Flow, Tracks
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.geometry.two_view import fit_two_view, turn_between
from lodelight.io.stamps import NS_PER_S
from lodelight.messages import Frame, Imu
from lodelight.rig import CameraSpec, ImuSpec, Rig
from lodelight.sim.imu import read_out
from lodelight.sim.motion import Motion
from lodelight.trajectory import Trajectory
from lodelight.types import Array

CAMERA = Camera.create("radtan", 752, 480, (458.0, 457.0, 367.0, 248.0), (-0.28, 0.074, 2e-4, 1.8e-5))
# The camera looks along the body's x axis, like a robot's.
T_BODY_CAM = SE3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.05, 0.02, -0.03]))
T_BODY_RIGHT = SE3(T_BODY_CAM.R, T_BODY_CAM.t + np.array([0.0, -0.11, 0.0]))
START_NS = 1_000_000_000_000


def rig(cameras: int = 1, imu: ImuSpec | None = None) -> Rig:
    specs = (CameraSpec("cam0", CAMERA, T_BODY_CAM, 20.0), CameraSpec("cam1", CAMERA, T_BODY_RIGHT, 20.0))
    return Rig(specs[:cameras], imu=imu or ImuSpec())


def flight(duration_s: float, seed: int = 0, rest_s: float = 0.0, speed: float = 1.0) -> Motion:
    """A smooth random flight of about `speed` m/s through a room, after standing still for rest_s."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, duration_s + 0.5, 0.05)
    go = np.clip((t - rest_s) / 1.0, 0.0, 1.0)
    go = go * go * (3 - 2 * go) if rest_s else np.ones_like(t)
    along = np.cumsum(go) * 0.05
    xyz, angle = np.zeros((len(t), 3)), np.zeros((len(t), 3))
    for axis, size in enumerate((1.6, 1.6, 0.5)):
        for frequency in (0.12, 0.31, 0.7):
            phase = rng.uniform(0, 2 * np.pi)
            xyz[:, axis] += speed * size * 0.35 / (1 + frequency * 2) * np.sin(2 * np.pi * frequency * along + phase)
    for axis, size in enumerate((0.15, 0.15, 0.8)):
        for frequency in (0.1, 0.35):
            phase = rng.uniform(0, 2 * np.pi)
            angle[:, axis] += size * 0.5 * np.sin(2 * np.pi * frequency * along + phase)
    poses = [SE3.exp(np.array([0, 0, a[2], 0, 0, 0])) @ SE3.exp(np.array([a[0], a[1], 0, *np.zeros(3)])) for a in angle]
    poses = [SE3(T.R, p + np.array([0.0, 0.0, 1.5])) for T, p in zip(poses, xyz, strict=True)]
    t_ns = START_NS + np.round(t * NS_PER_S).astype(np.int64)
    return Motion.fit(Trajectory.from_poses(t_ns.tolist(), poses), knot_s=0.1)


@dataclass(eq=False)
class Points:
    """Stands where the tracker stands: tracks of points on the walls of a room, that leave their points step by step.

    sigma_px : noise of a step, and of what the second camera adds; lost : share of tracks that end at every frame
    """

    motion: Motion
    rig: Rig
    seed: int = 0
    sigma_px: float = 0.1
    wanted: int = 150
    lost: float = 0.02
    outliers: float = 0.0
    room: tuple[float, float, float] = (5.0, 5.0, 3.0)
    flow: Flow = field(default_factory=lambda: Flow(np.eye(3)))

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)
        self.xyz = np.zeros((0, 3))
        self.ids = np.zeros(0, np.int64)
        self.age = np.zeros(0, np.int32)
        self.off = np.zeros((0, 2))
        self.wander_px2 = 0.0
        self.next_id = 0
        self.tracks: Tracks | None = None

    def _ahead(self, T_world_body: SE3, camera: int) -> tuple[Array, Array]:
        spec = self.rig.cameras[camera]
        return spec.camera.project((T_world_body @ spec.T_body_cam).inverse() @ self.xyz)

    def process(self, frame: Frame, R_now_last: Array | None = None, sigma_rotation: float = 0.03) -> Tracks:
        T = self.motion.at_ns(np.array([frame.t_ns])).poses()[0]
        if len(self.ids):
            _, seen = self._ahead(T, 0)
            keep = seen & (self.rng.random(len(seen)) > self.lost)
            self._keep(keep)
            self.age = self.age + np.int32(1)
            self.off = self.off + self.sigma_px * self.rng.standard_normal(self.off.shape)
        self.wander_px2 += self.sigma_px**2
        self._fill(T)
        px, _ = self._ahead(T, 0)
        px = px + self.off
        wrong = self.rng.random(len(px)) < self.outliers
        px[wrong] += self.rng.uniform(-30, 30, (wrong.sum(), 2))
        ray, _ = self.rig.cameras[0].camera.unproject(px)
        right = np.full(px.shape, np.nan, np.float32)
        if len(self.rig.cameras) > 1:
            there, seen = self._ahead(T, 1)
            there = there + self.off + self.sigma_px * self.rng.standard_normal(px.shape)
            right[seen] = there[seen]
        none = np.zeros(len(px))
        noise = (np.full(len(px), self.sigma_px), np.full(len(px), self.sigma_px), np.full(len(px), self.wander_px2))
        now = Tracks(frame.t_ns, self.ids, self.age, px.astype(np.float32), ray, right, none, none, *noise)
        if self.tracks is not None:
            self._compare(self.tracks, now)
        self.tracks = now
        return now

    def _compare(self, old: Tracks, now: Tracks) -> None:
        _, a, b = np.intersect1d(old.id, now.id, return_indices=True)
        R = turn_between(old.ray[a], now.ray[b])
        R, _, right, parallax = fit_two_view(old.ray[a], now.ray[b], R, 0.01, 1e-3, 3.0, 1)
        moved = float(np.median(np.linalg.norm(now.px[b] - old.px[a], axis=1))) if len(a) else 0.0
        self.flow = Flow(R, parallax, moved, len(old), len(a), int((~right).sum()))

    def _fill(self, T: SE3) -> None:
        n = self.wanted - len(self.ids)
        if n <= 0:
            return
        spec = self.rig.cameras[0]
        ray, _ = spec.camera.unproject(self.rng.uniform([5, 5], [746, 474], (n, 2)))
        T_world_cam = T @ spec.T_body_cam
        d = ray @ T_world_cam.R.T
        size = np.array(self.room)
        with np.errstate(divide="ignore"):
            away = np.where(d > 0, (size - T_world_cam.t) / d, (-size - T_world_cam.t) / d).min(axis=1)
        away *= self.rng.uniform(0.5, 1.0, n)  # furniture
        self.xyz = np.vstack([self.xyz, T_world_cam.t + away[:, None] * d])
        self.ids = np.concatenate([self.ids, np.arange(self.next_id, self.next_id + n)])
        self.age = np.concatenate([self.age, np.zeros(n, np.int32)])
        self.off = np.vstack([self.off, np.zeros((n, 2))])
        self.next_id += n

    def drop(self, ids: Array) -> None:
        self._keep(~np.isin(self.ids, ids))

    def _keep(self, keep: Array) -> None:
        self.xyz, self.ids, self.age, self.off = (a[keep] for a in (self.xyz, self.ids, self.age, self.off))

    def reset(self) -> None:
        self.drop(self.ids)
        self.tracks, self.flow = None, Flow(np.eye(3))


def messages(
    motion: Motion, spec: ImuSpec, seed: int, rate_hz: float = 20.0, turn_on: tuple[float, float] = (0.02, 0.05)
) -> Iterator[Imu | Frame]:
    """Samples and (empty) frames in the order of their stamps."""
    series = read_out(motion, spec, np.random.default_rng(seed), turn_on)
    step = round(spec.rate_hz / rate_hz)
    for i in range(len(series.t_ns)):
        yield Imu(int(series.t_ns[i]), series.gyro[i], series.accel[i])
        if i % step == 0:
            yield Frame(int(series.t_ns[i]), ())
