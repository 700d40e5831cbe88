"""A decoded frame to look at: circles, stripes, names, and why the rest was refused."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from lodelight.messages import LightSighting
from lodelight.types import Bytes

NAMED, REFUSED, EDGE = (90, 220, 90), (80, 110, 255), (255, 190, 60)
GAMMA = 0.45  # so that the wings of bright lights are seen


def draw(image: Bytes, sightings: Sequence[LightSighting], note: str = "") -> Bytes:
    """(H, W, 3) BGR: each outline with its edges (where bright stripes end), centre, name, frequency and confidence."""
    grey = (255.0 * (image / 255.0) ** GAMMA).astype(np.uint8)
    canvas = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    unit = max(1, round(image.shape[0] / 900))
    for s in sightings:
        left, top, width, height = s.box_px
        colour = NAMED if s.candidates else REFUSED
        cv2.rectangle(canvas, (left, top), (left + width, top + height), colour, unit)
        lines = (
            [s.why] if not s.candidates else [" ".join(s.candidates), f"{s.frequency_hz:.0f} Hz  {s.confidence:.2f}"]
        )
        for x, y in s.edges:
            cv2.circle(canvas, (round(x), round(y)), 2 * unit, EDGE, -1)
        if len(s.edges):
            u, v = (round(c) for c in s.centre_px.tolist())
            cv2.circle(canvas, (u, v), round(0.5 * s.diameter_rows), colour, unit, cv2.LINE_AA)
            cv2.drawMarker(canvas, (u, v), colour, cv2.MARKER_CROSS, 12 * unit, unit)
        for k, line in enumerate(lines):
            at = max(4, min(left, image.shape[1] - 8 * unit * len(line))), _line(top, height, k, unit, image.shape[0])
            cv2.putText(canvas, line, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5 * unit, colour, unit, cv2.LINE_AA)
    if note:
        cv2.putText(
            canvas, note, (12, 24 * unit), cv2.FONT_HERSHEY_SIMPLEX, 0.6 * unit, (255, 255, 255), unit, cv2.LINE_AA
        )
    return np.asarray(canvas, dtype=np.uint8)


def _line(top: int, height: int, k: int, unit: int, rows: int) -> int:
    """Text goes under its box, or above where that is cut off."""
    under = top + height + (k + 1) * 18 * unit
    return under if under < rows - 18 * unit else top - (2 - k) * 18 * unit
