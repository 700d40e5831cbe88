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

CLEARLY = 2.0  # by which the second nearest light of a code must be farther off than the nearest


def assigned(sighting: LightSighting, T_world_cam: SE3, camera: Camera, lights: Mapping[str, Light]) -> Light | None:
    """Of the lights with its code, the one surveyed nearest to the ray; None where another one is nearly as near.

    A code that is used once names its light wherever that hangs; one that is used again a distance D away, a light that
    hangs, or a camera that is, up to about D / 3 from where it should be.
    """
    rays, _ = camera.unproject(np.asarray(sighting.centre_px)[None])
    ray = rays[0] / np.linalg.norm(rays[0])
    found: list[tuple[float, Light]] = []
    for light in (lights[name] for name in sighting.candidates if name in lights):
        X = T_world_cam.R.T @ (light.xyz - T_world_cam.t)
        found.append((float(np.linalg.norm(X - max(X @ ray, 0.0) * ray)), light))
    found.sort(key=lambda f: f[0])
    if not found or (len(found) > 1 and found[1][0] < CLEARLY * found[0][0]):
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
