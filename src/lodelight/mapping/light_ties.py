"""Sightings of lights in the loop of SLAM: which light each is, whether it hangs there, and which keyframe it ties."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lodelight.anchors import Light
from lodelight.lights.sighted import assigned, centre_px
from lodelight.lights.watch import LightWatch
from lodelight.mapping.anchoring import AnchorSighting
from lodelight.mapping.body_path import BodyPath, Node
from lodelight.mapping.map import Map
from lodelight.messages import LightSighting
from lodelight.types import Array

NS = 1e-9
RECENT = 64  # sightings that a keyframe to come may have


@dataclass(frozen=True)
class LightsConfig:
    """use : off, or tight: sightings of lights are part of every adjustment
    sigma_px : of a light's centre; near_s : between a keyframe and a sighting that becomes part of it
    drift : error of the tracked motion between the two, as a share of its length
    late_s : by which the lights' stamps are behind the images', of gated lights as well
    """

    use: str = "off"
    sigma_px: float = 0.5
    near_s: float = 0.12
    drift: float = 0.02
    late_s: float = 0.0

    def __post_init__(self) -> None:
        if self.use not in ("off", "tight"):
            raise ValueError(f"{self.use!r} is no use of lights; choose off or tight")


@dataclass(frozen=True, eq=False)
class _Seen:
    """A sighting whose light is known, and where the body was in the map at its time."""

    light: str
    node: Node
    px: Array
    sigma_px: float


class LightTies:
    """Of one map that has been laid down in the world. watch : that every light hangs where it was surveyed."""

    def __init__(
        self, map: Map, path: BodyPath, config: LightsConfig, lights: dict[str, Light], emit: Callable[..., None]
    ) -> None:
        self._map = map
        self._path = path
        self._config = config
        self._lights = lights
        self._spec = map.rig.lights
        self._emit = emit
        self.watch = LightWatch(lights)
        self._recent: deque[_Seen] = deque(maxlen=RECENT)
        self._keyframe: tuple[int, int] | None = None  # the last one, and its stamp

    def forget(self) -> None:
        """The map is about to move."""
        self._recent.clear()

    def inserted(self, keyframe: int, t_ns: int) -> None:
        """A keyframe entered the map: the sightings of its time are its own."""
        self._keyframe = (keyframe, t_ns)
        for seen in self._recent:
            self._tie(seen)

    def see(self, sighting: LightSighting) -> None:
        """Name a sighting's light by where the body is, watch whether it hangs there, and tie a keyframe by it."""
        node = self._path.at(sighting.t_ns)
        if node is None or self._spec is None:
            return
        T_world_cam = self._path.pose(node) @ self._spec.T_body_cam
        light = assigned(sighting, T_world_cam, self._spec.camera, self._lights)
        if light is None:
            return
        px = centre_px(sighting.centre_px, T_world_cam, self._spec.camera, light)
        ray, _ = self._spec.camera.unproject(px[None])
        for bad in self.watch.see(sighting.t_ns, light.id, T_world_cam, ray[0]):
            told = {"light": bad.light.id, "alike": list(bad.alike), "off_m": bad.off_m, "why": bad.why}
            self._emit(sighting.t_ns, "light_misplaced", **told)
            self._map.anchoring.forget_light(bad.light.id)
        if self._config.use == "tight" and light.id not in self.watch.misplaced:
            seen = _Seen(light.id, node, px, max(sighting.sigma_px, self._config.sigma_px))
            self._recent.append(seen)
            self._tie(seen)

    def _tie(self, seen: _Seen) -> None:
        """Let the last keyframe have a sighting that is near enough in time."""
        if self._keyframe is None or self._config.use != "tight" or self._spec is None:
            return
        keyframe, t_ns = self._keyframe
        apart_s = abs(seen.node.t_ns - t_ns) * NS
        if apart_s > self._config.near_s or not self._map.keyframes.alive[keyframe]:
            return
        T_keyframe_body = self._map.pose(keyframe).inverse() @ self._path.pose(seen.node)
        far_m = float(np.linalg.norm(self._lights[seen.light].xyz - self._path.pose(seen.node).t))
        drift_px = self._spec.camera.focal_px * self._config.drift * float(np.linalg.norm(T_keyframe_body.t)) / far_m
        sigma_px = math.hypot(seen.sigma_px, drift_px)
        sighting = AnchorSighting(T_keyframe_body @ self._spec.T_body_cam, seen.px, sigma_px, apart_s)
        self._map.anchoring.add_sighting(keyframe, seen.light, sighting)
