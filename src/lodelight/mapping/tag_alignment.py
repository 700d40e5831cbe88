"""Where a map lies in the world, by tags that were mapped and surveyed, of which some may have been moved."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lodelight.geometry.se3 import SE3, carried_covariance, level
from lodelight.types import Array

AGREE_M = 0.3  # that a tag may be off its survey, as an alignment by another one has it
TURN_RAD, OFFSET_M = math.radians(1.0), 0.01  # sigmas of an alignment by one tag
BASE_M = 0.03  # by which two tags may be off across the line between them


@dataclass(frozen=True, eq=False)
class Consensus:
    """T_world_map as tag `by` says; agreeing : itself and the tags that it puts where their surveys have them."""

    T_world_map: SE3
    by: int
    agreeing: list[int]


def consensus(
    T_map_tag: Mapping[int, SE3], T_world_tag: Mapping[int, SE3], spread: Mapping[int, float], upright: bool = False
) -> Consensus | None:
    """The alignment by the tag with which most others agree, and of several by that of least spread; None without tags.

    T_map_tag : of each mapped tag; T_world_tag : its survey; spread : variance of its place, m^2
    upright : both frames have z up, and only a turn about it lies between them
    """
    best: Consensus | None = None
    for i, T in T_map_tag.items():
        T_world_map = T_world_tag[i] @ T.inverse()
        T_world_map = level(T_world_map, T.t) if upright else T_world_map
        agreeing = [j for j, other in T_map_tag.items() if off_m(T_world_map @ other, T_world_tag[j]) < AGREE_M]
        if best is None or (len(agreeing), -spread[i]) > (len(best.agreeing), -spread[best.by]):
            best = Consensus(T_world_map, i, agreeing)
    return best


def off_m(a: SE3, b: SE3) -> float:
    """Between two places of a tag."""
    return float(np.linalg.norm(a.t - b.t))


def looseness(anchors: Sequence[SE3], T_map_tag: SE3) -> Array:
    """(6, 6) of where an alignment that rests on the tags `anchors`, T_map_tag each, puts another one."""
    if not anchors:
        return np.zeros((6, 6))
    spots = np.array([T.t for T in anchors])
    nearest = int(np.argmin(np.linalg.norm(spots - T_map_tag.t, axis=1)))
    base_m = float(np.max(np.linalg.norm(spots - spots[nearest], axis=1)))
    turn = min(TURN_RAD, BASE_M / base_m) if base_m > 0.0 else TURN_RAD
    return carried_covariance(anchors[nearest], np.diag([turn**2] * 3 + [OFFSET_M**2] * 3), T_map_tag)
