"""Ways to go along a route: a cart, a walking person, a drone, a camera in the hand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from lodelight.sim.motion import DEGREE, KNOT_S, Motion
from lodelight.types import Array

STEP_M = 0.02  # along the route
RAMP_S = 2.0  # to come to speed
TURN_RATE = 0.9  # rad/s in bends, about


@dataclass(frozen=True)
class Gait:
    """speed m/s; height of the body over the floor, m; round_m: corners are cut over this length either side

    bob, sway : amplitude m of a step's rise and of a stride's sway; stride_hz: two steps
    shake : deviation of slow wander, (m, m, m, deg yaw, deg pitch, deg roll), in the band (from, to) Hz
    bank : how much of the acceleration shows as tilt, as with a multicopter
    """

    speed: float
    height: float
    round_m: float
    bob: float = 0.0
    sway: float = 0.0
    stride_hz: float = 0.0
    rock_deg: float = 0.0
    shake: tuple[float, ...] = (0.0,) * 6
    band_hz: tuple[float, float] = (0.05, 0.3)
    bank: float = 0.0


GAITS: dict[str, Gait] = {
    "cart": Gait(0.9, 1.3, 0.9),
    "walk": Gait(1.0, 1.45, 0.7, 0.011, 0.015, 0.8, 0.2, (0.02, 0.02, 0.01, 4.0, 1.5, 0.8), (0.05, 0.25)),
    "drone": Gait(1.1, 1.5, 0.9, shake=(0.05, 0.05, 0.16, 12.0, 1.0, 1.0), band_hz=(0.05, 0.25), bank=0.5),
    "hand": Gait(0.45, 1.4, 0.6, 0.006, 0.008, 0.7, 0.2, (0.05, 0.05, 0.05, 12.0, 4.0, 2.5), (0.06, 0.27)),
}


def generate(
    gait: Gait,
    route: Array,
    duration_s: float,
    start_ns: int,
    rng: np.random.Generator,
    standstill_s: float = 0.0,
) -> Motion:
    """Motion along a closed route (N, 2) m, lap after lap, from rest after `standstill_s`.

    Every lap runs the same way, so places are seen again from near where they were seen before.
    """
    n = int(np.ceil(duration_s / KNOT_S)) + DEGREE + 1
    t = KNOT_S * (np.arange(n, dtype=np.float64) - 0.5 * (DEGREE - 1)) - standstill_s
    line, heading = rounded(route, gait.round_m)
    s_line = STEP_M * np.arange(len(line) + 1)
    lap = s_line[-1]
    along, speed = _progress(gait, t, heading, rng)
    xy = np.stack([np.interp(along % lap, s_line, np.append(line[:, k], line[0, k])) for k in range(2)], axis=1)
    turn = 2 * np.pi * np.round((heading[-1] - heading[0]) / (2 * np.pi))
    yaw = np.unwrap(np.interp(along % lap, s_line, np.append(heading, heading[0] + turn)))
    moving = speed / gait.speed
    shake = _wander(gait, t, rng) * _ramp(t)[:, None]
    stride = 2.0 * np.pi * gait.stride_hz * np.cumsum(moving) * KNOT_S
    side = np.stack([-np.sin(yaw), np.cos(yaw)], axis=1)
    xy = xy + side * (gait.sway * moving * np.sin(stride))[:, None] + shake[:, :2]
    z = gait.height + gait.bob * moving * np.cos(2.0 * stride) + shake[:, 2]
    yaw = yaw + np.radians(gait.rock_deg * moving * np.cos(stride) + shake[:, 3])
    pitch = np.radians(gait.rock_deg * moving * np.sin(2.0 * stride + 0.7) + shake[:, 4])
    roll = np.radians(0.8 * gait.rock_deg * moving * np.sin(stride + 0.3) + shake[:, 5])
    if gait.bank:
        forward, left = _body_acceleration(xy, yaw)
        pitch, roll = pitch + gait.bank * forward / 9.81, roll - gait.bank * left / 9.81
    quat = Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], axis=1)).as_quat()[:, [3, 0, 1, 2]]
    return Motion.from_controls(np.hstack([xy, z[:, None], quat]), start_ns, duration_s)


def lap_seconds(gait: Gait, route: Array) -> float:
    """Time of one lap of a closed route, about: bends slow it down."""
    _, heading = rounded(route, gait.round_m)
    return float(STEP_M * np.sum(1.0 / _slow(gait, heading)) / gait.speed)


def _slow(gait: Gait, heading: Array) -> Array:
    """Factor on the speed along the route: less in bends."""
    bend = np.abs(np.gradient(heading, STEP_M))
    return _circular((1.0 / np.sqrt(1.0 + (gait.speed * bend / TURN_RATE) ** 2))[:, None], _window(0.3))[:, 0]


def _ramp(t: Array) -> Array:
    """0 before 0, 1 after RAMP_S, smooth to the second derivative."""
    u = np.clip(t / RAMP_S, 0.0, 1.0)
    return u**3 * (10.0 + u * (6.0 * u - 15.0))


def _progress(gait: Gait, t: Array, heading: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """(way along the route m, speed m/s) at times t: slower in bends, and wandering by an eighth."""
    wander = gait.speed * (1.0 + 0.12 * _noise(t, (0.03, 0.12), rng)) * _ramp(t)
    slow = _slow(gait, heading)
    along, speed = np.zeros(len(t)), np.zeros(len(t))
    for i in range(len(t)):
        speed[i] = wander[i] * slow[int(along[i] / STEP_M) % len(slow)]
        if i + 1 < len(t):
            along[i + 1] = along[i] + KNOT_S * speed[i]
    return along, speed


def rounded(route: Array, radius: float) -> tuple[Array, Array]:
    """The route every STEP_M with its corners rounded, (M, 2) m, and its heading, rad, unwrapped."""
    closed = np.vstack([route, route[:1]])
    legs = np.linalg.norm(np.diff(closed, axis=0), axis=1)
    at = np.concatenate([[0.0], np.cumsum(legs)])
    count = round(at[-1] / STEP_M)
    s = np.linspace(0.0, at[-1], count, endpoint=False)
    line = np.stack([np.interp(s, at, closed[:, k]) for k in range(2)], axis=1)
    smooth = _circular(line, _window(radius))
    ahead = np.roll(smooth, -5, axis=0) - np.roll(smooth, 5, axis=0)
    heading = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    return smooth, heading


def _window(radius: float) -> Array:
    window = np.hanning(2 * int(radius / STEP_M) + 3)[1:-1]
    out: Array = window / window.sum()
    return out


def _circular(values: Array, window: Array) -> Array:
    half = len(window) // 2
    padded = np.concatenate([values[-half:], values, values[:half]])
    return np.stack([np.convolve(padded[:, k], window, mode="valid") for k in range(values.shape[1])], axis=1)


def _noise(t: Array, band_hz: tuple[float, float], rng: np.random.Generator) -> Array:
    """Smooth noise of deviation 1: eight sines in a band."""
    f = np.exp(rng.uniform(np.log(band_hz[0]), np.log(band_hz[1]), 8))
    phase = rng.uniform(0, 2 * np.pi, 8)
    out: Array = np.sin(2 * np.pi * f * t[:, None] + phase).sum(axis=1) / 2.0
    return out


def _wander(gait: Gait, t: Array, rng: np.random.Generator) -> Array:
    return np.stack([amount * _noise(t, gait.band_hz, rng) for amount in gait.shake], axis=1)


def _body_acceleration(xy: Array, yaw: Array) -> tuple[Array, Array]:
    """Forward and left acceleration, m/s^2, smoothed over a second as a flight controller would."""
    a = np.gradient(np.gradient(xy, KNOT_S, axis=0), KNOT_S, axis=0)
    window = np.hanning(23)[1:-1]
    pad = np.pad(a, ((10, 10), (0, 0)), mode="edge")
    a = np.stack([np.convolve(pad[:, k], window / window.sum(), mode="valid") for k in range(2)], axis=1)
    c, s = np.cos(yaw), np.sin(yaw)
    return c * a[:, 0] + s * a[:, 1], c * a[:, 1] - s * a[:, 0]
