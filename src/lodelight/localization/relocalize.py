"""Where a frame was taken, without knowing where the camera was before: place recognition, then a pose."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lodelight.features.features import Features
from lodelight.features.orb import OrbConfig
from lodelight.geometry.se3 import SE3
from lodelight.localization.machine import Found
from lodelight.mapping.map import Map
from lodelight.mapping.places import Places
from lodelight.mapping.verification import Location, Refusal, Verifier, elsewhere
from lodelight.types import Ints


@dataclass(frozen=True)
class RelocalizerConfig:
    """sigma_px : noise of a corner at the finest octave
    candidates : places looked at, the most similar first
    min_inliers, min_coverage : map points found, and share of the image's cells with points that have one found,
        below which an answer is not believed. Wrong places of real rooms reach 10 points once in 10,000 trials
        (docs/places-and-loops.md); a poster that hangs in two rooms reaches more, but in few cells.
    rival : an answer elsewhere with so large a share of the best one's points makes it ambiguous
    hint_angle_deg : how far a keyframe's view may be turned from a hinted pose to be looked at
    """

    sigma_px: float = 1.0
    candidates: int = 5
    min_inliers: int = 30
    min_coverage: float = 0.35
    rival: float = 0.5
    hint_angle_deg: float = 60.0


class Relocalizer:
    """Finds frames in a map that others write."""

    def __init__(
        self, map: Map, orb: OrbConfig, places: Places | None = None, config: RelocalizerConfig | None = None
    ) -> None:
        self.map = map
        self.config = config or RelocalizerConfig()
        self.places = places or Places(map)
        self._verifier = Verifier(map, orb, self.config.sigma_px)

    def find(self, seen: Features, hint: tuple[SE3, float] | None = None) -> Found | str:
        """Pose of a frame in the map and what it shows of it, or why none is believed.

        hint : a pose and how far off it may be, m; only keyframes from around there are then looked at
        """
        with self.map.lock:
            doubts: list[str] = []
            believed: list[tuple[int, Location]] = []
            for keyframe in self._candidates(seen, hint).tolist():
                found = self._verifier.locate(seen, keyframe, self._verifier.neighbourhood(keyframe))
                doubt = found.why if isinstance(found, Refusal) else self._doubt(found)
                if isinstance(found, Location) and not doubt:
                    believed.append((keyframe, found))
                doubts.append(f"most like keyframe {keyframe}, but {doubt}")
            if not believed:
                return doubts[0] if doubts else "no keyframe looks alike"
            believed.sort(key=lambda answer: -len(answer[1]))
            return self._rival(believed) or self._answer(seen, *believed[0])

    def _candidates(self, seen: Features, hint: tuple[SE3, float] | None) -> Ints:
        if hint is None:
            return self.places.candidates(seen.desc, limit=self.config.candidates)
        T_world_body, radius_m = hint
        near = self._keyframes_near(T_world_body, radius_m)
        score, _ = self.places.similarity(seen.desc)
        return near[np.argsort(-score[near], kind="stable")][: self.config.candidates]

    def _keyframes_near(self, T_world_body: SE3, radius_m: float) -> Ints:
        """Keyframes not farther than radius_m from a pose, that look where it looks."""
        k, T_body_cam = self.map.keyframes, self.map.rig.cameras[0].T_body_cam
        distance = np.linalg.norm(k.p - T_world_body.t, axis=1)
        axis = T_body_cam.R[:, 2]
        cosine = k.R @ axis @ (T_world_body.R @ axis)
        near = k.alive & (distance <= radius_m) & (cosine >= math.cos(math.radians(self.config.hint_angle_deg)))
        return np.flatnonzero(near).astype(np.int32)

    def _doubt(self, found: Location) -> str:
        """Why a location is not to be believed; empty where it is."""
        if len(found) < self.config.min_inliers:
            return f"{len(found)} points found, {self.config.min_inliers} are needed"
        if found.coverage < self.config.min_coverage:
            return f"points found in {found.coverage:.0%} of the view, {self.config.min_coverage:.0%} are needed"
        return ""

    def _rival(self, believed: list[tuple[int, Location]]) -> str:
        """Whether the second best answer is elsewhere and nearly as good; empty where it is not."""
        (keyframe, best), *others = believed
        for other_keyframe, other in others:
            two_places = elsewhere(best.T_world_body, other.T_world_body)
            if two_places and len(other) > self.config.rival * len(best):
                return (
                    f"keyframes {keyframe} and {other_keyframe} both fit, with {len(best)} and {len(other)} points, "
                    "in different places"
                )
        return ""

    def _answer(self, seen: Features, keyframe: int, found: Location) -> Found:
        point = np.full(len(seen), -1, np.int32)
        point[found.feature] = found.point
        why = f"{len(found)} of {found.n_expected} points found around keyframe {keyframe}"
        return Found(found.T_world_body, found.covariance, point, why)
