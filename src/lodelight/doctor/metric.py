"""What motion in metres, by depth or a stereo pair, says of the lens: what its model leaves, by region."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from lodelight.doctor.gather import Pair
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.geometry.so3 import so3_exp
from lodelight.rig import CameraSpec
from lodelight.types import Array, Bools

FAR = 40.0  # depth over the stereo base line beyond which a disparity says too little


@dataclass(frozen=True, eq=False)
class Move:
    """The motion of camera 0 between the frames of a pair, in metres, with what its corners miss by.

    T_a_b; at_px (N, 2) where corners are in frame b; miss_px (N, 2) there, measured less predicted
    """

    t_a: int
    t_b: int
    T_a_b: SE3
    at_px: Array
    miss_px: Array


def points_of(pair: Pair, cam0: CameraSpec, cam1: CameraSpec | None) -> tuple[Array, Bools]:
    """(N, 3) m in the frame of camera 0 at a, and which are known."""
    rays = _rays(cam0.camera, pair.a_px)
    if (pair.depth_a > 0).sum() >= 20 or cam1 is None:
        return rays * pair.depth_a[:, None], np.asarray(pair.depth_a > 0)
    known: Bools = np.asarray(np.isfinite(pair.right_a_px).all(axis=1))
    right = _rays(cam1.camera, np.where(known[:, None], pair.right_a_px, 0.0))
    T = cam0.T_body_cam.inverse() @ cam1.T_body_cam
    r = right @ T.R.T
    # closest points of both rays: z_a a - z_b r = t
    aa, rr, ar = (rays**2).sum(1), (r**2).sum(1), (rays * r).sum(1)
    at, rt = rays @ T.t, r @ T.t
    det = np.maximum(aa * rr - ar**2, 1e-12)
    z = (rr * at - ar * rt) / det
    gap = np.linalg.norm(np.cross(rays, r) @ T.t[:, None] / np.sqrt(det)[:, None], axis=1)
    known = known & (z > 0.2) & (z < FAR * np.linalg.norm(T.t)) & (gap < 0.02 * np.maximum(z, 0.2))
    return rays * z[:, None], known


def move_of(pair: Pair, cam0: CameraSpec, cam1: CameraSpec | None) -> Move | None:
    """By the points of frame a in frame b. None where too few are known or agree."""
    X, known = points_of(pair, cam0, cam1)
    if np.count_nonzero(known) < 20:
        return None
    X, px = X[known], pair.b_px[known]
    rays = _rays(cam0.camera, px)
    cv2.setRNGSeed(0)
    f_px = cam0.camera.focal_px
    flat = np.ascontiguousarray(rays[:, :2])
    ok, rvec, tvec, _ = cv2.solvePnPRansac(
        X, flat, np.eye(3), None, iterationsCount=60, reprojectionError=3.0 / f_px, flags=cv2.SOLVEPNP_AP3P
    )
    if not ok:
        return None
    R, t = cv2.Rodrigues(rvec)[0], tvec.ravel()
    T_b_a, spread_px = _refined(SE3.from_matrix(np.column_stack([R, t])), X, flat, f_px)
    if spread_px > 2.0:
        return None
    Y = T_b_a @ X
    lens = cam0.camera
    seen_px, ok_px = lens.project(Y)
    near = ok_px & (np.linalg.norm(px - seen_px, axis=1) < 6.0 * max(spread_px, 0.3))
    return Move(pair.t_a, pair.t_b, T_b_a.inverse(), px[near], px[near] - seen_px[near])


def _refined(T_b_a: SE3, X: Array, flat: Array, f_px: float) -> tuple[SE3, float]:
    """Reweighted Gauss-Newton on the reprojection in the plane at z = 1."""
    spread = 1.0
    for _ in range(8):
        Y = T_b_a @ X
        z = np.maximum(Y[:, 2], 0.05)
        miss = (flat - Y[:, :2] / z[:, None]) * f_px
        length = np.linalg.norm(miss, axis=1)
        spread = max(1.2 * float(np.median(length)), 0.05)
        weight = 1.0 / (1.0 + (length / (2.0 * spread)) ** 2) ** 2
        x, y = Y[:, 0] / z, Y[:, 1] / z
        zero = np.zeros_like(z)
        # a small turn and shift of frame b on the left
        ju = np.column_stack([-x * y, 1 + x * x, -y, 1 / z, zero, -x / z]) * f_px
        jv = np.column_stack([-(1 + y * y), x * y, x, zero, 1 / z, -y / z]) * f_px
        J = np.concatenate([ju, jv])
        w = np.concatenate([weight, weight])
        r = np.concatenate([miss[:, 0], miss[:, 1]])
        d = np.linalg.solve((J.T * w) @ J + 1e-9 * np.eye(6), (J.T * w) @ r)
        turn = so3_exp(d[:3])
        T_b_a = SE3(turn @ T_b_a.R, turn @ T_b_a.t + d[3:])
        if np.abs(d).max() < 1e-7:
            break
    return T_b_a, spread


def field_of(moves: list[Move], lens: Camera, cells: int = 3) -> tuple[float, Array]:
    """The largest mean miss of a region of the image, px, and (cells, cells, 2) of all: what a wrong lens leaves."""
    at = np.concatenate([m.at_px for m in moves])
    miss = np.concatenate([m.miss_px for m in moves])
    column = np.clip((at[:, 0] * cells / lens.width).astype(int), 0, cells - 1)
    row = np.clip((at[:, 1] * cells / lens.height).astype(int), 0, cells - 1)
    out = np.zeros((cells, cells, 2))
    for i in range(cells):
        for j in range(cells):
            here = miss[(row == i) & (column == j)]
            if len(here) >= 30:
                out[i, j] = np.median(here, axis=0)
    return float(np.linalg.norm(out, axis=2).max()), out


def _rays(lens: Camera, px: Array) -> Array:
    """(N, 3) with z = 1; 0 where the lens sees nothing."""
    rays, ok = lens.unproject(px)
    return np.nan_to_num(rays / np.where(ok & (rays[:, 2] > 1e-6), rays[:, 2], np.nan)[:, None], nan=0.0)
