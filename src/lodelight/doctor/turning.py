"""How vision and gyro turn: the time between their clocks, the turn between their axes, and their scale."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from lodelight.doctor.findings import jackknifed
from lodelight.doctor.gather import Pair
from lodelight.geometry.cameras import Camera
from lodelight.geometry.so3 import so3_exp, so3_log
from lodelight.io.stamps import NS_PER_S
from lodelight.types import Array

LEAST_PAIRS = 12
LEAST_TURN = 0.004  # rad, of pairs in the root mean square
LEAST_SIGMA = 0.4e-3  # rad
SEARCH_S, STEP_S = 0.5, 0.005
HUBER = 2.0  # sigmas
BLOCK_S = 2.0  # for which errors may be alike
# How wrong things may well be: offset s, turn rad, gyro bias rad/s, scale. Where a motion tells nothing of one of them
# (a cart turns about one axis only), these keep it where the rig has it, and its sigma is as large as they are.
MAYBE = np.array([0.05, *[0.3] * 3, *[0.05] * 3, 0.1])


@dataclass(frozen=True, eq=False)
class Turn:
    """The rotation of camera 0 between two frames, of vision alone.

    vector : (3,) rad, R_a_b = Exp(vector); information : (3, 3) 1/rad^2
    """

    t_a: int
    t_b: int
    vector: Array
    information: Array


def turn_of(pair: Pair, lens: Camera) -> Turn | None:
    """By the epipolar geometry of a pair, which needs no depth and no other camera. None where it is not rigid.

    Who walks through the picture, and what is nearly one plane or nearly no translation, makes several geometries
    fit: from several beginnings that with the least median is taken.
    """
    f_a, ok_a = lens.unproject(pair.a_px)
    f_b, ok_b = lens.unproject(pair.b_px)
    ok = ok_a & ok_b & (f_a[:, 2] > 0.05) & (f_b[:, 2] > 0.05)
    if np.count_nonzero(ok) < 20:
        return None
    f_a, f_b = f_a[ok], f_b[ok]
    pixel = 1.0 / lens.focal_px
    fits = [_refined(R, t, f_a, f_b, pixel, 4) for R, t in _beginnings(f_a, f_b, pixel)]
    best = min(fits, key=lambda fit: fit[3])
    R, _, information, spread_px = _refined(best[0], best[1], f_a, f_b, pixel, 10)
    return Turn(pair.t_a, pair.t_b, so3_log(R), information) if spread_px < 1.0 else None


def _beginnings(f_a: Array, f_b: Array, pixel: float) -> list[tuple[Array, Array]]:
    """(R_a_b, t_a_b) to begin with: no translation, along each axis; and the five-point geometry of most corners."""
    R = _turned(f_a, f_b, pixel)
    found: list[tuple[Array, Array]] = [(R, axis) for axis in np.eye(3)]
    n_a, n_b = f_a[:, :2] / f_a[:, 2:], f_b[:, :2] / f_b[:, 2:]
    cv2.setRNGSeed(0)
    E, _ = cv2.findEssentialMat(n_b, n_a, np.eye(3), cv2.USAC_MAGSAC, 0.999, 1.0 * pixel, maxIters=300)
    if E is not None and E.shape == (3, 3):
        R1, R2, t = cv2.decomposeEssentialMat(E)
        both = [np.asarray(R1, np.float64), np.asarray(R2, np.float64)]
        found.append((min(both, key=lambda m: float(np.linalg.norm(so3_log(m)))), np.asarray(t, np.float64).ravel()))
    return found


def _turned(f_a: Array, f_b: Array, pixel: float) -> Array:
    """R_a_b that turns most rays b onto rays a, as if nothing had moved. Reweighted Kabsch."""
    a, b = (f / np.linalg.norm(f, axis=1, keepdims=True) for f in (f_a, f_b))
    weight, R = np.ones(len(a)), np.eye(3)
    for _ in range(8):
        U, _, Vt = np.linalg.svd((a * weight[:, None]).T @ b)
        R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        miss = np.linalg.norm(a - b @ R.T, axis=1) / pixel
        scale = max(1.4826 * float(np.median(miss)), 0.1)
        weight = 1.0 / (1.0 + (miss / scale) ** 2)
    return np.asarray(R)


def epipolar_miss(R_a_b: Array, t_a_b: Array, f_a: Array, f_b: Array) -> Array:
    """Angles, rad, by which rays f_a (N, 3) miss the planes that rays f_b span with the base line t_a_b."""
    turned = f_b @ R_a_b.T
    t = t_a_b / np.linalg.norm(t_a_b)
    nx, ny = t[1] * turned[:, 2] - t[2] * turned[:, 1], t[2] * turned[:, 0] - t[0] * turned[:, 2]
    nz = t[0] * turned[:, 1] - t[1] * turned[:, 0]
    length = np.sqrt(nx * nx + ny * ny + nz * nz) * np.sqrt((f_a * f_a).sum(axis=1))
    dot: Array = nx * f_a[:, 0] + ny * f_a[:, 1] + nz * f_a[:, 2]
    return np.asarray(dot / np.maximum(length, 1e-12))


def _refined(
    R: Array, t: Array, f_a: Array, f_b: Array, pixel: float, steps: int
) -> tuple[Array, Array, Array, float]:  # fmt: skip
    """R_a_b, t_a_b to the least squares of the misses of corners that fit; R's information; their spread in px.

    Gauss-Newton with Cauchy weights, whose scale is the spread of the better half: a walker is soon out of it.
    """
    H, spread = np.eye(5), np.inf
    for _ in range(steps):
        t = t / np.linalg.norm(t)
        across = np.linalg.svd(t[None])[2][1:]

        def moved(x: Array, R: Array = R, t: Array = t, across: Array = across) -> tuple[Array, Array]:
            return R @ so3_exp(x[:3]), t + x[3:] @ across

        miss = epipolar_miss(R, t, f_a, f_b) / pixel
        spread = max(1.4826 * float(np.median(np.abs(miss))), 0.02)
        weight = 1.0 / (1.0 + (miss / (2.0 * spread)) ** 2) ** 2
        J = np.column_stack([(epipolar_miss(*moved(d), f_a, f_b) / pixel - miss) / 1e-5 for d in 1e-5 * np.eye(5)])
        JW = J.T * weight
        H = JW @ J
        damped = H + 1e-6 * np.trace(H) * np.eye(5)
        x = -np.linalg.solve(damped, JW @ miss)
        x *= min(1.0, 0.3 / max(float(np.abs(x[3:]).max()), 1e-9))
        R, t = moved(x)
        if np.abs(x[:3]).max() < 1e-7:
            break
    information = (H[:3, :3] - H[:3, 3:] @ np.linalg.pinv(H[3:, 3:]) @ H[3:, :3]) / max(spread, 0.05) ** 2
    return R, t, 0.5 * (information + information.T), spread


def _root(information: Array) -> Array:
    """(3, 3) that whitens a turn. No turn is better than LEAST_SIGMA: lenses and clocks are not."""
    covariance = np.linalg.inv(information + 1e-6 * np.trace(information) * np.eye(3))
    root = np.linalg.cholesky(np.linalg.inv(covariance + LEAST_SIGMA**2 * np.eye(3)))
    return np.asarray(root.T)


class Gyro:
    """A gyro's turning between any two instants."""

    def __init__(self, t_ns: NDArray[np.int64], rate: Array) -> None:
        self.zero_ns = int(t_ns[0])
        self.t_s = (t_ns - self.zero_ns) / NS_PER_S
        self.rate = rate
        steps = np.diff(self.t_s)[:, None]
        self._angle = np.vstack([np.zeros(3), np.cumsum(0.5 * steps * (rate[1:] + rate[:-1]), axis=0)])

    def covers(self, t_a: int, t_b: int, margin_s: float) -> bool:
        a, b = (t_a - self.zero_ns) / NS_PER_S - margin_s, (t_b - self.zero_ns) / NS_PER_S + margin_s
        inside = (self.t_s >= a) & (self.t_s <= b)
        count = int(np.count_nonzero(inside))
        if a < self.t_s[0] or b > self.t_s[-1] or count < 3:
            return False
        return bool(np.diff(self.t_s[inside]).max() < 0.05)

    def angles(self, t_s: Array) -> Array:
        """(N, 3) rad: the rates summed up to instants, without the order of turns."""
        return np.column_stack([np.interp(t_s, self.t_s, self._angle[:, axis]) for axis in range(3)])

    def turn(self, a_s: float, b_s: float) -> Array:
        """(3,) rad, Log of the rotation from a to b: the rates in turn."""
        first, last = np.searchsorted(self.t_s, [a_s, b_s])
        knots = np.unique(np.concatenate([[a_s], self.t_s[first:last], [b_s]]))
        steps = np.diff(self.angles(knots), axis=0)
        R = np.eye(3)
        for step in steps:
            R = R @ so3_exp(step)
        return so3_log(R)


@dataclass(frozen=True, eq=False)
class Alignment:
    """How vision and gyro differ.

    offset_s : is to be added to the stamps of images; turn_rad : (3,) R_body_cam = rig's Exp(turn_rad), by camera axes
    scale : of visual angles about axes across the optical one over the gyro's: true focal length over the rig's
    sigma_... : standard deviations, scaled to the residuals' spread; that of the offset, which one turn of the body
    may pretend, is no less than what leaving out BLOCK_S at a time does to it; residual_rad : that spread; pairs : used
    rate_ratio, correlation : of the speeds of turning, vision to gyro; bias : (3,) rad/s of the gyro
    """

    offset_s: float
    sigma_offset_s: float
    turn_rad: Array
    sigma_turn_rad: Array
    scale: float
    sigma_scale: float
    residual_rad: float
    pairs: int
    rate_ratio: float
    correlation: float
    bias: Array


def align(turns: list[Turn], gyro: Gyro, R_body_cam: Array) -> Alignment | None:
    """None where there is too little turning to tell anything."""
    turns = [turn for turn in turns if gyro.covers(turn.t_a, turn.t_b, SEARCH_S)]
    if len(turns) < LEAST_PAIRS:
        return None
    a_s, b_s = (np.array([(getattr(t, n) - gyro.zero_ns) / NS_PER_S for t in turns]) for n in ("t_a", "t_b"))
    vision = np.array([turn.vector for turn in turns])
    if np.sqrt((vision**2).sum(axis=1).mean()) < LEAST_TURN:
        return None
    offset_s, ratio, correlation = _coarse(vision, gyro, a_s, b_s)
    return _fine(turns, vision, gyro, a_s, b_s, R_body_cam, offset_s, ratio, correlation)


def _coarse(vision: Array, gyro: Gyro, a_s: Array, b_s: Array) -> tuple[float, float, float]:
    """Offset by which the speeds of turning agree best, the ratio of vision's to the gyro's there, the correlation."""
    speed = np.linalg.norm(vision, axis=1) / (b_s - a_s)
    best = (0.0, 0.0, -1.0)
    for offset_s in np.arange(-SEARCH_S, SEARCH_S + STEP_S / 2, STEP_S):
        rates = (gyro.angles(b_s + offset_s) - gyro.angles(a_s + offset_s)) / (b_s - a_s)[:, None]
        said = np.linalg.norm(rates, axis=1)
        if said.std() < 1e-9 or speed.std() < 1e-9:
            continue
        correlation = float(np.corrcoef(speed, said)[0, 1])
        if correlation > best[2]:
            best = float(offset_s), float(speed @ said / (said @ said)), correlation
    return best


def _fine(
    turns: list[Turn], vision: Array, gyro: Gyro, a_s: Array, b_s: Array, R_body_cam: Array, offset_s: float,
    ratio: float, correlation: float,
) -> Alignment:  # fmt: skip
    """All at once: offset, turn of the axes, bias, scale; pairs that were tracked wrong count little."""
    length = (b_s - a_s)[:, None]
    roots = [_root(turn.information) for turn in turns]

    def said(offset: float) -> Array:
        return np.array([gyro.turn(a + offset, b + offset) for a, b in zip(a_s, b_s, strict=True)])

    step = 0.002
    at = offset_s
    for _ in range(3):  # the gyro's angles are all but linear in the offset: move the point of expansion a few times
        middle = said(at)
        slope = (said(at + step) - said(at - step)) / (2 * step)

        def residual(x: Array, middle: Array = middle, slope: Array = slope) -> Array:
            turned = (middle + slope * x[0] - x[4:7] * length) @ (R_body_cam @ so3_exp(x[1:4]))
            turned[:, :2] *= 1.0 + x[7]
            misses = [root @ row for root, row in zip(roots, vision - turned, strict=True)]
            return np.concatenate([*misses, x / MAYBE])

        fit = least_squares(
            residual, np.zeros(8), loss="huber", f_scale=HUBER, x_scale=[0.01, *[0.05] * 3, *[0.01] * 3, 0.05]
        )
        at += float(np.clip(fit.x[0], -0.02, 0.02))
        if abs(fit.x[0]) < 2e-4:
            break
    spread = max(1.0, 1.4826 * float(np.median(np.abs(residual(fit.x)))))
    sigma = np.sqrt(np.diag(np.linalg.pinv(fit.jac.T @ fit.jac))) * spread
    r = residual(fit.x)
    J = np.column_stack([(residual(fit.x + d) - r) / 1e-6 for d in 1e-6 * np.eye(8)])
    weight = np.minimum(1.0, HUBER / np.maximum(np.abs(r), 1e-12))
    by_blocks = jackknifed(J, weight, r, np.repeat((0.5 * (a_s + b_s) // BLOCK_S).astype(int), 3))
    sigma[0] = max(sigma[0], float(np.sqrt(by_blocks[0, 0])))
    turned = (middle + slope * fit.x[0] - fit.x[4:7] * length) @ (R_body_cam @ so3_exp(fit.x[1:4]))
    left = 1.4826 * float(np.median(np.abs(vision - turned)))
    return Alignment(
        at, float(sigma[0]), fit.x[1:4], sigma[1:4], 1.0 + float(fit.x[7]), float(sigma[7]), left, len(turns), ratio,
        correlation, fit.x[4:7],
    )  # fmt: skip
