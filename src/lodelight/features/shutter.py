"""A rolling shutter reads row after row while the camera moves: corners, put where a global shutter would see them.

A corner of row v is seen dt = `(v - stamped_row) row_time_s` after the stamp. With the camera's turn w and velocity u
over the readout, a point of the camera frame at that time, X, was at Exp(w dt) X + u dt when the stamp was taken. At
1 rad/s and 30 ms a frame's last row is 15 px away from where its first would have seen it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lodelight.compiled import kernel
from lodelight.features.features import Features
from lodelight.geometry.cameras import project_jacobian, project_points
from lodelight.rig import CameraSpec
from lodelight.types import AnyArray, Array

STILL = np.zeros(6)
BEYOND = 0.1  # of the image's width: so far outside of it a straightened corner may lie: the stamped row never saw it
UNMEASURED = 1e-6  # information that keeps the system solvable where corners leave a direction open


class Shutter:
    """Of one camera; all twists are (6,) rad/s and m/s in its frame, rotation first."""

    def __init__(self, spec: CameraSpec) -> None:
        self.camera = spec.camera
        self.row_time_s, self.stamped_row = spec.row_time_s, spec.stamped_row

    @property
    def rolls(self) -> bool:
        return self.row_time_s != 0.0

    @property
    def readout_s(self) -> float:
        return abs(self.row_time_s) * self.camera.height

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
        H, g = _turn_system(
            self.camera.model, self.camera.params, self._delay_s(px), np.asarray(px, np.float64), sigma_px, xyz_cam
        )
        H += UNMEASURED * np.eye(9)
        information = np.linalg.inv(covariance)
        H[:3, :3] += information
        g[:3] += information @ expected
        out: Array = np.linalg.solve(H, g)[:3]
        return out

    def reach_px(self, twist: Array) -> float:
        """How far a turn moves the last row from the first, nearly."""
        return float(np.linalg.norm(twist[:3])) * self.readout_s * self.camera.focal_px

    def _delay_s(self, px: AnyArray) -> Array:
        return self.row_time_s * (px[:, 1].astype(np.float64) - self.stamped_row)


@kernel
def _turned(vectors: Array, by: Array) -> Array:
    """Vectors (N, 3), each turned by its own small rotation vector: Rodrigues to third order."""
    out = np.empty_like(vectors)
    for i in range(len(vectors)):
        x, y, z = vectors[i]
        a, b, c = by[i]
        out[i] = vectors[i]
        for share in (1.0, 0.5, 1.0 / 3.0):
            x, y, z = share * (b * z - c * y), share * (c * x - a * z), share * (a * y - b * x)
            out[i, 0] += x
            out[i, 1] += y
            out[i, 2] += z
    return out


@kernel
def _turn_system(
    model: int, params: Array, delay_s: Array, px: Array, sigma_px: Array, xyz_cam: Array
) -> tuple[Array, Array]:
    """H (9, 9) and g (9,) of pixels by the turn per second, by a turn and by a shift of the points, camera frame."""
    H, g = np.zeros((9, 9)), np.zeros(9)
    E, A = np.zeros((2, 3)), np.zeros((2, 9))
    for i in range(len(px)):
        x, y, z = xyz_cam[i]
        u, v, _ = project_jacobian(model, params, x, y, z, E)
        w = 1.0 / sigma_px[i]
        for k in range(2):
            e0, e1, e2 = w * E[k, 0], w * E[k, 1], w * E[k, 2]
            A[k, 3], A[k, 4], A[k, 5] = e2 * y - e1 * z, e0 * z - e2 * x, e1 * x - e0 * y  # of X + axis x X
            A[k, 6], A[k, 7], A[k, 8] = e0, e1, e2
            for j in range(3):
                A[k, j] = delay_s[i] * A[k, 3 + j]
        r0, r1 = w * (u - px[i, 0]), w * (v - px[i, 1])
        for a in range(9):
            g[a] += A[0, a] * r0 + A[1, a] * r1
            for b in range(9):
                H[a, b] += A[0, a] * A[0, b] + A[1, a] * A[1, b]
    return H, g
