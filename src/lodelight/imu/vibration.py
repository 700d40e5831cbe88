"""How noisy an accelerometer is where it is mounted: motors shake it faster than it is sampled.

A data sheet's density is that of a sensor at rest. On a drone, single samples differ from their neighbours by a
hundred times more: vibration, sampled too seldom to be integrated. What is left of it in the velocity is a share of
what as much white noise would leave. (On EuRoC MH_05 the data sheet has 0.002 m/s^2/sqrt(Hz); the samples' second
differences say 0.06; velocities over 0.05 to 1 s err as with 0.02.) So the density is taken from the samples.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from lodelight.imu.samples import ImuSamples
from lodelight.rig import ImuSpec

MEMORY_S = 1.0


class Vibration:
    """Follows the accelerometer's noise. share : of white noise as strong as what the samples show."""

    def __init__(self, spec: ImuSpec, share: float) -> None:
        self.spec = spec
        self.share = share
        self._density2 = spec.accel_noise**2

    def add(self, samples: ImuSamples) -> ImuSpec:
        """The specification with the noise that the samples so far show, never less than the data sheet's."""
        n = len(samples)
        if n >= 4 and self.share > 0.0:
            t_s = (samples.t_ns - samples.t_ns[0]) * 1e-9
            inner = samples.accel[1:-1]  # the outer two are interpolated
            if len(inner) >= 3:
                second = inner[2:] - 2.0 * inner[1:-1] + inner[:-2]
                period = float(np.median(np.diff(t_s)))
                shown2 = float((second**2).mean()) / 6.0 * period
                weight = min(t_s[-1] / MEMORY_S, 1.0)
                self._density2 += weight * (self.share**2 * shown2 - self._density2)
        noise = math.sqrt(max(self._density2, self.spec.accel_noise**2))
        return replace(self.spec, accel_noise=noise)
