"""Normal equations of the sliding window: the IMU, standstills, the prior, and tags."""

import math

import numpy as np

from lodelight.compiled import kernel
from lodelight.estimation.factors.inertial import P, V, inertial_jacobian, inertial_residual
from lodelight.estimation.factors.tag_corners import CHI2_TAG, tag_corner_jacobian, tag_corner_residual
from lodelight.estimation.robust import huber
from lodelight.estimation.window_poses import load_pose, turned_back
from lodelight.types import Array, Bools, Ints


@kernel
def state_terms(
    x: Array, lin: Array, measured: Array, whiten: Array, use: Bools, still_sigma: Array,
    still_sigma_m: float,
    prior_at: Ints, prior_H: Array, prior_g: Array, delta: Array,
    pose_at: int, normal: bool, H: Array, g: Array,
) -> tuple[float, float]:  # fmt: skip
    """Add the IMU between frames, standstill and the prior; returns their cost, and that of the IMU alone.

    normal False : H and g are not wanted

    measured (F - 1, 76), whiten (F - 1, 15, 15) : L^-1 of the covariance's factor; use (F - 1,)
    still_sigma (F,) m/s : of a velocity of zero, 0 = moving; still_sigma_m : of the way between two such frames
    prior_H (q, q), prior_g (q,) : about lin, unknowns prior_at (q,); delta (q,) : how far x is from lin there
    """
    F = x.shape[0]
    cost = 0.0
    r, r_lin, J, column = np.empty(15), np.empty(15), np.empty((15, 30)), np.empty(30, np.int64)
    white, white_r = np.empty((15, 30)), np.empty(15)
    for k in range(F - 1):
        if not use[k]:
            continue
        inertial_residual(x[k], x[k + 1], measured[k], r)
        for a in range(15):
            white_r[a] = 0.0
            for b in range(a + 1):
                white_r[a] += whiten[k, a, b] * r[b]
            cost += white_r[a] * white_r[a]
        if not normal:
            continue
        inertial_residual(lin[k], lin[k + 1], measured[k], r_lin)
        inertial_jacobian(lin[k], lin[k + 1], measured[k], r_lin, J)
        for s in range(2):
            for a in range(6):
                column[15 * s + a] = pose_at + 6 * (k + s) + a
            for a in range(9):
                column[15 * s + 6 + a] = 9 * (k + s) + a
        white[:] = 0.0
        for a in range(15):
            for b in range(a + 1):
                scale = whiten[k, a, b]
                for c in range(30):
                    white[a, c] += scale * J[b, c]
        for a in range(15):
            for c in range(30):
                scale = white[a, c]
                if scale == 0.0:
                    continue
                at = column[c]
                g[at] += scale * white_r[a]
                for e in range(30):
                    if column[e] >= at:
                        H[at, column[e]] += scale * white[a, e]
    imu_cost = cost
    for f in range(F):
        if still_sigma[f] > 0.0:
            information = 1.0 / (still_sigma[f] * still_sigma[f])
            for a in range(3):
                H[9 * f + a, 9 * f + a] += information
                g[9 * f + a] += information * x[f, V + a]
                cost += information * x[f, V + a] * x[f, V + a]
            if f > 0 and still_sigma[f - 1] > 0.0:  # and it is where it was
                information = 1.0 / (still_sigma_m * still_sigma_m)
                for a in range(3):
                    now, then = pose_at + 6 * f + 3 + a, pose_at + 6 * (f - 1) + 3 + a
                    pull = information * (x[f, P + a] - x[f - 1, P + a])
                    H[then, then] += information
                    H[now, now] += information
                    H[then, now] -= information
                    g[now] += pull
                    g[then] -= pull
                    cost += pull * pull / information
    q = len(prior_at)
    for i in range(q):
        pull = 0.0
        for j in range(q):
            pull += prior_H[i, j] * delta[j]
            if normal and prior_at[j] >= prior_at[i]:
                H[prior_at[i], prior_at[j]] += prior_H[i, j]
        g[prior_at[i]] += prior_g[i] + pull
        cost += delta[i] * (pull + 2.0 * prior_g[i])
    return cost, imu_cost


@kernel
def tag_terms(
    x: Array, lin: Array, motion: Array, models: Ints, params: Array, mount: Array, mount_lin: Array,
    offset_s: float, tag: Array, tag_lin: Array, tag_column: Ints, corners: Array,
    view_tag: Ints, frame: Ints, camera: Ints, px: Array, sigma_px: Array, shift_s: Array, use: Bools,
    pose_at: int, mount_at: int, offset_at: int, H: Array, g: Array, chi2: Array,
) -> float:  # fmt: skip
    """Add sightings of tags: px (S, 4, 2), sigma_px (S, 4); tag (T, 12) poses, tag_column (T,) -1 where surveyed.

    Huber's kernel acts on the eight residuals of a sighting together: a wrong code is wrong in all of its corners.
    """
    R, p, L, lp = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty(3)
    Rc, pc, Lc, lc = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty(3)
    Rt, pt, Lt, lt = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty(3)
    r2, E, J2 = np.empty(2), np.empty((2, 3)), np.empty((2, 18))
    r, J, column = np.zeros(8), np.zeros((8, 19)), np.empty(19, np.int64)
    none = np.zeros((max(1, mount.shape[0], tag.shape[0]), 6))
    lens = np.empty(params.shape[1])
    cost = 0.0
    for s in range(len(frame)):
        f, c, t = frame[s], camera[s], view_tag[s]
        tau = offset_s + shift_s[s]
        load_pose(x, f, motion, tau, R, p)
        load_pose(lin, f, motion, tau, L, lp)
        load_pose(mount, c, none, 0.0, Rc, pc)
        load_pose(mount_lin, c, none, 0.0, Lc, lc)
        load_pose(tag, t, none, 0.0, Rt, pt)
        load_pose(tag_lin, t, none, 0.0, Lt, lt)
        for a in range(len(lens)):
            lens[a] = params[c, a]
        seen = True
        for k in range(4):
            s0, s1, s2 = corners[t, k, 0], corners[t, k, 1], corners[t, k, 2]
            seen = seen and tag_corner_residual(
                models[c], lens, R, p, Rc, pc, Rt, pt, s0, s1, s2, px[s, k, 0], px[s, k, 1], sigma_px[s, k], r2
            )
            seen = seen and tag_corner_jacobian(
                models[c], lens, L, lp, Lc, lc, Lt, lt, s0, s1, s2, sigma_px[s, k], E, J2
            )
            if not seen:
                break
            if tau != 0.0:
                turned_back(J2, 0, motion, f, tau)
            for i in range(2):
                r[2 * k + i] = r2[i]
                for a in range(18):
                    J[2 * k + i, a] = J2[i, a]
                J[2 * k + i, 18] = 0.0
                for a in range(3):
                    J[2 * k + i, 18] += J2[i, a] * motion[f, a] + J2[i, 3 + a] * motion[f, 3 + a]
        chi2[s] = math.inf
        if not seen:
            continue
        chi2[s] = 0.0
        for i in range(8):
            chi2[s] += r[i] * r[i]
        if not use[s]:
            continue
        value, weight = huber(chi2[s], CHI2_TAG)
        cost += value
        for a in range(6):
            column[a] = pose_at + 6 * f + a
            column[6 + a] = tag_column[t] + a if tag_column[t] >= 0 else -1
            column[12 + a] = mount_at + 6 * c + a if mount_at >= 0 else -1
        column[18] = offset_at
        for i in range(8):
            for a in range(19):
                if column[a] < 0:
                    continue
                wj = weight * J[i, a]
                g[column[a]] += wj * r[i]
                for b in range(19):
                    if column[b] >= column[a]:
                        H[column[a], column[b]] += wj * J[i, b]
    return cost
