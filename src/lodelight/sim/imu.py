"""An inertial sensor: what it would read, its noise, its wandering biases (science note E)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lodelight.io.stamps import NS_PER_S
from lodelight.rig import ImuSpec
from lodelight.sim.motion import GRAVITY, Motion
from lodelight.types import Array

EUROC = ImuSpec()
# A telephone's MEMS part (BMI055 class), upper end of the densities its data sheet gives
PHONE = ImuSpec(rate_hz=200.0, gyro_noise=3.0e-4, gyro_walk=2.0e-5, accel_noise=3.0e-3, accel_walk=1.0e-3)
TURN_ON = {"euroc": (0.02, 0.05), "phone": (0.01, 0.2), "perfect": (0.0, 0.0)}  # rad/s, m/s^2, deviation per axis
SPECS = {
    "euroc": EUROC,
    "phone": PHONE,
    "perfect": replace(EUROC, gyro_noise=0, gyro_walk=0, accel_noise=0, accel_walk=0),
}


@dataclass(frozen=True, eq=False)
class ImuSeries:
    """t_ns (N,); gyro rad/s and accel m/s^2 (N, 3), body frame; the biases in them, (N, 3)"""

    t_ns: NDArray[np.int64]
    gyro: Array
    accel: Array
    bias_gyro: Array
    bias_accel: Array


def read_out(
    motion: Motion, spec: ImuSpec, rng: np.random.Generator, turn_on: tuple[float, float] = (0.0, 0.0)
) -> ImuSeries:
    """Samples of the instants of `spec.rate_hz`; white noise sigma / sqrt(dt), biases that walk by sigma sqrt(dt)."""
    dt = 1.0 / spec.rate_hz
    n = int(motion.duration_s * spec.rate_hz) + 1
    true_ns = motion.start_ns + np.round(np.arange(n) * (NS_PER_S / spec.rate_hz)).astype(np.int64)
    state = motion.at_ns(true_ns)
    specific = np.einsum("nji,nj->ni", state.R_world_body, state.a_world - GRAVITY)
    steps = rng.standard_normal((2, n, 3)) * math.sqrt(dt)
    steps[:, 0] = rng.standard_normal((2, 3))
    scale = np.array([spec.gyro_walk, spec.accel_walk])[:, None, None]
    first = np.array(turn_on)[:, None]
    bias = np.cumsum(np.concatenate([(steps[:, 0] * first)[:, None], scale * steps[:, 1:]], axis=1), axis=1)
    white = rng.standard_normal((2, n, 3)) / math.sqrt(dt)
    stamps = true_ns - round(spec.time_offset_s * NS_PER_S)
    return ImuSeries(
        stamps,
        state.omega + bias[0] + spec.gyro_noise * white[0],
        specific + bias[1] + spec.accel_noise * white[1],
        bias[0],
        bias[1],
    )
