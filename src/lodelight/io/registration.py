"""Depth seen from another camera: each reading is moved there and drawn, nearest first.

A depth pixel covers an area, not a point: it is drawn over its footprint in the other image, so that a finer
image, or a slanted surface, shows no holes. Readings keep their values; nothing is interpolated.
"""

from __future__ import annotations

import math

import numpy as np

from lodelight.compiled import kernel
from lodelight.geometry.cameras import Camera, project_point
from lodelight.geometry.se3 import SE3
from lodelight.types import Array, ArrayF32

# A surface turned away spreads its pixels further apart in the other view: draw each a quarter larger.
FOOTPRINT = 1.25


@kernel
def register_depth(
    depth: ArrayF32, rays: ArrayF32, t: Array, model: int, params: Array, half_u: float, half_v: float, out: ArrayF32
) -> None:
    """Draw `depth` (H, W) m, 0 = none, into `out` (H', W') m, which starts at 0.

    rays : (H, W, 3) direction of each depth pixel, z of the depth camera = 1, in the axes of the target camera
    t : (3,) m, position of the depth camera in the target camera's frame
    half_u, half_v : half a depth pixel's footprint in target pixels where both see it at the same z
    """
    height, width = out.shape
    for row in range(depth.shape[0]):
        for col in range(depth.shape[1]):
            d = float(depth[row, col])
            z = d * rays[row, col, 2] + t[2]
            if d <= 0.0 or not z > 0.0:  # a pixel without a ray is NaN
                continue
            u, v, seen = project_point(model, params, d * rays[row, col, 0] + t[0], d * rays[row, col, 1] + t[1], z)
            if not seen:
                continue
            scale = d / z
            first_u, last_u = math.ceil(u - scale * half_u), math.floor(u + scale * half_u)
            first_v, last_v = math.ceil(v - scale * half_v), math.floor(v + scale * half_v)
            for i in range(max(first_v, 0), min(last_v, height - 1) + 1):
                for j in range(max(first_u, 0), min(last_u, width - 1) + 1):
                    if out[i, j] == 0.0 or z < out[i, j]:
                        out[i, j] = z


class Registration:
    """From the images of one camera to those of another, prepared once for many frames."""

    def __init__(self, depth_camera: Camera, target: Camera, T_target_depth: SE3) -> None:
        v, u = np.mgrid[: depth_camera.height, : depth_camera.width]
        rays, seen = depth_camera.unproject(np.column_stack([u.ravel(), v.ravel()]).astype(np.float64))
        with np.errstate(divide="ignore", invalid="ignore"):
            rays = rays / np.where(seen & (rays[:, 2] > 0.0), rays[:, 2], np.nan)[:, None]
        shape = (depth_camera.height, depth_camera.width, 3)
        self._rays = np.ascontiguousarray((rays @ T_target_depth.R.T).reshape(shape), dtype=np.float32)
        self._t = T_target_depth.t
        self._target = target
        ratio = target.params[:2] / depth_camera.params[:2]
        self._half_u, self._half_v = (0.5 * FOOTPRINT * float(r) for r in ratio)

    def __call__(self, depth_m: ArrayF32) -> ArrayF32:
        """(H, W) m along z of the depth camera to (H', W') m along z of the target, 0 = no reading."""
        target = self._target
        out = np.zeros((target.height, target.width), dtype=np.float32)
        register_depth(depth_m, self._rays, self._t, target.model, target.params, self._half_u, self._half_v, out)
        return out
