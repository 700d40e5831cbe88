"""Loops: a new keyframe shows a place that was mapped long before.

Places that look alike are verified by geometry in both directions (`verify_pair`), held against how far the estimate
can have drifted, and believed if the evidence is strong or a second keyframe soon after agrees. What is believed is
corrected in `loop_correction`. A wrong loop ruins a map, a missed one comes again.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from lodelight.features.orb import OrbConfig
from lodelight.geometry.se3 import SE3
from lodelight.mapping.drift import path_between
from lodelight.mapping.loop_correction import Correction, correct_loop
from lodelight.mapping.map import Map
from lodelight.mapping.pairs import Pair, PairConfig, verify_pair
from lodelight.mapping.places import Places
from lodelight.mapping.verification import MIN_AGREEING, WINDOWS_PX, Verifier, elsewhere
from lodelight.types import Ints

EventSink = Callable[..., None]  # called as sink(t_ns, kind, **fields)


@dataclass(frozen=True)
class LoopConfig:
    """What it takes to believe a loop; docs/places-and-loops.md has the measurements behind it.

    sigma_px : noise of a corner at the finest octave
    min_shared : keyframes that share so many points are neighbours, among which no loop is looked for
    candidates : places that are verified for each keyframe, most similar first
    min_similarity : of a place, as a share of the similarity to the least similar neighbour
    rival : a place elsewhere with so large a share of the points makes a loop ambiguous
    strong_inliers : points found in both directions that need no second keyframe
    confirm_within : keyframes within which a second one must agree with a loop that is not strong
    drift, drift_m, drift_deg : the estimate is off by no more than this share of the way between the two keyframes,
        and of the turns on it, plus this much. Three times what stereo and RGB-D drift by; what looks the same every
        few metres is kept apart by nothing else
    iterations : of the adjustment of the whole map after a loop
    """

    sigma_px: float = 1.0
    min_shared: int = 15
    candidates: int = 3
    min_similarity: float = 0.6
    pair: PairConfig = field(default_factory=PairConfig)
    rival: float = 0.5
    strong_inliers: int = 60
    confirm_within: int = 3
    drift: float = 0.03
    drift_m: float = 0.3
    drift_deg: float = 5.0
    iterations: int = 10


@dataclass(frozen=True, eq=False)
class LoopResult:
    """What became of a loop: the loop, and how the map was corrected."""

    loop: Pair
    correction: Correction


@dataclass(frozen=True, eq=False)
class _Awaiting:
    """A loop that waits for a second keyframe to agree. T_new_old : how it would move the world around `keyframe`."""

    keyframe: int
    place: Ints
    T_new_old: SE3


class LoopCloser:
    """Looks for a loop at each new keyframe, and closes those it believes.

    on_event : told of every loop accepted or refused, with the reason
    correcting : the map is being bent, on whichever thread `process` was called
    """

    def __init__(
        self,
        map: Map,
        orb: OrbConfig,
        places: Places | None = None,
        config: LoopConfig | None = None,
        on_event: EventSink | None = None,
    ) -> None:
        self.map = map
        self.places = places or Places(map)
        self.config = config or LoopConfig()
        self.verifier = Verifier(map, orb, self.config.sigma_px)
        self.emit: EventSink = on_event or (lambda t_ns, kind, **fields: None)
        self.correcting = False
        self._awaiting: list[_Awaiting] = []

    def process(self, keyframe: int, stop: Callable[[], bool] | None = None) -> LoopResult | None:
        """Close a loop at a keyframe that local mapping is done with, if there is one.

        stop : asked between the iterations of the last, long adjustment, which may be cut short
        """
        with self.map.lock:
            self._awaiting = [w for w in self._awaiting if keyframe - w.keyframe <= self.config.confirm_within]
            loop = self._find(keyframe)
        if loop is None:
            return None
        self.correcting = True
        try:
            correction = correct_loop(self.verifier, loop, self._drifted(loop), self.config.iterations, stop)
        finally:
            self.correcting = False
        return LoopResult(loop, correction)

    def forget(self) -> None:
        """The map was laid down elsewhere: what waits for a second keyframe would move the world as it was."""
        self._awaiting.clear()

    # -- belief -------------------------------------------------------------------------------------------------

    def _find(self, keyframe: int) -> Pair | None:
        """The loop that is believed, if any, of all the places that look alike."""
        possible: list[Pair] = []
        for candidate in self._candidates(keyframe).tolist():
            answer = verify_pair(self.verifier, keyframe, candidate, self.config.pair)
            refused = self._too_far(answer) if isinstance(answer, Pair) else answer.why
            if isinstance(answer, Pair) and not refused:
                possible.append(answer)
            else:
                self._tell(keyframe, candidate, answer.inliers, refused)
        possible.sort(key=lambda loop: -loop.inliers)
        for loop in possible:
            doubt = self._ambiguous(loop, possible) or self._unconfirmed(loop)
            self._tell(keyframe, loop.b, loop.inliers, doubt)
            if not doubt:
                self._awaiting.clear()
                return loop
        return None

    def _candidates(self, keyframe: int) -> Ints:
        """Keyframes that look like this one and are not its neighbours."""
        desc = self.map.features.desc[self.map.feature_range(keyframe)]
        neighbours, _ = self.map.covisible(keyframe, self.config.min_shared)
        if len(neighbours) == 0:
            return np.zeros(0, np.int32)
        score, common = self.places.similarity(desc)
        return self.places.best(
            score, common, self.config.candidates, excluded=np.append(neighbours, keyframe),
            min_score=self.config.min_similarity * float(score[neighbours].min()),
        )  # fmt: skip

    def _too_far(self, loop: Pair) -> str:
        """Why the estimate cannot have drifted as far as the loop says; empty where it can."""
        length_m, turns_deg = path_between(self.map, loop.a, loop.b)
        T_old_new = self.map.pose(loop.a).inverse() @ self._where(loop)
        moved_m, turned_deg = float(np.linalg.norm(T_old_new.t)), math.degrees(T_old_new.angle)
        config = self.config
        most_m, most_deg = config.drift_m + config.drift * length_m, config.drift_deg + config.drift * turns_deg
        if moved_m <= most_m and turned_deg <= most_deg:
            return ""
        return (
            f"would move the camera by {moved_m:.2f} m and {turned_deg:.1f} deg; after a path of {length_m:.1f} m "
            f"drift explains {most_m:.2f} m and {most_deg:.1f} deg"
        )

    def _ambiguous(self, loop: Pair, possible: list[Pair]) -> str:
        """Which other place fits nearly as well; empty where none does."""
        for other in possible:
            two_places = elsewhere(self._where(loop), self._where(other))
            if two_places and other.inliers > self.config.rival * loop.inliers:
                return f"keyframe {other.b} fits too, with {other.inliers} points to {loop.inliers}"
        return ""

    def _unconfirmed(self, loop: Pair) -> str:
        """Why a loop must wait for a second keyframe; empty where it is strong, or the second one."""
        if loop.inliers >= self.config.strong_inliers:
            return ""
        place, seen = self.verifier.neighbourhood(loop.b), self.map.features_of(loop.a)
        for first in self._awaiting:
            expected = first.T_new_old @ self.map.pose(loop.a)
            agreement = self.verifier.explained(loop.there, seen, expected)
            same_place = first.keyframe != loop.a and np.isin(place, first.place).any()
            if same_place and agreement >= self.config.pair.min_agreement:
                return ""
        self._awaiting.append(_Awaiting(loop.a, place, self._where(loop) @ self.map.pose(loop.a).inverse()))
        return f"{loop.inliers} points found; a second keyframe must agree"

    def _where(self, loop: Pair) -> SE3:
        """T_world_body of keyframe a as the loop has it."""
        return self.map.pose(loop.b) @ loop.T_a_b.inverse()

    def _drifted(self, loop: Pair) -> bool:
        """Whether the map's own poses put the points elsewhere than where they were found."""
        seen = self.map.features_of(loop.a)
        agreement = self.verifier.explained(loop.there, seen, self.map.pose(loop.a), WINDOWS_PX[-1])
        return agreement < self.config.pair.min_agreement

    def _tell(self, a: int, b: int, inliers: int, doubt: str) -> None:
        """Emit what was decided, where there was anything to decide: images that only look alike share no pose."""
        if inliers >= MIN_AGREEING:
            t_ns = int(self.map.keyframes.t_ns[a])
            self.emit(t_ns, "loop", accepted=not doubt, why=doubt, keyframe=a, place=b, inliers=inliers)
