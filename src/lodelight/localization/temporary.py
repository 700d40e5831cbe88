"""Temporary points: what carries a camera across a part of the building that the map does not show as it is now.

They are an overlay: a table of their own, in the map's frame, that the map knows nothing of. `clear` forgets them all,
with every match that names one. Source: science note B3.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincinv

from lodelight.features.epipolar import match_epipolar
from lodelight.features.features import Features
from lodelight.features.orb import OrbConfig
from lodelight.geometry.se3 import SE3
from lodelight.geometry.triangulate import CHI2_PAIR, triangulate_rays
from lodelight.localization.tracker import CLOSE_SIGMA, Tracked
from lodelight.mapping.sight import Sight, in_sight_of
from lodelight.mapping.table import Table
from lodelight.rig import CameraSpec
from lodelight.types import AnyArray, Array, Bools, Ints

NEVER_BELOW_DEG = 1.15  # of parallax: farther points are a matter of noise
SAME_SCALE = 1.8  # by how much sizes of a patch in two images may differ from what its distances say: 1.5 x an octave
NEAR_M = 0.05  # of baseline, below which no pair of frames is tried
VIEW_COSINE = 0.5  # of the angle between two views that may show the same
SUPPOSED = 0.5  # of an inverse distance that is not measured, one standard deviation as a share of it
AGREE = 0.95  # of right rays meet within this bound of their noise
ENOUGH_DISTANCES = 10  # measured in a frame, to suppose others from


@dataclass(frozen=True)
class TemporaryConfig:
    """d_min_m, min_parallax_deg : a partner frame is that far away, or a pair of rays has that much parallax
    max_relative_sigma : of the distance of a point, as a share of it
    weight : share of its information that an observation of a temporary point brings in; it is as good as poses were
    enough : points of both kinds in a frame above which no more are made; most : temporary points at a time
    found_ratio : a point found in a smaller share of the frames that should show it goes
    past_frames : earlier frames kept as partners, past_m or past_deg apart
    """

    d_min_m: float = 0.4
    min_parallax_deg: float = 2.0
    max_relative_sigma: float = 0.2
    weight: float = 0.5
    enough: int = 200
    most: int = 1500
    found_ratio: float = 0.25
    past_frames: int = 12
    past_m: float = 0.1
    past_deg: float = 6.0


@dataclass(eq=False)
class Past:
    """An earlier frame whose pose was measured; adjusting moves it.

    point, temporary : (N,) as in `Tracked`; well : the map alone held it
    """

    seen: Features
    T_world_body: SE3
    point: Ints
    temporary: Ints
    noise: float
    well: bool


class TemporaryPoints:
    """Points with stable numbers until `clear`, and the earlier frames they are made with.

    created : so many in all; the rest is of the camera that localizes, whose octaves scale the points
    """

    def __init__(self, spec: CameraSpec, orb: OrbConfig, config: TemporaryConfig, sigma_px: float) -> None:
        self.spec = spec
        self.orb = orb
        self.config = config
        self.sigma_rad = sigma_px / spec.camera.focal_px
        self.created = 0
        self._usual_m: float | None = None  # distance of what was seen last
        self._past: deque[Past] = deque(maxlen=config.past_frames)
        self._new_table()

    def __len__(self) -> int:
        return int(np.count_nonzero(self.table.alive))

    @property
    def references(self) -> int:
        """Matches of earlier frames that name a temporary point."""
        return sum(int(np.count_nonzero(past.temporary >= 0)) for past in self._past)

    def clear(self) -> int:
        """Forget all points and all that names them; returns how many there were. Earlier frames that the map alone
        held stay: they are as good as before."""
        there, self._usual_m = len(self), None
        self._new_table()
        for past in self._past:
            past.temporary[:] = -1
        kept = [past for past in self._past if past.well]
        self._past.clear()
        self._past.extend(kept)
        return there

    def forget_past(self) -> None:
        """The camera is somewhere else now."""
        self._past.clear()

    @property
    def past(self) -> list[Past]:
        """The earlier frames, oldest first."""
        return list(self._past)

    def remember(self, tracked: Tracked, well: bool) -> bool:
        """Keep a frame as a partner for later ones, if it is not where the last one was; returns whether it is kept."""
        if self._past:
            apart = self._past[-1].T_world_body.inverse() @ tracked.T_world_body
            near = float(np.linalg.norm(apart.t)) < self.config.past_m and apart.angle < math.radians(
                self.config.past_deg
            )
            if near and (self._past[-1].well or not well):
                return False
        self._past.append(self._past_of(tracked, well))
        return True

    def in_sight(self, T_world_body: SE3) -> Sight:
        """Which of them should be seen, and where."""
        rows = np.flatnonzero(self.table.alive).astype(np.int32)
        camera = self.spec.camera
        return in_sight_of(self.table, rows, camera.focal_px, T_world_body, self.spec.T_body_cam, camera, self.orb)

    def count(self, sighted: Ints, found: Ints) -> None:
        """Points that should have been seen, and those that were; what is hardly ever found goes."""
        t = self.table
        t.n_visible[sighted] += 1
        t.n_found[found] += 1
        bad = (t.n_visible >= 2) & (t.n_found < np.maximum(self.config.found_ratio * t.n_visible, 1.0))
        t.alive[bad] = False

    def alive(self, temporary: Ints) -> Ints:
        """(N,) with the numbers of points that are gone set to -1."""
        out: Ints = (
            np.where((temporary >= 0) & self.table.alive[np.maximum(temporary, 0)], temporary, -1)
            if len(self.table)
            else np.full(len(temporary), -1, np.int32)
        )
        return out.astype(np.int32)

    def uncertainty(self, temporary: Ints, centre: Array) -> Array:
        """(K,) rad: how far from where points should appear to a camera at centre they may, for want of a distance."""
        moved = np.linalg.norm(self.table.centre[temporary] - centre, axis=1)
        out: Array = moved * self.table.sigma_inv_distance[temporary]
        return out

    def measured(self, temporary: AnyArray) -> Bools:
        """(N,) which of them name a point whose distance is measured, and not supposed."""
        known = self.table.sigma_inv_distance == 0.0
        out: Bools = (temporary >= 0) & (known[np.maximum(temporary, 0)] if len(known) else False)
        return out

    # -- how they are made --------------------------------------------------------------------------------------

    def grow(self, tracked: Tracked, distance_m: Array) -> int:
        """New points from what a frame sees and nothing explains yet; its `temporary` names them. Returns how many.

        distance_m : (K,) of the points of the map that it sees
        Nothing is measured from a pose that is guessed: points are as exact as the poses that they are had from.
        """
        if tracked.temporary is None:
            tracked.temporary = _none(tracked.seen)
        before = self.created
        self._from_depth(tracked)
        self._measure(self._past if tracked.guessed else [*self._past, self._past_of(tracked, False)])
        for past in self._partners(tracked) if not tracked.guessed else ():
            if tracked.measured + self.created - before >= self.config.enough or len(self) >= self.config.most:
                break
            self._triangulate(tracked, past)
        self._suppose(tracked, distance_m, self.config.enough - tracked.right_in_all - (self.created - before))
        return self.created - before

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
            tracked.temporary[rows] = self._add(xyz, seen.take(rows), T_world_cam.t)

    def _past_of(self, tracked: Tracked, well: bool) -> Past:
        temporary = _none(tracked.seen) if tracked.temporary is None else tracked.temporary.copy()
        return Past(tracked.seen, tracked.T_world_body, tracked.point.copy(), temporary, tracked.noise, well)

    def _measure(self, frames: Iterable[Past]) -> None:
        """Give the distance to points that are only supposed, by all frames that see them."""
        ids, rays, centres, sigma = [], [], [], []
        for past in frames:
            rows = np.flatnonzero((self.alive(past.temporary) >= 0) & ~self.measured(past.temporary))
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
        t, ids = self.table, named[good]
        nearer = np.linalg.norm(made.xyz[good] - t.centre[ids], axis=1)
        nearer /= np.linalg.norm(t.xyz[ids] - t.centre[ids], axis=1)
        t.d_min[ids] *= nearer
        t.d_max[ids] *= nearer
        t.xyz[ids], t.sigma_inv_distance[ids] = made.xyz[good], 0.0

    def _partners(self, tracked: Tracked) -> list[Past]:
        """Earlier frames to triangulate with, best first: those the map alone held, then the others; the newest first.

        One of each that is far enough for its points to be exact, and one for rays of enough parallax.
        """
        chosen: list[Past] = []
        for least_m in (self.config.d_min_m, NEAR_M):
            for well in (True, False):
                for past in reversed(self._past):
                    apart = past.T_world_body.inverse() @ tracked.T_world_body
                    axis = self.spec.T_body_cam.R[:, 2]
                    if (
                        past.well == well
                        and float(np.linalg.norm(apart.t)) >= least_m
                        and float(axis @ apart.R @ axis) > VIEW_COSINE
                    ):
                        if all(past is not other for other in chosen):
                            chosen.append(past)
                        break
        return chosen

    def _suppose(self, tracked: Tracked, distance_m: Array, wanted: int) -> None:
        """Points as far away as others are, of what nothing explains: they hold the direction of a camera that turns
        on the spot, where nothing has parallax, and count for less the farther it has moved from where it saw them."""
        assert tracked.temporary is not None
        T_world_cam = tracked.T_world_body @ self.spec.T_body_cam
        named = tracked.temporary[self.measured(tracked.temporary)]
        distances = np.append(distance_m, np.linalg.norm(self.table.xyz[named] - T_world_cam.t, axis=1))
        if len(distances) >= ENOUGH_DISTANCES:
            self._usual_m = float(np.median(distances))
        rows = np.flatnonzero(~_taken(tracked.point, tracked.temporary))
        rows = rows[: max(min(wanted, self.config.most - len(self)), 0)]
        if self._usual_m is None or len(rows) == 0:
            return
        seen = tracked.seen.take(rows)
        xyz = T_world_cam @ (self._usual_m * seen.ray)
        tracked.temporary[rows] = self._add(xyz, seen, T_world_cam.t, SUPPOSED / self._usual_m)

    def _triangulate(self, tracked: Tracked, past: Past) -> None:
        assert tracked.temporary is not None
        free = np.flatnonzero((tracked.point < 0) & ~self.measured(tracked.temporary))
        free_there = np.flatnonzero((past.point < 0) & ~self.measured(past.temporary))
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
        good = made.in_front & (made.chi2 < CHI2_PAIR) & (made.parallax >= least)
        good &= made.relative_sigma < self.config.max_relative_sigma
        good &= np.abs(np.log(np.maximum(size, 1e-9) / np.maximum(expected, 1e-9))) < math.log(SAME_SCALE)
        ia, ib = ia[good], ib[good]
        ids = self._add(made.xyz[good], a.take(ia), T_world_a.t)
        for replaced in (tracked.temporary[free[ia]], past.temporary[free_there[ib]]):
            self.table.alive[replaced[replaced >= 0]] = False
        tracked.temporary[free[ia]] = ids
        past.temporary[free_there[ib]] = ids

    def _add(self, xyz: Array, seen: Features, centre: Array, sigma_inv_distance: float = 0.0) -> Ints:
        n = len(xyz)
        ray = xyz - centre
        distance = np.linalg.norm(ray, axis=1)
        d_max = distance * self.orb.scale(seen.octave)
        start = self.table.append(
            n, xyz=xyz, desc=seen.desc, normal=ray / np.maximum(distance, 1e-9)[:, None], d_max=d_max,
            d_min=d_max / self.orb.scale_factor ** (self.orb.n_levels - 1), alive=True, centre=centre,
            sigma_inv_distance=sigma_inv_distance,
        )  # fmt: skip
        self.created += n
        return np.arange(start, start + n, dtype=np.int32)

    def _sigma_rad(self, seen: Features, noise: float) -> Array:
        out: Array = noise * self.sigma_rad * self.orb.scale(seen.octave)
        return out

    def _new_table(self) -> None:
        f64, i32 = np.float64, np.int32
        self.table = Table(
            xyz=(f64, (3,)), desc=(np.uint64, (4,)), normal=(f64, (3,)), d_min=(f64, ()), d_max=(f64, ()),
            n_visible=(i32, ()), n_found=(i32, ()), alive=(np.bool_, ()), centre=(f64, (3,)),
            sigma_inv_distance=(f64, ()),
        )  # fmt: skip


def _none(seen: Features) -> Ints:
    return np.full(len(seen), -1, np.int32)


def _taken(point: Ints, temporary: AnyArray | None) -> Bools:
    """Which features a point of either kind explains."""
    out: Bools = (point >= 0) if temporary is None else (point >= 0) | (temporary >= 0)
    return out
