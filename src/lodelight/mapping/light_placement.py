"""Where a map lies in the world, as more and more poses by the lights say it, and single lights where none do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lodelight.anchors import Light
from lodelight.geometry.se3 import SE3, carried_covariance, level
from lodelight.lights.alignment import Pair, agreement, align
from lodelight.lights.rays import lay_down, settle
from lodelight.mapping.body_path import BodyPath, Node
from lodelight.mapping.light_rays import LightRays
from lodelight.messages import LightFix
from lodelight.rig import CameraSpec
from lodelight.types import Array

PAIRS, PAIR_M = 400, 0.05  # pairs kept; how far the body moves between two of them
ALIGN_PAIRS, ALIGN_M, ALIGN_SHARE = 10, 0.5, 0.6  # pairs, the ground they cover, and the share of them that must agree
ALIGN_LIGHTS = 3  # that those pairs must have seen: two that were swapped agree with themselves
CHI2_6_99 = 16.81
LATEST = 8  # lights, by which alone a map is laid down
CORRELATED_S = 5.0  # for which fixes share their largest error, that of up: together they are worth one


@dataclass(frozen=True, eq=False)
class Move:
    """T_world_map by which a map is to be moved, why, and of how many pairs. again : it lay elsewhere, for good."""

    T_world_map: SE3
    why: str
    pairs: int
    again: bool = False


class Placement:
    """Of one map, in a building of surveyed lights; spec : of the light camera, None where only poses come.

    upright : the map is level by an IMU, and is turned about the vertical and shifted alone
    placed : it has a place in the world, if only by one fix; aligned : for good
    """

    def __init__(
        self, path: BodyPath, lights: Mapping[str, Light], spec: CameraSpec | None, upright: bool = False
    ) -> None:
        self._upright = upright
        self._fewest = min(ALIGN_LIGHTS, len(lights))
        self._path = path
        self._lights = lights
        self._rays = LightRays(path, spec)
        self._met: list[tuple[LightFix, SE3, Node]] = []
        self._laid: tuple[int, SE3, Array] | None = None  # when, by which pose of the body, and its covariance
        self.placed = False
        self.aligned = False
        self.no_fit = ""  # why the map does not come to lie

    def covariance(self, t_ns: int, T_world_body: SE3) -> Array:
        """(6, 6) of a pose of the body, from how well the map was laid down alone; fixes since then improve on it."""
        if self._laid is None:
            return np.zeros((6, 6))
        laid_ns, T_world_laid, covariance = self._laid
        since_s = max(0.0, (t_ns - laid_ns) * 1e-9)
        return carried_covariance(T_world_laid, covariance, T_world_body) / (1.0 + since_s / CORRELATED_S)

    def meet(self, fix: LightFix, T_world_body: SE3, node: Node) -> Move | None:
        """A pose by the lights and where the body was in the map at its time; the map may then have to move."""
        if self._met and np.linalg.norm(self._path.pose(node).t - self._path.pose(self._met[-1][2]).t) < PAIR_M:
            return None
        self._met.append((fix, T_world_body, node))
        if len(self._met) > PAIRS:
            del self._met[1::2]  # the whole way, half as dense
        if not self.placed:
            self.placed = True
            T_world_map = T_world_body @ self._path.pose(node).inverse()
            return Move(self._level(T_world_map, node), "seeded by the first fix", 1)
        return self._review() if not self.aligned or len(self._met) % ALIGN_PAIRS == 0 else None

    def see(self, fix: LightFix, node: Node | None) -> Move | None:
        """What one image showed, be it a single light: three of them, passed one after another, lay the map down."""
        if not self._rays.see(fix, node) or self.aligned:
            return None
        laid = lay_down(self._rays.tracks()[-LATEST:], self._lights, *self._rays.up())
        if laid is None:
            return None
        self.placed = self.aligned = True
        self.no_fit = ""
        self._laid = fix.t_ns, laid.T_world_map, laid.covariance
        T_world_map = self._level(laid.T_world_map, node)
        return Move(T_world_map, f"the rays to {', '.join(laid.lights)} meet where they hang", len(laid.lights))

    def settle(self, without: Mapping[str, object]) -> Move | None:
        """By all lights that were passed, but for those; where poses by them alone were tipped, this is not.

        None for a map that an IMU levelled: its adjustment has had the lights, and only their tilt is left.
        """
        if self._upright:
            return None
        lights = {name: light for name, light in self._lights.items() if name not in without}
        tracks = self._rays.tracks()
        laid = settle(SE3.identity(), tracks, lights, *self._rays.up()) if self.aligned and tracks else None
        if laid is None:
            return None
        return Move(laid.T_world_map, f"by the rays to {len(laid.lights)} lights", len(tracks))

    def _review(self) -> Move | None:
        """Align with what most pairs say: once for good, and again only where they contradict what was believed."""
        pairs = [Pair(T_world_body, self._path.pose(node)) for _, T_world_body, node in self._met]
        ground_m = float(np.linalg.norm(np.ptp([pair.T_map_body.t for pair in pairs], axis=0)))
        if len(pairs) < ALIGN_PAIRS or ground_m < ALIGN_M:
            return None
        agrees = agreement(pairs, SE3.identity())
        if self.aligned:  # what a fix's own error explains, up above all, contradicts nothing
            agrees |= np.array([self._explained(fix, pair) for (fix, _, _), pair in zip(self._met, pairs, strict=True)])
        now = int(np.count_nonzero(agrees))
        if self.aligned and now >= 0.5 * len(pairs):
            return None
        found = align(pairs, self._upright)
        if found.count < max(ALIGN_PAIRS, ALIGN_SHARE * len(pairs)) or (self.aligned and found.count < 2 * now):
            if not self.aligned and len(pairs) >= 2 * ALIGN_PAIRS:
                self.no_fit = f"only {found.count} of {len(pairs)} poses by the lights agree on a place of the map"
            return None
        used = [met for met, agrees in zip(self._met, found.agrees, strict=True) if agrees]
        names = {name for fix, _, _ in used for name in fix.lights}
        if names and len(names) < self._fewest:
            return None
        again, self.aligned, self.no_fit = self.aligned, True, ""
        last, T_world_body, _ = used[-1]
        self._laid = last.t_ns, T_world_body, np.mean([fix.covariance for fix, _, _ in used], axis=0)
        return Move(found.T_world_map, f"{found.count} of {len(pairs)} pairs agree", len(pairs), again)

    def _level(self, T_world_map: SE3, node: Node | None) -> SE3:
        """Without the tilt, where the map needs none; the body stays where it was put."""
        if not self._upright:
            return T_world_map
        return level(T_world_map, self._path.pose(node).t if node is not None else np.zeros(3))

    def _explained(self, fix: LightFix, pair: Pair) -> bool:
        off = pair.T_world_body.inverse() @ pair.T_map_body
        e = np.concatenate([off.log()[:3], pair.T_map_body.t - pair.T_world_body.t])
        laid = self.covariance(fix.t_ns, pair.T_map_body)
        return bool(e @ np.linalg.solve(fix.covariance + laid + 1e-12 * np.eye(6), e) <= CHI2_6_99)
