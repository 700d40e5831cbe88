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
from dataclasses import dataclass

import numpy as np

from lodelight.compiled import kernel
from lodelight.geometry.dense import inverse3, matmul, transposed
from lodelight.geometry.se3 import SE3
from lodelight.geometry.so3 import so3_exp
from lodelight.imu.preintegration import Preintegration
from lodelight.types import Array, Ints

GRAVITY_M_S2 = 9.81
N = 11  # gravity's direction 2, velocity 3, gyro bias 3, accelerometer bias 3
LINEAR_REPETITIONS = 4
MOST_BEHIND = 0.5  # share of the landmarks
BEHIND = "most landmarks would lie behind the camera"
HUBER = 1.5  # of a ray's angle, in units of its noise
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
    if started[2] > MOST_BEHIND:
        return BEHIND
    # A scene turned inside out, with the motion turned about, nearly fits as well: both ways are tried.
    x = started[0]
    turned = np.concatenate([x[:3], -x[3:6], x[6:]])
    return _better(problem.refined(*started), problem.refined(turned, *problem.landmarks(turned)))


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

    def linear(self) -> tuple[Array, Array, float] | str:
        """x (9,) = gravity, velocity, accelerometer bias (from that of the motions); landmarks; the share behind."""
        m, rows, start = self.motions, self.rows, self.rows.start
        distance = np.ones(len(rows.frame))
        x, X, behind = np.zeros(9), np.zeros((len(start) - 1, 3)), 0.0
        along = self._along()
        for _ in range(LINEAR_REPETITIONS):
            H, b = linear_equations(
                m.t_s, m.dR, m.dp, m.jacobian, self.R_cam, self.p_cam,
                rows.frame, rows.camera, rows.ray, rows.inv_depth, along, start, distance,
            )  # fmt: skip
            H[6:, 6:] += np.eye(3) * 1e6  # no bias yet
            solved = _with_gravity(H, b)
            if solved is None:
                return "the images show no motion that gravity could be told from"
            x = solved
            behind = linear_landmarks(
                m.t_s, m.dR, m.dp, m.jacobian, self.R_cam, self.p_cam,
                rows.frame, rows.camera, rows.ray, rows.inv_depth, along, start, x, distance, X,
            )  # fmt: skip
        return x, X, behind

    def landmarks(self, x: Array) -> tuple[Array, float]:
        """Those that x (9,) makes of the sightings, and the share behind."""
        m, rows, start = self.motions, self.rows, self.rows.start
        X, along = np.zeros((len(start) - 1, 3)), self._along()
        behind = linear_landmarks(
            m.t_s, m.dR, m.dp, m.jacobian, self.R_cam, self.p_cam, rows.frame, rows.camera, rows.ray, rows.inv_depth,
            along, start, x, np.ones(len(rows.frame)), X,
        )  # fmt: skip
        return X, behind

    def _along(self) -> Array:
        """(N,) weight of a measured depth along its ray, beside 1 across."""
        rows, measured = self.rows, self.rows.inv_depth > 0
        along = np.zeros(len(rows.frame))
        along[measured] = (self.sigma_ray * rows.inv_depth[measured] ** 2 / rows.sigma_inv_depth[measured]) ** 2
        return along

    def refined(self, x: Array, X: Array, behind: float) -> Alignment | str:
        """Gauss-Newton (Levenberg-Marquardt) from the linear answer on, until it has settled."""
        state = _Guess(x[:3], x[3:6], self.motions.bias_gyro.copy(), self.motions.bias_accel + x[6:], X)
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
        return self._result(state, self._equations(state, 1e-10), behind)

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
        return _Guess(gravity, at.velocity + d[2:5], at.bias_gyro + d[5:8], at.bias_accel + d[8:], X)

    def _poses(self, at: _Guess) -> tuple[Array, Array, Array]:
        """R (K, 3, 3), p, v (K, 3) of the body at the images."""
        m = self.motions
        d = m.jacobian @ np.concatenate([at.bias_gyro - m.bias_gyro, at.bias_accel - m.bias_accel])
        t = m.t_s[:, None]
        R = np.stack([dR @ so3_exp(np.ascontiguousarray(turn)) for dR, turn in zip(m.dR, d[:, :3], strict=True)])
        p = at.velocity * t + 0.5 * at.gravity * t * t + m.dp + d[:, 3:6]
        return R, p, at.velocity + at.gravity * t + m.dv + d[:, 6:]

    def _result(self, at: _Guess, by: _Linearized, behind: float) -> Alignment | str:
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
            path_m=path, rms=rms, inliers=by.inliers, n=len(self.rows.frame), behind=behind, chi2=by.cost,
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


@kernel
def _ray_row(
    R: Array, p: Array, R_cam: Array, p_cam: Array, ray: Array, inv_depth: float, along: float, distance: float,
    P: Array, centre: Array, u: Array,
) -> None:  # fmt: skip
    """P (3, 3), the weight of X - centre; centre (3,) of the camera but for what is unknown; u (3,) = P centre + ..."""
    f = np.empty(3)
    g = np.empty(3)
    for i in range(3):
        g[i] = R_cam[i, 0] * ray[0] + R_cam[i, 1] * ray[1] + R_cam[i, 2] * ray[2]
    for i in range(3):
        f[i] = R[i, 0] * g[0] + R[i, 1] * g[1] + R[i, 2] * g[2]
        centre[i] = p[i] + R[i, 0] * p_cam[0] + R[i, 1] * p_cam[1] + R[i, 2] * p_cam[2]
    w = 1.0 / (distance * distance)
    for i in range(3):
        for j in range(3):
            P[i, j] = (along - w) * f[i] * f[j]
        P[i, i] += w
    away = 1.0 / (inv_depth * ray[2]) if along > 0.0 else 0.0
    for i in range(3):
        u[i] = P[i, 0] * centre[0] + P[i, 1] * centre[1] + P[i, 2] * centre[2] + along * away * f[i]


@kernel
def _unknown_part(t: float, jacobian: Array, C: Array) -> None:
    """C (3, 9): the camera's centre by gravity, velocity and accelerometer bias."""
    C[:] = 0.0
    for i in range(3):
        C[i, i], C[i, 3 + i] = 0.5 * t * t, t
        for j in range(3):
            C[i, 6 + j] = jacobian[3 + i, 3 + j]


@kernel
def linear_equations(
    t_s: Array, R: Array, p: Array, jacobian: Array, R_cam: Array, p_cam: Array, frame: Ints, camera: Ints, ray: Array,
    inv_depth: Array, along: Array, start: Ints, distance: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """H (9, 9), b (9,) of x = (gravity, velocity, accelerometer bias), all landmarks eliminated."""
    H, b = np.zeros((9, 9)), np.zeros(9)
    P, C, centre, u = np.empty((3, 3)), np.empty((3, 9)), np.empty(3), np.empty(3)
    Y, A, s = np.empty((3, 9)), np.empty((3, 3)), np.empty(3)
    for m in range(len(start) - 1):
        if start[m + 1] - start[m] < 2:
            continue
        Y[:], A[:], s[:] = 0.0, 0.0, 0.0
        H_own, b_own = np.zeros((9, 9)), np.zeros(9)
        for row in range(start[m], start[m + 1]):
            k, c = frame[row], camera[row]
            _ray_row(R[k], p[k], R_cam[c], p_cam[c], ray[row], inv_depth[row], along[row], distance[row], P, centre, u)
            _unknown_part(t_s[k], jacobian[k], C)
            PC = matmul(P, C)
            CT = transposed(C)
            H_own += matmul(CT, PC)
            Y += PC
            A += P
            for i in range(9):
                b_own[i] -= C[0, i] * u[0] + C[1, i] * u[1] + C[2, i] * u[2]
            s += u
        V = _inverse(A)
        if V[2, 2] == 0.0:
            continue
        VY = matmul(V, Y)
        H += H_own - matmul(transposed(Y), VY)
        for i in range(9):
            b[i] += b_own[i] + VY[0, i] * s[0] + VY[1, i] * s[1] + VY[2, i] * s[2]
    return H, b


@kernel
def _inverse(A: Array) -> Array:
    v00, v10, v11, v20, v21, v22 = inverse3(A[0, 0], A[1, 0], A[1, 1], A[2, 0], A[2, 1], A[2, 2])
    V = np.empty((3, 3))
    V[0, 0], V[1, 1], V[2, 2] = v00, v11, v22
    V[0, 1] = V[1, 0] = v10
    V[0, 2] = V[2, 0] = v20
    V[1, 2] = V[2, 1] = v21
    return V


@kernel
def linear_landmarks(
    t_s: Array, R: Array, p: Array, jacobian: Array, R_cam: Array, p_cam: Array, frame: Ints, camera: Ints, ray: Array,
    inv_depth: Array, along: Array, start: Ints, x: Array, distance: Array, X: Array,
) -> float:  # fmt: skip
    """Fill X (M, 3), NaN where it is not ahead of its cameras, and distance (N,); returns the share behind."""
    P, C, centre, u = np.empty((3, 3)), np.empty((3, 9)), np.empty(3), np.empty(3)
    A, s, off = np.empty((3, 3)), np.empty(3), np.empty(3)
    n_behind, n_all = 0, 0
    for m in range(len(start) - 1):
        A[:], s[:] = 0.0, 0.0
        X[m] = math.nan
        if start[m + 1] - start[m] < 2:
            continue
        for row in range(start[m], start[m + 1]):
            k, c = frame[row], camera[row]
            _ray_row(R[k], p[k], R_cam[c], p_cam[c], ray[row], inv_depth[row], along[row], distance[row], P, centre, u)
            _unknown_part(t_s[k], jacobian[k], C)
            for i in range(3):
                off[i] = 0.0
                for j in range(9):
                    off[i] += C[i, j] * x[j]
            for i in range(3):
                s[i] += u[i] + P[i, 0] * off[0] + P[i, 1] * off[1] + P[i, 2] * off[2]
            A += P
        V = _inverse(A)
        if V[2, 2] == 0.0:
            continue
        for i in range(3):
            X[m, i] = V[i, 0] * s[0] + V[i, 1] * s[1] + V[i, 2] * s[2]
        behind = 0
        for row in range(start[m], start[m + 1]):
            k, c = frame[row], camera[row]
            _ray_row(R[k], p[k], R_cam[c], p_cam[c], ray[row], inv_depth[row], along[row], distance[row], P, centre, u)
            _unknown_part(t_s[k], jacobian[k], C)
            ahead, d2 = 0.0, 0.0
            for i in range(3):
                d = X[m, i] - centre[i]
                for j in range(9):
                    d -= C[i, j] * x[j]
                f = 0.0
                for j in range(3):
                    g = R_cam[c, j, 0] * ray[row, 0] + R_cam[c, j, 1] * ray[row, 1] + R_cam[c, j, 2] * ray[row, 2]
                    f += R[k, i, j] * g
                ahead += f * d
                d2 += d * d
            distance[row] = min(max(math.sqrt(d2), 0.2), 100.0)
            behind += ahead <= 0.0
        n_all += 1
        if 2 * behind > start[m + 1] - start[m]:
            n_behind += 1
            X[m] = math.nan
    return n_behind / max(n_all, 1)


@kernel
def angle_equations(
    t_s: Array, R: Array, p: Array, jacobian: Array, R_cam: Array, p_cam: Array, frame: Ints, camera: Ints, ray: Array,
    inv_depth: Array, sigma_inv_depth: Array, start: Ints, X: Array, g_tangent: Array, sigma: float, damping: float,
    H: Array, b: Array, V_inverse: Array, gradient: Array, W: Array,
) -> tuple[float, int, int, float]:  # fmt: skip
    """Fill H (11, 11), b (11,), with the landmarks eliminated, and V_inverse, gradient, W of every landmark.

    Returns the robust cost, rays within the kernel's bound, rays used, and the squared errors of those within.
    """
    cost, inliers, used, total = 0.0, 0, 0, 0.0
    J, Jx, e = np.empty((3, 11)), np.empty((3, 3)), np.empty(3)
    y, B, Jy, A = np.empty(3), np.empty((2, 3)), np.empty((3, 3)), np.empty((3, 3))
    Jp, Jt = np.empty((3, 3)), np.empty((3, 3))
    for m in range(len(start) - 1):
        if X[m, 0] != X[m, 0] or start[m + 1] - start[m] < 2:
            continue
        V = np.zeros((3, 3))
        for row in range(start[m], start[m + 1]):
            k, c, t = frame[row], camera[row], t_s[frame[row]]
            body = np.empty(3)
            for i in range(3):
                body[i] = 0.0
                for j in range(3):
                    body[i] += R[k, j, i] * (X[m, j] - p[k, j])
            for i in range(3):
                y[i] = 0.0
                for j in range(3):
                    y[i] += R_cam[c, j, i] * (body[j] - p_cam[c, j])
            length = math.sqrt(y[0] ** 2 + y[1] ** 2 + y[2] ** 2)
            f = ray[row]
            if y[0] * f[0] + y[1] * f[1] + y[2] * f[2] <= 0.1 * length or length < 1e-6:
                cost += 100.0
                continue
            _across(f, B)
            n = 2
            for a in range(2):
                e[a] = 0.0
                for i in range(3):
                    e[a] += B[a, i] * y[i] / length
                e[a] /= sigma
            for a in range(2):
                for j in range(3):
                    Jy[a, j] = (B[a, j] - e[a] * sigma * y[j] / length) / (length * sigma)
            if inv_depth[row] > 0.0 and y[2] > 1e-3:
                n = 3
                e[2] = (1.0 / y[2] - inv_depth[row]) / sigma_inv_depth[row]
                Jy[2, 0] = Jy[2, 1] = 0.0
                Jy[2, 2] = -1.0 / (y[2] * y[2] * sigma_inv_depth[row])
            for i in range(3):  # A = R_cam^T R_k^T
                for j in range(3):
                    A[i, j] = 0.0
                    for q in range(3):
                        A[i, j] += R_cam[c, q, i] * R[k, j, q]
            for a in range(n):
                for j in range(3):
                    Jx[a, j] = Jy[a, 0] * A[0, j] + Jy[a, 1] * A[1, j] + Jy[a, 2] * A[2, j]
                    Jp[a, j] = 0.0  # of the body frame's axes
                    for q in range(3):
                        Jp[a, j] += Jy[a, q] * R_cam[c, j, q]
                # y moves by R_cam^T [body]x dtheta
                Jt[a, 0] = Jp[a, 1] * body[2] - Jp[a, 2] * body[1]
                Jt[a, 1] = Jp[a, 2] * body[0] - Jp[a, 0] * body[2]
                Jt[a, 2] = Jp[a, 0] * body[1] - Jp[a, 1] * body[0]
                for i in range(2):
                    J[a, i] = 0.0
                    for j in range(3):
                        J[a, i] -= Jx[a, j] * 0.5 * t * t * g_tangent[j, i]
                for i in range(3):
                    J[a, 2 + i] = -t * Jx[a, i]
                for i in range(6):
                    J[a, 5 + i] = 0.0
                    for j in range(3):
                        J[a, 5 + i] += -Jx[a, j] * jacobian[k, 3 + j, i] + Jt[a, j] * jacobian[k, j, i]
            norm2 = 0.0
            for a in range(n):
                norm2 += e[a] * e[a]
            norm, w = math.sqrt(norm2), 1.0
            used += 1
            if norm > HUBER:
                w = HUBER / norm
                cost += HUBER * (2.0 * norm - HUBER)
            else:
                cost += norm2
            if norm < 3.0:
                inliers += 1
                total += norm2
            for a in range(n):
                for i in range(11):
                    b[i] -= w * J[a, i] * e[a]
                    for j in range(i + 1):
                        H[i, j] += w * J[a, i] * J[a, j]
                    for j in range(3):
                        W[m, i, j] += w * J[a, i] * Jx[a, j]
                for i in range(3):
                    gradient[m, i] -= w * Jx[a, i] * e[a]
                    for j in range(3):
                        V[i, j] += w * Jx[a, i] * Jx[a, j]
        for i in range(3):
            V[i, i] += damping * V[i, i] + 1e-9
        v = inverse3(V[0, 0], V[1, 0], V[1, 1], V[2, 0], V[2, 1], V[2, 2])
        for i in range(6):
            V_inverse[m, i] = v[i]
        WV = np.empty((11, 3))
        for i in range(11):
            WV[i, 0] = W[m, i, 0] * v[0] + W[m, i, 1] * v[1] + W[m, i, 2] * v[3]
            WV[i, 1] = W[m, i, 0] * v[1] + W[m, i, 1] * v[2] + W[m, i, 2] * v[4]
            WV[i, 2] = W[m, i, 0] * v[3] + W[m, i, 1] * v[4] + W[m, i, 2] * v[5]
        for i in range(11):
            for q in range(3):
                b[i] -= WV[i, q] * gradient[m, q]
            for j in range(i + 1):
                for q in range(3):
                    H[i, j] -= WV[i, q] * W[m, j, q]
    for i in range(11):
        H[i, i] *= 1.0 + damping
        for j in range(i):
            H[j, i] = H[i, j]
    return cost, inliers, used, total


@kernel
def step_landmarks(X: Array, V_inverse: Array, gradient: Array, W: Array, d: Array) -> None:
    """Move X (M, 3) by what is left of each landmark's equations after the step d (11,)."""
    r = np.empty(3)
    for m in range(len(X)):
        if X[m, 0] != X[m, 0]:
            continue
        for i in range(3):
            r[i] = gradient[m, i]
            for j in range(len(d)):
                r[i] -= W[m, j, i] * d[j]
        v = V_inverse[m]
        X[m, 0] += v[0] * r[0] + v[1] * r[1] + v[3] * r[2]
        X[m, 1] += v[1] * r[0] + v[2] * r[1] + v[4] * r[2]
        X[m, 2] += v[3] * r[0] + v[4] * r[1] + v[5] * r[2]


@kernel
def _across(f: Array, B: Array) -> None:
    """B (2, 3): two unit vectors across a unit ray and each other."""
    least = 0
    for i in range(1, 3):
        if abs(f[i]) < abs(f[least]):
            least = i
    a = np.zeros(3)
    a[least] = 1.0
    x, y, z = f[1] * a[2] - f[2] * a[1], f[2] * a[0] - f[0] * a[2], f[0] * a[1] - f[1] * a[0]
    n = math.sqrt(x * x + y * y + z * z)
    B[0, 0], B[0, 1], B[0, 2] = x / n, y / n, z / n
    B[1, 0] = f[1] * B[0, 2] - f[2] * B[0, 1]
    B[1, 1] = f[2] * B[0, 0] - f[0] * B[0, 2]
    B[1, 2] = f[0] * B[0, 1] - f[1] * B[0, 0]
