"""A printed code laid over its image: the fit that gives all corners to a few hundredths of a pixel.

A library finds a code and reads it; where its corners are is known to a pixel or so. Once read, every module of it is
known, and the whole print becomes the ruler: the homography from the tag's plane to the camera's rays is adjusted
until the image, seen through the lens, is a + b times the print. All edges of the code speak, not only its rim, and
the lens' distortion is the lens' own. What the fit leaves over says how well image and print agree: a code that was
misread does not. Gauss-Newton on the eight numbers of the homography, a and b. Derivation: docs/tags.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from lodelight.anchors import tag_corners
from lodelight.compiled import kernel
from lodelight.geometry.cameras import Camera, project_jacobian
from lodelight.geometry.dense import spd_inverse
from lodelight.types import Array, ArrayF32, Bytes

UNIT_CORNERS = tag_corners(1.0)[:, :2]
MARGIN = 1.0  # modules of white around the code that take part
FINE = 6  # cells of a module in which the print is drawn before it is blurred
SHARP_PX, SMEARED_PX = (
    0.8,
    1.6,
)  # blur of a sharp lens, a pixel's own area included, and of one that moves or is not in focus
ENOUGH = 0.9  # agreement above which no other blur is tried
COARSE_BLUR = 0.45  # modules: as much as can be without two edges becoming one
MAX_SAMPLES = 1000
EDGE = 0.1  # share of the steepest slope above which a sample says where the print is
STEPS = 6
CONVERGED_PX = 0.02
ROBUST = 0.25  # of the print's contrast: a residual of so much counts half


@dataclass(frozen=True, eq=False)
class Fit:
    """corners_px (4, 2), in the order of `tag_corners`; covariance_px (8, 8) of them, x and y of each in turn
    agreement : correlation of image and print; contrast : white less black, grey levels
    """

    corners_px: Array
    covariance_px: Array
    agreement: float
    contrast: float


def fit_pattern(image: Bytes, camera: Camera, modules: Bytes, corners_px: Array, start_px: float = 1.0) -> Fit | None:
    """Lay a code (n, n), 0 black and 1 white, over an image, from where its corners (4, 2) px are thought to be.

    start_px : how far off they may be
    None where it leaves the image, or turns away so far that no plane explains it.
    """
    rays, seen = camera.unproject(corners_px)
    if not seen.all() or rays[:, 2].min() < 0.05:
        return None
    H = homography(UNIT_CORNERS, rays[:, :2] / rays[:, 2:])
    if H is None:
        return None
    sides = np.linalg.norm(np.roll(corners_px, -1, axis=0) - corners_px, axis=1)
    module_px = float(sides.mean()) / len(modules)
    fits = []
    for blur_px in (SHARP_PX, SMEARED_PX):
        start = H.copy()
        fine = blur_px / module_px
        for blur in (fine,) if start_px < SHARP_PX or fine > COARSE_BLUR else (COARSE_BLUR, fine):
            A = np.eye(8)
            agreement, contrast, noise2, ok = _fit(
                image, camera.model, camera.params, _samples(modules, blur, module_px), start, A, STEPS
            )
            if not ok:
                break
        else:
            px, J = _corners(camera, start)
            if px is not None and np.isfinite(A).all():
                fits.append(Fit(px, noise2 * J @ A @ J.T, agreement, contrast))
        if fits and fits[-1].agreement > ENOUGH:
            break
    return max(fits, key=lambda fit: fit.agreement, default=None)


def homography(src: Array, dst: Array) -> Array | None:
    """(3, 3) with H[2, 2] = 1 that takes four points (4, 2) to four others; None where three are on a line."""
    A, b = np.zeros((8, 8)), np.zeros(8)
    for i, ((x, y), (u, v)) in enumerate(zip(src, dst, strict=True)):
        A[2 * i] = [x, y, 1.0, 0.0, 0.0, 0.0, -u * x, -u * y]
        A[2 * i + 1] = [0.0, 0.0, 0.0, x, y, 1.0, -v * x, -v * y]
        b[2 * i : 2 * i + 2] = u, v
    try:
        h = np.linalg.solve(A, b)
    except np.linalg.LinAlgError:
        return None
    return np.append(h, 1.0).reshape(3, 3) if np.isfinite(h).all() else None


def _samples(modules: Bytes, blur: float, module_px: float) -> Array:
    """(N, 3) x, y in units of the code's side from its middle, and the blurred print there, where it has edges."""
    n = len(modules)
    wide = n + 2 * MARGIN
    framed = np.pad(modules, int(MARGIN), constant_values=1)
    cells: ArrayF32 = np.kron(framed, np.ones((FINE, FINE))).astype(np.float32)
    drawn = np.asarray(cv2.GaussianBlur(cells, (0, 0), blur * FINE, borderType=cv2.BORDER_REPLICATE), np.float64)
    per_module = min(max(math.ceil(1.2 * module_px), 2), FINE)
    count = round(wide * per_module)
    at = (np.arange(count) + 0.5) / per_module  # modules from the margin's corner
    cell = np.minimum((at * FINE).astype(int), drawn.shape[0] - 1)
    at = (cell + 0.5) / FINE
    value = drawn[np.ix_(cell, cell)]
    slope_y, slope_x = np.gradient(drawn)
    slope = np.hypot(slope_x, slope_y)[np.ix_(cell, cell)]
    rows, columns = np.nonzero(slope > EDGE * slope.max())
    stride = -(-len(rows) // MAX_SAMPLES)
    rows, columns = rows[::stride], columns[::stride]
    xy = (at - MARGIN) / n - 0.5
    return np.stack([xy[columns], xy[rows], value[rows, columns]], axis=1).astype(np.float64)


def _corners(camera: Camera, H: Array) -> tuple[Array | None, Array]:
    """The corners (4, 2) px under a homography, and their derivative (8, 8) by its first eight numbers."""
    px, J, Jp = np.empty((4, 2)), np.zeros((8, 8)), np.empty((2, 3))
    for i, (x, y) in enumerate(UNIT_CORNERS):
        X = H @ np.array([x, y, 1.0])
        u, v, seen = project_jacobian(camera.model, camera.params, X[0], X[1], X[2], Jp)
        if not seen:
            return None, J
        px[i] = u, v
        J[2 * i : 2 * i + 2] = np.hstack([Jp[:, :1] * [[x, y, 1.0]], Jp[:, 1:2] * [[x, y, 1.0]], Jp[:, 2:] * [[x, y]]])
    return px, J


@kernel
def _fit(
    image: Bytes, model: int, params: Array, samples: Array, H: Array, A: Array, steps: int
) -> tuple[float, float, float, bool]:
    """Adjust H in place; A (8, 8) becomes the inverse normal matrix of its first eight numbers, noise left out.

    Returns correlation, contrast, variance of the residuals, and whether the print stayed in the image.
    """
    h, w = image.shape
    n = samples.shape[0]
    grey = np.empty(n)
    g = np.empty((n, 8))
    Jp = np.empty((2, 3))
    N, rhs = np.zeros((10, 10)), np.zeros(10)
    agreement, b, noise2, moved = 0.0, 0.0, 0.0, 0.0
    for step in range(steps + 1):
        for i in range(n):
            x, y = samples[i, 0], samples[i, 1]
            X = H[0, 0] * x + H[0, 1] * y + H[0, 2]
            Y = H[1, 0] * x + H[1, 1] * y + H[1, 2]
            Z = H[2, 0] * x + H[2, 1] * y + H[2, 2]
            u, v, seen = project_jacobian(model, params, X, Y, Z, Jp)
            if not seen or not (u >= 1.0 and v >= 1.0 and u < w - 2.0 and v < h - 2.0):
                return 0.0, 0.0, 0.0, False
            c, r = int(u), int(v)
            du, dv = u - c, v - r
            p00, p01 = float(image[r, c]), float(image[r, c + 1])
            p10, p11 = float(image[r + 1, c]), float(image[r + 1, c + 1])
            grey[i] = (1 - dv) * ((1 - du) * p00 + du * p01) + dv * ((1 - du) * p10 + du * p11)
            gu = (1 - dv) * (p01 - p00) + dv * (p11 - p10)
            gv = (1 - du) * (p10 - p00) + du * (p11 - p01)
            gx = gu * Jp[0, 0] + gv * Jp[1, 0]
            gy = gu * Jp[0, 1] + gv * Jp[1, 1]
            gz = gu * Jp[0, 2] + gv * Jp[1, 2]
            g[i, 0], g[i, 1], g[i, 2] = gx * x, gx * y, gx
            g[i, 3], g[i, 4], g[i, 5] = gy * x, gy * y, gy
            g[i, 6], g[i, 7] = gz * x, gz * y
        s1, st, sg, stt, stg, sgg = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(n):
            t = samples[i, 2]
            s1 += 1.0
            st += t
            sg += grey[i]
            stt += t * t
            stg += t * grey[i]
            sgg += grey[i] * grey[i]
        vt, vg, ctg = stt - st * st / s1, sgg - sg * sg / s1, stg - st * sg / s1
        if vt <= 0.0 or vg <= 0.0:
            return 0.0, 0.0, 0.0, False
        b = ctg / vt
        a = (sg - b * st) / s1
        agreement = ctg / math.sqrt(vt * vg)
        N[:], rhs[:] = 0.0, 0.0
        scale2 = max((ROBUST * b) ** 2, 1.0)
        noise2, weights = 0.0, 0.0
        for i in range(n):
            t = samples[i, 2]
            res = grey[i] - a - b * t
            weight = 1.0 / (1.0 + res * res / scale2)
            noise2 += weight * res * res
            weights += weight
            for k in range(10):
                jk = g[i, k] if k < 8 else (-1.0 if k == 8 else -t)
                rhs[k] -= weight * jk * res
                for m in range(k + 1):
                    jm = g[i, m] if m < 8 else (-1.0 if m == 8 else -t)
                    N[k, m] += weight * jk * jm
        noise2 /= max(weights - 10.0, 1.0)
        for k in range(10):
            N[k, k] *= 1.0 + 1e-6
            N[k, k] += 1e-9
            for m in range(k):
                N[m, k] = N[k, m]
        inverse, ok = spd_inverse(N)
        if not ok:
            return agreement, b, noise2, False
        A[:] = inverse[:8, :8]
        if step == steps or (step > 0 and moved * params[0] < CONVERGED_PX):
            break
        moved = 0.0
        delta = np.zeros(8)
        for k in range(8):
            for m in range(10):
                delta[k] += inverse[k, m] * rhs[m]
            moved = max(moved, abs(delta[k]))
        for k in range(8):
            H[k // 3, k % 3] += delta[k]
    return agreement, b, noise2, True
