"""Tags and the way past them, seen from where they spread most: a PNG."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

from lodelight.anchors import Tag
from lodelight.trajectory import Trajectory
from lodelight.types import Array, Bytes

SIDE_PX, BORDER_PX = 1000, 60
PATH, QR, SQUARE, INK = (200, 170, 120), (40, 40, 200), (160, 40, 140), (60, 60, 60)


def draw_tags(tags: Sequence[Tag], path: Trajectory, level: bool) -> Bytes:
    """(H, W, 3) uint8. level : the frame has z up, and the picture is from above; else it is along the direction in
    which the path spreads least."""
    placed = [(tag, tag.T_world_tag) for tag in tags if tag.T_world_tag is not None]
    spots = np.concatenate([path.xyz, *[T.t[None] for _, T in placed]])
    middle = spots.mean(axis=0)
    plane = np.eye(3)[:2] if level else np.linalg.svd(spots - middle, full_matrices=False)[2][:2]
    flat = (spots - middle) @ plane.T
    low, high = flat.min(axis=0), flat.max(axis=0)
    scale = (SIDE_PX - 2 * BORDER_PX) / max(float((high - low).max()), 1e-3)
    width, height = (math.ceil(v) for v in (high - low) * scale + 2 * BORDER_PX)
    canvas = np.full((height, width, 3), 255, np.uint8)

    def at(xyz: Array) -> tuple[int, int]:
        x, y = ((xyz - middle) @ plane.T - low) * scale + BORDER_PX
        return round(x), height - round(y)

    way = np.array([at(p) for p in path.xyz], np.int32).reshape(-1, 1, 2)
    cv2.polylines(canvas, [way], False, PATH, 2, cv2.LINE_AA)
    for tag, T in placed:
        colour = QR if tag.family == "qr" else SQUARE
        x, y = at(T.t)
        cv2.arrowedLine(canvas, (x, y), at(T.t - 18.0 / scale * T.R[:, 2]), colour, 2, cv2.LINE_AA, tipLength=0.4)
        cv2.circle(canvas, (x, y), 4, colour, -1, cv2.LINE_AA)
        said = tag.id.encode("ascii", "replace").decode()[:16]
        cv2.putText(canvas, said, (x + 7, y - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.45, INK, 1, cv2.LINE_AA)
    metre = round(scale)
    cv2.line(canvas, (20, height - 15), (20 + metre, height - 15), INK, 2)
    cv2.putText(canvas, "1 m", (26 + metre, height - 11), cv2.FONT_HERSHEY_SIMPLEX, 0.45, INK, 1, cv2.LINE_AA)
    return canvas
