"""A simulated map of a circular corridor, made by an estimate that drifts."""

from __future__ import annotations

import numpy as np

from lodelight.features.features import Features
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.mapping.loops import LoopCloser
from lodelight.mapping.map import Map
from lodelight.rig import CameraSpec, Rig
from single_frames import ORB

CAMERA = Camera.create("radtan", 640, 480, (400.0, 400.0, 319.5, 239.5))
SIGMA_PX = 0.8
SIGMA_INV_DEPTH = 0.004  # 1/m: a stereo pair of 25 cm, 0.4 px


def flipped(rng, desc, p):
    """Descriptors with every bit turned with probability p."""
    bits = np.unpackbits(desc.view(np.uint8), axis=1)
    return np.packbits(bits ^ (rng.random(bits.shape) < p), axis=1).view(np.uint64)


class Ring:
    """A circular corridor that a camera goes round, looking at its outer wall, while its estimate drifts.

    span, begin : rad it goes, and from where; a little more than once round by default, so that the last keyframes see
        what the first saw
    copied : the wall between 90 and 190 degrees is the one between -40 and 60
    """

    def __init__(self, seed=0, span=2 * np.pi + 0.25, drift_deg=0.12, drift_m=0.01, copied=False, begin=0.0):
        rng = np.random.default_rng(seed)
        n = 4000
        angle, height = rng.uniform(0, 2 * np.pi, n), rng.uniform(-1.6, 1.6, n)
        radius = rng.uniform(7.5, 8.5, n)
        self.xyz = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
        self.desc = rng.integers(0, 2**64, (n, 4), dtype=np.uint64)
        if copied:
            turn = np.radians(130.0)
            away = (angle < np.radians(90.0)) | (angle > np.radians(190.0))
            first = (angle < np.radians(60.0)) | (angle > np.radians(320.0))
            R = np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
            self.xyz = np.concatenate([self.xyz[away], self.xyz[first] @ R.T])
            self.desc = np.concatenate([self.desc[away], self.desc[first]])
        self.truth = [self.pose(a) for a in np.arange(begin, begin + span, 0.12)]
        self.map = Map(Rig((CameraSpec("cam0", CAMERA, SE3.identity()),)))
        estimate, tracked = self.truth[0], {}
        slip = SE3.exp(np.array([0.0, np.radians(drift_deg), 0.0, drift_m, 0.0, 0.0]))
        for k, T_world_body in enumerate(self.truth):
            if k:
                estimate = estimate @ self.truth[k - 1].inverse() @ T_world_body @ slip
            tracked = self._add(rng, k, T_world_body, estimate, tracked)

    @staticmethod
    def pose(angle):
        out, down = np.array([np.cos(angle), np.sin(angle), 0.0]), np.array([0.0, 0.0, -1.0])
        return SE3(np.stack([np.cross(down, out), down, out], axis=1), 5.0 * out)

    def _add(self, rng, k, T_true, T_estimated, tracked):
        """A keyframe; points that the last one saw go on, the others are new. Returns point by landmark."""
        map = self.map
        X = T_true.inverse() @ self.xyz
        px, seen = CAMERA.project(X)
        who = np.flatnonzero(seen & (rng.random(len(px)) < 0.9))
        px = np.clip(px[who] + rng.normal(0, SIGMA_PX, (len(who), 2)), 0.0, (CAMERA.width - 1, CAMERA.height - 1))
        inv_depth = 1.0 / X[who, 2] + rng.normal(0, SIGMA_INV_DEPTH, len(who))
        ray, _ = CAMERA.unproject(px)
        seen = Features(
            px.astype(np.float32), np.zeros(len(who), np.int32), np.zeros(len(who), np.float32),
            flipped(rng, self.desc[who], 0.06), ray, inv_depth.astype(np.float32),
            np.full(len(who), SIGMA_INV_DEPTH, np.float32),
        )  # fmt: skip
        map.add_keyframe(k * 10**9, T_estimated, seen, parent=k - 1)
        rows = map.feature_range(k).start + np.arange(len(who))
        old = np.array([tracked.get(int(w), -1) for w in who], np.int32)
        map.link(rows[old >= 0], old[old >= 0])
        new = old < 0
        xyz = T_estimated @ (ray[new] / (ray[new, 2] * inv_depth[new])[:, None])
        old[new] = map.add_points(xyz, rows[new], k)
        map.refresh_points(old, ORB.scale_factor, ORB.n_levels)
        return dict(zip(who.tolist(), old.tolist(), strict=True))

    def errors_m(self):
        return np.array([np.linalg.norm(self.map.keyframes.p[k] - T.t) for k, T in enumerate(self.truth)])

    def close(self, config=None, keyframes=None):
        """Process keyframes, by default those of the second half: what was closed, and the events."""
        events = []
        closer = LoopCloser(self.map, ORB, config=config, on_event=lambda t_ns, kind, **fields: events.append(fields))
        results = [closer.process(k) for k in keyframes or range(27, len(self.truth))]
        return [r for r in results if r], events
