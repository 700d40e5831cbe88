"""How the body moves: quintic splines of position and orientation, with exact derivatives.

Position and an unnormalized quaternion are B-splines of degree five over even knots (continuous up to the fourth
derivative, so jerk is smooth); the quaternion is divided by its length, and the angular velocity follows by the
product rule. Quintics rather than the usual cubics: those have a jerk that jumps (science note E).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_lsq_spline
from scipy.spatial.transform import Rotation

from lodelight.errors import SourceError
from lodelight.geometry.se3 import SE3
from lodelight.io.stamps import NS_PER_S
from lodelight.trajectory import Trajectory
from lodelight.types import Array

DEGREE = 5
KNOT_S = 0.05  # of generated motion: a step of a walk has ten knots
FIT_KNOT_S = 0.05  # of a given trajectory: one at 20 Hz is met exactly, denser ones lose shakes above 10 Hz
GRAVITY = np.array([0.0, 0.0, -9.81])


@dataclass(frozen=True, eq=False)
class State:
    """Body states at N times. R_world_body (N, 3, 3); xyz, v_world, a_world (N, 3) m, m/s, m/s^2; omega (N, 3) rad/s,
    body frame."""

    xyz: Array
    R_world_body: Array
    v_world: Array
    a_world: Array
    omega: Array

    @property
    def quat_wxyz(self) -> Array:
        out: Array = Rotation.from_matrix(self.R_world_body).as_quat()[:, [3, 0, 1, 2]]
        return out

    def poses(self) -> list[SE3]:
        return [SE3(R, t) for R, t in zip(self.R_world_body, self.xyz, strict=True)]


@dataclass(frozen=True, eq=False)
class Motion:
    """T_world_body over `duration_s` from `start_ns` on. spline : of (x, y, z, qw, qx, qy, qz) over seconds.

    deviation_m, deviation_deg : how far, at most, it leaves the trajectory it was fitted to
    jump : (at, ahead) s: from `at` on, the body is where it would have been `ahead` later
    """

    spline: BSpline
    start_ns: int
    duration_s: float
    deviation_m: float = 0.0
    deviation_deg: float = 0.0
    jump: tuple[float, float] | None = None

    @staticmethod
    def from_controls(controls: Array, start_ns: int, duration_s: float) -> Motion:
        """From control points every KNOT_S, (n, 7); the first acts from 2 KNOT_S before the start on."""
        knots = KNOT_S * (np.arange(len(controls) + DEGREE + 1) - DEGREE)
        return Motion(BSpline(knots, _continuous(controls), DEGREE), start_ns, duration_s)

    @staticmethod
    def fit(given: Trajectory, knot_s: float = FIT_KNOT_S) -> Motion:
        """Least squares through given poses; knots every `knot_s`, or as far apart as the poses where those are
        sparser. Raises SourceError on fewer than eight poses."""
        if len(given) < 8:
            raise SourceError(f"the trajectory has {len(given)} poses; at least 8 are needed to fly it")
        t = (given.t_ns - given.t_ns[0]) / NS_PER_S
        values = _continuous(np.hstack([given.xyz, given.quat_xyzw[:, [3, 0, 1, 2]]]))
        inner = _even_times(t[3:-3], knot_s)
        knots = np.concatenate([np.full(DEGREE + 1, t[0]), inner, np.full(DEGREE + 1, t[-1])])
        spline = make_lsq_spline(t, values, knots, DEGREE)
        motion = Motion(spline, int(given.t_ns[0]), float(t[-1]))
        state = motion.at(t)
        off = np.linalg.norm(state.xyz - given.xyz, axis=1)
        turn = (Rotation.from_matrix(state.R_world_body).inv() * Rotation.from_quat(given.quat_xyzw)).magnitude()
        return replace(motion, deviation_m=float(off.max()), deviation_deg=float(np.degrees(turn.max())))

    def at(self, t_s: Array | float) -> State:
        """States at seconds from the start."""
        t = np.clip(np.atleast_1d(np.asarray(t_s, dtype=np.float64)), 0.0, self.duration_s)
        if self.jump is not None:
            t = np.where(t >= self.jump[0], t + self.jump[1], t)
        value, first, second = self.spline(t), self.spline(t, 1), self.spline(t, 2)
        s, ds = value[:, 3:], first[:, 3:]
        length = np.linalg.norm(s, axis=1, keepdims=True)
        q, dq = s / length, ds / length
        dq = dq - q * (q * dq).sum(axis=1, keepdims=True)
        w, v = q[:, :1], q[:, 1:]
        omega = 2.0 * (w * dq[:, 1:] - dq[:, :1] * v - np.cross(v, dq[:, 1:]))  # 2 vec(q* dq/dt)
        R = Rotation.from_quat(q[:, [1, 2, 3, 0]]).as_matrix()
        return State(value[:, :3].copy(), R, first[:, :3].copy(), second[:, :3].copy(), omega)

    def at_ns(self, t_ns: NDArray[np.int64]) -> State:
        return self.at((np.asarray(t_ns) - self.start_ns) / NS_PER_S)

    def moved(self, T_new_old: SE3) -> Motion:
        """The same motion in another world frame, turned about the vertical."""
        c = np.array(self.spline.c)
        turn = Rotation.from_matrix(T_new_old.R)
        size = np.linalg.norm(c[:, 3:], axis=1, keepdims=True)
        quat = (turn * Rotation.from_quat(c[:, [4, 5, 6, 3]])).as_quat()[:, [3, 0, 1, 2]] * size
        controls = np.hstack([c[:, :3] @ T_new_old.R.T + T_new_old.t, _continuous_quat(quat)])
        return replace(self, spline=BSpline(self.spline.t, controls, DEGREE))

    def trajectory(self, rate_hz: float) -> Trajectory:
        """Poses at a rate, from start to end."""
        t_ns = self.start_ns + np.arange(0, int(self.duration_s * NS_PER_S) + 1, round(NS_PER_S / rate_hz))
        state = self.at_ns(t_ns)
        return Trajectory(t_ns.astype(np.int64), state.xyz, state.quat_wxyz[:, [1, 2, 3, 0]])


def _continuous(values: Array) -> Array:
    return np.hstack([values[:, :3], _continuous_quat(values[:, 3:])])


def _continuous_quat(quat: Array) -> Array:
    """The same rotations with signs chosen so that neighbours are near."""
    flips = np.sign((quat[1:] * quat[:-1]).sum(axis=1))
    out: Array = quat * np.concatenate([[1.0], np.cumprod(np.where(flips == 0, 1.0, flips))])[:, None]
    return out


def _even_times(t: Array, spacing_s: float) -> Array:
    """Times out of t at least `spacing_s` apart."""
    kept = [t[0]] if len(t) else []
    for value in t:
        if value - kept[-1] >= spacing_s - 1e-6:
            kept.append(value)
    return np.array(kept)
