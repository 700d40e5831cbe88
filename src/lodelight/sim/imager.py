"""One camera on the moving body: what it takes at an instant."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lodelight.geometry.se3 import SE3
from lodelight.io.stamps import NS_PER_S
from lodelight.rig import CameraSpec
from lodelight.sim.blur import smear
from lodelight.sim.lights import brightness
from lodelight.sim.motion import Motion
from lodelight.sim.render import Eye, View, render
from lodelight.sim.scene import Scene
from lodelight.sim.sensor import Exposure, develop, shading
from lodelight.types import ArrayF32, Bytes


@dataclass(frozen=True, eq=False)
class Imager:
    """A camera's lens table and shading, made once; `scene` is shared by all cameras."""

    scene: Scene
    spec: CameraSpec
    motion: Motion
    eye: Eye = field(init=False)
    shade: ArrayF32 = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "eye", Eye.of(self.spec.camera))
        object.__setattr__(self, "shade", shading(self.spec.camera))

    def poses(self, t_s: float | np.ndarray) -> list[SE3]:
        """T_world_cam at seconds from the start of the motion."""
        return [T @ self.spec.T_body_cam for T in self.motion.at(np.atleast_1d(t_s)).poses()]

    def true_s(self, t_ns: int) -> float:
        """Seconds from the start of the motion at which a stamp's image was taken."""
        return (t_ns - self.motion.start_ns) / NS_PER_S + self.spec.time_offset_s

    def take(self, t_ns: int, exposure: Exposure, noise_seed: int) -> tuple[Bytes, View]:
        """The image of a stamp, and the exact view it was made from.

        A global shutter is open around the stamp. A rolling one opens its first row at the stamp and every other
        row `row_time_s` later.
        """
        t = self.true_s(t_ns)
        if self.spec.row_time_s > 0.0:
            opens = t + self.spec.row_time_s * np.arange(self.spec.camera.height, dtype=np.float64)
            poses = self.poses(opens + 0.5 * exposure.time_s)
            view = render(self.scene, self.eye, poses, brightness(self.scene.lamps, opens, exposure.time_s))
            return develop(view.image, self.shade, exposure, noise_seed), view
        half = 0.5 * exposure.time_s
        opened, here, closed = self.poses(np.array([t - half, t, t + half]))
        lit = brightness(self.scene.lamps, np.array([t - half]), exposure.time_s)
        view = render(self.scene, self.eye, [here], np.repeat(lit, self.spec.camera.height, axis=0))
        image = smear(view, self.eye, here, opened, closed)
        return develop(image, self.shade, exposure, noise_seed), view
