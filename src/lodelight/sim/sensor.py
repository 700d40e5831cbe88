"""From radiance to bytes: lens shading, blur, exposure, shot and read noise, eight bits.

The response is linear, as that of machine vision cameras. One exposure value is the product of time and gain; noise
grows with the gain as it does in a real sensor (EMVA 1288 for the model).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.special import ndtri

from lodelight.compiled import kernel
from lodelight.geometry.cameras import Camera
from lodelight.types import Array, ArrayF32, Bytes

FULL_WELL_E = 20_000.0  # electrons that make 255 grey levels at gain 1: noise as in EuRoC, 1.3 levels at mid grey
READ_NOISE_E = 30.0
DARK_DN = 1.5  # the black level, so that read noise is not cut off at 0
PSF_PX = 0.45  # standard deviation of the lens's blur: edges as steep as those of the EuRoC cameras
CORNER_LOSS = 0.45  # of the light, in the corners
SENSITIVITY = 0.385  # grey levels per cd/m^2 and ms at gain 1: f/2 and a 6 um pixel, about
NORMALS = ndtri((np.arange(1 << 14) + 0.5) / (1 << 14)).astype(np.float32)


@dataclass(frozen=True)
class Exposure:
    """time_s; gain over the sensor's base sensitivity. `level` is grey levels per cd/m^2."""

    time_s: float
    gain: float = 1.0

    @property
    def level(self) -> float:
        return SENSITIVITY * 1e3 * self.time_s * self.gain

    @staticmethod
    def for_level(level: float, longest_s: float) -> Exposure:
        """As long as allowed, then by gain up to 24 dB."""
        wanted_s = level / (SENSITIVITY * 1e3)
        time_s = float(np.clip(wanted_s, 5e-5, longest_s))
        return Exposure(time_s, float(np.clip(wanted_s / time_s, 1.0, 16.0)))


def shading(camera: Camera) -> ArrayF32:
    """(H, W) part of the light that arrives, 1 on the axis."""
    u, v = np.meshgrid(np.arange(camera.width) - camera.params[2], np.arange(camera.height) - camera.params[3])
    r2 = (u**2 + v**2) / (0.25 * (camera.width**2 + camera.height**2))
    out: ArrayF32 = (1.0 - CORNER_LOSS * np.minimum(r2, 1.3)).astype(np.float32)
    return out


def develop(radiance: ArrayF32, shade: ArrayF32, exposure: Exposure, seed: int, psf_px: float = PSF_PX) -> Bytes:
    """(H, W) cd/m^2 to grey levels; the same seed gives the same noise."""
    sharp = radiance * shade
    blurred = cv2.GaussianBlur(sharp, (0, 0), psf_px, borderType=cv2.BORDER_REPLICATE) if psf_px > 0 else sharp
    out = np.empty(radiance.shape, np.uint8)
    per_dn = FULL_WELL_E / 255.0 / exposure.gain
    _expose(np.asarray(blurred), exposure.level, 1.0 / per_dn, (READ_NOISE_E / per_dn) ** 2, NORMALS, seed, out)
    return out


@kernel
def hash64(x: int) -> int:
    """A well mixed 64-bit number for each number (splitmix64, Steele et al. 2014)."""
    z = np.uint64(x) + np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    out: int = z ^ (z >> np.uint64(31))
    return out


@kernel
def _expose(light: ArrayF32, level: float, shot: float, read2: float, normals: ArrayF32, seed: int, out: Bytes) -> None:
    h, w = light.shape
    mask = np.uint64(normals.shape[0] - 1)
    base = hash64(np.uint64(seed))
    for y in range(h):
        for x in range(0, w, 4):
            bits = hash64(base + np.uint64(y * w + x))
            for k in range(min(4, w - x)):
                dn = light[y, x + k] * level
                noise = normals[(bits >> np.uint64(16 * k)) & mask]
                dn += np.sqrt(dn * shot + read2) * noise + DARK_DN
                out[y, x + k] = np.uint8(min(max(dn + 0.5, 0.0), 255.0))


def seed_of(seed: int, camera: int, index: int) -> int:
    """One number for the noise of one image, whatever was rendered before it."""
    return int(np.random.SeedSequence([seed, camera, index]).generate_state(1, np.uint64)[0] >> 1)


def level_for(radiance: ArrayF32 | Array, target_dn: float) -> float:
    """Grey levels per cd/m^2 at which the mean of the clipped image is `target_dn`."""
    level = target_dn / max(float(radiance.mean()), 1e-9)
    for _ in range(12):
        level *= target_dn / max(float(np.minimum(radiance * level, 255.0).mean()), 1e-9)
        level = min(level, 1e6)
    return level
