"""Where a tag is, from its four corners: both poses that a plane allows, with their errors and covariances.

Seen in perspective, four corners of a square fit two poses: the true one, and one turned about the line of sight's
other side. The farther and the more squarely a tag is seen, the more alike the two fit, and noise decides. So both are
kept, and one is chosen only for a reason: its error is far smaller, gravity, a prediction, or several views
(`lodelight.tags.survey`). Starts: IPPE (Collins and Bartoli 2014); then Levenberg-Marquardt on pixels through the
lens. Derivation of the covariance: docs/tags.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from lodelight.anchors import tag_corners
from lodelight.compiled import kernel
from lodelight.geometry.cameras import Camera, project_jacobian
from lodelight.geometry.dense import spd_inverse
from lodelight.geometry.se3 import SE3
from lodelight.geometry.so3 import rotation_angle, so3_exp
from lodelight.messages import TagSighting
from lodelight.types import Array

CLEAR_RATIO = 4.0  # of the two errors, above which the smaller one is believed (science note C5)
CLEAR_SIDE_PX = 40.0
SAME_RAD = math.radians(1.0)  # two solutions nearer than this are one
UPRIGHT_DEG = 10.0  # how far from a wall's or a floor's a tag's normal may be
DOF = 2  # eight coordinates less six of a pose
STEPS = 15


@dataclass(frozen=True, eq=False)
class TagPose:
    """T_cam_tag; chi2 of the corners at it; covariance (6, 6) of it in the chart of SE3.perturbed."""

    T_cam_tag: SE3
    chi2: float
    covariance: Array

    @property
    def error(self) -> float:
        """Root of chi2 over what is expected of it, at least 1: noise makes no difference between errors below."""
        return math.sqrt(max(self.chi2 / DOF, 1.0))


def tag_poses(sighting: TagSighting, size_m: float, camera: Camera) -> list[TagPose]:
    """The one or two poses that fit the corners, best first; none where no pose does.

    Both have the camera in front of the print.
    """
    rays, seen = camera.unproject(sighting.corners_px)
    if not seen.all() or rays[:, 2].min() < 0.02:
        return []
    flat = np.ascontiguousarray(rays[:, :2] / rays[:, 2:])
    found: list[TagPose] = []
    for start in _ippe(flat, size_m):
        refined = refine(start, sighting, size_m, camera)
        if refined is None or not faces(refined.T_cam_tag):
            continue
        if all(angle_between(refined.T_cam_tag, other.T_cam_tag) > SAME_RAD for other in found):
            found.append(refined)
    return sorted(found, key=lambda pose: pose.chi2)


def _ippe(flat: Array, size_m: float) -> list[SE3]:
    try:
        _, rvecs, tvecs, _ = cv2.solvePnPGeneric(
            tag_corners(size_m), flat, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
        )  # fmt: skip
    except cv2.error:  # corners on a line
        return []
    starts = [
        SE3(so3_exp(np.ravel(r).astype(np.float64)), np.ravel(t).astype(np.float64))
        for r, t in zip(rvecs, tvecs, strict=True)
    ]
    return [T for T in starts if np.isfinite(T.matrix).all()]


def refine(start: SE3, sighting: TagSighting, size_m: float, camera: Camera) -> TagPose | None:
    """The nearest pose of least squares, from a start; None where a corner is behind the camera on the way."""
    R, t, H = start.R.copy(), start.t.copy(), np.zeros((6, 6))
    chi2 = _refine(
        camera.model, camera.params, tag_corners(size_m), sighting.corners_px, sighting.sigma_px, R, t, H
    )  # fmt: skip
    covariance, ok = spd_inverse(H)
    if not (math.isfinite(chi2) and ok):
        return None
    return TagPose(SE3(R, t), chi2, covariance)


def clear(poses: Sequence[TagPose], sighting: TagSighting) -> TagPose | None:
    """The pose that one view alone settles: the only one, or the far better one of a tag large enough."""
    if not poses or sighting.side_px < CLEAR_SIDE_PX:
        return None
    settled = len(poses) == 1 or poses[1].error >= CLEAR_RATIO * poses[0].error
    return poses[0] if settled else None


def by_gravity(poses: Sequence[TagPose], up_cam: Array) -> TagPose | None:
    """The only pose that hangs on a wall or lies on a floor or ceiling; None where none or both do.

    up_cam : (3,) unit, away from the ground, camera frame
    """
    tilt = math.sin(math.radians(UPRIGHT_DEG))
    level = []
    for pose in poses:
        upward = abs(float(pose.T_cam_tag.R[:, 2] @ up_cam))
        if upward < tilt or upward > math.cos(math.radians(UPRIGHT_DEG)):
            level.append(pose)
    return level[0] if len(level) == 1 else None


def by_prediction(poses: Sequence[TagPose], T_cam_tag: SE3) -> TagPose | None:
    """The pose whose attitude is nearer to an expected one; None where there is none."""
    return min(poses, key=lambda pose: angle_between(pose.T_cam_tag, T_cam_tag), default=None)


def angle_between(a: SE3, b: SE3) -> float:
    """Of two attitudes, rad."""
    return float(rotation_angle(np.ascontiguousarray(a.R.T @ b.R)))


def faces(T_cam_tag: SE3) -> bool:
    """Whether the camera is on the printed side: the tag's z points into the wall."""
    return bool(T_cam_tag.R[:, 2] @ T_cam_tag.t > 0.0)


def linearize_corners(
    camera: Camera, corners: Array, px: Array, sigma_px: Array, T_cam_tag: SE3
) -> tuple[float, Array, Array]:
    """chi2 of measured corners (4, 2) px at a pose, inf where one is not seen; J^T W J (6, 6) and J^T W r (6,)."""
    H, g = np.zeros((6, 6)), np.zeros(6)
    R = np.ascontiguousarray(T_cam_tag.R)
    chi2 = _linearize(camera.model, camera.params, corners, px, sigma_px, R, T_cam_tag.t, H, g)
    return chi2, H, g


@kernel
def _linearize(
    model: int, params: Array, corners: Array, px: Array, sigma: Array, R: Array, t: Array, H: Array, g: Array
) -> float:  # fmt: skip
    """H (6, 6) and g (6,) of the corners' residuals at a pose; returns their chi2, inf where one is not seen."""
    H[:], g[:] = 0.0, 0.0
    Jp, J, X = np.empty((2, 3)), np.empty((2, 6)), np.empty(3)
    cost = 0.0
    for i in range(corners.shape[0]):
        x, y, z = corners[i, 0], corners[i, 1], corners[i, 2]
        for a in range(3):
            X[a] = R[a, 0] * x + R[a, 1] * y + R[a, 2] * z + t[a]
        u, v, seen = project_jacobian(model, params, X[0], X[1], X[2], Jp)
        if not seen:
            return np.inf
        for a in range(2):
            j0 = Jp[a, 0] * R[0, 0] + Jp[a, 1] * R[1, 0] + Jp[a, 2] * R[2, 0]
            j1 = Jp[a, 0] * R[0, 1] + Jp[a, 1] * R[1, 1] + Jp[a, 2] * R[2, 1]
            j2 = Jp[a, 0] * R[0, 2] + Jp[a, 1] * R[1, 2] + Jp[a, 2] * R[2, 2]
            J[a, 0], J[a, 1], J[a, 2] = j2 * y - j1 * z, j0 * z - j2 * x, j1 * x - j0 * y  # -(j R) [s]x
            J[a, 3], J[a, 4], J[a, 5] = Jp[a, 0], Jp[a, 1], Jp[a, 2]
        w = 1.0 / (sigma[i] * sigma[i])
        ru, rv = u - px[i, 0], v - px[i, 1]
        cost += w * (ru * ru + rv * rv)
        for a in range(6):
            g[a] += w * (J[0, a] * ru + J[1, a] * rv)
            for b in range(6):
                H[a, b] += w * (J[0, a] * J[0, b] + J[1, a] * J[1, b])
    return cost


@kernel
def _refine(
    model: int, params: Array, corners: Array, px: Array, sigma: Array, R: Array, t: Array, H: Array
) -> float:  # fmt: skip
    """Levenberg-Marquardt on T_cam_tag in place; H becomes the information at the end. Returns chi2, inf on failure."""
    g, damped = np.zeros(6), np.empty((6, 6))
    H_new, g_new = np.zeros((6, 6)), np.zeros(6)
    cost = _linearize(model, params, corners, px, sigma, R, t, H, g)
    damping = 1e-4
    for _ in range(STEPS):
        if not cost < np.inf:
            return np.inf
        damped[:] = H
        for a in range(6):
            damped[a, a] += damping * H[a, a] + 1e-12
        inverse, ok = spd_inverse(damped)
        if not ok:
            return np.inf
        d = np.zeros(6)
        gain = 0.0
        for a in range(6):
            for b in range(6):
                d[a] -= inverse[a, b] * g[b]
            gain -= d[a] * g[a]
        turn = so3_exp(d[:3])
        R_new = np.zeros((3, 3))
        for a in range(3):
            for b in range(3):
                for c in range(3):
                    R_new[a, b] += R[a, c] * turn[c, b]
        t_new = t + d[3:]
        new = _linearize(model, params, corners, px, sigma, R_new, t_new, H_new, g_new)
        if new < cost:
            R[:], t[:], H[:], g[:] = R_new, t_new, H_new, g_new
            done = cost - new < 1e-9 * (1.0 + cost)
            cost = new
            damping = max(0.2 * damping, 1e-9)
            if done:
                break
        else:
            if gain < 1e-9 * (1.0 + cost):
                break
            damping *= 10.0
            if damping > 1e6:
                break
    return cost
