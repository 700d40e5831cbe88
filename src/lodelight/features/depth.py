"""Depth of corners from a depth image, with the sensor's noise."""

from __future__ import annotations

import numpy as np

from lodelight.features.features import Features
from lodelight.rig import DepthSpec
from lodelight.types import ArrayF32

# A corner on the rim of an object has two depths around it, and belongs to the nearer: the rim is the object's.
_RIM = 0.05  # a spread of depths around the corner above this share of the depth makes it a rim


def depth_of_features(features: Features, depth: ArrayF32, spec: DepthSpec) -> Features:
    """Features with inverse depth and its sigma, read at the nearest pixel of `depth` (H, W) m; 0 = no reading.

    On a rim the smallest depth of the 3x3 neighbourhood is taken, with the rim's half spread as its noise.
    sigma_z = a + b (z - c)^2 of the rig's depth sensor; sigma of 1/z is sigma_z / z^2.
    """
    height, width = depth.shape
    u = np.clip(np.rint(features.px[:, 0]).astype(int), 1, width - 2)
    v = np.clip(np.rint(features.px[:, 1]).astype(int), 1, height - 2)
    offsets = np.array([-1, 0, 1])
    around = depth[v[:, None, None] + offsets[None, :, None], u[:, None, None] + offsets[None, None, :]].reshape(-1, 9)
    centre = around[:, 4]
    nearest = np.where(around > 0, around, np.inf).min(axis=1)
    spread = around.max(axis=1) - nearest
    rim = (centre > 0) & (spread > _RIM * centre)
    z = np.where(rim, nearest, centre)
    a, b, c = spec.noise
    sigma_z = a + b * (z - c) ** 2
    sigma_z = np.where(rim, np.hypot(sigma_z, 0.5 * spread), sigma_z)
    known = z > 0
    inv_depth = np.divide(1.0, z, out=np.zeros_like(z), where=known)
    return features.with_depth(inv_depth.astype(np.float32), (sigma_z * inv_depth**2).astype(np.float32))
