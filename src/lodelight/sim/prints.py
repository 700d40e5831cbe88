"""Pictures that hang, stand and lie about: codes, posters, labels, book spines, screens, boards, views outside.

All are (h, w) float32 reflectances in [0, 1] with sides that are powers of two.
"""

from __future__ import annotations

import cv2
import numpy as np

from lodelight.fiducials import fiducial_modules, qr_modules
from lodelight.sim.textures import power_of_two
from lodelight.types import Array, ArrayF32

INK, PAPER = 0.05, 0.88  # a printer's black and a sheet's white
QUIET_QR, QUIET_FIDUCIAL = 4, 1  # modules of white around a code
WORDS = [
    "SAFETY",
    "FIRST",
    "EXIT",
    "ROOM",
    "OFFICE",
    "TEAM",
    "MEETING",
    "LIGHT",
    "MAP",
    "ROBOT",
    "LAB",
    "OPEN",
    "FORUM",
    "WINTER",
    "MUSIC",
    "CITY",
    "NIGHT",
    "COFFEE",
    "READ",
    "MORE",
    "QUIET",
    "ZONE",
    "FRAGILE",
    "HANDLE",
    "THIS",
    "SIDE",
    "UP",
    "NORTH",
    "DOCK",
    "PARTS",
    "2041",
    "MODEL",
    "SERIES",
    "DESIGN",
    "WEEK",
    "OCEAN",
    "ATLAS",
]


def _code(modules: Array, quiet: int) -> tuple[ArrayF32, float]:
    """A picture of modules (1 = white) with its quiet zone, and its side over that of the bare code."""
    n = modules.shape[0]
    framed = np.pad(modules, quiet, constant_values=1)
    picture = power_of_two(INK + (PAPER - INK) * np.kron(framed, np.ones((16, 16))), largest=512)
    return picture, (n + 2 * quiet) / n


def qr(payload: str) -> tuple[ArrayF32, float]:
    """A QR code, and its side with quiet zone over that without."""
    return _code(qr_modules(payload).astype(float), QUIET_QR)


def fiducial(family: str, number: int) -> tuple[ArrayF32, float]:
    """An AprilTag or ArUco marker, and its side with white border over that of the black one."""
    return _code(fiducial_modules(family, number).astype(float), QUIET_FIDUCIAL)


def _write(image: Array, text: str, x: int, y: int, height_px: float, grey: float, thick: int = 1) -> None:
    canvas = np.zeros(image.shape, np.uint8)  # putText wants bytes
    cv2.putText(canvas, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, height_px / 22.0, 255, thick, cv2.LINE_AA)
    ink = canvas / 255.0
    image += ink * (grey - image)


def _lines(image: Array, rng: np.random.Generator, x: int, y: int, w: int, rows: int, pitch: int, grey: float) -> None:
    """Rows of small print: words as bars, too small to read and large enough to track."""
    for r in range(rows):
        at, end = x, x + int(w * rng.uniform(0.6, 1.0))
        while at < end:
            word = int(rng.integers(pitch // 2, 4 * pitch))
            top = y + r * pitch
            bar = image[top : top + max(1, pitch // 2), at : min(end, at + word)]
            bar += (grey - bar) * rng.uniform(0.5, 1.0, (1, bar.shape[1])) if bar.size else 0.0
            at += word + max(2, pitch // 3)


def _finish(image: Array, rng: np.random.Generator, grain: float = 0.015) -> ArrayF32:
    noisy = image + grain * rng.standard_normal(image.shape)
    return np.clip(noisy, 0.02, 0.98).astype(np.float32)


def _scene(rng: np.random.Generator, h: int, w: int) -> Array:
    """A picture of something: hills of grey under a sky, discs and beams before them."""
    image = np.tile(np.linspace(rng.uniform(0.5, 0.9), rng.uniform(0.2, 0.6), h)[:, None], (1, w))
    x = np.arange(w)
    for _ in range(int(rng.integers(2, 6))):
        ridge = np.full(w, h * rng.uniform(0.3, 0.9))
        for k in range(1, 7):
            ridge = ridge + h * 0.12 / k * np.sin(2 * np.pi * (k * x / w * rng.uniform(0.5, 2) + rng.random()))
        image = np.where(np.arange(h)[:, None] > ridge[None, :], rng.uniform(0.05, 0.9), image)
    canvas = np.ascontiguousarray(image, dtype=np.float32)
    for _ in range(int(rng.integers(3, 14))):
        center = (int(rng.integers(0, w)), int(rng.integers(0, h)))
        grey = float(rng.uniform(0.05, 0.95))
        if rng.random() < 0.5:
            cv2.circle(canvas, center, int(rng.integers(3, max(4, h // 6))), grey, -1 if rng.random() < 0.6 else 2)
        else:
            other = (int(rng.integers(0, w)), int(rng.integers(0, h)))
            cv2.line(canvas, center, other, grey, int(rng.integers(1, 8)))
    return canvas.astype(np.float64)


def poster(rng: np.random.Generator, portrait: bool = True) -> ArrayF32:
    """A title, a picture, small print, in a frame."""
    h, w = (512, 256) if portrait else (256, 512)
    image = np.full((h, w), rng.uniform(0.55, 0.92) if rng.random() < 0.7 else rng.uniform(0.06, 0.25))
    ink = 0.06 if image[0, 0] > 0.5 else 0.9
    top = int(h * rng.uniform(0.16, 0.3))
    low = int(h * rng.uniform(0.62, 0.8))
    image[top:low, 12 : w - 12] = _scene(rng, low - top, w - 24)
    for k in range(int(rng.integers(1, 3))):
        _write(image, str(rng.choice(WORDS)), 14, 26 + 30 * k, float(rng.uniform(18, 34)), ink, 3)
    _lines(image, rng, 14, low + 12, w - 28, (h - low - 24) // 9, 9, ink)
    frame = rng.uniform(0.03, 0.9)
    image[:5], image[-5:], image[:, :5], image[:, -5:] = frame, frame, frame, frame
    return _finish(image, rng)


def spines(rng: np.random.Generator) -> ArrayF32:
    """Books side by side on a board, seen from the front: 1 m wide, 0.32 m high in 1024 by 256 px."""
    h, w = 256, 1024
    image = np.full((h, w), 0.04)
    x = 0
    while x < w:
        if rng.random() < 0.04:  # a gap, or something that leans
            x += int(rng.integers(15, 90))
            continue
        wide, tall = int(rng.integers(14, 52)), int(h * rng.uniform(0.62, 0.97))
        grey = rng.uniform(0.08, 0.85)
        book = image[h - tall :, x : x + wide]
        shade = 1.0 - 0.35 * np.abs(np.linspace(-1, 1, wide)[: book.shape[1]]) ** 3  # a rounded back
        book[:] = grey * shade
        other = 0.9 if grey < 0.45 else 0.06
        for _ in range(int(rng.integers(1, 4))):
            y = int(rng.integers(6, max(7, tall - 14)))
            book[y : y + int(rng.integers(2, 9))] += (other - grey) * rng.uniform(0.3, 1.0)
        if wide > 18 and book.shape[1] == wide:
            title = np.zeros((wide, tall - 20))
            _write(title, " ".join(rng.choice(WORDS, 3)), 4, int(wide * 0.68), wide * 0.45, 1.0, 1)
            book[10 : tall - 10] += np.rot90(title, -1) * (other - grey)
        if book.shape[1]:
            book[:, :1] *= 0.4
        x += wide
    return _finish(image, rng)


def label(rng: np.random.Generator) -> ArrayF32:
    """The side of a carton: tape, a shipping label with a bar code, stamps."""
    n = 256
    image = 0.42 + 0.02 * rng.standard_normal((n, 1)) + np.zeros((n, n))
    t = int(n * rng.uniform(0.44, 0.5))
    image[:, t : t + int(n * 0.1)] += 0.13
    w, h = int(rng.integers(80, 130)), int(rng.integers(60, 100))
    x, y = int(rng.integers(8, n - w - 8)), int(rng.integers(8, n - h - 8))
    image[y : y + h, x : x + w] = 0.85
    bars = rng.random(w - 16) < 0.5
    image[y + h // 2 : y + h - 8, x + 8 : x + w - 8] = np.where(bars, 0.05, 0.85)
    _write(image, str(rng.choice(WORDS)), x + 6, y + 20, 15, 0.08, 2)
    _lines(image, rng, x + 6, y + 26, w - 12, max(1, (h // 2 - 28) // 6), 6, 0.1)
    for _ in range(int(rng.integers(1, 4))):
        word = str(rng.choice(WORDS))
        _write(image, word, int(rng.integers(4, n // 2)), int(rng.integers(24, n - 6)), rng.uniform(16, 34), 0.12, 2)
    image[:2], image[-2:], image[:, :2], image[:, -2:] = 0.2, 0.2, 0.2, 0.2
    return _finish(image, rng, 0.02)


def screen(rng: np.random.Generator) -> ArrayF32:
    """A monitor: windows with text and pictures in a dark bezel."""
    h, w = 256, 512
    image = np.full((h, w), rng.uniform(0.25, 0.6))
    for _ in range(int(rng.integers(2, 5))):
        ww, hh = int(rng.integers(120, 300)), int(rng.integers(80, 180))
        x, y = int(rng.integers(10, w - ww - 8)), int(rng.integers(10, h - hh - 8))
        paper = rng.choice([0.08, 0.9, 0.75])
        image[y : y + hh, x : x + ww] = paper
        image[y : y + 10, x : x + ww] = 0.35
        if rng.random() < 0.3:
            image[y + 12 : y + hh - 4, x + 4 : x + ww - 4] = _scene(rng, hh - 16, ww - 8)
        else:
            _lines(image, rng, x + 6, y + 16, ww - 16, (hh - 20) // 7, 7, 0.9 if paper < 0.5 else 0.1)
    image[:8], image[-10:], image[:, :8], image[:, -8:] = 0.04, 0.04, 0.04, 0.04
    return _finish(image, rng, 0.01)


def board(rng: np.random.Generator, cork: bool) -> ArrayF32:
    """A pin board with sheets, or a white board with writing."""
    h, w = 512, 1024
    if cork:
        image = 0.4 + 0.1 * rng.standard_normal((h, w))
        for _ in range(int(rng.integers(12, 24))):
            ww, hh = int(rng.integers(60, 200)), int(rng.integers(60, 200))
            x, y = int(rng.integers(12, w - ww - 12)), int(rng.integers(12, h - hh - 12))
            image[y : y + hh, x : x + ww] = rng.uniform(0.5, 0.92)
            if rng.random() < 0.4:
                image[y + 6 : y + hh // 2, x + 6 : x + ww - 6] = _scene(rng, hh // 2 - 6, ww - 12)
            _lines(image, rng, x + 8, y + hh // 2 + 6, ww - 16, (hh // 2 - 12) // 8, 8, 0.1)
            image[y + 2 : y + 7, x + ww // 2 : x + ww // 2 + 5] = 0.03
    else:
        image = np.full((h, w), 0.86)
        for _ in range(int(rng.integers(6, 14))):
            x, y = int(rng.integers(20, w - 320)), int(rng.integers(40, h - 60))
            _write(image, " ".join(rng.choice(WORDS, 2)), x, y, float(rng.uniform(18, 34)), 0.15, 2)
        for _ in range(8):
            a, b = rng.integers(20, 480, 2), rng.integers(20, 480, 2)
            canvas = np.zeros((h, w), np.uint8)
            cv2.ellipse(canvas, (int(a[0]) * 2, int(a[1])), (int(b[0]) // 4 + 8, int(b[1]) // 8 + 8), 0, 0, 360, 255, 3)
            image += canvas / 255.0 * (0.25 - image)
    image[:10], image[-10:], image[:, :10], image[:, -10:] = 0.3, 0.3, 0.3, 0.3
    return _finish(image, rng, 0.01)


def door(rng: np.random.Generator, text: str) -> ArrayF32:
    """A door leaf with panels, a handle and its sign."""
    image = 0.5 + 0.03 * rng.standard_normal((1, 256)) + np.zeros((512, 256))
    for top, low in ((50, 230), (280, 470)):
        cv2.rectangle(image, (36, top), (220, low), 0.3, 4)
        cv2.rectangle(image, (42, top + 6), (214, low - 6), 0.58, 2)
    image[240:262, 20:48] = 0.85
    image[248:254, 20:64] = 0.12
    image[84:134, 70:186] = 0.9
    _write(image, text, 78, 118, 22, 0.08, 2)
    return _finish(image, rng, 0.02)


def keyboard(rng: np.random.Generator) -> ArrayF32:
    image = np.full((64, 128), 0.1)
    for r in range(5):
        for c in range(14):
            image[4 + r * 12 : 13 + r * 12, 3 + c * 9 : 10 + c * 9] = rng.uniform(0.15, 0.3)
    return _finish(image, rng)


def papers(rng: np.random.Generator) -> ArrayF32:
    """Sheets on a table."""
    image = np.full((256, 256), 0.9)
    _lines(image, rng, 20, 24, 210, 16, 13, 0.1)
    return _finish(image, rng)


def outside(rng: np.random.Generator) -> ArrayF32:
    """What a window shows: houses behind trees under a bright sky, and the cross of its bars."""
    h = w = 256
    image = (
        0.7 + 0.25 * np.linspace(1, 0, h)[:, None] + 0.05 * rng.standard_normal((16, 16)).repeat(16, 0).repeat(16, 1)
    )
    blocks = 12
    edges = np.sort(rng.integers(0, w, blocks - 1))
    for x0, x1 in zip([0, *edges], [*edges, w], strict=True):
        top = int(h * rng.uniform(0.2, 0.65))
        house = rng.uniform(0.12, 0.55) * np.ones((h - top, int(x1 - x0)))
        rows, columns = int(rng.integers(9, 18)), int(rng.integers(7, 14))
        lit = (np.arange(h - top)[:, None] % rows < rows // 2) & (
            np.arange(int(x1 - x0))[None, :] % columns < columns // 2
        )
        image[top:, x0:x1] = np.where(lit, house * rng.uniform(0.3, 1.8), house)
    canvas = np.ascontiguousarray(image, dtype=np.float32)
    for _ in range(120):  # leaves
        at = int(rng.integers(0, w)), int(h - abs(rng.normal(0, 0.16)) * h)
        cv2.circle(canvas, at, int(rng.integers(3, 11)), float(rng.uniform(0.05, 0.35)), -1)
    canvas[:8], canvas[-8:], canvas[:, :8], canvas[:, -8:] = 0.1, 0.1, 0.1, 0.1
    canvas[:, w // 2 - 4 : w // 2 + 4] = 0.1
    return _finish(canvas.astype(np.float64), rng, 0.01)


def marking(text: str) -> ArrayF32:
    """A sign of dark letters on white, or for the floor."""
    image = np.full((128, 256), 0.85)
    _write(image, text, 12, 86, min(60.0, 330.0 / max(len(text), 1)), 0.06, 4)
    image[:6], image[-6:], image[:, :6], image[:, -6:] = 0.1, 0.1, 0.1, 0.1
    return image.astype(np.float32)
