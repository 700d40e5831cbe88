"""Image messages to the arrays everything else works on."""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np

from lodelight.io.pictures import BadFrame, decode
from lodelight.types import AnyArray, ArrayF32, Bytes

IMAGE, COMPRESSED = "sensor_msgs/Image", "sensor_msgs/CompressedImage"
DEPTHS = ("16UC1", "32FC1")
TO_GREY = {
    "bgr8": cv2.COLOR_BGR2GRAY,
    "8UC3": cv2.COLOR_BGR2GRAY,
    "rgb8": cv2.COLOR_RGB2GRAY,
    "bgra8": cv2.COLOR_BGRA2GRAY,
    "8UC4": cv2.COLOR_BGRA2GRAY,
    "rgba8": cv2.COLOR_RGBA2GRAY,
}
# OpenCV names a pattern by its second row, ROS by its first.
BAYER = {
    "bayer_rggb8": cv2.COLOR_BayerBG2GRAY,
    "bayer_bggr8": cv2.COLOR_BayerRG2GRAY,
    "bayer_gbrg8": cv2.COLOR_BayerGR2GRAY,
    "bayer_grbg8": cv2.COLOR_BayerGB2GRAY,
}
LUMINANCE = {"yuv422": 1, "uyvy": 1, "yuv422_yuy2": 0, "yuyv": 0}  # which byte of a pixel is its brightness
CHANNELS = {"bgr8": 3, "8UC3": 3, "rgb8": 3, "bgra8": 4, "8UC4": 4, "rgba8": 4}
ENCODINGS = ("mono8", "8UC1", "mono16", *DEPTHS, *TO_GREY, *BAYER, *LUMINANCE)


def is_depth(message: Any, topic: str) -> bool:
    """Whether an image message holds depth: by its encoding, as drivers have no other way to say so."""
    if hasattr(message, "format"):
        return "compressedDepth" in message.format
    return message.encoding in DEPTHS or (message.encoding == "mono16" and "depth" in topic)


def is_image(message: Any) -> bool:
    """Whether it is of an encoding known here."""
    return hasattr(message, "format") or message.encoding in ENCODINGS


def encoding_of(message: Any) -> str:
    return str(message.format if hasattr(message, "format") else message.encoding)


def size_of(message: Any) -> tuple[int, int] | None:
    """(width, height); None where only decoding tells."""
    return None if hasattr(message, "format") else (int(message.width), int(message.height))


def grey(message: Any, size: tuple[int, int]) -> Bytes:
    """(H, W) uint8 of an Image or CompressedImage. Raises BadFrame where it is damaged or not of `size`."""
    if hasattr(message, "format"):
        flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
        return np.asarray(decode(message.data.tobytes(), flags, size), dtype=np.uint8)
    encoding = message.encoding
    if encoding in ("mono16", "16UC1"):
        return np.asarray(_plane(message, size, np.uint16) >> 8, dtype=np.uint8)
    if encoding in CHANNELS:
        pixels = _plane(message, size, np.uint8, CHANNELS[encoding])
        return np.asarray(cv2.cvtColor(pixels, TO_GREY[encoding]), dtype=np.uint8)
    if encoding in LUMINANCE:
        return np.ascontiguousarray(_plane(message, size, np.uint8, 2)[:, :, LUMINANCE[encoding]], dtype=np.uint8)
    if encoding in BAYER:
        return np.asarray(cv2.cvtColor(_plane(message, size, np.uint8), BAYER[encoding]), dtype=np.uint8)
    if encoding in ("mono8", "8UC1"):
        return np.asarray(_plane(message, size, np.uint8), dtype=np.uint8)
    raise BadFrame(f"image encoding {encoding!r} is not known here")


def raw_depth(message: Any, size: tuple[int, int]) -> AnyArray:
    """(H, W) of a depth message: uint16 as stored, or float32 m with 0 where there is no reading."""
    if hasattr(message, "format"):
        return _compressed_depth(message, size)
    if message.encoding == "32FC1":
        return _no_holes(_plane(message, size, np.float32))
    if message.encoding in ("16UC1", "mono16"):
        return _plane(message, size, np.uint16)
    raise BadFrame(f"depth encoding {message.encoding!r} is not known here")


def _no_holes(metres: AnyArray) -> ArrayF32:
    return np.where(np.isfinite(metres) & (metres > 0), metres, 0.0).astype(np.float32)


def _plane(message: Any, size: tuple[int, int], kind: type, channels: int = 1) -> AnyArray:
    """(H, W) or (H, W, channels) of an uncompressed image, without its rows' padding, in this machine's order."""
    width, height = int(message.width), int(message.height)
    if (width, height) != size:
        raise BadFrame(f"image is {width}x{height}, the rig says {size[0]}x{size[1]}")
    dtype = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    row, step = width * channels * dtype.itemsize, int(message.step)
    if step < row or message.data.size < step * height:
        raise BadFrame("image is truncated")
    rows = message.data.view(np.uint8)[: step * height].reshape(height, step)[:, :row]
    pixels: AnyArray = np.ascontiguousarray(rows).view(dtype).astype(kind, copy=False)
    return pixels if channels == 1 else pixels.reshape(height, width, channels)


def _compressed_depth(message: Any, size: tuple[int, int]) -> AnyArray:
    """What `compressed_depth_image_transport` writes: twelve bytes of head, then a PNG.

    Metres (32FC1) are stored as their inverse, which the two floats of the head scale: z = a / (stored - b).
    """
    data = message.data.tobytes()
    if "rvl" in message.format.lower():
        raise BadFrame("depth is compressed as RVL, which is not known here")
    if len(data) <= 12:
        raise BadFrame("image is truncated")
    stored = decode(data[12:], cv2.IMREAD_UNCHANGED, size)
    if stored.dtype != np.uint16 or stored.ndim != 2:
        raise BadFrame("depth image is not 16 bit with one channel")
    if not message.format.startswith("32FC1"):
        return stored
    a, b = struct.unpack("<ff", data[4:12])
    with np.errstate(divide="ignore", invalid="ignore"):
        return _no_holes(np.where(stored > 0, a / (stored - b), 0.0))
