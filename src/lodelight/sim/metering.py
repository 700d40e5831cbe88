"""Automatic exposure: as long, then as much gain, as brings the mean grey to its target, with some delay."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lodelight.geometry.cameras import Camera
from lodelight.rig import CameraSpec
from lodelight.sim.imager import Imager
from lodelight.sim.motion import Motion
from lodelight.sim.render import render
from lodelight.sim.scene import Scene
from lodelight.sim.sensor import Exposure, level_for

TARGET_DN = 110.0  # mean grey
LONGEST_S = 0.006  # motion smears longer exposures
LAG_S = 0.2
SMALL_PX = 48  # width of the image that is metered


def exposures(scene: Scene, spec: CameraSpec, motion: Motion, t_ns: NDArray[np.int64]) -> list[Exposure]:
    """One for each stamp. Known before the images are rendered, so that these can be made in any order."""
    small = Imager(scene, replace(spec, camera=_shrunk(spec.camera, SMALL_PX / spec.camera.width)), motion)
    wanted = []
    for t in t_ns.tolist():
        view = render(scene, small.eye, small.poses(small.true_s(t)))
        wanted.append(np.log(level_for(view.image * small.shade, TARGET_DN)))
    level, out = wanted[0] if wanted else 0.0, []
    for i, value in enumerate(wanted):
        dt = (t_ns[i] - t_ns[i - 1]) * 1e-9 if i else 0.0
        out.append(Exposure.for_level(float(np.exp(level)), LONGEST_S))
        level += (value - level) * (1.0 - np.exp(-dt / LAG_S))
    return out


def _shrunk(camera: Camera, factor: float) -> Camera:
    """The same lens on fewer, larger pixels."""
    fx, fy, cx, cy = (float(v) for v in camera.params[:4])
    size = max(8, round(camera.width * factor)), max(8, round(camera.height * factor))
    k = size[0] / camera.width, size[1] / camera.height
    inner = (fx * k[0], fy * k[1], (cx + 0.5) * k[0] - 0.5, (cy + 0.5) * k[1] - 0.5)
    n = 2 if camera.model_name == "double_sphere" else len(camera.distortion)
    return Camera.create(camera.model_name, *size, inner, camera.distortion[:n])
