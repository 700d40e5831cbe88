"""One camera on the moving body: what it takes at an instant."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lodelight.geometry.se3 import SE3
from lodelight.io.stamps import NS_PER_S
from lodelight.rig import CameraSpec
from lodelight.sim.blur import smear
from lodelight.sim.builder import Building
from lodelight.sim.lights import brightness
from lodelight.sim.motion import Motion
from lodelight.sim.render import Eye, View, render
from lodelight.sim.sensor import Exposure, develop, shading
from lodelight.types import Array, ArrayF32, Bytes


@dataclass(frozen=True, eq=False)
class Imager:
    """A camera's lens table and shading, made once; the building is shared by all cameras."""

    building: Building
    spec: CameraSpec
    motion: Motion
    eye: Eye = field(init=False)
    shade: ArrayF32 = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "eye", Eye.of(self.spec.camera))
        object.__setattr__(self, "shade", shading(self.spec.camera))

    def poses(self, t_s: float | Array) -> list[SE3]:
        """T_world_cam at seconds from the start of the motion."""
        return [T @ self.spec.T_body_cam for T in self.motion.at(t_s).poses()]

    def true_s(self, t_ns: int) -> float:
        """Seconds from the start of the motion at which a stamp's image was taken."""
        return (t_ns - self.motion.start_ns) / NS_PER_S + self.spec.time_offset_s

    def view(self, t_s: float, poses: list[SE3], opens_s: Array, exposure_s: float) -> View:
        """What is seen from `poses` by rows that open at `opens_s`, with everybody where they are at `t_s`."""
        scene, crowd = self.building.scene, self.building.crowd
        lit = brightness(scene.lamps, opens_s, exposure_s)
        rows = np.array(np.broadcast_to(lit, (self.spec.camera.height, lit.shape[1])), order="C")
        return render(scene, self.eye, poses, rows, crowd.geometry(t_s) if crowd else None)

    def take(self, t_ns: int, exposure: Exposure, noise_seed: int, covered: bool = False) -> tuple[Bytes, View]:
        """The image of a stamp, and the exact view it was made from; black but for noise if the lens is covered.

        A global shutter is open around the stamp. A rolling one opens its first row at the stamp and every other
        row `row_time_s` later.
        """
        t = self.true_s(t_ns)
        if self.spec.row_time_s > 0.0:
            opens = t + self.spec.row_time_s * np.arange(self.spec.camera.height, dtype=np.float64)
            view = self.view(t, self.poses(opens + 0.5 * exposure.time_s), opens, exposure.time_s)
            image = view.image
        else:
            half = 0.5 * exposure.time_s
            opened, here, closed = self.poses(np.array([t - half, t, t + half]))
            view = self.view(t, [here], np.array([t - half]), exposure.time_s)
            image = smear(view, self.eye, here, opened, closed)
        if covered:
            image = np.zeros_like(image)
            view.depth[:] = 0.0
        return develop(image, self.shade, exposure, noise_seed), view
