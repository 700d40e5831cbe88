"""A stereo pair held against its rig: how far matches miss their epipolar curves, and which error explains it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import least_squares

from lodelight.doctor.turning import epipolar_miss
from lodelight.geometry.se3 import SE3
from lodelight.geometry.so3 import so3_exp
from lodelight.rig import CameraSpec
from lodelight.types import Array, Bools

LEAST_MATCHES = 60
# How wrong a rig may well be: turn rad, direction of the base line rad, ratio of the focal lengths.
MAYBE = np.array([*[0.2] * 3, *[0.5] * 2, 0.1])


@dataclass(frozen=True, eq=False)
class Eyes:
    """What the matches of a stereo pair say of its rig.

    miss_px : median distance from the epipolar curve by the rig; best_px : by the rig once corrected
    behind : share of matches that lie behind the cameras by the rig; cameras that are swapped have nearly all there
    turn_rad : (3,) of camera 1, by its axes; aim_rad : (2,) of the base line's direction; focal : of camera 1 over 0,
        true over the rig's; sigma : (6,) of these
    """

    matches: int
    miss_px: float
    best_px: float
    behind: float
    turn_rad: Array
    aim_rad: Array
    focal: float
    sigma: Array
    baseline_m: float


def examine(matches: list[tuple[Array, Array]], cam0: CameraSpec, cam1: CameraSpec) -> Eyes | None:
    """None where there are too few matches to say anything."""
    a_px, b_px = (np.concatenate([np.zeros((0, 2)), *(m[i] for m in matches)]) for i in (0, 1))
    f_a, ok_a = cam0.camera.unproject(a_px)
    f_b, ok_b = cam1.camera.unproject(b_px)
    ok = ok_a & ok_b & (f_a[:, 2] > 0.05) & (f_b[:, 2] > 0.05)
    f_a, f_b = f_a[ok], f_b[ok]
    if len(f_a) < LEAST_MATCHES:
        return None
    pixel = 1.0 / cam0.camera.focal_px
    kept = _of_one_geometry(f_a, f_b, pixel)
    if np.count_nonzero(kept) < LEAST_MATCHES:
        return None
    f_a, f_b = f_a[kept], f_b[kept]
    T = cam0.T_body_cam.inverse() @ cam1.T_body_cam
    baseline_m = float(np.linalg.norm(T.t))
    if baseline_m < 1e-4:
        return None
    at = T.t / baseline_m
    across = np.linalg.svd(at[None])[2][1:]

    def miss(x: Array) -> Array:
        b = f_b / f_b[:, 2:]
        b = np.column_stack([b[:, :2] / (1.0 + x[5]), b[:, 2]])
        return epipolar_miss(T.R @ so3_exp(x[:3]), at + x[3:5] @ across, f_a, b) / pixel

    def residual(x: Array) -> Array:
        return np.concatenate([miss(x), x / MAYBE])

    fit = least_squares(residual, np.zeros(6), loss="huber", f_scale=0.5, max_nfev=40)
    best_px = float(np.median(np.abs(miss(fit.x))))
    H = fit.jac.T @ fit.jac
    spread = max(1.4826 * best_px, 0.1)
    sigma = np.sqrt(np.diag(np.linalg.pinv(H))) * max(spread, 1.0)
    return Eyes(
        len(f_a), float(np.median(np.abs(miss(np.zeros(6))))), best_px, _behind(T, f_a, f_b), fit.x[:3], fit.x[3:5],
        1.0 + float(fit.x[5]), sigma, baseline_m,
    )  # fmt: skip


def _of_one_geometry(f_a: Array, f_b: Array, pixel: float) -> Bools:
    """Matches that agree on one pose of the cameras, whatever it is: all frames have the same."""
    cv2.setRNGSeed(0)
    n_a, n_b = f_a[:, :2] / f_a[:, 2:], f_b[:, :2] / f_b[:, 2:]
    _, mask = cv2.findEssentialMat(n_a, n_b, np.eye(3), cv2.USAC_MAGSAC, 0.999, 3.0 * pixel, maxIters=2000)
    return np.zeros(len(f_a), bool) if mask is None else mask.ravel().astype(bool)


def _behind(T_a_b: SE3, f_a: Array, f_b: Array) -> float:
    """Share of matches whose rays, by the rig, run apart: of those that are near enough to say."""
    a = f_a / np.linalg.norm(f_a, axis=1, keepdims=True)
    b = (f_b @ T_a_b.R.T) / np.linalg.norm(f_b, axis=1, keepdims=True)
    between = np.cross(a, b)
    near = np.linalg.norm(between, axis=1) > np.radians(0.3)
    if np.count_nonzero(near) < 20:
        return 0.0
    # depth along a solves  z_a a = t + z_b b: (t x b) = z_a (a x b)
    z = np.einsum("ij,ij->i", np.cross(T_a_b.t, b), between) / np.maximum((between**2).sum(axis=1), 1e-12)
    return float(np.mean(z[near] < 0.0))
