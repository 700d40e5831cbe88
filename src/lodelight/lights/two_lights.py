"""A levelled camera's place from two known lights, in closed form (science note A4)."""

from __future__ import annotations

import math

import numpy as np

from lodelight.geometry.se3 import SE3
from lodelight.types import Array


def level(up_cam: Array) -> Array:
    """R_level_cam (3, 3): the least turn that takes `up` (unit, camera frame) to z."""
    z = np.array([0.0, 0.0, 1.0])
    axis, cosine = np.cross(up_cam, z), float(up_cam @ z)
    if cosine < -0.999999:
        return np.diag([1.0, -1.0, -1.0])
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    R: Array = np.eye(3) + K + K @ K / (1.0 + cosine)
    return R


def poses_from_two_lights(rays: Array, xyz: Array, up_cam: Array) -> list[SE3]:
    """T_world_cam from two lights: none where they cannot be so seen, two where both heights are possible.

    rays : (2, 3) in the camera frame; xyz : (2, 3) m; up_cam : unit, the direction of world z in the camera frame
    """
    R_level_cam = level(up_cam)
    m = rays @ R_level_cam.T
    if (m[:, 2] <= 1e-6).any():
        return []
    M = m[:, :2] / m[:, 2:]
    dM, dP, dZ = M[1] - M[0], (xyz[1] - xyz[0])[:2], float(xyz[1, 2] - xyz[0, 2])
    # |d1 dM + dZ M2|^2 = |dP|^2, d1 the height of the first light over the camera
    a, b, c = float(dM @ dM), 2.0 * dZ * float(dM @ M[1]), dZ**2 * float(M[1] @ M[1]) - float(dP @ dP)
    root = b * b - 4.0 * a * c
    if a < 1e-12 or root < 0.0:
        return []
    out = []
    for d1 in {(-b + math.sqrt(root)) / (2.0 * a), (-b - math.sqrt(root)) / (2.0 * a)}:
        if d1 <= 0.0 or d1 + dZ <= 0.0:
            continue
        q = d1 * dM + dZ * M[1]
        yaw = math.atan2(q[0] * dP[1] - q[1] * dP[0], float(q @ dP))
        R = np.array([[math.cos(yaw), -math.sin(yaw), 0.0], [math.sin(yaw), math.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
        d = np.array([d1, d1 + dZ])
        xy = np.mean(xyz[:, :2] - d[:, None] * (M @ R[:2, :2].T), axis=0)
        out.append(SE3(R @ R_level_cam, np.array([xy[0], xy[1], float(xyz[0, 2]) - d1])))
    return out
