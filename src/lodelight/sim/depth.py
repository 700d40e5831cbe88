"""A structured-light depth sensor: its noise, its range, its holes (science note E for the noise)."""

from __future__ import annotations

import numpy as np

from lodelight.compiled import kernel
from lodelight.rig import DepthSpec
from lodelight.sim.sensor import NORMALS, hash64
from lodelight.types import ArrayF32

GRAZING = 0.12  # relative change of depth from pixel to pixel beyond which no pattern is recognised
SHADOW_PX = 4  # right of a near edge the projector, which stands beside the camera, lights nothing
SPECKLE = 0.003  # share of readings lost without a reason


def sense_depth(exact: ArrayF32, spec: DepthSpec, seed: int) -> ArrayF32:
    """(H, W) m as the sensor reads it, 0 where it reads nothing; the same seed gives the same noise."""
    out = np.zeros_like(exact)
    a, b, c = spec.noise
    _sense(exact, a, b, c, spec.min_m, spec.max_m, NORMALS, seed, out)
    return out


@kernel
def _sense(
    exact: ArrayF32, a: float, b: float, c: float, near: float, far: float, normals: ArrayF32, seed: int, out: ArrayF32
) -> None:
    h, w = exact.shape
    mask = np.uint64(normals.shape[0] - 1)
    base = hash64(np.uint64(seed))
    for y in range(h):
        for x in range(w):
            z = exact[y, x]
            if z < near or z > far:
                continue
            across = max(abs(exact[y, max(x - 1, 0)] - z), abs(exact[y, min(x + 1, w - 1)] - z))
            step = max(across, abs(exact[max(y - 1, 0), x] - z), abs(exact[min(y + 1, h - 1), x] - z))
            if step > GRAZING * z or exact[y, max(x - SHADOW_PX, 0)] < z * (1.0 - GRAZING):
                continue
            bits = hash64(base + np.uint64(y * w + x))
            if (bits >> np.uint64(40)) * (1.0 / (1 << 24)) < SPECKLE:
                continue
            sigma = a + b * (z - c) * (z - c)
            z += sigma * normals[bits & mask]
            out[y, x] = z if near <= z <= far else 0.0
