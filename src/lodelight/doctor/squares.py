"""Tags are squares: what their corners say of the lens, when nothing is known of where they hang or how large they are.

Four corners have two coordinates more than a pose explains. What is left of them tells how square tags appear; and by
how much another focal length, or other proportions of it, would leave less, by the parabola through three of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lodelight.geometry.cameras import Camera
from lodelight.messages import TagSighting
from lodelight.tags.pose import tag_poses

LEAST_SIGHTINGS = 12
LEAST_SIDE_PX = 20.0
MODEL_PX = 0.2  # of corners on a sheet that is not quite flat, added to every corner's sigma
CAP = 25.0  # of a sighting's chi2, from which on it counts by its logarithm: a corner may be misread
STEPS = (0.04, 0.02, 0.01)  # by which focal lengths are tried, around the best so far


@dataclass(frozen=True, eq=False)
class Squares:
    """left_px : what a best pose leaves of the corners, in the median of the sightings
    focal, sigma_focal : true over the rig's, less 1; aspect, sigma_aspect : the same of fx over fy
    """

    sightings: int
    left_px: float
    focal: float
    sigma_focal: float
    aspect: float
    sigma_aspect: float


def squares_of(sightings: Sequence[TagSighting], camera: Camera) -> Squares | None:
    """None where there are too few tags, or none is large enough."""
    noisy = [replace(s, sigma_px=np.hypot(s.sigma_px, MODEL_PX)) for s in sightings if s.side_px >= LEAST_SIDE_PX]
    chi2 = np.array([_left(s, camera) for s in noisy])
    known = [s for s, left in zip(noisy, chi2, strict=True) if np.isfinite(left)]
    chi2 = chi2[np.isfinite(chi2)]
    if len(known) < LEAST_SIGHTINGS:
        return None
    sigma_px = np.array([float(s.sigma_px.mean()) for s in known])
    spread = max(1.0, float(np.median(chi2)) / 1.386)  # the median of a chi-square with two degrees of freedom
    focal, sigma_focal = _best(known, camera, spread, (1.0, 1.0))
    aspect, sigma_aspect = _best(known, camera, spread, (0.5, -0.5))
    left_px = float(np.median(np.sqrt(chi2 / (2 * 4)) * sigma_px))
    return Squares(len(known), left_px, focal, sigma_focal, aspect, sigma_aspect)


def _left(sighting: TagSighting, camera: Camera) -> float:
    poses = tag_poses(sighting, 1.0, camera)
    return poses[0].chi2 if poses else float("nan")


def _best(
    sightings: Sequence[TagSighting], camera: Camera, spread: float, by: tuple[float, float]
) -> tuple[float, float]:
    """Where the cost is least, along a change of (fx, fy) by shares `by` of it, and its standard deviation."""

    def cost(x: float) -> float:
        chi2 = np.array([_left(s, _changed(camera, x * by[0], x * by[1])) for s in sightings]) / spread
        return float(np.sum(CAP * np.log1p(chi2[np.isfinite(chi2)] / CAP)))

    at, bend = 0.0, 0.0
    for step in STEPS:
        below, here, above = cost(at - step), cost(at), cost(at + step)
        bend = (above - 2.0 * here + below) / step**2
        if bend <= 0.0:
            return 0.0, 1.0
        at -= float(np.clip((above - below) / (2.0 * step) / bend, -2.0 * step, 2.0 * step))
    return at, float(np.sqrt(2.0 / bend))


def _changed(camera: Camera, x: float, y: float) -> Camera:
    fx, fy, cx, cy = camera.params[:4].tolist()
    return Camera.create(
        camera.model_name, camera.width, camera.height, (fx * (1.0 + x), fy * (1.0 + y), cx, cy), camera.distortion
    )
