"""The frequency of a striped profile: windowed non-linear least squares over a tone and its harmonics.

Source: science note A3. The coarse search is a Hann-windowed periodogram of the profile's square root (bright cores
do not outshout their wings); the fine one fits c + sum_h a_h cos + b_h sin to the profile over its running mean.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lodelight.compiled import kernel
from lodelight.geometry.dense import cholesky, cholesky_solve
from lodelight.types import Array

HARMONICS = 3
LARGEST_HARMONIC = 0.47  # of the row rate
CANDIDATES = 3
LEAST_POWER = 0.05  # of the highest peak's; lower ones are side lobes and noise
DARK = 0.02  # of the brightest part of a face; what is darker says little


@dataclass(frozen=True, eq=False)
class Tone:
    """frequency_hz and its sigma; residual : share of the profile's variance that the model leaves (0 to 1)

    gain : (n,) fitted brightness of each row over its mean along a period
    """

    frequency_hz: float
    sigma_hz: float
    residual: float
    gain: Array


def estimate_tone(
    profile: Array, envelope: Array | None, row_time_s: float, lowest_hz: float, highest_hz: float, noise: float
) -> Tone | None:
    """The tone of a profile (n,) of one sample a row, background taken off; None where the band holds no peak.

    envelope : (n,) what the profile were without stripes; None: not known yet, then its running mean has to do,
        whose ripple and smoothing pull the frequency by up to 2 %
    noise : sigma of one sample. Several peaks are refined, and the one that leaves the least is taken.
    """
    n = len(profile)
    step = 0.2 / n
    lowest, count = lowest_hz * row_time_s, int((highest_hz - lowest_hz) * row_time_s / step) + 1
    if n < 8 or count < 3:
        return None
    window = np.sin(math.pi * (np.arange(n) + 0.5) / n) ** 2
    if envelope is None:
        values, weights = np.sqrt(np.maximum(profile, 0.0)), window
    else:
        values, weights = _normalized(profile, envelope, window, noise)
    power = periodogram(detrended(values, weights), weights, lowest, step, count)
    inner = np.flatnonzero((power[1:-1] >= power[:-2]) & (power[1:-1] > power[2:])) + 1
    inner = inner[power[inner] > LEAST_POWER * power[inner].max(initial=0.0)]
    best: Tone | None = None
    for k in inner[np.argsort(-power[inner], kind="stable")][:CANDIDATES].tolist():
        nu = lowest + k * step
        if envelope is None:
            faded = running_mean(running_mean(profile, 1.0 / nu), 1.0 / nu)
            values, weights = _normalized(profile, faded, window, noise)
        tone = _fine(values, weights, nu, row_time_s)
        if tone and lowest_hz <= tone.frequency_hz <= highest_hz and (best is None or tone.residual < best.residual):
            best = tone
    return best


def _normalized(profile: Array, envelope: Array, window: Array, noise: float) -> tuple[Array, Array]:
    """The profile over its envelope, and weights: little where the envelope drowns in noise."""
    at_least = np.maximum(envelope, max(3.0 * noise, DARK * float(envelope.max())))
    return profile / at_least, window * (envelope / at_least) ** 2


def _fine(values: Array, weights: Array, nu: float, row_time_s: float) -> Tone | None:
    """The tone near nu cycles per row, None where there is none within 0.8 of a cycle over the profile."""
    n = len(values)
    harmonics = max(1, min(HARMONICS, int(LARGEST_HARMONIC / nu)))
    step = 0.1 / n
    grid: Array = nu + step * np.arange(-8.0, 9.0)
    costs = tone_costs(values, weights, grid, harmonics)
    k = int(np.argmin(costs))
    if k in (0, len(grid) - 1) or not np.isfinite(costs).all():
        return None
    curve = float(costs[k - 1] - 2.0 * costs[k] + costs[k + 1])
    if not curve > 0.0:
        return None
    nu = float(grid[k] + 0.5 * step * (costs[k - 1] - costs[k + 1]) / curve)
    gain, beta = np.empty(n), np.zeros(1 + 2 * HARMONICS)
    cost = tone_fit(values, weights, nu, harmonics, gain, beta)
    if np.hypot(beta[3], beta[4]) > np.hypot(beta[1], beta[2]):
        return None  # of a PWM light, the second harmonic is never the stronger: this is half of its frequency
    total = float(np.sum(weights * (values - np.sum(weights * values) / np.sum(weights)) ** 2))
    # Sandwich: residuals of variance s2 under weights that are not their information; lever arms grow from the middle
    y = np.arange(n) - np.sum(weights * np.arange(n)) / np.sum(weights)
    spread = float(np.sum(weights**2 * y**2) / np.sum(weights * y**2))
    used = 2.0 * harmonics + 2.0
    free = max(float(np.sum(weights) ** 2 / np.sum(weights**2)) - used, 1.0)
    s2 = cost / np.sum(weights) * (free + used) / free
    sigma_nu = math.sqrt(2.0 * s2 * spread * step**2 / curve)
    return Tone(nu / row_time_s, sigma_nu / row_time_s, cost / max(total, 1e-12), gain)


@kernel
def detrended(s: Array, w: Array) -> Array:
    """s less its weighted quadratic."""
    n = len(s)
    A, b = np.zeros((3, 3)), np.zeros(3)
    for k in range(n):
        x = 2.0 * k / n - 1.0
        p = (1.0, x, x * x)
        for i in range(3):
            b[i] += w[k] * p[i] * s[k]
            for j in range(3):
                A[i, j] += w[k] * p[i] * p[j]
    out: Array = s.copy()
    if cholesky(A):
        cholesky_solve(A, b)
        for k in range(n):
            x = 2.0 * k / n - 1.0
            out[k] -= b[0] + b[1] * x + b[2] * x * x
    return out


@kernel
def periodogram(s: Array, w: Array, nu0: float, step: float, count: int) -> Array:
    """|sum w s exp(-2 pi i nu k)|^2 at nu0 + step * (0 .. count - 1) cycles per sample."""
    out = np.empty(count)
    for i in range(count):
        a = 2.0 * math.pi * (nu0 + step * i)
        turn_c, turn_s = math.cos(a), math.sin(a)
        c, d = 1.0, 0.0
        re, im = 0.0, 0.0
        for k in range(len(s)):
            v = w[k] * s[k]
            re += v * c
            im -= v * d
            c, d = c * turn_c - d * turn_s, d * turn_c + c * turn_s
        out[i] = re * re + im * im
    return out


@kernel
def running_mean(s: Array, period: float) -> Array:
    """Mean of s over `period` samples around each, of what is inside; the ends of the window count in part."""
    n = len(s)
    total = np.zeros(n + 1)
    for k in range(n):
        total[k + 1] = total[k] + s[k]
    out = np.empty(n)
    for k in range(n):
        a, b = max(k + 0.5 - 0.5 * period, 0.0), min(k + 0.5 + 0.5 * period, float(n))
        ia, ib = min(int(a), n - 1), min(int(b), n - 1)
        upper = total[ib] + (b - ib) * s[ib]
        lower = total[ia] + (a - ia) * s[ia]
        out[k] = (upper - lower) / (b - a)
    return out


@kernel
def tone_fit(s: Array, w: Array, nu: float, harmonics: int, fitted: Array, beta: Array) -> float:
    """Weighted least squares of a constant and `harmonics` of nu cycles per sample: its cost.

    Fills fitted (n,) and beta (1 + 2 harmonics or more,): constant, then cosine and sine of each.
    """
    n, m = len(s), 1 + 2 * harmonics
    A, b, p = np.zeros((m, m)), np.zeros(m), np.empty(m)
    for k in range(n):
        _basis(nu, k, n, p)
        for i in range(m):
            b[i] += w[k] * p[i] * s[k]
            for j in range(i + 1):
                A[i, j] += w[k] * p[i] * p[j]
    for i in range(m):
        A[i, i] += 1e-12
        for j in range(i):
            A[j, i] = A[i, j]
    if not cholesky(A):
        return np.inf
    cholesky_solve(A, b)
    beta[:m] = b
    cost = 0.0
    for k in range(n):
        _basis(nu, k, n, p)
        fitted[k] = 0.0
        for i in range(m):
            fitted[k] += b[i] * p[i]
        cost += w[k] * (s[k] - fitted[k]) ** 2
    return cost


@kernel
def tone_costs(s: Array, w: Array, nus: Array, harmonics: int) -> Array:
    out, fitted, beta = np.empty(len(nus)), np.empty(len(s)), np.empty(1 + 2 * harmonics)
    for i in range(len(nus)):
        out[i] = tone_fit(s, w, nus[i], harmonics, fitted, beta)
    return out


@kernel
def _basis(nu: float, k: int, n: int, p: Array) -> None:
    """1 and the harmonics' cosines and sines at sample k, counted from the middle."""
    a = 2.0 * math.pi * nu * (k - 0.5 * (n - 1))
    c1, s1 = math.cos(a), math.sin(a)
    p[0] = 1.0
    c, s = 1.0, 0.0
    for h in range((len(p) - 1) // 2):
        c, s = c * c1 - s * s1, s * c1 + c * s1
        p[1 + 2 * h], p[2 + 2 * h] = c, s
