"""Normal equations of the sliding window: landmarks and the frames that see them."""

import math

import numpy as np

from lodelight.compiled import kernel
from lodelight.estimation.factors.inverse_depth import inverse_depth_jacobian, inverse_depth_residual
from lodelight.estimation.factors.reprojection import CHI2_PX, CHI2_PX_DEPTH
from lodelight.estimation.robust import fading
from lodelight.estimation.window_poses import load_pose, turned_back
from lodelight.types import Array, Bools, Ints

# Sigma of the inverse depth of any point indoors, 1/m, about that of the others around: hands and table tops come as
# near as 0.2 m, and a tighter one bends the scale of a start next to them. It keeps points that are seen
# under no parallax from falling into the camera while a start is still unsure of its speed.
SIGMA_INV_DEPTH = 5.0
# No point is farther, and none lies beyond infinity: a scene seen the wrong way round, with the motion turned about,
# fits the images as well while the IMU is unsure.
LEAST_INV_DEPTH = 0.005


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
                turned_back(J_own, 0, motion, anchor, tau_i)
            if j != anchor and tau_j != 0.0:
                turned_back(J_own, 6, motion, j, tau_j)
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
