"""Images and IMU put together without knowing anything: gravity, velocity, biases, and with them the scale.

In the body's frame at the first image, the IMU alone says where it went, but for eleven numbers: the direction of
gravity g (2), the first velocity v (3), and the biases of gyroscope and accelerometer (6):

    R_k = dR_k(bg),   p_k = v t_k + g t_k^2 / 2 + dp_k(bg, ba)

Every landmark seen in some of the images says that its rays meet. Two steps: a linear one (gyroscope bias given),
in which each ray contributes (I - f f^T)(X - c_k) = 0 with landmarks eliminated and |g| held; then Gauss-Newton on the
angles between rays and landmarks over all eleven numbers, robust, whose inverse normal matrix says how well each is
known. Over the second or two that it takes, the noise of the IMU itself moves p by millimetres and is left out.
No map and no scale-less reconstruction before it: one camera, two, or depth are the same with more rows.
Derivation: docs/inertial.md. Related: Martinelli 2014 (closed form); Qin and Shen 2017.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from lodelight.geometry.se3 import SE3
from lodelight.geometry.so3 import so3_exp
from lodelight.imu.alignment_kernels import N, angle_equations, linear_equations, linear_landmarks, step_landmarks
from lodelight.imu.preintegration import Preintegration
from lodelight.types import Array, Ints

GRAVITY_M_S2 = 9.81
LINEAR_REPETITIONS = 4
SOME = 60  # landmarks that find the way to a solution
MOST_BEHIND = 0.5  # share of the landmarks
BEHIND = "most landmarks would lie behind the camera"
# One camera in slow motion takes twenty steps and more from the linear answer, which takes a scene for smaller than it
# is, to the right one; a start on the way there is wrong by much more than its covariance says.
MOST_STEPS, SETTLED = 60, 1e-4


@dataclass(frozen=True, eq=False)
class Rows:
    """N sightings, sorted by landmark.

    frame, camera, landmark (N,) int32; ray (N, 3) unit, camera frame
    inv_depth, sigma_inv_depth (N,) 1/m along the camera's z; 0 = not measured
    """

    frame: Ints
    camera: Ints
    landmark: Ints
    ray: Array
    inv_depth: Array
    sigma_inv_depth: Array

    @property
    def start(self) -> Ints:
        """(M + 1,) where each landmark's rows begin."""
        m = int(self.landmark[-1]) + 1 if len(self.landmark) else 0
        return np.searchsorted(self.landmark, np.arange(m + 1)).astype(np.int32)

    def some(self, n: int) -> Rows:
        """All sightings of n landmarks, or of as many as there are, evenly chosen among all."""
        start = self.start
        m = len(start) - 1
        if m <= n:
            return self
        number = np.full(m, -1, np.int32)
        number[np.linspace(0, m - 1, n).astype(int)] = np.arange(n)
        of = number[self.landmark]
        keep = of >= 0
        return Rows(
            self.frame[keep], self.camera[keep], of[keep], self.ray[keep], self.inv_depth[keep],
            self.sigma_inv_depth[keep],
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Motions:
    """The IMU from the first image to each of K: t_s (K,), dR (K, 3, 3), dp, dv (K, 3), jacobian (K, 9, 6).

    bias_gyro, bias_accel : those it was integrated with
    """

    t_s: Array
    dR: Array
    dp: Array
    dv: Array
    jacobian: Array
    bias_gyro: Array
    bias_accel: Array

    @staticmethod
    def of(parts: Sequence[Preintegration]) -> Motions:
        """From preintegrations that all begin at the first image; the first image itself has none."""
        first = parts[0]
        return Motions(
            np.array([0.0, *(p.dt_s for p in parts)]),
            np.stack([np.eye(3), *(p.dR for p in parts)]),
            np.stack([np.zeros(3), *(p.dp for p in parts)]),
            np.stack([np.zeros(3), *(p.dv for p in parts)]),
            np.stack([np.zeros((9, 6)), *(p.jacobian for p in parts)]),
            first.bias_gyro,
            first.bias_accel,
        )


@dataclass(frozen=True, eq=False)
class Alignment:
    """What was found, in the body's frame at the first image.

    gravity (3,) m/s^2, velocity (3,) m/s; bias_gyro rad/s, bias_accel m/s^2 (3,)
    R (K, 3, 3), p (K, 3) m, v (K, 3) m/s : of the body at every image
    covariance (11, 11) : gravity's direction (rad, in the basis `tangent` (3, 2)), velocity, biases
    sigma_velocity m/s : of the last velocity, its worst direction; sigma_scale : of how far the camera went, as a share
    sigma_tilt rad : of gravity's direction; path_m : farthest from the first position
    rms : of the angles that agree, in units of the noise; inliers, n : rays that agree, of so many
    behind : share of the landmarks that came to lie behind the cameras in the linear step
    chi2 : robust, of everything, in units of the noise
    """

    gravity: Array
    velocity: Array
    bias_gyro: Array
    bias_accel: Array
    R: Array
    p: Array
    v: Array
    covariance: Array
    sigma_velocity: float
    sigma_scale: float
    sigma_tilt: float
    path_m: float
    rms: float
    inliers: int
    n: int
    behind: float
    chi2: float = 0.0


def align(
    motions: Motions,
    rows: Rows,
    T_body_cam: Sequence[SE3],
    sigma_ray: float,
    sigma_bias: tuple[float, float] = (0.01, 0.1),
) -> Alignment | str:
    """The alignment, or why there is none.

    sigma_ray rad; sigma_bias : how far the biases may be from those of `motions`, rad/s and m/s^2, per axis
    """
    R_cam = np.ascontiguousarray(np.stack([T.R for T in T_body_cam]))
    p_cam = np.stack([T.t for T in T_body_cam])
    problem = _Problem(motions, rows, R_cam, p_cam, sigma_ray, sigma_bias)
    started = problem.linear()
    if isinstance(started, str):
        return started
    x, behind = started
    if behind > MOST_BEHIND:
        return BEHIND
    # A scene turned inside out, with the motion turned about, nearly fits as well: both ways are tried, with some of
    # the landmarks, and the better one is gone on with.
    turned = np.concatenate([x[:3], -x[3:6], x[6:]])
    some = replace(problem, rows=rows.some(SOME))
    first = _better(*(some.refined(some.guess(way)) for way in (x, turned)))
    if isinstance(first, str):
        return _better(*(problem.refined(problem.guess(way)) for way in (x, turned)))
    x = np.concatenate([first.gravity, first.velocity, first.bias_accel - motions.bias_accel])
    return problem.refined(replace(problem.guess(x), bias_gyro=first.bias_gyro))


def _better(a: Alignment | str, b: Alignment | str) -> Alignment | str:
    if isinstance(a, str) or isinstance(b, str):
        return b if isinstance(a, str) else a
    return a if a.rms * b.inliers <= b.rms * a.inliers else b


@dataclass(eq=False)
class _Problem:
    motions: Motions
    rows: Rows
    R_cam: Array
    p_cam: Array
    sigma_ray: float
    sigma_bias: tuple[float, float]

    def linear(self) -> tuple[Array, float] | str:
        """x (9,) = gravity, velocity, accelerometer bias (from that of the motions); share of landmarks behind."""
        m, rows, start = self.motions, self.rows, self.rows.start
        distance = np.ones(len(rows.frame))
        x, behind = np.zeros(9), 0.0
        for _ in range(LINEAR_REPETITIONS):
            H, b = linear_equations(
                m.t_s, m.dR, m.dp, m.jacobian, self.R_cam, self.p_cam,
                rows.frame, rows.camera, rows.ray, rows.inv_depth, self.along, start, distance,
            )  # fmt: skip
            H[6:, 6:] += np.eye(3) * 1e6  # no bias yet
            solved = _with_gravity(H, b)
            if solved is None:
                return "the images show no motion that gravity could be told from"
            x = solved
            _, behind = self._landmarks(x, distance)
        return x, behind

    def guess(self, x: Array) -> _Guess:
        """By x (9,) = gravity, velocity, accelerometer bias (from that of the motions), and what landmarks it makes."""
        m = self.motions
        X, behind = self._landmarks(x, np.ones(len(self.rows.frame)))
        return _Guess(x[:3], x[3:6], m.bias_gyro.copy(), m.bias_accel + x[6:], X, behind)

    def _landmarks(self, x: Array, distance: Array) -> tuple[Array, float]:
        """(M, 3) that x (9,) makes of the sightings, and the share behind; distance (N,) to them, is brought up to
        date."""
        m, rows, start = self.motions, self.rows, self.rows.start
        X = np.empty((len(start) - 1, 3))
        behind = linear_landmarks(
            m.t_s, m.dR, m.dp, m.jacobian, self.R_cam, self.p_cam, rows.frame, rows.camera, rows.ray, rows.inv_depth,
            self.along, start, x, distance, X,
        )  # fmt: skip
        return X, behind

    @cached_property
    def along(self) -> Array:
        """(N,) weight of a measured depth along its ray, beside 1 across."""
        rows, measured = self.rows, self.rows.inv_depth > 0
        along = np.zeros(len(rows.frame))
        along[measured] = (self.sigma_ray * rows.inv_depth[measured] ** 2 / rows.sigma_inv_depth[measured]) ** 2
        return along

    def refined(self, state: _Guess) -> Alignment | str:
        """Gauss-Newton (Levenberg-Marquardt) from there on, until it has settled."""
        best = self._equations(state, 1e-4)
        if best.used < 2 * N:
            return f"{best.used} rays agree with one motion, {2 * N} are needed"
        damping = 1e-4
        for _ in range(MOST_STEPS):
            trial_state = self._stepped(state, best)
            trial = self._equations(trial_state, damping)
            if trial.cost < best.cost:
                done = best.cost - trial.cost < SETTLED * best.cost
                state, best, damping = trial_state, trial, max(0.1 * damping, 1e-8)
                if done:
                    break
            elif damping > 1.0:  # no way down is left
                break
            else:
                damping *= 10.0
                best = self._equations(state, damping)
        else:
            return f"images and IMU have not settled on one motion after {MOST_STEPS} steps"
        return self._result(state, self._equations(state, 1e-10))

    def _equations(self, at: _Guess, damping: float) -> _Linearized:
        m, rows = self.motions, self.rows
        R, p, _ = self._poses(at)
        tangent = _tangent(at.gravity)
        n = len(at.X)
        out = _Linearized(
            np.zeros((N, N)), np.zeros(N), np.zeros((n, 6)), np.zeros((n, 3)), np.zeros((n, N, 3)), tangent
        )
        out.cost, out.inliers, out.used, out.chi2 = angle_equations(
            m.t_s, R, p, m.jacobian, self.R_cam, self.p_cam, rows.frame, rows.camera, rows.ray, rows.inv_depth,
            rows.sigma_inv_depth, rows.start, at.X, tangent * GRAVITY_M_S2, self.sigma_ray, damping,
            out.H, out.b, out.V_inverse, out.g, out.W,
        )  # fmt: skip
        prior = np.repeat(self.sigma_bias, 3) ** -2.0
        off = np.concatenate([at.bias_gyro - m.bias_gyro, at.bias_accel - m.bias_accel])
        out.H[range(5, N), range(5, N)] += prior
        out.b[5:] -= prior * off
        out.cost += float(prior @ off**2)
        return out

    def _stepped(self, at: _Guess, by: _Linearized) -> _Guess:
        H = by.H + np.diag(1e-9 * np.diag(by.H) + 1e-12)
        try:
            d = np.asarray(np.linalg.solve(H, by.b), np.float64)
        except np.linalg.LinAlgError:
            d = np.zeros(N)
        gravity = at.gravity + GRAVITY_M_S2 * by.tangent @ d[:2]
        gravity *= GRAVITY_M_S2 / np.linalg.norm(gravity)
        X = at.X.copy()
        step_landmarks(X, by.V_inverse, by.g, by.W, d)
        return _Guess(gravity, at.velocity + d[2:5], at.bias_gyro + d[5:8], at.bias_accel + d[8:], X, at.behind)

    def _poses(self, at: _Guess) -> tuple[Array, Array, Array]:
        """R (K, 3, 3), p, v (K, 3) of the body at the images."""
        m = self.motions
        d = m.jacobian @ np.concatenate([at.bias_gyro - m.bias_gyro, at.bias_accel - m.bias_accel])
        t = m.t_s[:, None]
        R = np.stack([dR @ so3_exp(np.ascontiguousarray(turn)) for dR, turn in zip(m.dR, d[:, :3], strict=True)])
        p = at.velocity * t + 0.5 * at.gravity * t * t + m.dp + d[:, 3:6]
        return R, p, at.velocity + at.gravity * t + m.dv + d[:, 6:]

    def _result(self, at: _Guess, by: _Linearized) -> Alignment | str:
        try:
            covariance = np.asarray(np.linalg.inv(by.H), np.float64)
        except np.linalg.LinAlgError:
            return "the images do not determine the motion"
        dof = max(by.inliers * 2 - N, 1)
        rms = math.sqrt(by.chi2 / dof)
        covariance *= max(rms, 1.0) ** 2
        R, p, v = self._poses(at)
        _m, far = self.motions, int(np.argmax(np.linalg.norm(p, axis=1)))
        J_v, J_p = (self._sensitivity(k, by.tangent)[i] for k, i in ((len(p) - 1, 1), (far, 0)))
        path = float(np.linalg.norm(p[far]))
        along = p[far] / max(path, 1e-9)
        return Alignment(
            at.gravity, at.velocity, at.bias_gyro, at.bias_accel, R, p, v, covariance,
            sigma_velocity=math.sqrt(max(np.linalg.eigvalsh(J_v @ covariance @ J_v.T)[-1], 0.0)),
            sigma_scale=math.sqrt(max(along @ J_p @ covariance @ J_p.T @ along, 0.0)) / max(path, 1e-9),
            sigma_tilt=math.sqrt(max(np.linalg.eigvalsh(covariance[:2, :2])[-1], 0.0)),
            path_m=path, rms=rms, inliers=by.inliers, n=len(self.rows.frame), behind=at.behind, chi2=by.cost,
        )  # fmt: skip

    def _sensitivity(self, k: int, tangent: Array) -> tuple[Array, Array]:
        """(3, 11) of position and of velocity at image k to what is estimated."""
        m, t = self.motions, float(self.motions.t_s[k])
        g = GRAVITY_M_S2 * tangent
        J_p = np.hstack([0.5 * t * t * g, t * np.eye(3), m.jacobian[k, 3:6]])
        return J_p, np.hstack([t * g, np.eye(3), m.jacobian[k, 6:9]])


@dataclass(frozen=True, eq=False)
class _Guess:
    gravity: Array
    velocity: Array
    bias_gyro: Array
    bias_accel: Array
    X: Array
    behind: float


@dataclass(eq=False)
class _Linearized:
    """Normal equations with landmarks eliminated, and what gives those back."""

    H: Array
    b: Array
    V_inverse: Array
    g: Array
    W: Array
    tangent: Array
    cost: float = 0.0
    chi2: float = 0.0
    inliers: int = 0
    used: int = 0


def _tangent(gravity: Array) -> Array:
    """(3, 2) orthonormal, across gravity."""
    u = gravity / np.linalg.norm(gravity)
    a = np.cross(u, np.eye(3)[int(np.argmin(np.abs(u)))])
    a /= np.linalg.norm(a)
    return np.column_stack([a, np.cross(u, a)])


def _with_gravity(H: Array, b: Array) -> Array | None:
    """argmin x^T H x - 2 b^T x with the first three of x of length GRAVITY_M_S2; None where H does not tell."""
    try:
        inner = np.linalg.inv(H[3:, 3:])
    except np.linalg.LinAlgError:
        return None
    A = H[:3, :3] - H[:3, 3:] @ inner @ H[3:, :3]
    c = b[:3] - H[:3, 3:] @ inner @ b[3:]
    values, vectors = np.linalg.eigh(0.5 * (A + A.T))
    d = vectors.T @ c
    if not np.isfinite(values).all() or np.linalg.norm(d) == 0.0:
        return None
    # (A + m I) g = c; |g| falls with m beyond the least eigenvalue, so there is one such m
    low = -values[0]
    high = low + np.linalg.norm(d) / GRAVITY_M_S2
    for _ in range(200):
        m = 0.5 * (low + high)
        if np.linalg.norm(d / np.maximum(values + m, 1e-300)) > GRAVITY_M_S2:
            low = m
        else:
            high = m
    g = vectors @ (d / np.maximum(values + high, 1e-300))
    length = float(np.linalg.norm(g))
    if not 0.5 * GRAVITY_M_S2 < length < 2.0 * GRAVITY_M_S2:
        return None
    g *= GRAVITY_M_S2 / length
    return np.concatenate([g, inner @ (b[3:] - H[3:, :3] @ g)])
