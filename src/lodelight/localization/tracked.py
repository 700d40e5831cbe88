"""What tracking hands on: a frame with its pose, what it was matched with, and the settings that decide."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lodelight.estimation.pose import PoseResult
from lodelight.features.features import Features
from lodelight.geometry.se3 import SE3
from lodelight.types import Array, ArrayF32, Ints, Words


@dataclass(frozen=True)
class TrackerConfig:
    """sigma_px : noise of a corner at the finest octave
    search_px : how far a corner may be from where the motion model puts it, at the finest octave
    min_matches : fewer that fit a pose, and the next way of matching is tried
    min_inliers : fewer after the local map, and the frame is lost; good_inliers : fewer, and it is degraded
    """

    sigma_px: float = 1.0
    search_px: float = 15.0
    min_matches: int = 20
    min_inliers: int = 15
    good_inliers: int = 40


@dataclass(eq=False)
class Tracked:
    """A frame and what it was matched with.

    point : (N,) map point of every feature, -1 = none; inliers only
    reference : the keyframe that sees most of those points; noise : sigma of its corners over a sharp frame's
    temporary : (N,) temporary point of every feature, -1 = none; None where there are no such points
    right_in_map, right_in_all, measured : how many of the map's points agree beyond chance, of both kinds, and of both
        kinds those whose distance is known; -1 = not asked
    guessed : those leave open where the camera is: points whose distance is supposed have a say
    """

    t_ns: int
    seen: Features
    T_world_body: SE3
    covariance: Array
    point: Ints
    reference: int
    noise: float = 1.0
    why_lost: str = ""
    T_reference_body: SE3 = field(default_factory=SE3.identity)
    temporary: Ints | None = None
    right_in_map: int = -1
    right_in_all: int = -1
    measured: int = -1
    guessed: bool = False

    @property
    def n_inliers(self) -> int:
        return int(np.count_nonzero(self.point >= 0))


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Things to match with: map point (M,) or -1, position (M, 3) m world, and how a feature of it looked."""

    point: Ints
    xyz: Array
    desc: Words
    octave: Ints
    angle: ArrayF32


@dataclass(frozen=True, eq=False)
class Fit:
    """A pose from matches. point : (N,) map point of every feature that agrees, or -1; tried : matches there were;
    right : how many of them are at least, going by how many more agree than would by chance
    """

    solved: PoseResult
    point: Ints
    tried: int
    right: float
