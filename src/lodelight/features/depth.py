"""Depth of corners from a depth image, with the noise of the sensor and of its registration."""

from __future__ import annotations

import math

import numpy as np

from lodelight.compiled import kernel
from lodelight.rig import DepthSpec
from lodelight.types import ArrayF32

# A depth pixel belongs to an image pixel only to within this: calibration of the two lenses against each other, and
# their shutters, which consumer sensors do not open together.
MISREGISTRATION_PX = 2
# Scale error of a factory-calibrated sensor, as a share of the depth.
SCALE_ERROR = 0.005


def depth_at(px: ArrayF32, depth: ArrayF32, spec: DepthSpec) -> tuple[ArrayF32, ArrayF32]:
    """Inverse depth and its sigma (N,) 1/m, read at the pixel of `depth` (H, W) m nearest to each px; 0 = no reading.

    sigma_z^2 = (a + b (z - c)^2)^2 + (scale error z)^2 + (half the spread of depths around)^2: where the depth changes
    from pixel to pixel, as on the rim of an object, a misregistered reading says little.
    """
    z, spread = _read(px, depth)
    a, b, c = spec.noise
    sigma_z = np.sqrt((a + b * (z - c) ** 2) ** 2 + (SCALE_ERROR * z) ** 2 + (0.5 * spread) ** 2)
    inv_depth = np.divide(1.0, z, out=np.zeros_like(z), where=z > 0)
    return inv_depth, sigma_z * inv_depth**2


@kernel
def _read(px: ArrayF32, depth: ArrayF32) -> tuple[ArrayF32, ArrayF32]:
    """Depth (N,) m at the nearest pixel, and the spread of the readings around it."""
    height, width = depth.shape
    z, spread = np.zeros(len(px), np.float32), np.zeros(len(px), np.float32)
    for i in range(len(px)):
        u = min(max(round(px[i, 0]), 0), width - 1)
        v = min(max(round(px[i, 1]), 0), height - 1)
        if not 0.0 < depth[v, u] < math.inf:  # false for NaN, as some drivers mark what they could not read
            continue
        z[i] = depth[v, u]
        low = high = z[i]
        for y in range(max(v - MISREGISTRATION_PX, 0), min(v + MISREGISTRATION_PX, height - 1) + 1):
            for x in range(max(u - MISREGISTRATION_PX, 0), min(u + MISREGISTRATION_PX, width - 1) + 1):
                d = depth[y, x]
                if 0.0 < d < math.inf:
                    low, high = min(low, d), max(high, d)
        spread[i] = high - low
    return z, spread
