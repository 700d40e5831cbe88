"""Where a tag hangs, from many views of it at known poses.

Every view offers the one or two poses a plane allows. Each of them is a hypothesis that the other views are asked
about: the false poses of different views disagree, the true ones coincide. The best is adjusted over all views that
agree with it, and believed only if most views do and no other pose fits nearly as well. So a flipped pose, a second
copy of a tag and a tag that was moved in between do not get into the map.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lodelight.anchors import tag_corners
from lodelight.geometry.cameras import Camera
from lodelight.geometry.dense import spd_inverse
from lodelight.geometry.se3 import SE3
from lodelight.geometry.so3 import so3_log
from lodelight.messages import TagSighting
from lodelight.tags.corners import corner_jacobians
from lodelight.tags.pose import angle_between, linearize_corners, tag_poses
from lodelight.types import Array, Bools


@dataclass(frozen=True)
class SurveyConfig:
    """min_views : of a tag that is mapped; model_px : error of the lens model, added to every corner's sigma
    chi2_view : of a view's eight coordinates, above which it does not agree (99.9 %)
    min_share : of the views that must agree
    rival_chi2, rival_deg : by so much must another pose, turned by at least so much, fit worse
    hypotheses : views whose poses are tried, the largest sightings
    """

    min_views: int = 3
    model_px: float = 0.3
    chi2_view: float = 26.12
    min_share: float = 0.6
    rival_chi2: float = 30.0
    rival_deg: float = 8.0
    hypotheses: int = 12


@dataclass(frozen=True, eq=False)
class TagView:
    """A sighting from T_world_cam; covariance (6, 6) of that pose against the poses of the other views, or None."""

    sighting: TagSighting
    T_world_cam: SE3
    covariance: Array | None = None


@dataclass(frozen=True, eq=False)
class MappedTag:
    """T_world_tag with covariance (6, 6), chart of SE3.perturbed; agrees (N,) : which views it explains.

    rms_px : of the corners in those
    """

    T_world_tag: SE3
    covariance: Array
    agrees: Bools
    rms_px: float


@dataclass(frozen=True)
class Unmapped:
    """Why a tag has no place yet."""

    why: str


def map_tag(
    views: Sequence[TagView], size_m: float, camera: Camera, config: SurveyConfig | None = None
) -> MappedTag | Unmapped:
    """The pose of a tag that most of its views agree on."""
    config = config or SurveyConfig()
    if len(views) < config.min_views:
        return Unmapped(f"{len(views)} views, {config.min_views} are needed")
    problem = _Problem(views, size_m, camera, config)
    refined: list[tuple[float, SE3]] = []
    for T in problem.hypotheses():
        if all(_apart(T, other) for _, other in refined):
            adjusted = problem.adjust(T)
            refined.append((problem.cost(adjusted), adjusted))
    if not refined:
        return Unmapped("no view gives a pose")
    refined.sort(key=lambda pair: pair[0])
    cost, best = refined[0]
    chi2 = problem.chi2(best)
    agrees = chi2 < config.chi2_view
    share = float(np.mean(agrees))
    if share < config.min_share or np.count_nonzero(agrees) < config.min_views:
        return Unmapped(f"{np.count_nonzero(agrees)} of {len(views)} views agree: moved, hung twice, or misread")
    for other_cost, other in refined[1:]:
        turned = math.degrees(angle_between(best, other))
        if turned > config.rival_deg and other_cost - cost < config.rival_chi2:
            return Unmapped(f"a pose turned by {turned:.0f} deg fits as well; more views from the side are needed")
    return problem.result(best, agrees)


def against(
    views: Sequence[TagView], T_world_tag: SE3, attitude: Array, size_m: float, camera: Camera,
    config: SurveyConfig | None = None,
) -> tuple[float, float]:  # fmt: skip
    """By how much views fit better with a tag that is turned than with one that hangs as it should.

    T_world_tag : where it should; attitude (3, 3) : covariance of that, rad^2, about the tag's axes; its position does
    not matter
    Returns the likelihood ratio's chi-square, of 3 degrees of freedom for a tag that hangs right, and the angle between
    the attitude that fits best and T_world_tag, rad.

    It needs no decision between the two poses of a square: for the false one to fit better by c where the true one is
    better by E on average, noise must make up for c + E with a deviation of 2 sqrt(E), at most 1 in 30,000 for c = 16.
    """
    problem = _Problem(views, size_m, camera, config or SurveyConfig())
    found = [problem.adjust(T) for T in (*problem.hypotheses(), T_world_tag)]
    costs = [problem.cost(T) for T in found]
    best = int(np.argmin(costs))
    information, _ = spd_inverse(attitude)
    T = problem.adjust(T_world_tag, (T_world_tag, information))
    d = _turn(T_world_tag, T)
    return problem.cost(T) + float(d @ information @ d) - costs[best], angle_between(T_world_tag, found[best])


def _turn(a: SE3, b: SE3) -> Array:
    """(3,) from one attitude to another, about the axes of the first, rad."""
    turn: Array = so3_log(np.ascontiguousarray(a.R.T @ b.R))
    return turn


def _apart(a: SE3, b: SE3) -> bool:
    return math.degrees(angle_between(a, b)) > 2.0 or float(np.linalg.norm(a.t - b.t)) > 0.05


class _Problem:
    def __init__(self, views: Sequence[TagView], size_m: float, camera: Camera, config: SurveyConfig) -> None:
        self.views, self.size_m, self.camera, self.config = views, size_m, camera, config
        self.corners = tag_corners(size_m)
        self.poses = [tag_poses(v.sighting, size_m, camera) for v in views]
        self.T_cam_world = [v.T_world_cam.inverse() for v in views]
        self.sigma_px = [
            self._sigma(v, poses[0].T_cam_tag if poses else None) for v, poses in zip(views, self.poses, strict=True)
        ]

    def _sigma(self, view: TagView, T_cam_tag: SE3 | None) -> Array:
        """(4,) of each corner, what the camera's pose adds included as if it were independent."""
        s2 = np.square(view.sighting.sigma_px) + self.config.model_px**2
        if view.covariance is not None and T_cam_tag is not None:
            T_world_tag = view.T_world_cam @ T_cam_tag
            found = corner_jacobians(self.camera, SE3.identity(), view.T_world_cam, T_world_tag, self.corners)
            if found is not None:
                spread = np.diag(found[1] @ view.covariance @ found[1].T)
                s2 = s2 + spread.reshape(4, 2).mean(axis=1)
        return np.sqrt(s2)

    def hypotheses(self) -> list[SE3]:
        """T_world_tag of both poses of the largest sightings."""
        largest = sorted(range(len(self.views)), key=lambda i: -self.views[i].sighting.side_px)
        chosen = largest[: self.config.hypotheses]
        return [self.views[i].T_world_cam @ pose.T_cam_tag for i in chosen for pose in self.poses[i]]

    def chi2(self, T_world_tag: SE3) -> Array:
        """(N,) of each view at a pose, inf where the tag is not seen."""
        return np.array([self._view(i, T_world_tag)[0] for i in range(len(self.views))])

    def cost(self, T_world_tag: SE3) -> float:
        """Sum over the views, none counting more than one that just disagrees."""
        return float(np.minimum(self.chi2(T_world_tag), self.config.chi2_view).sum())

    def adjust(self, T: SE3, believed: tuple[SE3, Array] | None = None) -> SE3:
        """Gauss-Newton on the views that agree, and those that nearly do; believed : an attitude and the information
        (3, 3) of it, which count as well."""
        for _ in range(10):
            H, g, weight = self._normal(T)
            if believed is not None:
                H[:3, :3] += believed[1]
                g[:3] += believed[1] @ _turn(believed[0], T)
            inverse, ok = spd_inverse(H + 1e-9 * np.diag(np.diag(H)) + 1e-9 * np.eye(6))
            if weight == 0.0 or not ok:
                return T
            step = -inverse @ g
            T = SE3.from_matrix(T.perturbed(step).matrix)
            if float(step @ H @ step) < 1e-6:
                break
        return T

    def result(self, T: SE3, agrees: Bools) -> MappedTag:
        H, _, _ = self._normal(T, agrees)
        covariance, _ = spd_inverse(H)
        chi2 = self.chi2(T)[agrees]
        scale = max(1.0, float(chi2.sum()) / max(8.0 * np.count_nonzero(agrees) - 6.0, 1.0))
        errors = [self._residual(i, T) for i in np.flatnonzero(agrees).tolist()]
        return MappedTag(T, scale * covariance, agrees, float(np.sqrt(np.mean(np.square(errors)))))

    def _normal(self, T: SE3, only: Bools | None = None) -> tuple[Array, Array, float]:
        H, g, total = np.zeros((6, 6)), np.zeros(6), 0.0
        for i in range(len(self.views)):
            if only is not None and not only[i]:
                continue
            chi2, H_view, g_view = self._view(i, T)
            if not math.isfinite(chi2):
                continue
            weight = 1.0 if only is not None else 1.0 / (1.0 + (chi2 / self.config.chi2_view) ** 2)
            J = np.eye(6)
            J[3:, 3:] = self.T_cam_world[i].R  # T_cam_tag moves in the camera's axes as T_world_tag does in the world's
            H += weight * J.T @ H_view @ J
            g += weight * J.T @ g_view
            total += weight
        return H, g, total

    def _view(self, i: int, T_world_tag: SE3) -> tuple[float, Array, Array]:
        T = self.T_cam_world[i] @ T_world_tag
        s = self.views[i].sighting
        if T.R[:, 2] @ T.t <= 0.0:  # seen from behind
            return math.inf, np.zeros((6, 6)), np.zeros(6)
        return linearize_corners(self.camera, self.corners, s.corners_px, self.sigma_px[i], T)

    def _residual(self, i: int, T_world_tag: SE3) -> Array:
        px, _ = self.camera.project(self.T_cam_world[i] @ (T_world_tag @ self.corners))
        out: Array = px - self.views[i].sighting.corners_px
        return out
