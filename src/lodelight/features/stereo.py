"""Depth of corners from a second camera: along its epipolar curve, to sub-pixel. Any two lenses, rectified or not.

A corner's ray, seen from the other camera, is a curve of pixels, one for each inverse depth. Its match is the corner
there with the nearest descriptor; the last fraction of a pixel comes from sliding its patch along the curve.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lodelight.compiled import kernel
from lodelight.features.features import Features
from lodelight.features.hamming import hamming
from lodelight.features.orb import OrbConfig, OrbExtractor
from lodelight.geometry.cameras import project_point
from lodelight.rig import CameraSpec
from lodelight.types import Array, ArrayF32, Bytes, Ints, Words

MAX_HAMMING = 75
N_SAMPLES = 17  # of a curve, evenly in inverse depth, which is nearly evenly in pixels
PATCH = 5  # half the side of the patch that is slid along the curve, px of the corner's octave
SLIDE = 5  # how far it is slid each way, px of the corner's octave
OFF_CURVE_PX = 2.0  # at the finest octave: noise of the corner and of the calibration
WORSE_THAN_MEDIAN = 2.1  # a patch that differs by so many times the median difference is another patch


@dataclass(frozen=True)
class StereoConfig:
    """sigma_px : noise of a disparity at the finest octave; nearest_m : nearer things are not matched."""

    sigma_px: float = 0.4
    nearest_m: float = 0.3


class StereoMatcher:
    """Measures the depth of camera `left`'s corners with camera `right`."""

    def __init__(self, left: CameraSpec, right: CameraSpec, orb: OrbConfig, config: StereoConfig | None = None) -> None:
        self.config = config or StereoConfig()
        self.orb = orb
        self.left, self.right = left.camera, right.camera
        self.T_right_left = right.T_body_cam.inverse() @ left.T_body_cam
        self._extractor = OrbExtractor(right.camera, orb)

    def measure(self, seen: Features, left_pyramid: list[Bytes], right_image: Bytes) -> Features:
        """`seen` with the inverse depths that could be measured, and their noise."""
        right_pyramid = self._extractor.pyramid(right_image)
        there = self._extractor.extract(right_pyramid)
        nearest = 1.0 / self.config.nearest_m
        T, scale = self.T_right_left, self.orb.scale_factor
        curve = _curves(seen.ray, T.R, T.t, self.right.model, self.right.params, nearest)
        order = np.argsort(there.px[:, 1], kind="stable").astype(np.int32)
        match = _match_along(curve, seen.octave, seen.desc, there.px, order, there.octave, there.desc, scale)
        tangent = _left_tangents(seen.ray, seen.px, T.R.T @ T.t, self.left.model, self.left.params)
        shift_px, difference = np.zeros(len(seen)), np.full(len(seen), np.inf)
        for octave, (left, right) in enumerate(zip(left_pyramid, right_pyramid, strict=False)):
            at = np.flatnonzero((match >= 0) & (seen.octave == octave)).astype(np.int32)
            _slide(at, left, right, seen.px, there.px[match], tangent, curve, scale**octave, shift_px, difference)
        good = np.isfinite(difference)
        if good.any():
            good &= difference <= WORSE_THAN_MEDIAN * np.median(difference[good])
        inv_depth, slope = _invert(curve, there.px[match], shift_px, good, nearest)
        sigma = self.config.sigma_px * self.orb.scale(seen.octave) / np.maximum(slope, 1e-12)
        # behind infinity by no more than its noise, a point is at infinity: a direction without a depth
        good &= inv_depth > 0
        none = np.float32(0)
        return seen.with_depth(
            np.where(good, inv_depth, none).astype(np.float32), np.where(good, sigma, none).astype(np.float32)
        )


@kernel
def _curves(ray: Array, R: Array, t: Array, model: int, params: Array, nearest: float) -> Array:
    """(N, N_SAMPLES, 2) px in the right image of rays (N, 3) of the left, at inverse depths 0 to `nearest`.

    NaN from where the right lens no longer sees the point.
    """
    out = np.full((len(ray), N_SAMPLES, 2), np.nan)
    for i in range(len(ray)):
        z = ray[i, 2]
        if z <= 1e-6:
            continue
        a, b = ray[i, 0] / z, ray[i, 1] / z
        x0 = R[0, 0] * a + R[0, 1] * b + R[0, 2]
        y0 = R[1, 0] * a + R[1, 1] * b + R[1, 2]
        z0 = R[2, 0] * a + R[2, 1] * b + R[2, 2]
        for k in range(N_SAMPLES):
            inv = nearest * k / (N_SAMPLES - 1)
            u, v, seen = project_point(model, params, x0 + inv * t[0], y0 + inv * t[1], z0 + inv * t[2])
            if not seen:
                break
            out[i, k, 0], out[i, k, 1] = u, v
    return out


@kernel
def _left_tangents(ray: Array, px: ArrayF32, along: Array, model: int, params: Array) -> Array:
    """(N, 2) unit direction in the left image in which a point moves when the camera moves towards the right one."""
    out = np.zeros((len(ray), 2))
    for i in range(len(ray)):
        step = 1e-3 / math.sqrt(along[0] ** 2 + along[1] ** 2 + along[2] ** 2)
        u, v, seen = project_point(
            model, params, ray[i, 0] + step * along[0], ray[i, 1] + step * along[1], ray[i, 2] + step * along[2]
        )
        du, dv = u - px[i, 0], v - px[i, 1]
        norm = math.hypot(du, dv)
        if seen and norm > 0.0:
            out[i, 0], out[i, 1] = du / norm, dv / norm
    return out


@kernel
def _nearest_on_curve(curve: Array, u: float, v: float) -> tuple[float, float, float, float, float]:
    """Sample number (fractional) of the point of a curve (N_SAMPLES, 2) nearest to (u, v), its squared distance,
    the curve's unit direction there, and its px per sample."""
    best, best_d2, best_x, best_y, best_length = -1.0, np.inf, 1.0, 0.0, 1.0
    for k in range(N_SAMPLES - 1):
        x0, y0, x1, y1 = curve[k, 0], curve[k, 1], curve[k + 1, 0], curve[k + 1, 1]
        if not math.isfinite(x1):
            break
        dx, dy = x1 - x0, y1 - y0
        length2 = dx * dx + dy * dy
        if length2 < 1e-12:
            continue
        s = ((u - x0) * dx + (v - y0) * dy) / length2
        if k > 0 or s > 0.0:  # the first stretch goes on beyond infinity, for points there seen with noise
            s = max(s, 0.0)
        s = min(s, 1.0)
        ex, ey = u - x0 - s * dx, v - y0 - s * dy
        d2 = ex * ex + ey * ey
        if d2 < best_d2:
            length = math.sqrt(length2)
            best, best_d2, best_x, best_y, best_length = k + s, d2, dx / length, dy / length, length
    return best, best_d2, best_x, best_y, best_length


@kernel
def _match_along(
    curve: Array, octave: Ints, desc: Words, px: ArrayF32, order: Ints, there_octave: Ints, there_desc: Words,
    scale_factor: float,
) -> Ints:  # fmt: skip
    """For every left corner the right one on its curve with the nearest descriptor, none taken twice, or -1.

    order : (M,) the right corners by rising row
    """
    n, m = len(curve), len(px)
    rows = px[:, 1][order]
    match = np.full(n, -1, np.int32)
    owner = np.full(m, -1, np.int32)
    owner_distance = np.empty(m, np.int32)
    for i in range(n):
        low_u, high_u, low_v, high_v = np.inf, -np.inf, np.inf, -np.inf
        for k in range(N_SAMPLES):
            if math.isfinite(curve[i, k, 0]):
                low_u, high_u = min(low_u, curve[i, k, 0]), max(high_u, curve[i, k, 0])
                low_v, high_v = min(low_v, curve[i, k, 1]), max(high_v, curve[i, k, 1])
        if not math.isfinite(low_u):
            continue
        band = OFF_CURVE_PX * scale_factor ** octave[i]
        best, best_distance = -1, MAX_HAMMING + 1
        for at in range(np.searchsorted(rows, low_v - band), m):
            j = order[at]
            if px[j, 1] > high_v + band:
                break
            if px[j, 0] < low_u - band or px[j, 0] > high_u + band or abs(there_octave[j] - octave[i]) > 1:
                continue
            distance = hamming(desc[i], there_desc[j])
            if distance < best_distance and _nearest_on_curve(curve[i], px[j, 0], px[j, 1])[1] <= band * band:
                best, best_distance = j, distance
        if best < 0:
            continue
        if owner[best] >= 0:
            if owner_distance[best] <= best_distance:
                continue
            match[owner[best]] = -1
        owner[best], owner_distance[best], match[i] = i, best_distance, best
    return match


@kernel
def _sample_strip(image: Bytes, u: float, v: float, du: float, dv: float, half_length: int, strip: Array) -> bool:
    """Fill strip (2 PATCH + 1, 2 half_length + 1) with the image along (du, dv) and across it, around (u, v)."""
    height, width = image.shape
    reach_u = half_length * abs(du) + PATCH * abs(dv)
    reach_v = half_length * abs(dv) + PATCH * abs(du)
    if u - reach_u < 0.0 or v - reach_v < 0.0 or u + reach_u >= width - 1 or v + reach_v >= height - 1:
        return False
    for b in range(-PATCH, PATCH + 1):
        for a in range(-half_length, half_length + 1):
            x, y = u + a * du - b * dv, v + a * dv + b * du
            ix, iy = int(x), int(y)
            fx, fy = x - ix, y - iy
            top = (1.0 - fx) * image[iy, ix] + fx * image[iy, ix + 1]
            bottom = (1.0 - fx) * image[iy + 1, ix] + fx * image[iy + 1, ix + 1]
            strip[b + PATCH, a + half_length] = (1.0 - fy) * top + fy * bottom
    return True


@kernel
def _slide(
    at: Ints, left: Bytes, right: Bytes, left_px: ArrayF32, right_px: ArrayF32, tangent: Array, curve: Array,
    scale: float, shift_px: Array, difference: Array,
) -> None:  # fmt: skip
    """For the corners `at` of one octave: how far along the curve the patch fits best, px of the image, and how badly
    it fits there, grey values a pixel. The difference stays infinite where there is no minimum within reach."""
    side = 2 * PATCH + 1
    patch, strip = np.empty((side, side)), np.empty((side, side + 2 * SLIDE))
    cost = np.empty(2 * SLIDE + 1)
    for i in at:
        u, v = (left_px[i, 0] + 0.5) / scale - 0.5, (left_px[i, 1] + 0.5) / scale - 0.5
        ru, rv = (right_px[i, 0] + 0.5) / scale - 0.5, (right_px[i, 1] + 0.5) / scale - 0.5
        _, _, du, dv, _ = _nearest_on_curve(curve[i], right_px[i, 0], right_px[i, 1])
        if not _sample_strip(left, u, v, tangent[i, 0], tangent[i, 1], PATCH, patch):
            continue
        if not _sample_strip(right, ru, rv, du, dv, PATCH + SLIDE, strip):
            continue
        patch_mean = patch.mean()
        lowest = 0
        for k in range(2 * SLIDE + 1):
            offset = strip[:, k : k + side].mean() - patch_mean
            total = 0.0
            for b in range(side):
                for a in range(side):
                    e = strip[b, k + a] - patch[b, a] - offset
                    total += e * e
            cost[k] = total
            if total < cost[lowest]:
                lowest = k
        if lowest == 0 or lowest == 2 * SLIDE:
            continue
        before, here, after = cost[lowest - 1], cost[lowest], cost[lowest + 1]
        bend = before - 2.0 * here + after
        if bend <= 0.0:
            continue
        shift = lowest - SLIDE + 0.5 * (before - after) / bend
        if abs(shift) > OFF_CURVE_PX:  # along the curve a corner is as noisy as across it: the patch is another one's
            continue
        shift_px[i] = scale * shift
        difference[i] = math.sqrt(here) / side


@kernel
def _invert(curve: Array, px: ArrayF32, shift_px: Array, good: Array, nearest: float) -> tuple[Array, Array]:
    """Inverse depth (N,) of the right pixel px moved by shift_px along the curve, and px per unit of it (N,)."""
    inv_depth, slope = np.zeros(len(px)), np.zeros(len(px))
    step = nearest / (N_SAMPLES - 1)
    for i in range(len(px)):
        if good[i]:
            sample, _, _, _, length = _nearest_on_curve(curve[i], px[i, 0], px[i, 1])
            inv_depth[i] = step * (sample + shift_px[i] / length)
            slope[i] = length / step
    return inv_depth, slope
