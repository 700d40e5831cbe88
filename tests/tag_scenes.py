"""Pictures of printed codes by an independent, plain-numpy ray caster; and the codes' modules."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from lodelight.anchors import tag_corners
from lodelight.fiducials import fiducial_modules
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3

EUROC = Camera.create("radtan", 752, 480, (458.0, 457.0, 367.0, 248.0), (-0.28, 0.07, 1e-4, 2e-5))
FISHEYE = Camera.create("equidistant", 640, 480, (240.0, 240.0, 320.0, 240.0), (0.01, -0.004, 0.002, -0.001))
FINE = 4  # rays of a pixel along each axis


def qr_modules(text: str) -> np.ndarray:
    """(n, n) of a QR code, 1 = white, from OpenCV's encoder."""
    image = cv2.QRCodeEncoder_create().encode(text) > 127
    dark = np.flatnonzero(~image.all(axis=1))
    return image[dark[0] : dark[-1] + 1, dark[0] : dark[-1] + 1].astype(np.uint8)


@dataclass(frozen=True, eq=False)
class Print:
    """modules (n, n) with quiet modules of white around, hung at T_cam_tag, size_m a side."""

    modules: np.ndarray
    T_cam_tag: SE3
    size_m: float
    quiet: int = 1

    def corners_px(self, camera: Camera) -> np.ndarray:
        return camera.project(self.T_cam_tag @ tag_corners(self.size_m))[0]


def april(number: int, T_cam_tag: SE3, size_m: float = 0.2) -> Print:
    return Print(fiducial_modules("tag36h11", number), T_cam_tag, size_m)


def qr(text: str, T_cam_tag: SE3, size_m: float = 0.2) -> Print:
    return Print(qr_modules(text), T_cam_tag, size_m, quiet=4)


def facing(xyz, turn=(0.0, 0.0, 0.0)) -> SE3:
    """A tag at xyz in the camera, turned by a rotation vector (rad) from facing it squarely."""
    return SE3.exp(np.array([*turn, *xyz], dtype=np.float64))


def picture(
    camera: Camera, prints: list[Print], blur_px: float = 0.6, noise: float = 2.0, seed: int = 0, fine: int = FINE
) -> np.ndarray:
    """(H, W) uint8: prints on a grey wall; none hides another. fine : rays of a pixel along each axis"""
    image = np.full((camera.height, camera.width), 120.0)
    for p in prints:
        n, q = len(p.modules), p.quiet
        reach = tag_corners(p.size_m * (n + 2 * q) / n)
        outline = np.array([camera.project((p.T_cam_tag @ c)[None])[0][0] for c in reach])
        x0, y0 = np.maximum(np.floor(outline.min(axis=0)).astype(int) - 6, 0)
        x1, y1 = np.minimum(np.ceil(outline.max(axis=0)).astype(int) + 6, (camera.width, camera.height))
        u = (np.arange(x0 * fine, x1 * fine) + 0.5) / fine - 0.5
        v = (np.arange(y0 * fine, y1 * fine) + 0.5) / fine - 0.5
        U, V = np.meshgrid(u, v)
        rays, _ = camera.unproject(np.stack([U.ravel(), V.ravel()], axis=1))
        R, t = p.T_cam_tag.R, p.T_cam_tag.t
        along = (R[:, 2] @ t) / (rays @ R[:, 2])
        xy = ((rays * along[:, None] - t) @ R)[:, :2] / p.size_m + 0.5
        column, row = np.floor(xy * n).astype(int).T
        value = np.full(len(xy), 120.0)
        paper = (column >= -q) & (row >= -q) & (column < n + q) & (row < n + q) & (along > 0)
        value[paper] = 215.0
        code = paper & (column >= 0) & (row >= 0) & (column < n) & (row < n)
        value[code] = np.where(p.modules[row[code], column[code]] > 0, 215.0, 25.0)
        part = cv2.GaussianBlur(value.reshape(U.shape), (0, 0), max(blur_px, 0.01) * fine)
        part = part.reshape(y1 - y0, fine, x1 - x0, fine).mean(axis=(1, 3))
        inside = cv2.erode(np.pad(np.ones((y1 - y0 - 2, x1 - x0 - 2), np.uint8), 1), np.ones((3, 3), np.uint8)) > 0
        image[y0:y1, x0:x1][inside] = part[inside]
    image = image + noise * np.random.default_rng(seed).standard_normal(image.shape)
    return np.clip(np.round(image), 0, 255).astype(np.uint8)
