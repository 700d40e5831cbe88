"""Automatic exposure: as long, then as much gain, as brings the mean grey to its target, with some delay."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lodelight.geometry.cameras import Camera
from lodelight.rig import CameraSpec
from lodelight.sim.builder import Building
from lodelight.sim.imager import Imager
from lodelight.sim.motion import Motion
from lodelight.sim.sensor import Exposure, level_for

TARGET_DN = 110.0  # mean grey
LONGEST_S = 0.006  # motion smears longer exposures
LAG_S = 0.2
SMALL_PX = 48  # width of the image that is metered


def exposures(building: Building, spec: CameraSpec, motion: Motion, t_ns: NDArray[np.int64]) -> list[Exposure]:
    """One for each stamp. Known before the images are rendered, so that these can be made in any order."""
    small = Imager(building, replace(spec, camera=_shrunk(spec.camera, SMALL_PX / spec.camera.width)), motion)
    level, before, out = 0.0, 0, []
    for i, stamp in enumerate(t_ns.tolist()):
        t = small.true_s(stamp)
        view = small.view(t, small.poses(t), np.array([t]), LONGEST_S)
        wanted = float(np.log(level_for(view.image * small.shade, TARGET_DN)))
        # What is seen now acts on the frames to come
        now = wanted if i == 0 else level
        out.append(Exposure.for_level(float(np.exp(now)), LONGEST_S))
        level = now + (wanted - now) * (1.0 - np.exp(-(stamp - before) * 1e-9 / LAG_S)) if i else wanted
        before = stamp
    return out


def _shrunk(camera: Camera, factor: float) -> Camera:
    """The same lens on fewer, larger pixels."""
    fx, fy, cx, cy = (float(v) for v in camera.params[:4])
    size = max(8, round(camera.width * factor)), max(8, round(camera.height * factor))
    k = size[0] / camera.width, size[1] / camera.height
    inner = (fx * k[0], fy * k[1], (cx + 0.5) * k[0] - 0.5, (cy + 0.5) * k[1] - 0.5)
    return Camera.create(camera.model_name, *size, inner, camera.distortion)
