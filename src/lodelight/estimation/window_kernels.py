"""The loops of the sliding window: normal equations of its factors, elimination of landmarks, step.

Order of the unknowns: (v, bg, ba) of every frame, then (theta, p) of every frame, then the mountings of the cameras and
the time offset where they are estimated, then tags. Velocities and biases couple to their neighbours only; first in the
order they are eliminated at little cost, as rows of the factor that are mostly zero are skipped.

First-estimate Jacobians: a state that the prior knows is linearized for ever where the prior was made (`lin`); the
residuals are those of the current state (`x`). Without that, yaw would seem to be measured where it is not (C6).
"""

import math

import numpy as np

from lodelight.compiled import kernel
from lodelight.estimation.factors.inertial import P, V, inertial_jacobian, inertial_residual
from lodelight.estimation.factors.inverse_depth import inverse_depth_jacobian, inverse_depth_residual
from lodelight.estimation.factors.reprojection import CHI2_PX, CHI2_PX_DEPTH
from lodelight.estimation.factors.tag_corners import CHI2_TAG, tag_corner_jacobian, tag_corner_residual
from lodelight.estimation.robust import fading, huber
from lodelight.geometry.dense import inverse3, matmul, transposed
from lodelight.geometry.so3 import so3_exp, so3_log, so3_perturbed
from lodelight.types import Array, Bools, Ints

# Sigma of the inverse depth of any point indoors, 1/m, about that of the others around: hands and table tops come as
# near as 0.2 m, and a tighter one bends the scale of a start next to them. It keeps points that are seen
# under no parallax from falling into the camera while a start is still unsure of its speed.
SIGMA_INV_DEPTH = 5.0
# No point is farther, and none lies beyond infinity: a scene seen the wrong way round, with the motion turned about,
# fits the images as well while the IMU is unsure.
LEAST_INV_DEPTH = 0.005


@kernel
def load_pose(x: Array, f: int, motion: Array, tau: float, R: Array, p: Array) -> None:
    """R, p of row f of x, carried on by tau seconds at the angular rate and velocity in motion (F, 6)."""
    for a in range(3):
        p[a] = x[f, 9 + a] + tau * motion[f, 3 + a]
        for b in range(3):
            R[a, b] = x[f, 3 * a + b]
    if tau != 0.0:
        w = np.empty(3)
        for a in range(3):
            w[a] = tau * motion[f, a]
        turned = matmul(R, so3_exp(w))
        for a in range(3):
            for b in range(3):
                R[a, b] = turned[a, b]


@kernel
def _turned_back(J: Array, at: int, motion: Array, f: int, tau: float) -> None:
    """Columns of the rotation at the exposure become those of the rotation at the frame's stamp."""
    w = np.empty(3)
    for a in range(3):
        w[a] = tau * motion[f, a]
    turn = so3_exp(w)
    for row in range(J.shape[0]):
        j0, j1, j2 = J[row, at], J[row, at + 1], J[row, at + 2]
        for b in range(3):
            J[row, at + b] = j0 * turn[b, 0] + j1 * turn[b, 1] + j2 * turn[b, 2]


@kernel
def _add_block(
    J: Array, at: int, width: int, base: int, sign: float, compact: Array, bases: Ints, widths: Ints, n: int
) -> int:
    """Add columns `at` to at + width of J (3, n), times sign, to the block of compact that stands for the unknowns from
    `base` on; returns how many blocks compact has now. The third row is held against nothing: only a sign of + has it.
    """
    k = 0
    while k < n and bases[k] != base:
        k += 1
    if k == n:
        bases[n], widths[n] = base, width
        n += 1
        for row in range(3):
            for c in range(width):
                compact[row, 6 * k + c] = 0.0
    for c in range(width):
        compact[0, 6 * k + c] += sign * J[0, at + c]
        compact[1, 6 * k + c] += sign * J[1, at + c]
        if sign > 0.0:
            compact[2, 6 * k + c] += J[2, at + c]
    return n


@kernel
def _add_sighting(
    J: Array, sign: float, frame: int, anchor: int, camera: int, camera_anchor: int, pose_at: int, mount_at: int,
    offset_at: int, compact: Array, bases: Ints, widths: Ints, n: int,
) -> int:  # fmt: skip
    """Add one sighting's derivatives to its unknowns; those of the landmark are dealt with elsewhere."""
    if frame != anchor:
        n = _add_block(J, 0, 6, pose_at + 6 * anchor, sign, compact, bases, widths, n)
        n = _add_block(J, 6, 6, pose_at + 6 * frame, sign, compact, bases, widths, n)
        if offset_at >= 0:
            n = _add_block(J, 27, 1, offset_at, sign, compact, bases, widths, n)
    # at the anchor's own pixel neither poses nor mountings have a say
    if mount_at >= 0 and (frame != anchor or camera != camera_anchor):
        n = _add_block(J, 15, 6, mount_at + 6 * camera_anchor, sign, compact, bases, widths, n)
        n = _add_block(J, 21, 6, mount_at + 6 * camera, sign, compact, bases, widths, n)
    return n


@kernel
def _add_products(
    compact: Array, weighted: Array, bases: Ints, widths: Ints, n: int, rows: int, H: Array
) -> None:  # fmt: skip
    """H += compact^T weighted over its blocks, those of the lower half left out."""
    for x in range(n):
        for y in range(n):
            if bases[y] < bases[x]:
                continue
            low, high = bases[x], bases[y]
            for i in range(widths[x]):
                j0, j1 = weighted[0, 6 * x + i], weighted[1, 6 * x + i]
                if rows == 3:
                    j2 = weighted[2, 6 * x + i]
                    for j in range(widths[y]):
                        H[low + i, high + j] += (
                            j0 * compact[0, 6 * y + j] + j1 * compact[1, 6 * y + j] + j2 * compact[2, 6 * y + j]
                        )
                elif widths[y] == 6:
                    for j in range(6):
                        H[low + i, high + j] += j0 * compact[0, 6 * y + j] + j1 * compact[1, 6 * y + j]
                else:
                    H[low + i, high] += j0 * compact[0, 6 * y] + j1 * compact[1, 6 * y]


@kernel
def visual_terms(
    x: Array, lin: Array, motion: Array, models: Ints, params: Array, mount: Array, mount_lin: Array,
    offset_s: float, base: Array, landmark: Array, start: Ints, frame: Ints, camera: Ints, before_row: Ints, px: Array,
    sigma_px: Array, inv_depth: Array, sigma_inv_depth: Array, shift_s: Array, active: Bools, robust: bool,
    before: Array, usual_inv_depth: float, pose_at: int, mount_at: int, offset_at: int, normal: bool,
    H: Array, g: Array, V_out: Array, g_landmark: Array, W: Array, chi2: Array,
) -> tuple[float, float]:  # fmt: skip
    """Add the observations to H (n, n) upper half and g (n,); fill V (M, 6) lower half, g_landmark (M, 3),
    W (M, 3, columns from pose_at on) and chi2 (N,).

    mount_at, offset_at : columns, -1 where not estimated; normal False : only chi2 and the costs are wanted
    Returns the cost, and the cost comparable with the state that had chi-squares `before`.
    """
    Ri, pi, Rj, pj = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty(3)
    Li, li, Lj, lj = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty(3)
    Rci, pci, Rcj, pcj = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty(3)
    Lci, lci, Lcj, lcj = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty(3)
    here, place, lens = np.empty((3, 3)), np.empty(3), np.empty(params.shape[1])
    most = 1
    for m in range(len(start) - 1):
        most = max(most, start[m + 1] - start[m])
    r_all, r_row, J_all = np.zeros((most, 3)), np.zeros((most, 3)), np.zeros((most, 3, 28))
    good, n_rows, weights = np.zeros(most, np.bool_), np.zeros(most, np.int64), np.zeros(most)
    r, E, r_own, J_own = np.zeros(3), np.empty((2, 3)), np.zeros(3), np.empty((3, 27))
    compact, weighted, J_landmark = np.zeros((3, 48)), np.zeros((3, 48)), np.empty((3, 3))
    bases, widths = np.empty(8, np.int32), np.empty(8, np.int32)
    still = np.zeros((mount.shape[0], 6))
    if normal:
        V_out[:] = 0.0
        g_landmark[:] = 0.0
        W[:] = 0.0
    cost = comparable = 0.0
    for m in range(len(start) - 1):
        first = start[m]
        anchor, ci = frame[first], camera[first]
        tau_i = offset_s + shift_s[first]
        load_pose(x, anchor, motion, tau_i, Ri, pi)
        load_pose(lin, anchor, motion, tau_i, Li, li)
        load_pose(mount, ci, still, 0.0, Rci, pci)
        load_pose(mount_lin, ci, still, 0.0, Lci, lci)
        for a in range(3):  # a copy costs less than a view, which counts its references
            place[a] = landmark[m, a]
            for b in range(3):
                here[a, b] = base[m, a, b]
        total = total_comparable = 0.0
        measured = -3
        for o in range(first, start[m + 1]):
            k, back = o - first, before_row[o] - first
            j, cj = frame[o], camera[o]
            load_pose(x, j, motion, offset_s + shift_s[o], Rj, pj)
            load_pose(mount, cj, still, 0.0, Rcj, pcj)
            for a in range(len(lens)):
                lens[a] = params[cj, a]
            rows = inverse_depth_residual(
                models[cj], lens, Ri, pi, Rci, pci, Rj, pj, Rcj, pcj, here, place,
                px[o, 0], px[o, 1], 1.0, inv_depth[o], sigma_inv_depth[o], r_own,
            )  # fmt: skip
            good[k] = rows > 0
            if rows > 0:
                for row in range(3):
                    r_all[k, row] = r_own[row]
            if before_row[o] >= 0 and not good[back]:
                rows = 0
            n_rows[k] = rows
            bound = CHI2_PX_DEPTH if inv_depth[o] > 0.0 else CHI2_PX
            weights[k] = 0.0
            if rows == 0:
                chi2[o] = math.inf
                if active[o] and before[o] < math.inf:
                    total_comparable += fading(before[o], bound)[0] if robust else before[o]
                continue
            scale = 1.0 / sigma_px[o]
            r_row[k, 0], r_row[k, 1], r_row[k, 2] = scale * r_all[k, 0], scale * r_all[k, 1], r_all[k, 2]
            if before_row[o] >= 0:
                r_row[k, 0] -= scale * r_all[back, 0]
                r_row[k, 1] -= scale * r_all[back, 1]
            was = before[o]
            chi2[o] = r_row[k, 0] ** 2 + r_row[k, 1] ** 2 + r_row[k, 2] ** 2
            if not active[o]:
                continue
            value, weights[k] = fading(chi2[o], bound) if robust else (chi2[o], 1.0)
            total += value
            measured += rows
            if was < math.inf:
                total_comparable += value
        whole = 1.0
        if robust and measured > 0:
            # 95 % of a chi-square distribution, by Wilson and Hilferty
            spread = 2.0 / (9.0 * measured)
            bound = measured * (1.0 - spread + 1.645 * math.sqrt(spread)) ** 3
            total, whole = fading(total, bound)
            total_comparable = fading(total_comparable, bound)[0]
        cost += total
        comparable += total_comparable
        for o in range(first, start[m + 1] if normal else first):
            k, back = o - first, before_row[o] - first
            if not good[k]:
                continue
            j, cj = frame[o], camera[o]
            tau_j = offset_s + shift_s[o]
            load_pose(lin, j, motion, tau_j, Lj, lj)
            load_pose(mount_lin, cj, still, 0.0, Lcj, lcj)
            for a in range(len(lens)):
                lens[a] = params[cj, a]
            good[k] = inverse_depth_jacobian(
                models[cj], lens, Li, li, Lci, lci, Lj, lj, Lcj, lcj, here, place,
                1.0, inv_depth[o], sigma_inv_depth[o], E, J_own,
            )  # fmt: skip
            if not good[k]:
                continue
            if j != anchor and tau_i != 0.0:
                _turned_back(J_own, 0, motion, anchor, tau_i)
            if j != anchor and tau_j != 0.0:
                _turned_back(J_own, 6, motion, j, tau_j)
            for row in range(3):
                for a in range(27):
                    J_all[k, row, a] = J_own[row, a]
            if offset_at >= 0:
                for row in range(3):
                    s = 0.0
                    for a in range(3):
                        s += J_own[row, a] * motion[anchor, a] + J_own[row, 3 + a] * motion[anchor, 3 + a]
                        s += J_own[row, 6 + a] * motion[j, a] + J_own[row, 9 + a] * motion[j, 3 + a]
                    J_all[k, row, 27] = s
            weight, rows = whole * weights[k], n_rows[k]
            if weight == 0.0 or (before_row[o] >= 0 and not good[back]):
                continue
            scale = 1.0 / sigma_px[o]
            for row in range(3):
                r[row] = r_row[k, row]
            for row in range(3):
                for a in range(3):
                    J_landmark[row, a] = J_all[k, row, 12 + a]
            n = _add_sighting(
                J_all[k], 1.0, j, anchor, cj, ci, pose_at, mount_at, offset_at, compact, bases, widths, 0
            )  # fmt: skip
            if before_row[o] >= 0:
                for row in range(2):
                    for a in range(3):
                        J_landmark[row, a] -= J_all[back, row, 12 + a]
                n = _add_sighting(
                    J_all[back], -1.0, frame[first + back], anchor, camera[first + back], ci, pose_at, mount_at,
                    offset_at, compact, bases, widths, n,
                )  # fmt: skip
            for row in range(2):
                for a in range(6 * n):
                    compact[row, a] *= scale
                for a in range(3):
                    J_landmark[row, a] *= scale
            for row in range(rows):
                for a in range(6 * n):
                    weighted[row, a] = weight * compact[row, a]
            _add_products(compact, weighted, bases, widths, n, rows, H)
            for x_block in range(n):
                for i in range(widths[x_block]):
                    a = 6 * x_block + i
                    at = bases[x_block] + i
                    j0, j1 = weighted[0, a], weighted[1, a]
                    j2 = weighted[2, a] if rows == 3 else 0.0
                    g[at] += j0 * r[0] + j1 * r[1] + j2 * r[2]
                    at -= pose_at
                    for b in range(3):
                        W[m, b, at] += j0 * J_landmark[0, b] + j1 * J_landmark[1, b] + j2 * J_landmark[2, b]
            slot = 0
            for a in range(3):
                j0, j1, j2 = weight * J_landmark[0, a], weight * J_landmark[1, a], weight * J_landmark[2, a]
                g_landmark[m, a] += j0 * r[0] + j1 * r[1] + j2 * r[2]
                for b in range(a + 1):
                    V_out[m, slot] += j0 * J_landmark[0, b] + j1 * J_landmark[1, b] + j2 * J_landmark[2, b]
                    slot += 1
        unusual = (landmark[m, 2] - usual_inv_depth) / SIGMA_INV_DEPTH
        cost += unusual * unusual
        comparable += unusual * unusual
        if not normal:
            continue
        V_out[m, 5] += 1.0 / (SIGMA_INV_DEPTH * SIGMA_INV_DEPTH)
        g_landmark[m, 2] += unusual / SIGMA_INV_DEPTH
        if landmark[m, 2] <= LEAST_INV_DEPTH and g_landmark[m, 2] > 0.0:  # held at its bound
            g_landmark[m, 2] = V_out[m, 3] = V_out[m, 4] = 0.0
            for a in range(W.shape[2]):
                W[m, 2, a] = 0.0
    return cost, comparable


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
                _turned_back(J2, 0, motion, f, tau)
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


@kernel
def chart_difference(x: Array, lin: Array, out: Array) -> None:
    """out (F, 15) = (theta, p, v, bg, ba) of x (F, 21) from lin; rows of 12, a pose alone, fill out (F, 6)."""
    R, L = np.empty((3, 3)), np.empty((3, 3))
    for f in range(x.shape[0]):
        for a in range(9):
            R[a // 3, a % 3], L[a // 3, a % 3] = x[f, a], lin[f, a]
        w = so3_log(matmul(transposed(L), R))
        for a in range(3):
            out[f, a] = w[a]
        for a in range(9, x.shape[1]):
            out[f, a - 6] = x[f, a] - lin[f, a]


@kernel
def eliminate_landmarks(
    damping: float, start: Ints, frame: Ints, pose_at: int, extra: int, frames: int,
    V_in: Array, g_landmark: Array, W: Array, V_inverse: Array, S: Array, b: Array,
) -> None:  # fmt: skip
    """S (n, n) -= W V^-1 W^T in its upper half, b (n,) -= W V^-1 g_landmark.

    extra : columns after those of the `frames` poses that any landmark may touch
    """
    column = np.empty(W.shape[2], np.int64)
    Y, Wc, seen = np.empty((W.shape[2], 3)), np.empty((3, W.shape[2])), np.zeros(frames, np.bool_)
    more = 1.0 + damping
    for m in range(len(start) - 1):
        v = inverse3(V_in[m, 0] * more, V_in[m, 1], V_in[m, 2] * more, V_in[m, 3], V_in[m, 4], V_in[m, 5] * more)
        for c in range(6):
            V_inverse[m, c] = v[c]
        seen[:] = False
        for o in range(start[m], start[m + 1]):
            seen[frame[o]] = True
        n = 0
        for f in range(frames):
            if seen[f]:
                for a in range(6):
                    column[n] = 6 * f + a
                    n += 1
        for a in range(extra):
            column[n] = 6 * frames + a
            n += 1
        for a in range(n):
            w0, w1, w2 = W[m, 0, column[a]], W[m, 1, column[a]], W[m, 2, column[a]]
            Wc[0, a], Wc[1, a], Wc[2, a] = w0, w1, w2
            y0 = w0 * v[0] + w1 * v[1] + w2 * v[3]
            y1 = w0 * v[1] + w1 * v[2] + w2 * v[4]
            y2 = w0 * v[3] + w1 * v[4] + w2 * v[5]
            Y[a, 0], Y[a, 1], Y[a, 2] = y0, y1, y2
            b[pose_at + column[a]] -= y0 * g_landmark[m, 0] + y1 * g_landmark[m, 1] + y2 * g_landmark[m, 2]
        for a in range(n):
            y0, y1, y2 = Y[a, 0], Y[a, 1], Y[a, 2]
            row = pose_at + column[a]
            for c in range(a, n):
                S[row, pose_at + column[c]] -= y0 * Wc[0, c] + y1 * Wc[1, c] + y2 * Wc[2, c]


@kernel
def factor_rows(S: Array) -> bool:
    """The upper half of S (n, n) becomes U with S = U^T U; False where it is not positive definite.

    By rows, three at a time subtracted from those below: zeros are skipped and the inner loop runs along memory.
    """
    n = S.shape[0]
    for k in range(0, n, 3):
        end = min(k + 3, n)
        for a in range(k, end):
            for r in range(k, a):
                f = S[r, a]
                if f != 0.0:
                    for j in range(a, n):
                        S[a, j] -= f * S[r, j]
            if not S[a, a] > 0.0:
                return False
            inverse = 1.0 / math.sqrt(S[a, a])
            for j in range(a, n):
                S[a, j] *= inverse
        for i in range(end, n):  # only where there are three
            f0, f1, f2 = S[k, i], S[k + 1, i], S[k + 2, i]
            if f0 != 0.0 or f1 != 0.0 or f2 != 0.0:
                for j in range(i, n):
                    S[i, j] -= f0 * S[k, j] + f1 * S[k + 1, j] + f2 * S[k + 2, j]
    return True


@kernel
def solve_rows(U: Array, b: Array) -> None:
    """b (n,) becomes the solution of U^T U x = b."""
    n = U.shape[0]
    for k in range(n):
        b[k] /= U[k, k]
        f = b[k]
        if f != 0.0:
            for j in range(k + 1, n):
                b[j] -= f * U[k, j]
    for k in range(n - 1, -1, -1):
        s = b[k]
        for j in range(k + 1, n):
            s -= U[k, j] * b[j]
        b[k] = s / U[k, k]


@kernel
def step(
    damping: float, x: Array, mount: Array, offset_s: Array, tag: Array, tag_column: Ints, landmark: Array,
    start: Ints, frame: Ints, pose_at: int, mount_at: int, offset_at: int, extra: int,
    H: Array, g: Array, V_in: Array, g_landmark: Array, W: Array, V_inverse: Array, S: Array,
    x_new: Array, mount_new: Array, offset_new: Array, tag_new: Array, landmark_new: Array,
) -> float:  # fmt: skip
    """Solve the damped normal equations and move; returns the gain in chi-square promised, -1 if not definite."""
    n, F = len(g), x.shape[0]
    b = np.empty(n)
    for i in range(n):
        b[i] = g[i]
        for j in range(i, n):
            S[i, j] = H[i, j]
        S[i, i] *= 1.0 + damping
    eliminate_landmarks(damping, start, frame, pose_at, extra, F, V_in, g_landmark, W, V_inverse, S, b)
    if not factor_rows(S):
        return -1.0
    for i in range(n):
        b[i] = -b[i]
    solve_rows(S, b)
    gain = 0.0
    for i in range(n):
        gain -= g[i] * b[i]
    d = np.empty(3)
    R = np.empty((3, 3))
    for f in range(F):
        _moved_pose(x, f, b, pose_at + 6 * f, R, d, x_new)
        for a in range(9):
            x_new[f, 12 + a] = x[f, 12 + a] + b[9 * f + a]
    for c in range(mount.shape[0]):
        if mount_at >= 0:
            _moved_pose(mount, c, b, mount_at + 6 * c, R, d, mount_new)
        else:
            mount_new[c] = mount[c]
    offset_new[0] = offset_s[0] + (b[offset_at] if offset_at >= 0 else 0.0)
    for t in range(tag.shape[0]):
        if tag_column[t] >= 0:
            _moved_pose(tag, t, b, tag_column[t], R, d, tag_new)
        else:
            tag_new[t] = tag[t]
    for m in range(len(start) - 1):
        y0, y1, y2 = -g_landmark[m, 0], -g_landmark[m, 1], -g_landmark[m, 2]
        for a in range(W.shape[2]):
            f = b[pose_at + a]
            y0 -= W[m, 0, a] * f
            y1 -= W[m, 1, a] * f
            y2 -= W[m, 2, a] * f
        v = V_inverse[m]
        d0 = v[0] * y0 + v[1] * y1 + v[3] * y2
        d1 = v[1] * y0 + v[2] * y1 + v[4] * y2
        d2 = v[3] * y0 + v[4] * y1 + v[5] * y2
        gain -= g_landmark[m, 0] * d0 + g_landmark[m, 1] * d1 + g_landmark[m, 2] * d2
        landmark_new[m, 0] = landmark[m, 0] + d0
        landmark_new[m, 1] = landmark[m, 1] + d1
        landmark_new[m, 2] = max(landmark[m, 2] + d2, LEAST_INV_DEPTH)
    return gain


@kernel
def _moved_pose(x: Array, f: int, b: Array, at: int, R: Array, d: Array, out: Array) -> None:
    for a in range(3):
        d[a] = b[at + a]
        out[f, 9 + a] = x[f, 9 + a] + b[at + 3 + a]
        for c in range(3):
            R[a, c] = x[f, 3 * a + c]
    turned = so3_perturbed(R, d)
    for a in range(3):
        for c in range(3):
            out[f, 3 * a + c] = turned[a, c]


@kernel
def marginal_covariance(U: Array, columns: Ints) -> Array:
    """Block of (U^T U)^-1 at `columns` (q,)."""
    q, n = len(columns), U.shape[0]
    out, b = np.empty((q, q)), np.empty(n)
    for i in range(q):
        b[:] = 0.0
        b[columns[i]] = 1.0
        solve_rows(U, b)
        for j in range(q):
            out[i, j] = b[columns[j]]
    return out


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
