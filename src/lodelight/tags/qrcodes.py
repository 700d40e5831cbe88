"""QR codes by ZXing: their text, their corners, and their modules as they were printed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lodelight.types import AnyArray, Array, Bools, Bytes

LEVELS = {"M": 0, "L": 1, "H": 2, "Q": 3}
READING_ORDER = [3, 2, 1, 0]  # corners from the upper left clockwise, as ZXing gives them, to our order


@dataclass(frozen=True, eq=False)
class QrCode:
    """text; corners_px (4, 2) in the order of `anchors.tag_corners`, to a pixel or two; modules (n, n), 1 = white
    mirrored : as seen in a mirror, or through a window from behind
    """

    text: str
    corners_px: Array
    modules: Bytes
    mirrored: bool


def read_qr(image: Bytes, scale: float = 1.0) -> list[QrCode]:
    """The QR codes of an image that was enlarged by `scale`; corners are those of the image before that."""
    import zxingcpp

    found = []
    formats = zxingcpp.BarcodeFormats(zxingcpp.BarcodeFormat.QRCode)
    for code in zxingcpp.read_barcodes(image, formats, try_rotate=False, try_downscale=False, try_invert=False):
        p = code.position
        corners = np.array([[c.x, c.y] for c in (p.top_left, p.top_right, p.bottom_right, p.bottom_left)], np.float64)
        corners = (corners + 0.5) / scale - 0.5
        printed: AnyArray = np.asarray(code.to_image(scale=1, add_quiet_zones=False))
        modules = (printed.reshape(*printed.shape[:2], -1)[:, :, 0] > 127).astype(np.uint8)
        found.append(QrCode(code.text, corners[READING_ORDER], modules, _mirrored(modules, code.ec_level, code.extra)))
    return found


def _mirrored(modules: Bytes, level: str, extra: Any) -> bool:
    """Whether the format bits beside the upper left finder stand the wrong way about. ISO 18004, 7.9."""
    mask = extra.get("DataMask") if isinstance(extra, dict) else None
    if level not in LEVELS or not isinstance(mask, int) or modules.shape[0] < 21:
        return False
    data = LEVELS[level] << 3 | mask
    rest = data << 10
    for bit in range(14, 9, -1):
        if rest >> bit & 1:
            rest ^= 0x537 << (bit - 10)
    dark = [bool(((data << 10 | rest) ^ 0x5412) >> i & 1) for i in range(15)]
    cells = [(i, 8) for i in range(6)] + [(7, 8), (8, 8), (8, 7)] + [(8, 14 - i) for i in range(9, 15)]
    seen: Bools = modules == 0
    upright = sum(bool(seen[row, column]) == d for (row, column), d in zip(cells, dark, strict=True))
    turned = sum(bool(seen[column, row]) == d for (row, column), d in zip(cells, dark, strict=True))
    return turned > upright
