"""A frame of the window: its state, what was seen in it, and the IMU since the frame before."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from lodelight.estimation.factors.inertial import MEASUREMENT
from lodelight.estimation.window_problem import Sightings
from lodelight.estimation.window_types import Observations, TagView
from lodelight.geometry.se3 import SE3
from lodelight.imu.preintegration import NavState, Preintegration
from lodelight.imu.samples import ImuSamples
from lodelight.rig import CameraSpec
from lodelight.types import AnyArray, Array, Bools, Ints

COLUMNS = ("track", "camera", "px", "sigma_px", "inv_depth", "sigma_inv_depth", "shift_s", "rays", "wander_px2")

LEAST_STEP_PX2 = 0.02**2  # of a track from one frame to another
# Correlation of a track's errors in the second camera, frames of a window apart (docs/inertial.md): as much of each
# counts once, however often it is seen.
ALIKE = 0.5


@dataclass(eq=False)
class Seen:
    """Observations of one frame as columns of equal length, with the unit rays of their pixels."""

    track: AnyArray
    camera: Ints
    px: Array
    sigma_px: Array
    inv_depth: Array
    sigma_inv_depth: Array
    shift_s: Array
    rays: Array
    wander_px2: Array
    rejected: Bools

    @staticmethod
    def of(observations: Observations, cameras: Sequence[CameraSpec]) -> Seen:
        """Rows that are no numbers or that the lens has no ray for are left out."""
        o, n = observations, len(observations.track)
        px = np.ascontiguousarray(o.px, np.float64).reshape(n, 2)
        camera = np.asarray(o.camera, np.int32)
        rays, good = np.zeros((n, 3)), np.zeros(n, bool)
        for c, spec in enumerate(cameras):
            mine = np.flatnonzero(camera == c)
            if len(mine):
                rays[mine], good[mine] = spec.camera.unproject(px[mine])
        sigma = np.asarray(o.sigma_px, np.float64)
        zero = np.zeros(n)
        depth = zero if o.inv_depth is None else np.nan_to_num(np.asarray(o.inv_depth, np.float64), posinf=0.0)
        depth_sigma = zero if o.sigma_inv_depth is None else np.asarray(o.sigma_inv_depth, np.float64)
        depth = np.where((depth > 0.0) & (depth_sigma > 0.0) & np.isfinite(depth_sigma), depth, 0.0)
        shift = zero if o.dt_s is None else np.asarray(o.dt_s, np.float64)
        good &= np.isfinite(px).all(axis=1) & (sigma > 0.0) & np.isfinite(sigma) & np.isfinite(shift)
        track = np.asarray(o.track, np.int64)
        depth_sigma = np.where(depth > 0.0, depth_sigma, 1.0)
        wander = np.full(n, np.nan) if o.wander_px2 is None else np.asarray(o.wander_px2, np.float64)
        every = Seen(track, camera, px, sigma, depth, depth_sigma, shift, rays, wander, np.zeros(n, bool))
        return every.kept(good)

    def __len__(self) -> int:
        return len(self.track)

    def kept(self, mask: Bools) -> Seen:
        return Seen(*(getattr(self, name)[mask] for name in (*COLUMNS, "rejected")))


@dataclass(eq=False)
class SeenTag:
    """use : it counts; agrees False : it contradicted the window"""

    view: TagView
    use: bool = True
    agrees: bool = True
    tested: bool = False
    chi2: float = 0.0


@dataclass(eq=False)
class WindowFrame:
    """x (21,) the state as the kernels have it; lin likewise, where the prior holds it; omega rad/s, body."""

    key: int
    t_ns: int
    x: Array
    keyframe: bool
    seen: Seen
    tags: list[SeenTag]
    imu: Preintegration | None = None
    omega: Array = field(default_factory=lambda: np.zeros(3))
    still_sigma: float = 0.0
    lin: Array | None = None
    measured: Array = field(default_factory=lambda: np.zeros(MEASUREMENT))
    whiten: Array = field(default_factory=lambda: np.zeros((15, 15)))

    @property
    def state(self) -> NavState:
        x = self.x.copy()
        return NavState(self.t_ns, SE3(x[:9].reshape(3, 3), x[9:12]), x[12:15], x[15:18], x[18:])

    def carry(self, imu: Preintegration) -> None:
        """The IMU since the frame before, prepared for the kernels."""
        self.imu = imu
        self.omega = imu.samples.gyro[-1] - imu.bias_gyro
        self.measured, self.whiten = prepared(imu)

    def follow(self, x_before: Array) -> None:
        """Integrate anew where the biases have left what was integrated with."""
        if self.imu is not None and self.imu.moved(x_before[15:18], x_before[18:21]):
            self.carry(self.imu.repropagated(x_before[15:18].copy(), x_before[18:21].copy()))


def prepared(imu: Preintegration) -> tuple[Array, Array]:
    """measured (76,) and whiten (15, 15), the inverse of the covariance's factor, as the kernels have them."""
    measured = np.concatenate(
        [imu.dR.ravel(), imu.dp, imu.dv, imu.jacobian.ravel(), imu.bias_gyro, imu.bias_accel, [imu.dt_s]]
    )
    deviation = np.sqrt(np.diag(imu.covariance))  # scaled first: its units run over ten powers of ten
    factor = np.linalg.cholesky(imu.covariance / np.outer(deviation, deviation))
    return measured, np.tril(np.linalg.inv(factor)) / deviation


def row_of(state: NavState) -> Array:
    T = state.T_world_body
    return np.concatenate([T.R.ravel(), T.t, state.v_world, state.bias_gyro, state.bias_accel]).astype(np.float64)


def pose_row(T: SE3) -> Array:
    return np.concatenate([T.R.ravel(), T.t]).astype(np.float64)


def pose_of(row: Array) -> SE3:
    return SE3(row[:9].reshape(3, 3).copy(), row[9:12].copy())


def moved_row(row: Array, R: Array, t: Array) -> Array:
    """A state or a pose in another frame: T_new_old = (R, t)."""
    out: Array = row.copy()
    out[:9] = (R @ row[:9].reshape(3, 3)).ravel()
    out[9:12] = R @ row[9:12] + t
    if len(row) > 12:
        out[12:15] = R @ row[12:15]
    return out


def gathered(frames: Sequence[WindowFrame]) -> tuple[Sightings, Ints, Ints]:
    """All sightings sorted by landmark; for every row its frame and its row in that frame.

    A track is a landmark where it has two sightings or a depth.
    """
    sizes = [len(f.seen) for f in frames]
    frame = np.repeat(np.arange(len(frames), dtype=np.int32), sizes)
    row = np.concatenate([np.arange(size, dtype=np.int32) for size in sizes])
    columns = {name: np.concatenate([getattr(f.seen, name) for f in frames]) for name in COLUMNS}
    order = np.lexsort((columns["camera"], frame, columns["track"]))
    track = columns["track"][order]
    first = np.concatenate([[True], track[1:] != track[:-1]]) if len(track) else np.zeros(0, bool)
    starts = np.flatnonzero(first)
    count = np.diff(np.append(starts, len(track)))
    depth = columns["inv_depth"][order] > 0.0
    enough = (count > 1) | depth[starts]
    order = order[np.repeat(enough, count)]
    start = np.concatenate([[0], np.cumsum(count[enough])]).astype(np.int32)
    sorted_columns = {name: np.ascontiguousarray(columns[name][order]) for name in COLUMNS[1:]}
    wander = sorted_columns.pop("wander_px2")
    before = _before(start, frame[order], sorted_columns["camera"], wander)
    followed = (before >= 0) & (sorted_columns["camera"] == 0)
    step2 = wander[followed] - wander[before[followed]]
    sorted_columns["sigma_px"][followed] = np.sqrt(np.maximum(step2, LEAST_STEP_PX2))
    across = (before >= 0) & ~followed
    times = np.repeat(np.add.reduceat(across, start[:-1]) if len(across) else np.zeros(0, int), np.diff(start))
    sorted_columns["sigma_px"][across] *= np.sqrt(1.0 + ALIKE * (times[across] - 1))
    return (
        Sightings(track=track[starts[enough]], start=start, frame=frame[order], before=before, **sorted_columns),
        frame[order],
        row[order],
    )


def _before(start: Ints, frame: Ints, camera: Ints, wander: Array) -> Ints:
    """(N,) the row that each is held against, -1 = none: of camera 0 the last one of its track there, of another the
    one of camera 0 in the same frame, as its patch was looked for there."""
    n = len(frame)
    first = np.repeat(start[:-1], np.diff(start))
    own = np.where(camera == 0, np.arange(n), -1)
    last = np.concatenate([[-1], np.maximum.accumulate(own)[:-1]]) if n else own
    good = (last >= first) & np.isfinite(wander) & ((camera == 0) | (frame == frame[last]))
    return np.where(good, last, -1).astype(np.int32)


def joined_imu(frame: WindowFrame) -> ImuSamples:
    assert frame.imu is not None
    return frame.imu.samples
