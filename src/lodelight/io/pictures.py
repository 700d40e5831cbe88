"""Image files to arrays, and what is wrong with those that are none."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from lodelight.types import AnyArray, Bytes

SUFFIXES = (".png", ".jpg", ".jpeg", ".pgm", ".ppm", ".bmp", ".tif", ".tiff", ".webp")


class BadFrame(Exception):
    """One frame that cannot be used, and why; readers skip it and count it."""


def read_grey(path: Path, size: tuple[int, int] | None = None) -> Bytes:
    """Grey (H, W) uint8 of any image file; deeper ones are scaled to 8 bit, an orientation tag is left alone.

    Raises BadFrame where the file is missing, truncated, no image, or not of `size` (width, height).
    """
    return np.asarray(_decode(path, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION, size), dtype=np.uint8)


def read_raw(path: Path, size: tuple[int, int] | None = None) -> AnyArray:
    """A depth image as stored, (H, W) uint16. Raises BadFrame as `read_grey`, and on any other kind of image."""
    image = _decode(path, cv2.IMREAD_UNCHANGED, size)
    if image.ndim != 2 or image.dtype != np.uint16:
        raise BadFrame("depth image is not 16 bit with one channel")
    return image


def _decode(path: Path, flags: int, size: tuple[int, int] | None) -> AnyArray:
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise BadFrame("image file is missing") from None
    except OSError as error:
        raise BadFrame(f"image file cannot be read ({error.strerror})") from None
    return decode(data, flags, size, "image file")


def decode(data: bytes, flags: int, size: tuple[int, int] | None, what: str = "image") -> AnyArray:
    """The image of an encoded file's bytes, read with OpenCV's `flags`; `what` it is, for BadFrame."""
    if not data:
        raise BadFrame(f"{what} is empty")
    if _truncated(data):
        raise BadFrame(f"{what} is truncated")
    try:
        image: AnyArray | None = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    if image is None:
        raise BadFrame(f"{what.removeprefix('image ')} is no readable image")
    if size is not None and image.shape[1::-1] != size:
        raise BadFrame(f"image is {image.shape[1]}x{image.shape[0]}, the rig says {size[0]}x{size[1]}")
    return image


def _truncated(data: bytes) -> bool:
    """Decoders fill in what a cut file lacks, each in its own way: look for the end marker instead."""
    if data.startswith(b"\xff\xd8"):
        return b"\xff\xd9" not in data[-64:]  # some cameras pad after the marker
    if data.startswith(b"\x89PNG"):
        return b"IEND" not in data[-64:]
    return False
