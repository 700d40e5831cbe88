"""Which way is up in a map that no IMU has levelled: from the largest surface its cameras look down upon."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from lodelight.types import Array

TILT_DEG = 60.0  # how far cameras may be pitched or rolled, on the average; a wall seen by level ones is at 90
SLAB_M = 0.05  # how far points of a surface may lie off it: depth noise and clutter
PATCH_M = 0.5  # three points about this far from each other are likely on one surface
SHARE = 0.1  # of all points that the surface must hold, or there is none worth the name
TRIALS = 2000


def estimate_up(xyz: Array, R_world_cam: Array, centres: Array, seed: int = 0) -> tuple[Array, float]:
    """Unit vector up (3,) in the frame of points (N, 3), and the share of points on the surface it stands on.

    The share is what a slab round the surface holds beyond the slabs above and below it: a slice through walls has
    none. Where no surface has a tenth of the points, up is the mean of the cameras' own and the share is 0.
    R_world_cam : (K, 3, 3), centres : (K, 3) of the cameras
    Source: RANSAC, Fischler and Bolles 1981, on triples of neighbours.
    """
    own_up = -R_world_cam[:, :, 1].mean(axis=0)
    own_up /= np.linalg.norm(own_up)
    xyz = xyz[np.isfinite(xyz).all(axis=1)]
    if len(xyz) < 3:
        return own_up, 0.0
    rng = np.random.default_rng(seed)
    sample = xyz if len(xyz) <= 10_000 else xyz[rng.choice(len(xyz), 10_000, replace=False)]
    normals, offsets = _patches(sample, rng)
    toward_cameras = np.sign(normals @ centres.mean(axis=0) - offsets)
    normals, offsets = normals * toward_cameras[:, None], offsets * toward_cameras
    level = normals @ own_up > np.cos(np.radians(TILT_DEG))
    normals, offsets = normals[level], offsets[level]
    if not len(normals):
        return own_up, 0.0
    shares = [_share(sample @ n - d) for n, d in zip(normals, offsets, strict=True)]
    up, offset = normals[int(np.argmax(shares))], offsets[int(np.argmax(shares))]
    for _ in range(5):  # least squares on what the slab holds moves the slab a little
        on = xyz[np.abs(xyz @ up - offset) < SLAB_M]
        middle = on.mean(axis=0)
        normal = np.linalg.eigh((on - middle).T @ (on - middle))[1][:, 0]
        up = normal * np.sign(normal @ up)
        offset = float(middle @ up)
    share = _share(xyz @ up - offset)
    return (up, share) if share >= SHARE else (own_up, 0.0)


def _share(height_m: Array) -> float:
    """Share of points in a slab, less what the slabs above and below it hold on the average."""
    off = np.abs(height_m)
    return float(np.mean(off < SLAB_M) - 0.5 * np.mean((off >= SLAB_M) & (off < 3 * SLAB_M)))


def _patches(xyz: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Planes n @ x = d through random triples of neighbours: unit n (T, 3), d (T,) m."""
    p = xyz[rng.integers(len(xyz), size=TRIALS)]
    tree = cKDTree(xyz)
    q, r = (xyz[tree.query(p + rng.normal(0.0, PATCH_M, p.shape))[1]] for _ in range(2))
    normals = np.cross(q - p, r - p)
    length = np.linalg.norm(normals, axis=1)
    proper = length > 1e-4  # m^2, twice the triangle's area: 1 cm by 1 cm
    normals = normals[proper] / length[proper, None]
    return normals, np.einsum("ij,ij->i", normals, p[proper])
