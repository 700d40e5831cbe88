"""The lights a body passes, each followed through the map, which may lie anywhere as yet."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from lodelight.geometry.se3 import SE3
from lodelight.lights.rays import Track
from lodelight.mapping.body_path import BodyPath, Node
from lodelight.messages import LightFix, LightSighting
from lodelight.rig import CameraSpec
from lodelight.types import Array

GAP_S = 2.0  # without a sighting, after which a code may belong to another light
RAY_M = 0.05  # between two rays of one light
KEPT = 200  # lights, and levels
LEAST_PX = 0.5  # sigma of a sighting, with what the motion since the frames beside it adds
NS = 1e-9


@dataclass(eq=False)
class _Followed:
    candidates: tuple[str, ...]
    last_ns: int
    rays: list[tuple[Node, Array, float]] = field(default_factory=list)  # where the body was; unit, camera; rad


class LightRays:
    """Fed with the sightings of every image, whether or not a pose came of them."""

    def __init__(self, path: BodyPath, spec: CameraSpec | None) -> None:
        self._path = path
        self._spec = spec
        self._followed: list[_Followed] = []
        self._levels: list[tuple[Node, Array, float]] = []

    def see(self, fix: LightFix, node: Node | None) -> bool:
        """What one image showed; whether there is a ray more. node : where the body was at the fix's stamp."""
        if node is None or fix.up_body is None or self._spec is None:
            return False
        more = False
        for sighting in fix.seen:
            more = self._follow(sighting, self._path.at(sighting.t_ns), self._spec) or more
        if more:
            self._levels.append((node, fix.up_body, fix.sigma_up_rad))
            del self._levels[:-KEPT]
        return more

    def _follow(self, sighting: LightSighting, node: Node | None, spec: CameraSpec) -> bool:
        if node is None:
            return False
        one = next((f for f in reversed(self._followed) if f.candidates == sighting.candidates), None)
        if one is None or (sighting.t_ns - one.last_ns) * NS > GAP_S:
            one = _Followed(sighting.candidates, sighting.t_ns)
            self._followed.append(one)
            del self._followed[:-KEPT]
        one.last_ns = sighting.t_ns
        if one.rays and np.linalg.norm(self._path.pose(node).t - self._path.pose(one.rays[-1][0]).t) < RAY_M:
            return False
        ray = spec.camera.unproject(np.asarray(sighting.centre_px)[None])[0][0]
        one.rays.append((node, ray / np.linalg.norm(ray), max(sighting.sigma_px, LEAST_PX) / spec.camera.focal_px))
        return True

    def tracks(self) -> list[Track]:
        """As the map stands now."""
        return [self._track(f, self._spec.T_body_cam) for f in self._followed] if self._spec is not None else []

    def _track(self, followed: _Followed, T_body_cam: SE3) -> Track:
        poses = [self._path.pose(node) @ T_body_cam for node, _, _ in followed.rays]
        directions = np.array([T.R @ ray for T, (_, ray, _) in zip(poses, followed.rays, strict=True)])
        sigma = np.array([sigma for _, _, sigma in followed.rays])
        return Track(followed.candidates, np.array([T.t for T in poses]), directions, sigma)

    def up(self) -> tuple[Array, float]:
        """(3,) unit, the map's, and its sigma: what errs for seconds gains nothing by being asked often."""
        weights = np.array([1.0 / sigma**2 for _, _, sigma in self._levels])
        total = np.sum(
            [w * (self._path.pose(n).R @ up) for w, (n, up, _) in zip(weights, self._levels, strict=True)], 0
        )
        return total / np.linalg.norm(total), math.sqrt(len(weights) / float(weights.sum()))
