"""How temporary points are made, of what a frame sees and nothing explains yet. Source: science note B3."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from scipy.special import gammaincinv

from lodelight.features.epipolar import match_epipolar
from lodelight.features.features import Features
from lodelight.geometry.triangulate import triangulate_rays
from lodelight.localization.temporary import Past, TemporaryPoints
from lodelight.localization.tracker import CLOSE_SIGMA, Tracked
from lodelight.types import AnyArray, Array, Bools, Ints

NEVER_BELOW_DEG = 1.15  # of parallax: farther points are a matter of noise
SAME_SCALE = 1.8  # by how much sizes of a patch in two images may differ from what its distances say: 1.5 x an octave
NEAR_M = 0.05  # of baseline, below which no pair of frames is tried
VIEW_COSINE = 0.5  # of the angle between two views that may show the same
SUPPOSED = 0.5  # of an inverse distance that is not measured, one standard deviation as a share of it
AGREE = 0.95  # of right rays meet within this bound of their noise
ENOUGH_DISTANCES = 10  # measured in a frame, to suppose others from


class Growth:
    """Adds to an overlay: by depth, by pairs of frames, by all frames that see a point, and where there is nothing to
    measure, by supposition."""

    def __init__(self, points: TemporaryPoints) -> None:
        self.points = points
        self.config, self.orb, self.spec = points.config, points.orb, points.spec

    def grow(self, tracked: Tracked, distance_m: Array) -> int:
        """New points from what a frame sees and nothing explains yet; its `temporary` names them. Returns how many.

        distance_m : (K,) of the points of the map that it sees
        Nothing is measured from a pose that is guessed: points are as exact as the poses that they are had from.
        """
        if tracked.temporary is None:
            tracked.temporary = np.full(len(tracked.seen), -1, np.int32)
        self.points.make_room(tracked.temporary)
        points, before = self.points, self.points.created
        self._from_depth(tracked)
        self._measure(points.past if tracked.guessed else [*points.past, points.past_of(tracked, False)])
        for past in self._partners(tracked) if not tracked.guessed else ():
            known = tracked.measured + points.created - before
            if known >= self.config.enough or len(points) >= self.config.most:
                break
            self._triangulate(tracked, past)
        self._suppose(tracked, distance_m, self.config.enough - tracked.right_in_all - (points.created - before))
        return points.created - before

    def _from_depth(self, tracked: Tracked) -> None:
        """Where a sensor has measured the depth, one frame is enough."""
        seen = tracked.seen
        close = (seen.inv_depth > 0) & (seen.sigma_inv_depth < CLOSE_SIGMA * seen.inv_depth)
        rows = np.flatnonzero(close & ~_taken(tracked.point, tracked.temporary))
        rows = rows[: max(self.config.enough - tracked.right_in_all, 0)]
        if len(rows):
            T_world_cam = tracked.T_world_body @ self.spec.T_body_cam
            xyz = T_world_cam @ (seen.ray[rows] / (seen.ray[rows, 2] * seen.inv_depth[rows])[:, None])
            assert tracked.temporary is not None
            tracked.temporary[rows] = self.points.add(xyz, seen.take(rows), T_world_cam.t)

    def _measure(self, frames: Iterable[Past]) -> None:
        """Give the distance to points that are only supposed, by all frames that see them."""
        ids, rays, centres, sigma = [], [], [], []
        for past in frames:
            rows = np.flatnonzero((self.points.alive(past.temporary) >= 0) & ~self.points.measured(past.temporary))
            seen, T_world_cam = past.seen.take(rows), past.T_world_body @ self.spec.T_body_cam
            ids.append(past.temporary[rows])
            rays.append(seen.ray @ T_world_cam.R.T)
            centres.append(np.broadcast_to(T_world_cam.t, (len(rows), 3)))
            sigma.append(self._sigma_rad(seen, past.noise))
        order = np.argsort(np.concatenate(ids), kind="stable")
        named, start = np.unique(np.concatenate(ids)[order], return_index=True)
        start = np.append(start, len(order))
        made = triangulate_rays(
            np.concatenate(centres)[order], np.concatenate(rays)[order], np.concatenate(sigma)[order], start
        )
        views = np.diff(start)
        good = made.in_front & (made.chi2 < 2.0 * gammaincinv(np.maximum(views, 2) - 1.5, AGREE))
        good &= made.parallax >= math.radians(NEVER_BELOW_DEG)
        good &= made.relative_sigma < self.config.max_relative_sigma
        t, ids = self.points.table, named[good]
        nearer = np.linalg.norm(made.xyz[good] - t.centre[ids], axis=1)
        nearer /= np.linalg.norm(t.xyz[ids] - t.centre[ids], axis=1)
        t.d_min[ids] *= nearer
        t.d_max[ids] *= nearer
        t.xyz[ids], t.sigma_inv_distance[ids] = made.xyz[good], 0.0

    def _partners(self, tracked: Tracked) -> list[Past]:
        """Earlier frames to triangulate with, best first: those the map alone held, then the others; the newest first.

        One of each that is far enough for its points to be exact, and one for rays of enough parallax.
        """
        axis = self.spec.T_body_cam.R[:, 2]
        apart = [(past, past.T_world_body.inverse() @ tracked.T_world_body) for past in reversed(self.points.past)]
        alike = [(past, float(np.linalg.norm(T.t))) for past, T in apart if float(axis @ T.R @ axis) > VIEW_COSINE]
        chosen: dict[int, Past] = {}
        for least_m in (self.config.d_min_m, NEAR_M):
            for well in (True, False):
                far = (past for past, away_m in alike if past.well == well and away_m >= least_m)
                newest = next(far, None)
                if newest is not None:
                    chosen.setdefault(id(newest), newest)
        return list(chosen.values())

    def _suppose(self, tracked: Tracked, distance_m: Array, wanted: int) -> None:
        """Points as far away as others are, of what nothing explains: they hold the direction of a camera that turns
        on the spot, where nothing has parallax, and count for less the farther it has moved from where it saw them."""
        assert tracked.temporary is not None
        T_world_cam = tracked.T_world_body @ self.spec.T_body_cam
        named = tracked.temporary[self.points.measured(tracked.temporary)]
        distances = np.append(distance_m, np.linalg.norm(self.points.table.xyz[named] - T_world_cam.t, axis=1))
        if len(distances) >= ENOUGH_DISTANCES:
            self.points.usual_m = float(np.median(distances))
        rows = np.flatnonzero(~_taken(tracked.point, tracked.temporary))
        rows = rows[: max(min(wanted, self.config.most - len(self.points)), 0)]
        if self.points.usual_m is None or len(rows) == 0:
            return
        seen = tracked.seen.take(rows)
        xyz = T_world_cam @ (self.points.usual_m * seen.ray)
        tracked.temporary[rows] = self.points.add(xyz, seen, T_world_cam.t, SUPPOSED / self.points.usual_m)

    def _triangulate(self, tracked: Tracked, past: Past) -> None:
        assert tracked.temporary is not None
        free = np.flatnonzero((tracked.point < 0) & ~self.points.measured(tracked.temporary))
        free_there = np.flatnonzero((past.point < 0) & ~self.points.measured(past.temporary))
        if len(free) == 0 or len(free_there) == 0:
            return
        a, b = tracked.seen.take(free), past.seen.take(free_there)
        T_world_a = tracked.T_world_body @ self.spec.T_body_cam
        T_world_b = past.T_world_body @ self.spec.T_body_cam
        sigma_a, sigma_b = self._sigma_rad(a, tracked.noise), self._sigma_rad(b, past.noise)
        match = match_epipolar(a, b, T_world_b.inverse() @ T_world_a, sigma_b)
        ia = np.flatnonzero(match >= 0)
        ib = match[ia]
        if len(ia) == 0:
            return
        centres = np.empty((len(ia), 2, 3))
        centres[:, 0], centres[:, 1] = T_world_a.t, T_world_b.t
        rays = np.stack([a.ray[ia] @ T_world_a.R.T, b.ray[ib] @ T_world_b.R.T], axis=1)
        sigma = np.stack([sigma_a[ia], sigma_b[ib]], axis=1)
        made = triangulate_rays(
            centres.reshape(-1, 3), rays.reshape(-1, 3), sigma.ravel(), np.arange(0, 2 * len(ia) + 1, 2)
        )
        far_apart = float(np.linalg.norm(T_world_a.t - T_world_b.t)) >= self.config.d_min_m
        least = math.radians(NEVER_BELOW_DEG if far_apart else self.config.min_parallax_deg)
        distance_a = np.linalg.norm(made.xyz - T_world_a.t, axis=1)
        distance_b = np.linalg.norm(made.xyz - T_world_b.t, axis=1)
        expected = distance_b / np.maximum(distance_a, 1e-9)  # a patch half as far away is twice as large
        size = self.orb.scale(a.octave[ia]) / self.orb.scale(b.octave[ib])
        good = made.in_front & (made.parallax >= least)  # that they meet is how they were matched
        good &= made.relative_sigma < self.config.max_relative_sigma
        good &= np.abs(np.log(np.maximum(size, 1e-9) / np.maximum(expected, 1e-9))) < math.log(SAME_SCALE)
        ia, ib = ia[good], ib[good]
        ids = self.points.add(made.xyz[good], a.take(ia), T_world_a.t)
        for replaced in (tracked.temporary[free[ia]], past.temporary[free_there[ib]]):
            self.points.table.alive[replaced[replaced >= 0]] = False
        tracked.temporary[free[ia]] = ids
        past.temporary[free_there[ib]] = ids

    def _sigma_rad(self, seen: Features, noise: float) -> Array:
        out: Array = noise * self.points.sigma_rad * self.orb.scale(seen.octave)
        return out


def _taken(point: Ints, temporary: AnyArray | None) -> Bools:
    """Which features a point of either kind explains."""
    out: Bools = (point >= 0) if temporary is None else (point >= 0) | (temporary >= 0)
    return out
