"""Corridors of points for tests of localization: what a camera sees of them is made up, without images.

A point has a descriptor, and a size that decides the pyramid level at which it is seen from a distance. A stretch of
the corridor may be redecorated after it was mapped: there the map's points are gone and others are seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lodelight.features.features import Features
from lodelight.features.orb import OrbConfig
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.mapping.map import Map
from lodelight.rig import CameraSpec, Rig

ORB = OrbConfig()
LENGTH_M, WIDTH_M, HEIGHT_M = 24.0, 3.0, 2.6
AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # camera axes in a body x forward, z up
MAPPING_LENS = Camera.create("radtan", 640, 480, (380.0, 381.0, 322.0, 241.0), (-0.28, 0.07))
OTHER_LENS = Camera.create("equidistant", 800, 600, (470.0, 471.0, 398.0, 301.0), (-0.01, 0.002))
TILTED = SE3(AHEAD, np.array([0.0, -0.04, 0.03])) @ SE3.exp(np.array([0.02, 0.03, -0.01, 0.0, 0.0, 0.0]))
MAPPING = Rig((CameraSpec("cam0", MAPPING_LENS, SE3(AHEAD, np.array([0.1, 0.05, 0.0])), 15.0),))
OTHER = Rig((CameraSpec("cam0", OTHER_LENS, TILTED, 10.0),))
NOISE_PX = 0.5  # of a corner at the finest octave
FLIPPED = 0.06  # share of a descriptor's bits that change from view to view


@dataclass(frozen=True, eq=False)
class Corridor:
    """xyz (N, 3) m; desc (N, 4); size (N,) px m: its diameter in the mapping camera from a metre away"""

    xyz: np.ndarray
    desc: np.ndarray
    size: np.ndarray

    @staticmethod
    def built(seed: int, count: int = 3000) -> Corridor:
        """A straight corridor along x with points on both walls, floor and ceiling, and its end."""
        rng = np.random.default_rng(seed)
        side = rng.integers(0, 4, count)
        x, a = rng.uniform(0.0, LENGTH_M, count), rng.uniform(-0.5, 0.5, count)
        y = np.where(side < 2, (side - 0.5) * WIDTH_M, a * WIDTH_M)
        z = np.where(side < 2, (a + 0.5) * HEIGHT_M, (side - 2.0) * HEIGHT_M)
        at_end = rng.random(count) < 0.08
        x = np.where(at_end, LENGTH_M, x)
        y = np.where(at_end, rng.uniform(-0.5, 0.5, count) * WIDTH_M, y)
        z = np.where(at_end, rng.uniform(0.0, HEIGHT_M, count), z)
        desc = rng.integers(0, 2**64, (count, 4), dtype=np.uint64)
        return Corridor(np.column_stack([x, y, z]), desc, np.exp(rng.uniform(np.log(1.5), np.log(8.0), count)))

    def redecorated(self, start_m: float, end_m: float, seed: int) -> Corridor:
        """Between two places, other points."""
        other = Corridor.built(seed, len(self.xyz))
        keep = (self.xyz[:, 0] < start_m) | (self.xyz[:, 0] > end_m)
        new = (other.xyz[:, 0] >= start_m) & (other.xyz[:, 0] <= end_m)
        return Corridor(*(np.concatenate([getattr(self, n)[keep], getattr(other, n)[new]]) for n in vars(self)))

    def seen(self, rig: Rig, T_world_body: SE3, rng: np.random.Generator) -> tuple[Features, np.ndarray]:
        """What camera 0 sees from a pose, at most 800 corners, and which point each is."""
        spec = rig.cameras[0]
        X = (T_world_body @ spec.T_body_cam).inverse() @ self.xyz
        distance = np.linalg.norm(X, axis=1)
        zoom = spec.camera.focal_px / MAPPING.cameras[0].camera.focal_px
        octave = np.rint(np.log(np.maximum(zoom * self.size / distance, 1e-9)) / np.log(ORB.scale_factor)).astype(int)
        px, inside = spec.camera.project(X)
        rows = np.flatnonzero(inside & (X[:, 2] > 0.3) & (octave >= 0) & (octave < ORB.n_levels))
        rows = np.sort(rng.permutation(rows)[:800])
        n, octave = len(rows), octave[rows].astype(np.int32)
        px = px[rows] + NOISE_PX * ORB.scale(octave)[:, None] * rng.normal(size=(n, 2))
        bits = rng.random((n, 256)) < FLIPPED
        flips = np.packbits(bits, axis=1, bitorder="little").view(np.uint64)
        ray, ok = spec.camera.unproject(px)
        none = np.zeros(n, np.float32)
        features = Features(px.astype(np.float32), octave, none, self.desc[rows] ^ flips, ray, none, none)
        return features.take(ok), rows[ok]

    def mapped(self, seed: int = 0, step_m: float = 0.5) -> Map:
        """A map by `MAPPING`, walking from the start to near the end, exact but for the corners' noise."""
        rng, map = np.random.default_rng(seed), Map(MAPPING)
        point_of = np.full(len(self.xyz), -1, np.int32)
        for k, x in enumerate(np.arange(0.5, LENGTH_M - 2.0, step_m)):
            T_world_body = walk(x)
            seen, rows = self.seen(MAPPING, T_world_body, rng)
            keyframe = map.add_keyframe(k * 10**9, T_world_body, seen, parent=k - 1)
            feature = np.arange(map.feature_range(keyframe).start, map.feature_range(keyframe).stop, dtype=np.int32)
            new = point_of[rows] < 0
            point_of[rows[new]] = map.add_points(self.xyz[rows[new]], feature[new], keyframe)
            map.link(feature[~new], point_of[rows[~new]])
        map.refresh_points(map.alive_points, ORB.scale_factor, ORB.n_levels)
        return map


def walk(x_m: float, side_m: float = 0.0, yaw: float = 0.0) -> SE3:
    """T_world_body in the corridor: eyes at 1.4 m, swaying a little."""
    y, z = side_m + 0.08 * np.sin(1.3 * x_m), 1.4 + 0.03 * np.cos(2.1 * x_m)
    return SE3.exp(np.array([0.0, 0.0, yaw + 0.06 * np.sin(0.9 * x_m), x_m, y, z]))
