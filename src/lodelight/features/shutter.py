"""A rolling shutter reads row after row while the camera moves: corners, put where a global shutter would see them.

A corner of row v is seen `v row_time_s` after the stamp. With the camera's turn w and velocity u over the readout, a
point of the camera frame at that time, X, was at Exp(w dt) X + u dt when the stamp was taken. At 1 rad/s and 30 ms a
frame's last row is 15 px away from where its first would have seen it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lodelight.features.features import Features
from lodelight.geometry.cameras import project_points
from lodelight.rig import CameraSpec
from lodelight.types import AnyArray, Array

STILL = np.zeros(6)
BEYOND = 0.1  # of the image's width: so far outside of it a straightened corner may lie, as the first row never saw it
STEP = 1e-4  # rad or m, of the central differences
UNMEASURED = 1e-6  # information that keeps the system solvable where corners leave a direction open


class Shutter:
    """Of one camera; all twists are (6,) rad/s and m/s in its frame, rotation first."""

    def __init__(self, spec: CameraSpec) -> None:
        self.camera = spec.camera
        self.row_time_s = spec.row_time_s

    @property
    def rolls(self) -> bool:
        return self.row_time_s > 0.0

    @property
    def readout_s(self) -> float:
        return self.row_time_s * self.camera.height

    def straightened(self, seen: Features, twist: Array) -> Features:
        """Corners as they would be at the stamp, some of them past the image's rim (see BEYOND).

        Those without depth are taken for far away.
        """
        if not self.rolls or len(seen) == 0 or not np.any(twist):
            return seen
        dt_s = self._delay_s(seen.px)
        shift = (dt_s * seen.inv_depth * seen.ray[:, 2])[:, None] * twist[3:]
        moved = _turned(seen.ray, dt_s[:, None] * twist[:3]) + shift  # in units of the distance to the point
        px, visible = project_points(self.camera.model, self.camera.params, moved)
        visible &= self.camera.inside(px, -BEYOND * self.camera.width)
        moved[~visible], px[~visible] = seen.ray[~visible], seen.px[~visible]
        near = np.divide(seen.ray[:, 2], moved[:, 2], out=np.ones(len(seen)), where=seen.inv_depth > 0)
        return replace(
            seen, px=px.astype(np.float32), ray=moved / np.linalg.norm(moved, axis=1)[:, None],
            inv_depth=(seen.inv_depth * near).astype(np.float32),
            sigma_inv_depth=(seen.sigma_inv_depth * near).astype(np.float32),
        )  # fmt: skip

    def turn_left_over(
        self, px: AnyArray, sigma_px: Array, xyz_cam: Array, expected: Array, covariance: Array
    ) -> Array:
        """(3,) rad/s of turn that corners px (N, 2) still show; points (N, 3) m, camera frame.

        expected (3,) rad/s, covariance (3, 3) : what is known of it without the rows
        Linear in the turn, and in the pose, which is free beside it: a turn moves later rows farther.
        """
        predicted = self._project(xyz_cam)
        turned, shifted = self._derivatives(xyz_cam)
        delayed = self._delay_s(px)[:, None, None] * turned
        A = (np.concatenate([delayed, turned, shifted], axis=2) / sigma_px[:, None, None]).reshape(-1, 9)
        r = ((predicted - px) / sigma_px[:, None]).reshape(-1)
        H, g = A.T @ A + UNMEASURED * np.eye(9), A.T @ r
        information = np.linalg.inv(covariance)
        H[:3, :3] += information
        g[:3] += information @ expected
        out: Array = np.linalg.solve(H, g)[:3]
        return out

    def reach_px(self, twist: Array) -> float:
        """How far a turn moves the last row, nearly."""
        return float(np.linalg.norm(twist[:3])) * self.readout_s * self.camera.focal_px

    def _derivatives(self, xyz_cam: Array) -> tuple[Array, Array]:
        """(N, 2, 3) of pixels by a turn of the points about the camera, px/rad, and by a shift of them, px/m."""
        turned, shifted = np.empty((2, len(xyz_cam), 2, 3))
        for axis in range(3):
            step = np.zeros(3)
            step[axis] = STEP
            for out, by in ((turned, np.cross(step, xyz_cam)), (shifted, step)):
                ahead, behind = self._project(xyz_cam + by), self._project(xyz_cam - by)
                out[:, :, axis] = (ahead - behind) / (2.0 * STEP)
        return turned, shifted

    def _project(self, xyz_cam: Array) -> Array:
        return project_points(self.camera.model, self.camera.params, np.ascontiguousarray(xyz_cam))[0]

    def _delay_s(self, px: AnyArray) -> Array:
        return self.row_time_s * px[:, 1].astype(np.float64)


def _turned(vectors: Array, by: Array) -> Array:
    """Vectors (N, 3), each turned by its own small rotation vector: Rodrigues to third order."""
    first = np.cross(by, vectors)
    second = np.cross(by, first)
    out: Array = vectors + first + 0.5 * second + np.cross(by, second) / 6.0
    return out
