"""What the front end sees in one frame: corners of camera 0 with descriptor and, where there is one, depth."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lodelight.types import AnyArray, Array, ArrayF32, Ints, Words


@dataclass(frozen=True, eq=False)
class Features:
    """N corners as parallel arrays.

    px : (N, 2) float32, raw pixels of camera 0 (distorted, sub-pixel)
    octave : (N,) int32, pyramid level; a corner's noise grows with scale_factor ** octave
    angle : (N,) float32 rad, orientation of the patch
    desc : (N, 4) uint64, 256-bit binary descriptor
    ray : (N, 3) float64, unit ray in the camera frame
    inv_depth : (N,) float32 1/m along the camera's z, 0 = not measured
    sigma_inv_depth : (N,) float32 1/m, its standard deviation
    """

    px: ArrayF32
    octave: Ints
    angle: ArrayF32
    desc: Words
    ray: Array
    inv_depth: ArrayF32
    sigma_inv_depth: ArrayF32

    def __len__(self) -> int:
        return len(self.px)

    @staticmethod
    def empty() -> Features:
        f32, none = np.float32, np.zeros(0, np.float32)
        return Features(
            np.zeros((0, 2), f32),
            np.zeros(0, np.int32),
            none,
            np.zeros((0, 4), np.uint64),
            np.zeros((0, 3)),
            none,
            none,
        )

    def with_depth(self, inv_depth: ArrayF32, sigma_inv_depth: ArrayF32) -> Features:
        return replace(self, inv_depth=inv_depth, sigma_inv_depth=sigma_inv_depth)

    def take(self, index: AnyArray) -> Features:
        """The corners of an index or mask."""
        return Features(
            self.px[index],
            self.octave[index],
            self.angle[index],
            self.desc[index],
            self.ray[index],
            self.inv_depth[index],
            self.sigma_inv_depth[index],
        )
