"""How noisy an IMU is where it is mounted: motors shake it faster than it is sampled.

A data sheet's density is that of a sensor at rest. On a drone, single samples differ from their neighbours by ten to
fifty times more: vibration, sampled too seldom to be integrated, and with it the errors of scale and of alignment that
a data sheet tells apart from noise. What is left of all that in angle and velocity is a share of what as much white
noise would leave, so the densities are taken from the samples. docs/inertial.md has the figures of the share.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from lodelight.imu.samples import ImuSamples
from lodelight.rig import ImuSpec
from lodelight.types import Array

MEMORY_S = 1.0
# A tenth of the noise of a good MEMS sensor. One that is said to have none, as a simulated one may be, could not be
# weighed against anything.
LEAST = {"gyro_noise": 1.7e-5, "gyro_walk": 1.9e-6, "accel_noise": 2.0e-4, "accel_walk": 3.0e-4}


def with_least_noise(spec: ImuSpec) -> ImuSpec:
    """The specification with noise that no sensor is without."""
    return replace(spec, **{name: max(least, getattr(spec, name)) for name, least in LEAST.items()})


class Vibration:
    """Follows the noise of an IMU. spec : of one at rest; share : of white noise as strong as what the samples show."""

    def __init__(self, spec: ImuSpec, share: float) -> None:
        self.spec = with_least_noise(spec)
        self.share = share
        self._density2 = np.array([self.spec.gyro_noise, self.spec.accel_noise]) ** 2

    def add(self, samples: ImuSamples) -> ImuSpec:
        """The specification with the noise that the samples so far show, never less than the data sheet's."""
        if len(samples) >= 5 and self.share > 0.0:
            t_s = (samples.t_ns - samples.t_ns[0]) * 1e-9
            period = float(np.median(np.diff(t_s)))
            shown2 = np.array([_white2(samples.gyro, period), _white2(samples.accel, period)])
            self._density2 += min(t_s[-1] / MEMORY_S, 1.0) * (self.share**2 * shown2 - self._density2)
        gyro, accel = (math.sqrt(d) for d in self._density2)
        return replace(
            self.spec, gyro_noise=max(gyro, self.spec.gyro_noise), accel_noise=max(accel, self.spec.accel_noise)
        )


def _white2(x: Array, period: float) -> float:
    """Squared density, of the mean axis, of the white noise that has the second differences of x (N, 3)."""
    inner = x[1:-1]  # the outer two are interpolated
    second = inner[2:] - 2.0 * inner[1:-1] + inner[:-2]
    return float((second**2).mean()) / 6.0 * period
