"""The window at one instant as plain arrays, and Levenberg-Marquardt on them.

Order of the unknowns: (v, bg, ba) of every frame, then (theta, p) of every frame, then the mountings of the cameras and
the time offset where they are estimated, then tags. Velocities and biases couple to their neighbours only; first in the
order they are eliminated at little cost, as rows of the factor that are mostly zero are skipped.

First-estimate Jacobians: a state that the prior knows is linearized for ever where the prior was made (`lin`); the
residuals are those of the current state (`x`). Without that, yaw would seem to be measured where it is not (C6).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from lodelight.estimation.marginalization import Key, Prior
from lodelight.estimation.window_elimination import eliminate_landmarks, marginal_covariance, step
from lodelight.estimation.window_poses import chart_difference
from lodelight.estimation.window_terms import state_terms, tag_terms
from lodelight.estimation.window_visual import visual_terms
from lodelight.types import AnyArray, Array, Bools, Ints

DAMPING_START, DAMPING_MAX = 1e-12, 1e4  # at first too little to be seen in the covariance
# A step that promises less, in all of the window's hundreds of directions together, is not worth its time: every frame
# goes on from where the last one ended. What a keyframe leaves behind is linearized once for all, and taken better care
# of.
CONVERGED_CHI2, SETTLED_CHI2 = 0.1, 0.01
# The quadratic of the prior is followed by the identity for its Jacobian, though the chart turns with the state: a step
# may end so much higher, in chi-square.
RISE_CHI2 = 0.05
NO_COVARIANCE = 1e-6  # on every diagonal: what no factor holds stays where it is


@dataclass(eq=False)
class Sightings:
    """Observations sorted by track, then frame, then camera. start (M + 1,) : rows of each landmark, track (M,)

    before (N,) : the row that one is held against, -1 = none; sigma_px (N,) is that of the difference
    """

    track: AnyArray
    start: Ints
    frame: Ints
    camera: Ints
    before: Ints
    px: Array
    sigma_px: Array
    inv_depth: Array
    sigma_inv_depth: Array
    shift_s: Array
    rays: Array

    def __len__(self) -> int:
        return len(self.frame)


@dataclass(eq=False)
class TagSightings:
    """Sightings of tags, S of them: tag (S,) rows of the problem's tags, corners_px (S, 4, 2), sigma_px (S, 4)."""

    tag: Ints
    frame: Ints
    camera: Ints
    corners_px: Array
    sigma_px: Array
    shift_s: Array
    use: Bools


@dataclass(eq=False)
class Unknowns:
    """frames (F, 21), mounts (C, 12), offset_s (1,), tags (T, 12), landmarks (M, 3)"""

    frames: Array
    mounts: Array
    offset_s: Array
    tags: Array
    landmarks: Array

    def empty(self) -> Unknowns:
        return Unknowns(*(np.empty_like(a) for a in self.arrays))

    @property
    def arrays(self) -> tuple[Array, Array, Array, Array, Array]:
        return self.frames, self.mounts, self.offset_s, self.tags, self.landmarks


@dataclass(eq=False)
class Linear:
    """Normal equations at one state."""

    H: Array
    g: Array
    V: Array
    g_landmark: Array
    W: Array
    chi2: Array
    tag_chi2: Array
    imu_chi2: float = 0.0
    cost: float = 0.0
    comparable: float = 0.0

    def take_costs(self, other: Linear) -> None:
        """Of a state so near that these equations hold there as well."""
        self.chi2, other.chi2 = other.chi2, self.chi2
        self.tag_chi2, other.tag_chi2 = other.tag_chi2, self.tag_chi2
        self.cost, self.imu_chi2 = other.cost, other.imu_chi2


@dataclass(frozen=True, eq=False)
class Belief:
    """What is known of one state beforehand, with a mean: information (d, d) in its chart, d = 15, 6 or 1."""

    mean: Array
    information: Array


@dataclass(eq=False)
class Problem:
    """keys_frame : ids of the frames, in the order of their rows; likewise keys_tag

    lin : where what the prior knows was linearized; the rows of all others follow the state
    frozen_frames, frozen_mounts, frozen_tags : which rows do not follow
    usual_inv_depth : 1/m, of points here, see the kernels
    first_estimates : Jacobians of what the prior knows are taken at lin, those of what leaves are; see the prior
    measured (F - 1, 76), whiten (F - 1, 15, 15) : IMU; use_imu (F - 1,); still_sigma (F,)
    """

    keys_frame: Sequence[int]
    keys_tag: Sequence[int]
    models: Ints
    params: Array
    motion: Array
    start: Unknowns
    lin: Unknowns
    frozen_frames: Bools
    frozen_mounts: bool
    frozen_offset: bool
    frozen_tags: Bools
    tag_estimated: Bools
    corners_tag: Array
    calibrate_mounts: bool
    calibrate_offset: bool
    sightings: Sightings
    base: Array
    usual_inv_depth: float
    active: Bools
    tag_sightings: TagSightings
    measured: Array
    whiten: Array
    use_imu: Bools
    still_sigma: Array
    still_sigma_m: float
    prior: Prior
    first_estimates: bool = False
    beliefs: Mapping[Key, Belief] = field(default_factory=dict)

    def __post_init__(self) -> None:
        F, C = len(self.start.frames), len(self.start.mounts)
        self.pose_at = 9 * F
        self.mount_at = 15 * F if self.calibrate_mounts else -1
        at = 15 * F + (6 * C if self.calibrate_mounts else 0)
        self.offset_at = at if self.calibrate_offset else -1
        at += self.calibrate_offset
        self.extra = at - 15 * F
        self.tag_column = np.full(len(self.tag_estimated), -1, np.int32)
        count = int(self.tag_estimated.sum())
        self.tag_column[self.tag_estimated] = at + 6 * np.arange(count)
        self.n = at + 6 * count
        self._row = {("frame", key): i for i, key in enumerate(self.keys_frame)}
        self._row |= {("tag", key): i for i, key in enumerate(self.keys_tag)}
        self.prior_at = (
            np.concatenate([self.columns(key) for key in self.prior.keys]) if self.prior.keys else np.zeros(0, np.int32)
        )
        self.state = self.start
        self.linear = self._allocated()
        self.spare = self._allocated()
        self.V_inverse = np.empty((len(self.sightings.track), 6))
        self.S = np.empty((self.n, self.n))
        self._factored = False  # whether S holds the factor of `linear`, as good as undamped

    def _allocated(self) -> Linear:
        M, n = len(self.sightings.track), self.n
        W = np.empty((M, 3, 6 * len(self.start.frames) + self.extra))
        return Linear(
            np.empty((n, n)), np.empty(n), np.empty((M, 6)), np.empty((M, 3)), W,
            np.full(len(self.sightings), np.inf), np.full(len(self.tag_sightings.frame), np.inf),
        )  # fmt: skip

    def columns(self, key: Key) -> Ints:
        """Where an unknown stands; ("frame", id) is all 15 of a frame in the order of its chart."""
        kind, number = key
        if kind == "mount":
            at = np.arange(6) + self.mount_at + 6 * number
        elif kind == "offset":
            at = np.array([self.offset_at])
        elif kind == "tag":
            at = np.arange(6) + self.tag_column[self._row["tag", number]]
        else:
            row = self._row["frame", number]
            pose, rest = self.pose_at + 6 * row + np.arange(6), 9 * row + np.arange(9)
            at = {"pose": pose, "rest": rest, "frame": np.concatenate([pose, rest])}[kind]
        return np.asarray(at, np.int32)

    def offsets(self, x: Unknowns) -> Array:
        """(n,) how far x is from lin, by columns."""
        F, C = len(x.frames), len(x.mounts)
        out = np.zeros(self.n)
        d = np.empty((F, 15))
        chart_difference(x.frames, self.lin_frames(x), d)
        out[: self.pose_at] = d[:, 6:].ravel()
        out[self.pose_at : 15 * F] = d[:, :6].ravel()
        if self.calibrate_mounts and self.frozen_mounts:
            d = np.empty((C, 6))
            chart_difference(x.mounts, self.lin.mounts, d)
            out[self.mount_at : self.mount_at + 6 * C] = d.ravel()
        if self.calibrate_offset and self.frozen_offset:
            out[self.offset_at] = x.offset_s[0] - self.lin.offset_s[0]
        if len(x.tags):
            d = np.empty((len(x.tags), 6))
            chart_difference(x.tags, self.lin_tags(x), d)
            for column, row in zip(self.tag_column, d, strict=True):
                if column >= 0:
                    out[column : column + 6] = row
        return out

    def lin_frames(self, x: Unknowns) -> Array:
        return np.where(self.frozen_frames[:, None], self.lin.frames, x.frames)

    def lin_tags(self, x: Unknowns) -> Array:
        return np.where(self.frozen_tags[:, None], self.lin.tags, x.tags)

    def linearize(
        self, x: Unknowns, out: Linear, robust: bool = True, before: Array | None = None, normal: bool = True
    ) -> None:
        """Fill `out`. before (N,) : chi-squares of a state that its `comparable` is to be compared with; normal False :
        only costs and chi-squares are wanted."""
        s, t = self.sightings, self.tag_sightings
        if normal:
            out.H[:] = 0.0
            out.g[:] = 0.0
        frames, tags, mounts = x.frames, x.tags, x.mounts
        if self.first_estimates:
            frames, tags = self.lin_frames(x), self.lin_tags(x)
            mounts = self.lin.mounts if self.frozen_mounts else x.mounts
        offset = float(x.offset_s[0])
        out.cost, out.comparable = visual_terms(
            x.frames, frames, self.motion, self.models, self.params, x.mounts, mounts, offset, self.base,
            x.landmarks, s.start, s.frame, s.camera, s.before, s.px, s.sigma_px, s.inv_depth, s.sigma_inv_depth,
            s.shift_s, self.active, robust, out.chi2 if before is None else before, self.usual_inv_depth,
            self.pose_at, self.mount_at, self.offset_at, normal,
            out.H, out.g, out.V, out.g_landmark, out.W, out.chi2,
        )  # fmt: skip
        delta = self.offsets(x)[self.prior_at]
        rest, out.imu_chi2 = state_terms(
            x.frames, frames, self.measured, self.whiten, self.use_imu, self.still_sigma, self.still_sigma_m,
            self.prior_at, self.prior.H, self.prior.g, delta, self.pose_at, normal, out.H, out.g,
        )  # fmt: skip
        if len(t.frame):
            rest += tag_terms(
                x.frames, frames, self.motion, self.models, self.params, x.mounts, mounts, offset,
                x.tags, tags, self.tag_column, self.corners_tag, t.tag, t.frame, t.camera, t.corners_px, t.sigma_px,
                t.shift_s, t.use, self.pose_at, self.mount_at, self.offset_at, out.H, out.g, out.tag_chi2,
            )  # fmt: skip
        for key, belief in self.beliefs.items():
            at, d = self.columns(key), self._from_mean(key, belief.mean, x)
            pull = belief.information @ d
            if normal:
                out.H[np.ix_(at, at)] += belief.information
                out.g[at] += pull
            rest += float(d @ pull)
        if normal:
            out.H[np.arange(self.n), np.arange(self.n)] += NO_COVARIANCE
        out.cost += rest
        out.comparable += rest

    def _from_mean(self, key: Key, mean: Array, x: Unknowns) -> Array:
        kind, number = key
        if kind == "offset":
            return np.array([x.offset_s[0] - mean[0]])
        row = (
            x.frames[self._row["frame", number]] if kind == "frame"
            else x.mounts[number] if kind == "mount"
            else x.tags[self._row["tag", number]]
        )  # fmt: skip
        d = np.empty((1, len(row) - 6))
        chart_difference(row[None], mean[None], d)
        return d.ravel()

    def minimize(self, iterations: int, converged_chi2: float = SETTLED_CHI2) -> int:
        """Gauss-Newton with as little damping as it needs; returns the steps taken, -1 where it came to nothing."""
        trial = self.state.empty()
        self.linearize(self.state, self.linear)
        self._factored = False
        damping, taken, tried = DAMPING_START, 0, 0
        while taken < iterations and tried < 3 * iterations + 5:
            tried += 1
            gain = self._step(damping, trial)
            if 0.0 <= gain < converged_chi2:
                break
            if gain > 0.0:
                self.linearize(trial, self.spare, before=self.linear.chi2, normal=False)
                fell = self.linear.cost - self.spare.comparable
                if fell >= -RISE_CHI2:
                    self.state, trial = trial, self.state if taken else self.state.empty()
                    damping = max(0.1 * damping, DAMPING_START)
                    taken += 1
                    if taken == iterations or abs(fell - gain) < converged_chi2:  # as promised: this is the bottom
                        self.linear.take_costs(self.spare)
                        break
                    self.linearize(self.state, self.linear)
                    self._factored = False
                    continue
            damping = max(100.0 * damping, 1e-4)
            if damping > DAMPING_MAX:
                break
        whole = all(np.isfinite(a).all() for a in self.state.arrays)
        return taken if whole and math.isfinite(self.linear.cost) else -1

    def _step(self, damping: float, to: Unknowns) -> float:
        x, at, s = self.state, self.linear, self.sightings
        gain = step(
            damping, x.frames, x.mounts, x.offset_s, x.tags, self.tag_column, x.landmarks, s.start, s.frame,
            self.pose_at, self.mount_at, self.offset_at, self.extra, at.H, at.g, at.V, at.g_landmark, at.W,
            self.V_inverse, self.S, to.frames, to.mounts, to.offset_s, to.tags, to.landmarks,
        )  # fmt: skip
        self._factored = damping <= DAMPING_START and gain >= 0.0
        return gain

    def covariance(self, columns: AnyArray) -> Array | None:
        """Marginal covariance of these columns at the state, None where the equations are not definite."""
        if not self._factored and self._step(0.0, self.state.empty()) < 0.0:
            return None
        out = marginal_covariance(self.S, np.ascontiguousarray(columns, np.int32))
        symmetric: Array = 0.5 * (out + out.T)
        return symmetric

    def eliminated(self) -> tuple[Array, Array]:
        """(H, g), symmetric, over all columns, landmarks gone, about lin instead of the state."""
        at, s = self.linear, self.sightings
        H, b = at.H.copy(), at.g.copy()
        H[np.arange(self.n), np.arange(self.n)] -= NO_COVARIANCE
        eliminate_landmarks(
            0.0, s.start, s.frame, self.pose_at, self.extra, len(self.start.frames), at.V, at.g_landmark, at.W,
            self.V_inverse, H, b,
        )  # fmt: skip
        H = np.triu(H) + np.triu(H, 1).T
        return H, b - H @ self.offsets(self.state)
