"""A body with cameras and an IMU in a room of point features and tags: exact truth, simulated noise, no images."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lodelight.estimation.window import Observations, StartSigma, Tag, TagView, Window, WindowConfig
from lodelight.geometry.se3 import SE3
from lodelight.imu.preintegration import NavState
from lodelight.imu.samples import ImuSamples
from lodelight.rig import ImuSpec, Rig
from lodelight.sim.gaits import GAITS, generate
from lodelight.sim.imu import ImuSeries, read_out
from lodelight.sim.motion import Motion
from lodelight.sim.rigs import standard
from lodelight.types import Array

ROOM = np.array([12.0, 9.0, 3.0])
FLOOR_PLAN = np.array([[3.0, 2.5], [9.0, 2.5], [9.0, 6.5], [3.0, 6.5]])
SIZE_M = 0.2
CORNERS = 0.5 * SIZE_M * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class Scene:
    """points (N, 3) m; tags : T_world_tag on the walls, their normals into the room"""

    rig: Rig
    motion: Motion
    imu: ImuSeries
    points: Array
    tags: dict[str, SE3]
    frame_ns: Array
    rng: np.random.Generator
    sigma_px: float = 1.0
    sigma_tag_px: float = 0.5
    max_tracks: int = 120
    track_of: dict[int, int] = field(default_factory=dict)

    @property
    def samples(self) -> ImuSamples:
        return ImuSamples(self.imu.t_ns, self.imu.gyro, self.imu.accel)

    def truth(self, t_ns: int) -> NavState:
        s = self.motion.at_ns(np.array([t_ns]))
        t = (t_ns - self.imu.t_ns[0]) * 1e-9
        bias = [
            np.array([np.interp(t, (self.imu.t_ns - self.imu.t_ns[0]) * 1e-9, b[:, a]) for a in range(3)])
            for b in (self.imu.bias_gyro, self.imu.bias_accel)
        ]
        return NavState(int(t_ns), SE3(s.R_world_body[0], s.xyz[0]), s.v_world[0], *bias)


def scene(
    seed: int,
    gait: str = "walk",
    duration_s: float = 20.0,
    rate_hz: float = 20.0,
    cameras: int = 1,
    imu: str = "euroc",
    points: int = 700,
    tags: int = 0,
    standstill_s: float = 0.0,
    begin_s: float = 2.5,
    lens: str = "radtan",
    **options: float,
) -> Scene:
    rng = np.random.default_rng(seed)
    rig = standard(imu=imu, lens=lens).with_cameras(cameras)
    motion = generate(GAITS[gait], FLOOR_PLAN, begin_s + duration_s + 1.0, 1_000_000_000, rng, standstill_s)
    spec = rig.imu
    assert spec is not None
    series = read_out(motion, spec, rng, (0.02, 0.05) if imu == "euroc" else (0.0, 0.0))
    step = round(1e9 / rate_hz)
    frame_ns = motion.start_ns + round(begin_s * 1e9) + step * np.arange(int(duration_s * rate_hz)) + 1_234_567
    wall = rng.integers(0, 6, points)
    xyz = rng.uniform(0.0, 1.0, (points, 3)) * ROOM
    xyz[np.arange(points), wall // 2] = (wall % 2) * ROOM[wall // 2]
    inside = rng.random(points) < 0.2  # furniture: pillars in the middle
    xyz[inside] = np.array([5.2, 4.0, 0.0]) + rng.uniform(0.0, 1.0, (int(inside.sum()), 3)) * [1.6, 1.0, 2.5]
    return Scene(rig, motion, series, xyz, wall_tags(tags), frame_ns, rng, **options)


def wall_tags(count: int) -> dict[str, SE3]:
    """Evenly along the walls, upright, 1.5 m high, their normals into the room."""
    out: dict[str, SE3] = {}
    corners = np.array([[0.0, 0.0], [ROOM[0], 0.0], ROOM[:2], [0.0, ROOM[1]], [0.0, 0.0]])
    length = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    for along in length.sum() * (np.arange(count) + 0.35) / max(count, 1):
        wall = int(np.searchsorted(np.cumsum(length), along))
        direction = (corners[wall + 1] - corners[wall]) / length[wall]
        at = corners[wall] + (along - length[:wall].sum()) * direction
        y, z = np.array([0.0, 0.0, 1.0]), np.array([-direction[1], direction[0], 0.0])
        out[f"T{len(out)}"] = SE3(np.column_stack([np.cross(y, z), y, z]), np.array([*at, 1.5]))
    return out


def look(made: Scene, t_ns: int) -> tuple[Observations, list[TagView]]:
    """What the cameras see at t_ns. A point that leaves the view of camera 0 comes back as another track."""
    body = made.truth(t_ns).T_world_body
    views = [project(made, body, c, made.points) for c in range(len(made.rig.cameras))]
    seen0 = views[0][1]
    for point in [p for p in made.track_of if not seen0[p]]:
        del made.track_of[point]
    fresh = [p for p in np.flatnonzero(seen0) if p not in made.track_of]
    made.rng.shuffle(fresh)
    last = getattr(made, "_next", 0)
    for point in fresh[: max(0, int(made.max_tracks) - len(made.track_of))]:
        made.track_of[int(point)] = last
        last += 1
    object.__setattr__(made, "_next", last)
    track, camera, px = [], [], []
    for c, (pixels, seen) in enumerate(views):
        for point, number in made.track_of.items():
            if seen[point]:
                track.append(number)
                camera.append(c)
                px.append(pixels[point] + made.sigma_px * made.rng.standard_normal(2))
    observations = Observations(
        np.array(track, np.int64), np.array(camera, np.int32), np.array(px).reshape(-1, 2),
        np.full(len(track), made.sigma_px),
    )  # fmt: skip
    tags = []
    for name, T in made.tags.items():
        pixels, seen = project(made, body, 0, T @ CORNERS)
        away = body.t - T.t
        if seen.all() and np.linalg.norm(away) < 4.0 and away @ T.R[:, 2] > 0.35 * np.linalg.norm(away):
            noisy = pixels + made.sigma_tag_px * made.rng.standard_normal((4, 2))
            T_world_cam = body @ made.rig.cameras[0].T_body_cam
            guess = (T_world_cam.inverse() @ T).perturbed(made.rng.normal(size=6) * 0.05)
            tags.append(TagView(name, 0, noisy, np.full(4, made.sigma_tag_px), guess))
    return observations, tags


def project(made: Scene, body: SE3, c: int, X: Array) -> tuple[Array, Array]:
    spec = made.rig.cameras[c]
    X_cam = (body @ spec.T_body_cam).inverse() @ X
    px, seen = spec.camera.project(X_cam)
    return px, seen & (X_cam[:, 2] > 0.3) & (np.linalg.norm(X_cam, axis=1) < 12.0)


def perturbed(state: NavState, sigma: StartSigma, rng: np.random.Generator) -> NavState:
    """A start that is off by its sigmas."""
    n = rng.standard_normal((5, 3))
    R = state.T_world_body.R
    turn = R.T @ (np.array([sigma.tilt_rad, sigma.tilt_rad, sigma.yaw_rad]) * n[0])
    T = state.T_world_body.perturbed(np.concatenate([turn, sigma.position_m * n[1]]))
    return NavState(
        state.t_ns, T, state.v_world + sigma.velocity_m_s * n[2], state.bias_gyro + sigma.bias_gyro * n[3],
        state.bias_accel + sigma.bias_accel * n[4],
    )  # fmt: skip


def state_error(estimate: NavState, truth: NavState) -> Array:
    """d (15,) with truth = estimate perturbed by d."""
    turn = SE3(estimate.T_world_body.R.T @ truth.T_world_body.R, np.zeros(3)).log()[:3]
    return np.concatenate([
        turn, truth.T_world_body.t - estimate.T_world_body.t, truth.v_world - estimate.v_world,
        truth.bias_gyro - estimate.bias_gyro, truth.bias_accel - estimate.bias_accel,
    ])  # fmt: skip


# What an initialization in motion gives
START = StartSigma(tilt_rad=0.01, velocity_m_s=0.05, bias_gyro=0.003, bias_accel=0.05)


@dataclass(eq=False)
class Flight:
    """errors (N, 15), covariances (N, 15, 15) of the newest state after every solve; ms of processor time"""

    window: Window
    errors: Array
    covariances: Array
    ms: Array
    keyframes: int


def fly(
    made: Scene,
    config: WindowConfig | None = None,
    tags: str = "none",
    every: int = 1,
    start: StartSigma = START,
    covariance_every: int = 10,
) -> Flight:
    """The whole scene through a window. tags : "none", "known", "estimated"; keyframes after 0.2 m or 10 degrees."""
    import time

    spec = made.rig.imu
    assert isinstance(spec, ImuSpec)
    window = Window(made.rig, config or WindowConfig(), spec)
    for name, T in made.tags.items():
        if tags != "none":
            window.declare(Tag(name, CORNERS, T if tags == "known" else None))
    samples = made.samples
    errors, covariances, ms = [], [], []
    key, keyframes = SE3.identity(), 0
    for i, t_ns in enumerate(made.frame_ns[::every]):
        observations, views = look(made, int(t_ns))
        views = views if tags != "none" else []
        truth = made.truth(int(t_ns))
        began = time.thread_time()
        if i == 0:
            window.start(perturbed(truth, start, made.rng), start, observations, views)
            key = truth.T_world_body
            continue
        T = truth.T_world_body
        moved = np.linalg.norm(T.t - key.t) > 0.2 or SE3(key.R.T @ T.R, np.zeros(3)).angle > np.radians(10.0)
        window.add_frame(int(t_ns), samples_near(samples, window.newest.t_ns, int(t_ns)), observations, views, moved)
        if moved:
            key, keyframes = T, keyframes + 1
        solution = window.solve()
        ms.append(1e3 * (time.thread_time() - began))
        assert solution.ok
        if i % covariance_every == 0:
            errors.append(state_error(window.newest, truth))
            covariances.append(window.covariance())
    return Flight(window, np.array(errors), np.array(covariances), np.array(ms), keyframes)


def samples_near(samples: ImuSamples, start_ns: int, end_ns: int) -> ImuSamples:
    """As a stream would hold them: from just before to just after."""
    lo = max(0, int(np.searchsorted(samples.t_ns, start_ns, "right")) - 1)
    hi = int(np.searchsorted(samples.t_ns, end_ns, "left")) + 1
    return ImuSamples(samples.t_ns[lo:hi], samples.gyro[lo:hi], samples.accel[lo:hi])


def nees(errors: Array, covariances: Array, part: slice) -> Array:
    """Per degree of freedom, of every state."""
    d = errors[:, part]
    squared = np.einsum("ni,ni->n", d, np.linalg.solve(covariances[:, part, part], d[:, :, None])[:, :, 0])
    out: Array = squared / d.shape[1]
    return out
