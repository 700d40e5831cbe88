"""What ties keyframes to the world: poses by the lights, and the lights themselves where they were seen.

Kept beside the map and not saved with it: a saved map stands where these put it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lodelight.anchors import Light
from lodelight.estimation.factors.light import LightViews
from lodelight.estimation.factors.pose_prior import PosePrior
from lodelight.geometry.se3 import SE3
from lodelight.rig import CameraSpec
from lodelight.types import Array, Ints

ROOT_LIGHTS = 2  # different ones, seen by the keyframes of a window, that hold it in the world: one leaves its yaw free


@dataclass(frozen=True, eq=False)
class AnchorSighting:
    """A light as one keyframe has it: T_keyframe_cam when its row was exposed, px (2,) of its centre.

    apart_s : between the keyframe and the sighting
    """

    T_keyframe_cam: SE3
    px: Array
    sigma_px: float
    apart_s: float


@dataclass(eq=False)
class Anchoring:
    """spec : the light camera, lights : those surveyed; neither is needed where only poses are added."""

    spec: CameraSpec | None = None
    lights: dict[str, Light] = field(default_factory=dict)
    _poses: dict[int, tuple[SE3, Array]] = field(default_factory=dict, init=False)
    _sightings: dict[int, dict[str, AnchorSighting]] = field(default_factory=dict, init=False)

    def add_pose(self, keyframe: int, T_world_body: SE3, information: Array) -> None:
        """information : (6, 6), chart of SE3.perturbed."""
        self._poses[keyframe] = (T_world_body, information)

    def add_sighting(self, keyframe: int, light: str, sighting: AnchorSighting) -> None:
        """One for a light and a keyframe: the nearest in time stays."""
        there = self._sightings.setdefault(keyframe, {})
        if light not in there or sighting.apart_s < there[light].apart_s:
            there[light] = sighting

    def forget_light(self, light: str) -> None:
        """Drop all sightings of a light that proved to hang elsewhere."""
        for there in self._sightings.values():
            there.pop(light, None)

    def holds(self, window: Ints) -> bool:
        """Whether the keyframes of a window are tied to the world in all six degrees of freedom."""
        here = [int(k) for k in window]
        if any(k in self._poses for k in here):
            return True
        seen = [light for k in here for light in self._sightings.get(k, ())]
        return len(set(seen)) >= ROOT_LIGHTS and len(seen) > ROOT_LIGHTS

    def priors(self, keyframes: Ints, window: Ints) -> list[PosePrior]:
        """Of the window's poses; `keyframes` are the rows of the problem, rising."""
        known = [int(k) for k in window if int(k) in self._poses]
        return [PosePrior(int(np.searchsorted(keyframes, k)), *self._poses[k]) for k in known]

    def views(self, keyframes: Ints, window: Ints) -> LightViews | None:
        """Of the window's sightings; None where there are none."""
        rows = [
            (int(np.searchsorted(keyframes, k)), light, sighting)
            for k in sorted(int(k) for k in window)
            for light, sighting in sorted(self._sightings.get(k, {}).items())
        ]
        if not rows or self.spec is None:
            return None
        names = sorted({light for _, light, _ in rows})
        return LightViews(
            camera=self.spec.camera,
            xyz=np.array([self.lights[name].xyz for name in names]),
            sigma_m=np.array([self.lights[name].sigma_m for name in names]),
            keyframe=np.array([row for row, _, _ in rows], np.int32),
            light=np.array([names.index(light) for _, light, _ in rows], np.int32),
            R=np.array([s.T_keyframe_cam.R for _, _, s in rows]),
            p=np.array([s.T_keyframe_cam.t for _, _, s in rows]),
            px=np.array([s.px for _, _, s in rows]),
            sigma_px=np.array([s.sigma_px for _, _, s in rows]),
        )
