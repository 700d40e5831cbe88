"""AprilTags by the AprilTag library (pupil-apriltags), held so that it does not crash."""

from __future__ import annotations

import atexit
import threading
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from lodelight.types import Array, Bytes


@dataclass(frozen=True, eq=False)
class Quad:
    """A code as a library found it: corners (4, 2) px in the order of `anchors.tag_corners`."""

    family: str
    number: int
    corners_px: Array
    hamming: int = 0


_lock = threading.Lock()  # the library keeps its work area in the detector


@cache
def _detector(family: str) -> Any:
    """One detector per family and process, never torn down: two of a family, or one at exit, crash the interpreter."""
    from pupil_apriltags import Detector

    detector = Detector(family, nthreads=1, quad_decimate=2.0)
    atexit.register(setattr, detector, "tag_detector_ptr", None)
    return detector


def detect_apriltags(image: Bytes, family: str, decimate: float = 2.0) -> list[Quad]:
    """Tags of one family in an image; those read with more than one wrong bit are left out.

    decimate : quads are searched in an image so many times smaller; edges and bits are read in full
    """
    with _lock:
        detector = _detector(family)
        detector.tag_detector_ptr.contents.quad_decimate = float(decimate)
        found = detector.detect(np.ascontiguousarray(image))
    # The library puts the top-left pixel's centre at (0.5, 0.5).
    return [Quad(family, int(d.tag_id), d.corners - 0.5, int(d.hamming)) for d in found if d.hamming <= 1]
