"""How large a tag is, by views of it from places whose distances are known: against what it says of itself.

Corners k s_i of a tag that is k times as large as said, at R, t, are seen at π(T_cam_map (R k s_i + t)). Gauss-Newton
over the pose and k; from one place alone k and the distance along the line of sight are the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lodelight.anchors import tag_corners
from lodelight.geometry.cameras import Camera
from lodelight.geometry.dense import spd_inverse
from lodelight.geometry.se3 import SE3
from lodelight.tags.corners import corner_jacobians
from lodelight.tags.gate import GateConfig
from lodelight.tags.pose import tag_poses
from lodelight.tags.survey import TagView
from lodelight.types import Array

STEPS = 15
RIGHT = GateConfig.size_ratio - 1.0  # a share of its size by which a tag may differ in any case
SIGMAS = 4.0
UNKNOWN = 0.1  # relative deviation of k at which views say nothing of it


@dataclass(frozen=True)
class MeasuredSize:
    """said, found m; sigma : of found / said, the length scale of the views not included"""

    said: float
    found: float
    sigma: float

    def contradicts(self, sigma_scale: float) -> str:
        """In words what is wrong with what it says, by views whose lengths are known to so much (a share); or
        nothing."""
        off = self.found / self.said - 1.0
        if not abs(off) > max(RIGHT, SIGMAS * float(np.hypot(self.sigma, sigma_scale))):
            return ""
        return f"its side measures {self.found:.3f} m, and it says {self.said:.3f} m ({-off / (1.0 + off):+.0%})"


def measured_size(views: Sequence[TagView], size_m: float, camera: Camera) -> MeasuredSize | None:
    """None where the views do not tell."""
    if len(views) < 2:
        return None
    first = max(views, key=lambda view: view.sighting.side_px)
    fits = [_fit(views, first.T_world_cam @ pose.T_cam_tag, size_m, camera) for pose in tag_poses(
        first.sighting, size_m, camera)]  # fmt: skip
    good = [fit for fit in fits if fit is not None]
    if not good:
        return None
    chi2, k, sigma = min(good)
    sigma *= float(np.sqrt(max(1.0, chi2 / max(8 * len(views) - 7, 1))))
    return MeasuredSize(size_m, k * size_m, sigma) if sigma < UNKNOWN * k else None


def _fit(views: Sequence[TagView], T: SE3, size_m: float, camera: Camera) -> tuple[float, float, float] | None:
    """chi2, k and its deviation from a start T_world_tag; None where a view does not see the tag there."""
    k, damping = 1.0, 1e-3
    found = _normal(views, T, k * size_m, size_m, camera)
    for _ in range(STEPS):
        if found is None:
            return None
        chi2, H, g = found
        inverse, ok = spd_inverse(H + damping * np.diag(np.diag(H)))
        if not ok:
            return None
        d = -inverse @ g
        T_new, k_new = SE3.from_matrix(T.perturbed(d[:6]).matrix), k + float(d[6])
        trial = _normal(views, T_new, k_new * size_m, size_m, camera) if k_new > 0.0 else None
        if trial is None or trial[0] > chi2:
            damping *= 10.0
            if damping > 1e6:
                break
            continue
        T, k, found, damping = T_new, k_new, trial, max(0.1 * damping, 1e-9)
        if chi2 - trial[0] < 1e-4 * (1.0 + chi2):
            break
    assert found is not None
    inverse, ok = spd_inverse(found[1])
    return (found[0], k, float(np.sqrt(inverse[6, 6]))) if ok else None


def _normal(
    views: Sequence[TagView], T: SE3, side_m: float, size_m: float, camera: Camera
) -> tuple[float, Array, Array] | None:
    H, g, chi2 = np.zeros((7, 7)), np.zeros(7), 0.0
    corners = tag_corners(side_m)
    along = (T.R @ tag_corners(size_m).T).T  # of each corner by k, in the world
    for view in views:
        found = corner_jacobians(camera, SE3.identity(), view.T_world_cam, T, corners)
        if found is None:
            return None
        px, _, J_tag = found
        by_k = np.concatenate([J_tag[2 * i : 2 * i + 2, 3:] @ along[i] for i in range(4)])
        w = 1.0 / np.repeat(np.hypot(view.sighting.sigma_px, GateConfig.model_px), 2)
        J = np.column_stack([J_tag, by_k]) * w[:, None]
        r = (px - view.sighting.corners_px).ravel() * w
        H += J.T @ J
        g += J.T @ r
        chi2 += float(r @ r)
    return chi2, H, g
