"""Depth images as stored to metres along z of camera 0, registered to it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lodelight.errors import SourceError
from lodelight.io.registration import Registration
from lodelight.rig import CameraSpec, DepthSpec
from lodelight.types import ArrayF32

# An indoor depth camera's median reading lies well inside; outside, the unit is wrong and not the room.
PLAUSIBLE_MEDIAN_M = (0.05, 100.0)


class DepthReader:
    """Converts the images of one depth sensor. Stored values of 0, and readings out of its range, become 0."""

    def __init__(self, spec: DepthSpec, cam0: CameraSpec) -> None:
        self.spec = spec
        raw = np.arange(1 << 16, dtype=np.float64)
        metres = raw / spec.units_per_m
        self._table = np.where((metres >= spec.min_m) & (metres <= spec.max_m), metres, 0.0).astype(np.float32)
        self._table[0] = 0.0
        T_cam_depth = cam0.T_body_cam.inverse() @ spec.T_body_depth
        self._registration = None if spec.registered else Registration(spec.camera, cam0.camera, T_cam_depth)

    def metres(self, raw: NDArray[np.uint16]) -> ArrayF32:
        """(H, W) stored values to (H', W') m of camera 0, 0 = no reading."""
        depth_m = np.take(self._table, raw)
        return self._registration(depth_m) if self._registration else depth_m

    def registered(self, metres: ArrayF32) -> ArrayF32:
        """As `metres`, of (H, W) float32 m along z of the depth camera, 0 = no reading."""
        low, high = np.float32(self.spec.min_m), np.float32(self.spec.max_m)
        depth_m = np.where((metres >= low) & (metres <= high), metres, np.float32(0.0)).astype(np.float32)
        return self._registration(depth_m) if self._registration else depth_m

    def median_m(self, raw: NDArray[np.uint16]) -> float:
        """Median of all readings before the range is applied; 0 where there is no reading."""
        readings = raw[(raw > 0) & (raw < 65535)]
        return float(np.median(readings)) / self.spec.units_per_m if len(readings) else 0.0

    def check_unit(self, median_m: float, where: str) -> None:
        """Raises SourceError where half the readings lie nearer, or farther, than any room allows."""
        low, high = PLAUSIBLE_MEDIAN_M
        if not low <= median_m <= high:
            raise SourceError(
                f"{where}: the median depth is {median_m:.3g} m, so {self.spec.units_per_m:g} units per metre is the "
                "wrong unit; set depth.units_per_m in the rig file"
            )
