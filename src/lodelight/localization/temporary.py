"""Temporary points: what carries a camera across a part of the building that the map does not show as it is now.

They are an overlay: a table of their own, in the map's frame, that the map knows nothing of. `clear` forgets them all,
with every match that names one. `growth` makes them. Source: science note B3.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from lodelight.features.features import Features
from lodelight.features.orb import OrbConfig
from lodelight.geometry.se3 import SE3
from lodelight.localization.tracker import Tracked
from lodelight.mapping.sight import Sight, in_sight_of
from lodelight.mapping.table import Table
from lodelight.rig import CameraSpec
from lodelight.types import AnyArray, Array, Bools, Ints


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
        self.usual_m: float | None = None  # distance of what was seen last
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
        there, self.usual_m = len(self), None
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
        self._past.append(self.past_of(tracked, well))
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

    def make_room(self, temporary: Ints) -> None:
        """Where there are nearly as many points as may be, the oldest go that neither an earlier frame names nor
        `temporary` (N,): the camera has left them behind."""
        surplus = len(self) + self.config.enough - self.config.most
        if surplus > 0:
            named = np.concatenate([temporary, *(past.temporary for past in self._past)])
            left_behind = np.setdiff1d(np.flatnonzero(self.table.alive), named)
            self.table.alive[left_behind[:surplus]] = False

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

    def add(self, xyz: Array, seen: Features, centre: Array, sigma_inv_distance: float = 0.0) -> Ints:
        """Numbers of new points at (N, 3), seen as `seen` from centre.

        sigma_inv_distance : 1/m, 0 where the distance is measured
        """
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

    def past_of(self, tracked: Tracked, well: bool) -> Past:
        """A frame as a partner for later ones."""
        temporary = _none(tracked.seen) if tracked.temporary is None else tracked.temporary.copy()
        return Past(tracked.seen, tracked.T_world_body, tracked.point.copy(), temporary, tracked.noise, well)

    def _new_table(self) -> None:
        f64, i32 = np.float64, np.int32
        self.table = Table(
            xyz=(f64, (3,)), desc=(np.uint64, (4,)), normal=(f64, (3,)), d_min=(f64, ()), d_max=(f64, ()),
            n_visible=(i32, ()), n_found=(i32, ()), alive=(np.bool_, ()), centre=(f64, (3,)),
            sigma_inv_distance=(f64, ()),
        )  # fmt: skip


def _none(seen: Features) -> Ints:
    return np.full(len(seen), -1, np.int32)
