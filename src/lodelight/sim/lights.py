"""How bright a lamp is while a row of an image is exposed (science note A2)."""

from __future__ import annotations

import math

import numpy as np

from lodelight.sim.scene import Lamp
from lodelight.types import Array

MAINS_HZ, MAINS_RIPPLE = 100.0, 0.3  # of lamps without a code, and its amplitude over their mean


def pwm_mean(frequency_hz: float, duty: float, phase: float, start_s: Array, exposure_s: float) -> Array:
    """Mean over [start, start + exposure] of a light that is 1 while frac(f t + phase) < duty, else 0; exactly."""

    def lit(t: Array) -> Array:  # seconds of light until t
        x = frequency_hz * t + phase
        whole = np.floor(x)
        out: Array = (whole * duty + np.minimum(x - whole, duty)) / frequency_hz
        return out

    return (lit(start_s + exposure_s) - lit(start_s)) / exposure_s


def brightness(lamps: tuple[Lamp, ...], start_s: Array, exposure_s: float) -> Array:
    """(rows, lamps) factor on each lamp's mean radiance for rows exposed from `start_s` (rows,) on."""
    out = np.zeros((len(start_s), len(lamps)))
    for i, lamp in enumerate(lamps):
        if not lamp.on:
            continue
        if lamp.frequency_hz > 0.0:
            out[:, i] = pwm_mean(lamp.frequency_hz, lamp.duty, lamp.phase, start_s, exposure_s) / lamp.duty
        elif abs(lamp.normal[2]) > 0.5:
            w = 2.0 * math.pi * MAINS_HZ
            turns = np.cos(w * start_s) - np.cos(w * (start_s + exposure_s))
            out[:, i] = 1.0 + MAINS_RIPPLE * turns / (w * exposure_s)
        else:
            out[:, i] = 1.0  # daylight through a window
    return out
