"""A sighting from a camera whose pose is known: which light it is, and where that light's centre is seen."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from lodelight.anchors import Light
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.lights.conic import conic_centre, image_of_disc
from lodelight.messages import LightSighting
from lodelight.types import Array

NEAR_M = 2.0  # a light may hang that far from its survey, and still be taken for itself
CLEARLY = 2.0  # by which the second nearest light of a code must be farther off than the nearest


def assigned(sighting: LightSighting, T_world_cam: SE3, camera: Camera, lights: Mapping[str, Light]) -> Light | None:
    """Of the lights with its code, the one that is expected nearest to it; None where none or several are near."""
    rays, _ = camera.unproject(np.asarray(sighting.centre_px)[None])
    ray = rays[0] / np.linalg.norm(rays[0])
    found: list[tuple[float, Light]] = []
    for name in sighting.candidates:
        light = lights.get(name)
        if light is None:
            continue
        X = T_world_cam.R.T @ (light.xyz - T_world_cam.t)
        if X[2] > 0.05:
            found.append((float(np.linalg.norm(X - (X @ ray) * ray)), light))
    found.sort(key=lambda f: f[0])
    if not found or found[0][0] > NEAR_M or (len(found) > 1 and found[1][0] < CLEARLY * found[0][0]):
        return None
    return found[0][1]


def centre_px(measured_px: Array, T_world_cam: SE3, camera: Camera, light: Light) -> Array:
    """(2,) where the light's centre is seen, from where its ellipse is centred: they differ by a fraction of a pixel.

    A light that should not be in view at all is left as measured.
    """
    X = T_world_cam.R.T @ (light.xyz - T_world_cam.t)
    if X[2] < 2.0 * light.radius_m:
        return measured_px
    ellipse = conic_centre(image_of_disc(X, T_world_cam.R.T @ light.normal, light.radius_m))
    px, seen = camera.project(np.array([[*ellipse, 1.0], X]))
    out: Array = measured_px - (px[0] - px[1]) if seen.all() else measured_px
    return out
