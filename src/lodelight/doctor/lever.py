"""Where camera 0 sits on the IMU, in metres: what its motion by depth or a stereo pair and the accelerometer differ by.

In the axes that the body has when a stretch of moves begins, with R_k by the gyro and dR, dp, dv preintegrated over the
k-th move, which takes T_k:

    (1 + s) R_k R_body_cam t_k = v_k T_k + g T_k^2 / 2 + R_k dp_k + (R_k+1 - R_k) p_body_cam
    v_k+1 = v_k + g T_k + R_k dv_k

So the lever tells itself where the body turns. The first velocity and gravity are free in every stretch, and biases
wander from one to the next. The scale s of the camera's metres, and what is left of the turn between the axes and of
the time offset, are common to all.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from lodelight.doctor.metric import Move
from lodelight.doctor.turning import Alignment
from lodelight.geometry.so3 import so3_exp
from lodelight.imu.preintegration import preintegrate
from lodelight.imu.samples import ImuSamples
from lodelight.imu.vibration import with_least_noise
from lodelight.messages import Imu
from lodelight.rig import CameraSpec, ImuSpec
from lodelight.types import Array

LEAST_MOVES, LEAST_STRETCH = 20, 3
STRETCH_S = 4.0  # for longer the gyro's own drift would turn gravity
BLOCK_S = 1.0  # for which errors may be alike
# How far off things may well be: lever m, accelerometer's bias m/s^2, scale, gyro's bias rad/s. Gravity and velocity
# are not known at all; the turn and the offset are known as well as `Alignment` says.
MAYBE = [*[0.3] * 3, *[0.3] * 3, 0.05, *[0.005] * 3]
COMMON = 14  # unknowns of all stretches, in the order of `_Stretch.A`
BIASES = [3, 4, 5, 7, 8, 9]  # of them
STEP = np.array([*[1e-4] * 3, *[1e-4] * 3, 1e-3])  # of gyro bias rad/s, turn rad and offset s, to differentiate by
LEAST_TURN_RAD = 1e-3
LEAST_M = 2e-5  # by which a move errs
ROUNDS, OUTLIER = 12, 2.5  # of reweighting; sigmas


@dataclass(frozen=True, eq=False)
class Lever:
    """shift_m (3,) : true position of camera 0 on the body less the rig's; covariance (3, 3)."""

    shift_m: Array
    covariance: Array

    def told(self, sigma_m: float) -> tuple[float, float]:
        """The part of the shift along axes that are known to sigma_m, and its standard deviation."""
        values, axes = np.linalg.eigh(self.covariance)
        known = np.sqrt(values) < sigma_m
        if not known.any():
            return 0.0, float(np.sqrt(values[0]))
        along = axes[:, known].T @ self.shift_m
        length = float(np.linalg.norm(along))
        way = along / max(length, 1e-12)
        return length, float(np.sqrt(way**2 @ values[known]))


@dataclass(frozen=True, eq=False)
class _Stretch:
    """Moves that follow one another: A x = y, for the error x of what is common and of what is the stretch's own.

    A (n, 3, 26) : by lever, accelerometer's bias, scale, gyro's bias, turn, offset; by the first velocity, gravity, and
    how far both biases are from those of all
    y (n, 3) m; at_s (n,) : when moves begin
    walk (n, n) s^3 : covariance of an axis of y by an accelerometer whose white noise has the density 1 m/s^2/sqrt(Hz)
    """

    at_s: Array
    A: Array
    y: Array
    walk: Array


@dataclass(frozen=True, eq=False)
class _Reduced:
    """Normal equations H (14, 14), b (14,) of what is common, with a stretch's own eliminated; gain (12, 15) gives that
    back."""

    H: Array
    b: Array
    gain: Array

    def own(self, x: Array) -> Array:
        out: Array = self.gain[:, COMMON] - self.gain[:, :COMMON] @ x
        return out


def lever_of(
    moves: Sequence[Move], imu: Sequence[Imu], spec: ImuSpec, cam0: CameraSpec, turning: Alignment
) -> Lever | None:
    """None where there are too few moves in a row to say anything.

    turning : how the gyro is biased, how cam0 is turned, and what is to be added to the stamps of images
    """
    samples = ImuSamples(
        np.array([s.t_ns for s in imu], dtype=np.int64), np.array([s.gyro for s in imu]),
        np.array([s.accel for s in imu]),
    )  # fmt: skip
    spec = with_least_noise(spec)
    margin_ns = abs(turning.offset_s) * 1e9 + 2e6
    inside = [m for m in moves if samples.t_ns[0] + margin_ns < m.t_a and m.t_b < samples.t_ns[-1] - margin_ns]
    rows = [_stretch(run, samples, spec, cam0, turning) for run in _in_a_row(inside)]
    if sum(len(part.y) for part in rows) < LEAST_MOVES:
        return None
    sigma = np.array([*MAYBE, *np.maximum(turning.sigma_turn_rad, LEAST_TURN_RAD), turning.sigma_offset_s])
    wander = np.repeat([spec.accel_walk, spec.gyro_walk], 3) * np.sqrt((moves[-1].t_b - moves[0].t_a) * 1e-9)
    return _solved(rows, 1.0 / sigma**2, 1.0 / wander**2, spec.accel_noise)


def _in_a_row(moves: Sequence[Move]) -> Iterator[list[Move]]:
    run: list[Move] = []
    for move in moves:
        if run and (move.t_a != run[-1].t_b or (move.t_b - run[0].t_a) * 1e-9 > STRETCH_S):
            if len(run) >= LEAST_STRETCH:
                yield run
            run = []
        run.append(move)
    if len(run) >= LEAST_STRETCH:
        yield run


def _stretch(run: list[Move], samples: ImuSamples, spec: ImuSpec, cam0: CameraSpec, turning: Alignment) -> _Stretch:
    n = len(run)
    T = np.array([(m.t_b - m.t_a) * 1e-9 for m in run])
    at = np.array([(m.t_a - run[0].t_a) * 1e-9 for m in run])

    def missed(d: Array) -> tuple[Array, Array]:
        """y (n, 3) and A (n, 3, 7) with the gyro's bias, the turn and the offset moved by d (7,)."""
        R_body_cam = cam0.T_body_cam.R @ so3_exp(turning.turn_rad + d[3:6])
        shift_ns = round((turning.offset_s + d[6]) * 1e9)
        R, v, v_by_bias = np.eye(3), np.zeros(3), np.zeros((3, 3))
        y, A = np.zeros((n, 3)), np.zeros((n, 3, 7))
        for k, move in enumerate(run):
            between = samples.between(move.t_a + shift_ns, move.t_b + shift_ns)
            part = preintegrate(between, turning.bias + d[:3], np.zeros(3), spec)
            seen, turn = R @ R_body_cam @ move.T_a_b.t, R @ part.dR - R
            y[k] = seen - v * T[k] - R @ part.dp - turn @ cam0.T_body_cam.t
            A[k] = np.hstack([turn, v_by_bias * T[k] + R @ part.jacobian[3:6, 3:6], -seen[:, None]])
            v, v_by_bias = v + R @ part.dv, v_by_bias + R @ part.jacobian[6:9, 3:6]
            R = R @ part.dR
        return y, A

    y, A = missed(np.zeros(7))
    moved = np.stack([(y - missed(step)[0]) / step.sum() for step in np.diag(STEP)], axis=2)
    own = np.stack([T, T * at + 0.5 * T**2], axis=1)[:, None, :, None] * np.eye(3)[None, :, None, :]
    common = np.concatenate([A, moved], axis=2)
    walk = np.outer(T, T) * np.minimum.outer(at, at) + np.diag(T**3 / 3.0)
    A = np.concatenate([common, own.reshape(n, 3, 6), common[..., BIASES]], axis=2)
    return _Stretch(at + run[0].t_a * 1e-9, A, y, walk)


def _solved(rows: list[_Stretch], prior: Array, prior_wander: Array, accel_noise: float) -> Lever:
    """Least squares with weights that outliers do not pass; sure as leaving out a second at a time leaves it."""
    weights, noise = [np.ones(len(part.y)) for part in rows], (1e-3, accel_noise)
    for _ in range(ROUNDS):
        reduced = [_reduced(part, weight, noise, prior_wander) for part, weight in zip(rows, weights, strict=True)]
        x, H = _common(reduced, prior)
        left = [part.y - part.A @ np.concatenate([x, of.own(x)]) for part, of in zip(rows, reduced, strict=True)]
        miss = [np.linalg.norm(r, axis=1) for r in left]
        spread = max(float(np.median(np.concatenate(miss))) / 1.54, 1e-5)  # median length of three normal coordinates
        weights = [1.0 / (1.0 + (m / (OUTLIER * spread)) ** 2) ** 2 for m in miss]
        noise = _likely(rows, left, weights, noise, accel_noise)
    reduced = [_reduced(part, weight, noise, prior_wander) for part, weight in zip(rows, weights, strict=True)]
    left_out = []
    for i, part in enumerate(rows):
        block = (part.at_s - part.at_s[0]) // BLOCK_S
        for name in np.unique(block):
            less = _reduced(part, np.where(block == name, 1e-9, weights[i]), noise, prior_wander)
            left_out.append(_common([*reduced[:i], less, *reduced[i + 1 :]], prior)[0][:3] - x[:3])
    d = np.array(left_out)
    values, axes = np.linalg.eigh(np.linalg.inv(H)[:3, :3])
    jackknife = (len(d) - 1) / len(d) * ((d @ axes) ** 2).sum(axis=0)
    return Lever(x[:3], (axes * np.maximum(values, jackknife)) @ axes.T)


def _likely(
    rows: list[_Stretch], left: list[Array], weights: list[Array], noise: tuple[float, float], least: float
) -> tuple[float, float]:
    """(m of a move, m/s^2/sqrt(Hz) of the accelerometer, `least` or more) under which what is left is likeliest."""

    def unlikely(logs: Array) -> float:
        spread, density = np.exp(logs)
        total = 0.0
        for part, r, weight in zip(rows, left, weights, strict=True):
            L = _root(part, weight, (max(spread, LEAST_M), max(density, least)))
            total += 3.0 * np.log(np.diag(L)).sum() + 0.5 * float((np.linalg.solve(L, r) ** 2).sum())
        return total

    found = minimize(unlikely, np.log(noise), method="Nelder-Mead", options={"maxfev": 40})
    spread, density = np.exp(found.x)
    return max(float(spread), LEAST_M), max(float(density), least)


def _root(part: _Stretch, weight: Array, noise: tuple[float, float]) -> Array:
    """Cholesky factor of the covariance of an axis of part.y."""
    spread, density = noise
    covariance = density**2 * part.walk + np.diag(spread**2 / np.maximum(weight, 1e-9))
    return np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)


def _reduced(part: _Stretch, weight: Array, noise: tuple[float, float], prior_wander: Array) -> _Reduced:
    L = _root(part, weight, noise)
    J = np.linalg.solve(L, part.A.reshape(len(weight), -1)).reshape(-1, part.A.shape[2])
    r = np.linalg.solve(L, part.y).ravel()
    common, own = J[:, :COMMON], J[:, COMMON:]
    cross = own.T @ common
    free = own.T @ own + np.diag([*[0.0] * 6, *prior_wander])
    gain = np.linalg.solve(free, np.column_stack([cross, own.T @ r]))
    H = common.T @ common - cross.T @ gain[:, :COMMON]
    return _Reduced(H, common.T @ r - cross.T @ gain[:, COMMON], gain)


def _common(parts: Sequence[_Reduced], prior: Array) -> tuple[Array, Array]:
    """What is common to all (14,), and its information (14, 14)."""
    H = np.diag(prior) + sum(part.H for part in parts)
    return np.asarray(np.linalg.solve(H, sum(part.b for part in parts)), dtype=np.float64), H
