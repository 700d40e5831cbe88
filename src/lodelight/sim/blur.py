"""Motion blur: the mean of an image along the way its points take while the shutter is open."""

from __future__ import annotations

import numpy as np

from lodelight.compiled import kernel
from lodelight.geometry.cameras import Camera, project_point
from lodelight.geometry.se3 import SE3
from lodelight.sim.render import Eye, View
from lodelight.types import Array, ArrayF32

BLOCK = 8  # px; within one the way is taken to be the same
SHORTEST_PX = 0.25  # a way below it leaves no trace


def smear(view: View, eye: Eye, T_world_cam: SE3, T_world_open: SE3, T_world_closed: SE3) -> ArrayF32:
    """The view's radiance, (H, W), smeared by the motion from one pose to the other around the one it was seen from."""
    to_open, to_closed = T_world_open.inverse() @ T_world_cam, T_world_closed.inverse() @ T_world_cam
    out = np.empty_like(view.image)
    camera: Camera = eye.camera
    ends = np.stack([to_open.matrix[:3], to_closed.matrix[:3]])
    _smear(view.image, view.depth, eye.rays, camera.model, camera.params, np.ascontiguousarray(ends), out)
    return out


@kernel
def _moved(T: Array, x: float, y: float, z: float) -> tuple[float, float, float]:
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
    )


@kernel
def _smear(
    image: ArrayF32, depth: ArrayF32, rays: ArrayF32, model: int, params: Array, ends: Array, out: ArrayF32
) -> None:
    h, w = image.shape
    for by in range(0, h, BLOCK):
        for bx in range(0, w, BLOCK):
            y, x = min(by + BLOCK // 2, h - 1), min(bx + BLOCK // 2, w - 1)
            rx, ry, rz = rays[y + 1, x + 1, 0], rays[y + 1, x + 1, 1], rays[y + 1, x + 1, 2]
            du, dv = 0.0, 0.0
            if depth[y, x] > 0.0 and rz > 0.0:
                t = depth[y, x] / rz
                ax, ay, az = _moved(ends[0], t * rx, t * ry, t * rz)
                cx, cy, cz = _moved(ends[1], t * rx, t * ry, t * rz)
                u0, v0, seen0 = project_point(model, params, ax, ay, az)
                u1, v1, seen1 = project_point(model, params, cx, cy, cz)
                if seen0 and seen1:
                    du, dv = u1 - u0, v1 - v0
            length = np.sqrt(du * du + dv * dv)
            taps = min(64, int(np.ceil(length)) + 1) if length > SHORTEST_PX else 1
            for yy in range(by, min(by + BLOCK, h)):
                for xx in range(bx, min(bx + BLOCK, w)):
                    total = 0.0
                    for k in range(taps):
                        s = (k + 0.5) / taps - 0.5
                        px, py = min(max(xx + s * du, 0.0), w - 1.0), min(max(yy + s * dv, 0.0), h - 1.0)
                        x0, y0 = min(int(px), w - 2), min(int(py), h - 2)
                        fx, fy = px - x0, py - y0
                        top = image[y0, x0] * (1.0 - fx) + image[y0, x0 + 1] * fx
                        low = image[y0 + 1, x0] * (1.0 - fx) + image[y0 + 1, x0 + 1] * fx
                        total += top * (1.0 - fy) + low * fy
                    out[yy, xx] = total / taps
