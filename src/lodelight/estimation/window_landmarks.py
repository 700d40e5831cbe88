"""Landmarks of the sliding window: into the frame that saw them first, and back into the world."""

import math

import numpy as np

from lodelight.compiled import kernel
from lodelight.estimation.window_poses import load_pose
from lodelight.geometry.dense import matmul
from lodelight.types import Array, Bools, Ints


@kernel
def place_landmarks(
    x: Array, motion: Array, models: Ints, mount: Array, offset_s: float, rays: Array, start: Ints, frame: Ints,
    camera: Ints, inv_depth: Array, shift_s: Array, world: Array, known: Bools, default: float,
    base: Array, landmark: Array, parallax: Array,
) -> None:  # fmt: skip
    """Put every landmark into the frame of its first observation: fill base (M, 3, 3) and landmark (M, 3).

    world (M, 4) : homogeneous point (Y, lambda) of those known from before; the others are triangulated along the ray
    of their first observation. rays (N, 3) : unit, camera frame; parallax (M,) : root of the sum of squared sines
    """
    Ri, pi, Rj, pj, d = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty(3), np.empty(3)
    A, b = np.empty(3), np.empty(3)
    none = np.zeros((max(1, mount.shape[0]), 6))
    Rc, pc, Rci, pci = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty(3)
    for m in range(len(start) - 1):
        first = start[m]
        load_pose(x, frame[first], motion, offset_s + shift_s[first], Ri, pi)
        load_pose(mount, camera[first], none, 0.0, Rci, pci)
        R_anchor = matmul(Ri, Rci)  # the anchor camera in the world
        p_anchor = np.empty(3)
        for a in range(3):
            p_anchor[a] = pi[a]
            for c in range(3):
                p_anchor[a] += Ri[a, c] * pci[c]
        lam = 0.0
        behind = True
        if known[m]:
            norm = 0.0
            for a in range(3):
                d[a] = 0.0
                for c in range(3):
                    d[a] += R_anchor[c, a] * (world[m, c] - world[m, 3] * p_anchor[c])
                norm += d[a] * d[a]
            norm = math.sqrt(norm)
            lam = world[m, 3] / norm if norm > 0.0 else 0.0
            toward = 0.0
            for a in range(3):
                d[a] = d[a] / norm if norm > 0.0 else 0.0
                toward += d[a] * rays[first, a]
            behind = toward < 0.9
        numerator = denominator = 0.0
        for a in range(3):
            d[a] = rays[first, a] if behind else d[a]
        for o in range(first, start[m + 1]):
            load_pose(x, frame[o], motion, offset_s + shift_s[o], Rj, pj)
            load_pose(mount, camera[o], none, 0.0, Rc, pc)
            R_cam = matmul(Rj, Rc)
            # (A + lambda b) x ray = 0
            for a in range(3):
                A[a], b[a] = 0.0, 0.0
            for c in range(3):
                in_world, arm = 0.0, p_anchor[c] - pj[c]
                for a in range(3):
                    in_world += R_anchor[c, a] * d[a]
                    arm -= Rj[c, a] * pc[a]
                for a in range(3):
                    A[a] += R_cam[c, a] * in_world
                    b[a] += R_cam[c, a] * arm
            if inv_depth[o] > 0.0 and o == first and behind:
                lam = inv_depth[o] * rays[o, 2]
                numerator, denominator = lam * 1e6, 1e6
            ax = A[1] * rays[o, 2] - A[2] * rays[o, 1]
            ay = A[2] * rays[o, 0] - A[0] * rays[o, 2]
            az = A[0] * rays[o, 1] - A[1] * rays[o, 0]
            bx = b[1] * rays[o, 2] - b[2] * rays[o, 1]
            by = b[2] * rays[o, 0] - b[0] * rays[o, 2]
            bz = b[0] * rays[o, 1] - b[1] * rays[o, 0]
            numerator -= ax * bx + ay * by + az * bz
            denominator += bx * bx + by * by + bz * bz
        parallax[m] = math.sqrt(denominator) * abs(lam if not behind else default)
        if behind:
            # 1 cm of base is 3 px at a metre: less says nothing
            lam = numerator / denominator if denominator > 1e-4 else default
            lam = min(max(lam, 0.01), 5.0)
            parallax[m] = math.sqrt(denominator) * lam
        # t1, t2 : square to d, from the axis that d is least along
        least = 0
        for a in range(1, 3):
            if abs(d[a]) < abs(d[least]):
                least = a
        norm = math.sqrt(1.0 - d[least] * d[least])
        for a in range(3):
            base[m, a, 0] = ((1.0 if a == least else 0.0) - d[least] * d[a]) / norm
            base[m, a, 2] = d[a]
        for a in range(3):
            u, v = (a + 1) % 3, (a + 2) % 3
            base[m, a, 1] = d[u] * base[m, v, 0] - d[v] * base[m, u, 0]
        landmark[m, 0], landmark[m, 1], landmark[m, 2] = 0.0, 0.0, lam


@kernel
def world_landmarks(
    x: Array, motion: Array, mount: Array, offset_s: float, start: Ints, frame: Ints, camera: Ints, shift_s: Array,
    base: Array, landmark: Array, out: Array,
) -> None:  # fmt: skip
    """Fill out (M, 4), homogeneous points of the world."""
    R, p, Rc, pc, d = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty(3), np.empty(3)
    none = np.zeros((max(1, mount.shape[0]), 6))
    for m in range(len(start) - 1):
        first = start[m]
        load_pose(x, frame[first], motion, offset_s + shift_s[first], R, p)
        load_pose(mount, camera[first], none, 0.0, Rc, pc)
        lam = landmark[m, 2]
        for a in range(3):
            d[a] = base[m, a, 0] * landmark[m, 0] + base[m, a, 1] * landmark[m, 1] + base[m, a, 2]
        for a in range(3):
            out[m, a] = lam * p[a]
            for c in range(3):
                body = lam * pc[c]
                for e in range(3):
                    body += Rc[c, e] * d[e]
                out[m, a] += R[a, c] * body
        out[m, 3] = lam
