"""Where a frame was taken, without knowing where the camera was before: place recognition, then a pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lodelight.features.features import Features
from lodelight.features.orb import OrbConfig
from lodelight.geometry.se3 import SE3
from lodelight.localization.machine import Found
from lodelight.mapping.map import Map
from lodelight.mapping.places import Places
from lodelight.mapping.sight import keyframes_near
from lodelight.mapping.verification import Location, Refusal, Verifier, elsewhere
from lodelight.rig import CameraSpec
from lodelight.types import Array, Ints


@dataclass(frozen=True)
class RelocalizerConfig:
    """sigma_px : noise of a corner at the finest octave
    candidates : places looked at, the most similar first
    min_agreeing : matches that fit a first pose, around which the others are looked for. By chance 4 or 5 of a dozen do
    min_inliers, min_coverage : map points found, and share of the image's cells with points that have one found,
        below which an answer is not believed. Wrong places of real rooms reach 10 points once in 10,000 trials
        (docs/places-and-loops.md); a poster that hangs in two rooms reaches more, but in few cells.
    rival : an answer elsewhere with so large a share of the best one's points makes it ambiguous
    hint_angle_deg : how far a keyframe's view may be turned from a hinted pose to be looked at
    hint_sigmas : a hinted pose is off by no more of its own standard deviations than this
    """

    sigma_px: float = 1.0
    candidates: int = 12
    min_agreeing: int = 6
    min_inliers: int = 30
    min_coverage: float = 0.35
    rival: float = 0.5
    hint_angle_deg: float = 60.0
    hint_sigmas: float = 3.5


@dataclass(frozen=True, eq=False)
class Hint:
    """Roughly where a frame was taken: by a light fix, a tag, or what it was before it was lost.

    radius_m : how far off the pose may be besides its covariance, and from how far a place may be seen
    covariance : (6, 6) of the pose, chart of SE3.perturbed; nothing where None
    """

    T_world_body: SE3
    radius_m: float
    covariance: Array | None = None

    def reach(self, away: Array, sigmas: float) -> Array:
        """(N,) m: how far off it may be in each direction away (N, 3)."""
        if self.covariance is None:
            return np.full(len(away), self.radius_m)
        length = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
        variance = np.einsum("ni,ij,nj->n", away, self.covariance[3:, 3:], away) / length**2
        out: Array = self.radius_m + sigmas * np.sqrt(np.maximum(variance, 0.0))
        return out

    def turn_deg(self, sigmas: float) -> float:
        """How far off its direction may be."""
        if self.covariance is None:
            return 0.0
        return float(np.degrees(sigmas * np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3])[-1])))


class Relocalizer:
    """Finds frames in a map that others write. spec : the camera of the frames, where it is not the map's."""

    def __init__(
        self,
        map: Map,
        orb: OrbConfig,
        places: Places | None = None,
        config: RelocalizerConfig | None = None,
        spec: CameraSpec | None = None,
    ) -> None:
        self.map = map
        self.config = config or RelocalizerConfig()
        self.places = places or Places(map)
        self.T_body_cam = (spec or map.rig.cameras[0]).T_body_cam
        self._verifier = Verifier(
            map, orb, self.config.sigma_px, spec, whole_place=True, min_agreeing=self.config.min_agreeing
        )

    def find(self, seen: Features, hint: Hint | None = None) -> Found | str:
        """Pose of a frame in the map and what it shows of it, or why none is believed.

        hint : only keyframes from around there are looked at, and no answer far from there is believed
        """
        with self.map.lock:
            doubts: list[str] = []
            believed: list[tuple[int, Location]] = []
            for keyframe in self._candidates(seen, hint).tolist():
                found = self._verifier.locate(seen, keyframe, self._verifier.neighbourhood(keyframe))
                doubt = found.why if isinstance(found, Refusal) else self._doubt(found) or self._far(found, hint)
                if isinstance(found, Location) and not doubt:
                    believed.append((keyframe, found))
                doubts.append(f"most like keyframe {keyframe}, but {doubt}")
            if not believed:
                return doubts[0] if doubts else "no keyframe looks alike"
            believed.sort(key=lambda answer: -len(answer[1]))
            return self._rival(believed) or self._answer(seen, *believed[0])

    def _candidates(self, seen: Features, hint: Hint | None) -> Ints:
        far = None
        if hint is not None:
            far = np.setdiff1d(np.arange(len(self.map.keyframes)), self._keyframes_near(hint))
        return self.places.candidates(seen.desc, self.config.candidates, far)

    def _keyframes_near(self, hint: Hint) -> Ints:
        """Keyframes whose cameras may be within reach of a hint's, and look where it looks."""
        sigmas, T_world_cam = self.config.hint_sigmas, hint.T_world_body @ self.T_body_cam
        reach_m = hint.reach(self.map.keyframes.p - hint.T_world_body.t, sigmas)
        return keyframes_near(self.map, T_world_cam, reach_m, self.config.hint_angle_deg + hint.turn_deg(sigmas))

    def _far(self, found: Location, hint: Hint | None) -> str:
        """Whether an answer is out of a hint's reach; empty where it is not."""
        if hint is None:
            return ""
        away = found.T_world_body.t - hint.T_world_body.t
        off_m, reach_m = float(np.linalg.norm(away)), float(hint.reach(away[None], self.config.hint_sigmas)[0])
        return f"found {off_m:.1f} m from where it was hinted, beyond {reach_m:.1f} m" if off_m > reach_m else ""

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
