"""What a camera sees of a scene: radiance, depth and quad per pixel, exact for any lens and row by row.

The image is cut into tiles. For each, the tree gives the quads its rays may meet, near ones first, and every quad is
tried on all rays of the tile at once, a loop the compiler turns into vector instructions. Where neighbouring pixels
see different quads, eight rays per pixel are averaged.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodelight.compiled import kernel
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.sim.scene import Scene
from lodelight.sim.shade import shade_rays
from lodelight.types import Array, ArrayF32, Bytes, Ints

TILE = 16
SIDE = TILE + 2  # with one pixel around it, to see where quads change
CELL = SIDE * SIDE
SUB = 8  # rays of a pixel on an edge
STACK = 96
EDGE_SLACK_M = 2e-5  # quads reach this much over their edges, so that no ray slips between two neighbours
F0, F1, NEAR = np.float32(0.0), np.float32(1.0), np.float32(1e-3)


@dataclass(frozen=True, eq=False)
class Eye:
    """A lens as a table of rays. rays : (H + 2, W + 2, 3) float32 unit vectors, one pixel beyond the image on all
    sides, 0 where the lens sees nothing."""

    camera: Camera
    rays: ArrayF32

    @staticmethod
    def of(camera: Camera) -> Eye:
        u, v = np.meshgrid(np.arange(-1.0, camera.width + 1), np.arange(-1.0, camera.height + 1))
        rays, seen = camera.unproject(np.stack([u.ravel(), v.ravel()], axis=1))
        rays[~seen] = 0.0
        return Eye(camera, rays.reshape(camera.height + 2, camera.width + 2, 3).astype(np.float32))


@dataclass(frozen=True, eq=False)
class View:
    """image : (H, W) float32 radiance; depth : (H, W) float32 m along z, 0 = nothing; quad : (H, W) int32, -1 = none"""

    image: ArrayF32
    depth: ArrayF32
    quad: Ints


def render(
    scene: Scene, eye: Eye, poses: list[SE3], brightness: Array | None = None, loose: Array | None = None
) -> View:
    """The view from `poses`, T_world_cam: one for a global shutter, or one per row.

    brightness : (H, lamps) factor on each lamp's own radiance while a row is exposed; None = all 1 (or 0 if off)
    loose : (n, 18) where the scene's loose quads are now; None = where they were built
    """
    h, w = eye.camera.height, eye.camera.width
    pick = np.zeros(h + 2, dtype=int) if len(poses) == 1 else np.clip(np.arange(-1, h + 1), 0, h - 1)
    R = np.array([T.R for T in poses])[pick]
    o = np.array([T.t for T in poses])[pick]
    if brightness is None:
        brightness = np.tile([float(lamp.on) for lamp in scene.lamps], (h, 1)).reshape(h, -1)
    view = View(np.zeros((h, w), np.float32), np.zeros((h, w), np.float32), np.full((h, w), -1, np.int32))
    lamps = np.array([[lamp.radiance, lamp.disc, lamp.size_m[0]] for lamp in scene.lamps]).reshape(-1, 3)
    tree = scene.tree
    geometry = scene.geometry if loose is None else np.vstack([scene.geometry[: scene.static], loose])
    _render(
        eye.rays, R, o, tree.boxes, tree.links, tree.order, geometry, scene.static, scene.paint, scene.scale,
        scene.textures.texels, scene.textures.table, scene.light, lamps, brightness, view.image, view.depth, view.quad,
    )  # fmt: skip
    return view


@kernel
def _try_quad(g: Array, q: int, ref: Array, n: int, o: ArrayF32, d: ArrayF32, best: ArrayF32, ids: Ints) -> None:
    """Let quad q shorten the n rays (3, n) that meet it sooner than `best`; positions relative to `ref`."""
    px, py, pz = np.float32(g[0] - ref[0]), np.float32(g[1] - ref[1]), np.float32(g[2] - ref[2])
    nx, ny, nz = np.float32(g[3]), np.float32(g[4]), np.float32(g[5])
    ux, uy, uz = np.float32(g[6]), np.float32(g[7]), np.float32(g[8])
    vx, vy, vz = np.float32(g[9]), np.float32(g[10]), np.float32(g[11])
    eu = np.float32(EDGE_SLACK_M * math.sqrt(g[6] * g[6] + g[7] * g[7] + g[8] * g[8]))
    ev = np.float32(EDGE_SLACK_M * math.sqrt(g[9] * g[9] + g[10] * g[10] + g[11] * g[11]))
    iq = np.int32(q)
    ox, oy, oz, dx, dy, dz = o[0], o[1], o[2], d[0], d[1], d[2]
    for i in range(n):
        rx, ry, rz = ox[i] - px, oy[i] - py, oz[i] - pz
        t = -(nx * rx + ny * ry + nz * rz) / (nx * dx[i] + ny * dy[i] + nz * dz[i])
        hx, hy, hz = rx + t * dx[i], ry + t * dy[i], rz + t * dz[i]
        a = ux * hx + uy * hy + uz * hz
        b = vx * hx + vy * hy + vz * hz
        met = (t > NEAR) & (t < best[i]) & (a >= -eu) & (a <= F1 + eu) & (b >= -ev) & (b <= F1 + ev)
        best[i] = t if met else best[i]
        ids[i] = iq if met else ids[i]


@kernel
def _farthest(best: ArrayF32, n: int) -> float:
    m0 = m1 = m2 = m3 = F0
    for i in range(0, n - n % 4, 4):
        m0, m1 = max(m0, best[i]), max(m1, best[i + 1])
        m2, m3 = max(m2, best[i + 2]), max(m3, best[i + 3])
    for i in range(n - n % 4, n):
        m0 = max(m0, best[i])
    return float(max(max(m0, m1), max(m2, m3)))


@kernel
def _outside(
    planes: Array, apex: Array, lo0: float, lo1: float, lo2: float, hi0: float, hi1: float, hi2: float
) -> bool:
    """Whether a box lies wholly beyond one of the four sides of a tile's pyramid."""
    for k in range(4):
        nx, ny, nz = planes[k, 0], planes[k, 1], planes[k, 2]
        x = (hi0 if nx > 0.0 else lo0) - apex[0]
        y = (hi1 if ny > 0.0 else lo1) - apex[1]
        z = (hi2 if nz > 0.0 else lo2) - apex[2]
        if nx * x + ny * y + nz * z < -2e-3:
            return True
    return False


@kernel
def _quad_outside(planes: Array, apex: Array, g: Array) -> bool:
    for k in range(4):
        nx, ny, nz = planes[k, 0], planes[k, 1], planes[k, 2]
        base = nx * (g[0] - apex[0]) + ny * (g[1] - apex[1]) + nz * (g[2] - apex[2])
        u = nx * g[12] + ny * g[13] + nz * g[14]
        v = nx * g[15] + ny * g[16] + nz * g[17]
        if base + max(u, 0.0) + max(v, 0.0) < -2e-3:
            return True
    return False


@kernel
def _pyramid(d: ArrayF32, planes: Array) -> None:
    """Inward normals of the four sides of the tile whose rays (3, CELL) are d; zeros (no side) where a corner has
    no ray."""
    corner = (0, SIDE - 1, CELL - 1, CELL - SIDE)
    middle = (SIDE // 2) * SIDE + SIDE // 2
    planes[:] = 0.0
    for k in range(4):
        c = corner[k]
        if d[0, c] == F0 and d[1, c] == F0 and d[2, c] == F0:
            return
    for k in range(4):
        c, e = corner[k], corner[(k + 1) % 4]
        x = float(d[1, c]) * d[2, e] - float(d[2, c]) * d[1, e]
        y = float(d[2, c]) * d[0, e] - float(d[0, c]) * d[2, e]
        z = float(d[0, c]) * d[1, e] - float(d[1, c]) * d[0, e]
        s = 1.0 / math.sqrt(x * x + y * y + z * z)
        if x * d[0, middle] + y * d[1, middle] + z * d[2, middle] < 0.0:
            s = -s
        planes[k, 0], planes[k, 1], planes[k, 2] = s * x, s * y, s * z


@kernel
def _box_distance2(b: Array, apex: Array) -> float:
    total = 0.0
    for k in range(3):
        gap = max(0.0, max(b[k] - apex[k], apex[k] - b[3 + k]))
        total += gap * gap
    return total


@kernel
def _gather_hits(
    boxes: Array, links: Ints, order: Ints, geometry: Array, static: int, planes: Array, apex: Array,
    o: ArrayF32, d: ArrayF32, best: ArrayF32, ids: Ints, tried: Ints, stack: Ints, near: Array,
) -> int:  # fmt: skip
    """Nearest hits of a tile's rays into best, ids; returns how many quads were tried, listed in `tried`."""
    count = 0
    for q in range(static, geometry.shape[0]):
        if not _quad_outside(planes, apex, geometry[q]):
            _try_quad(geometry[q], np.int64(q), apex, CELL, o, d, best, ids)
            tried[count] = q
            count += 1
    far = _farthest(best, CELL)
    stack[0], near[0] = 0, 0.0
    top = 1
    while top > 0:
        top -= 1
        node = stack[top]
        if near[top] > far * far:
            continue
        if links[node, 2] < 0:
            left, right = links[node, 0], links[node, 1]
            bl, br = boxes[left], boxes[right]
            dl, dr = _box_distance2(bl, apex), _box_distance2(br, apex)
            see_l = not _outside(planes, apex, bl[0], bl[1], bl[2], bl[3], bl[4], bl[5])
            see_r = not _outside(planes, apex, br[0], br[1], br[2], br[3], br[4], br[5])
            if dl < dr:  # the nearer one on top
                left, right, dl, dr, see_l, see_r = right, left, dr, dl, see_r, see_l
            if see_l:
                stack[top], near[top] = left, dl
                top += 1
            if see_r:
                stack[top], near[top] = right, dr
                top += 1
            continue
        before = count
        for i in range(links[node, 0], links[node, 0] + links[node, 1]):
            q = order[i]
            if not _quad_outside(planes, apex, geometry[q]):
                _try_quad(geometry[q], np.int64(q), apex, CELL, o, d, best, ids)
                tried[count] = q
                count += 1
        if count > before:
            far = _farthest(best, CELL)
    return count


@kernel
def _render(
    rays: ArrayF32, R: Array, origin: Array, boxes: Array, links: Ints, order: Ints, geometry: Array, static: int,
    paint: Ints, scale: ArrayF32, texels: Bytes, table: NDArray[np.int64], light: ArrayF32, lamps: Array,
    brightness: Array, image: ArrayF32, depth: ArrayF32, quad: Ints,
) -> None:  # fmt: skip
    h, w = image.shape
    o, d = np.zeros((3, CELL), np.float32), np.zeros((3, CELL), np.float32)
    best, ids = np.empty(CELL, np.float32), np.empty(CELL, np.int32)
    tried = np.empty(geometry.shape[0], np.int32)
    stack, near, planes = np.empty(STACK, np.int32), np.empty(STACK), np.zeros((4, 3))
    # Rays to be shaded: those of the tile's pixels, then those of its edges
    n = SUB * TILE * TILE
    ray_o, ray_d = np.zeros((3, n), np.float32), np.zeros((3, n), np.float32)
    right, down = np.zeros((3, n), np.float32), np.zeros((3, n), np.float32)
    ray_quad, ray_row, edge = np.empty(n, np.int32), np.empty(n, np.int32), np.empty(n, np.int32)
    ray_best, value, distance = np.empty(n, np.float32), np.empty(n), np.empty(n)
    mine, owner, share = np.empty(SUB, np.int32), np.empty(n, np.int32), np.empty(n)
    # Eight queens: rays of a pixel that share no row, no column and no diagonal
    step_x = (-0.4375, -0.3125, -0.1875, -0.0625, 0.0625, 0.1875, 0.3125, 0.4375)
    step_y = (0.0625, 0.3125, -0.1875, 0.4375, -0.3125, -0.4375, 0.1875, -0.0625)
    for ty in range(0, h, TILE):
        for tx in range(0, w, TILE):
            apex = origin[min(ty + TILE // 2, h + 1)]
            for r in range(SIDE):
                y = min(ty + r, h + 1)
                for c in range(SIDE):
                    x = min(tx + c, w + 1)
                    i = r * SIDE + c
                    for k in range(3):
                        d[k, i] = R[y, k, 0] * rays[y, x, 0] + R[y, k, 1] * rays[y, x, 1] + R[y, k, 2] * rays[y, x, 2]
                        o[k, i] = origin[y, k] - apex[k]
            best[:] = np.inf
            ids[:] = -1
            _pyramid(d, planes)
            count = _gather_hits(
                boxes, links, order, geometry, static, planes, apex, o, d, best, ids, tried, stack, near
            )
            n, edges = 0, 0
            for r in range(1, min(TILE, h - ty) + 1):
                for c in range(1, min(TILE, w - tx) + 1):
                    i = r * SIDE + c
                    q = ids[i]
                    quad[ty + r - 1, tx + c - 1] = q
                    if q != ids[i - 1] or q != ids[i + 1] or q != ids[i - SIDE] or q != ids[i + SIDE]:
                        edge[edges] = i
                        edges += 1
                    if q < 0:
                        continue
                    for k in range(3):
                        ray_o[k, n], ray_d[k, n] = o[k, i], d[k, i]
                        right[k, n], down[k, n] = d[k, i + 1] - d[k, i], d[k, i + SIDE] - d[k, i]
                    ray_quad[n], ray_row[n] = q, ty + r - 1
                    n += 1
            shade_rays(
                np.int64(n), ray_quad, ray_row, ray_o, ray_d, right, down, apex,
                geometry, paint, scale, texels, table, light, lamps, brightness, value, distance,
            )  # fmt: skip
            n = 0
            for y in range(ty, min(ty + TILE, h)):
                for x in range(tx, min(tx + TILE, w)):
                    if quad[y, x] >= 0:
                        image[y, x] = value[n]
                        depth[y, x] = distance[n] * rays[y + 1, x + 1, 2]
                        n += 1
            if edges == 0:
                continue
            for e in range(edges):
                i = edge[e]
                for s in range(SUB):
                    j = SUB * e + s
                    for k in range(3):
                        right[k, j], down[k, j] = d[k, i + 1] - d[k, i], d[k, i + SIDE] - d[k, i]
                        ray_d[k, j] = d[k, i] + step_x[s] * right[k, j] + step_y[s] * down[k, j]
                        ray_o[k, j] = o[k, i]
            n = SUB * edges
            ray_best[:n] = np.inf
            ray_quad[:n] = -1
            for k in range(count):
                _try_quad(geometry[tried[k]], np.int64(tried[k]), apex, n, ray_o, ray_d, ray_best, ray_quad)
            n = 0
            for e in range(edges):  # what a pixel sees of one quad is shaded once, where its rays meet it on average
                i = edge[e]
                for s in range(SUB):
                    mine[s] = ray_quad[SUB * e + s]
                for s in range(SUB):
                    q = mine[s]
                    if q < 0:
                        continue
                    rays_of_q, fx, fy = 0, 0.0, 0.0
                    for other in range(s, SUB):
                        if mine[other] == q:
                            mine[other] = -1
                            rays_of_q, fx, fy = rays_of_q + 1, fx + step_x[other], fy + step_y[other]
                    for k in range(3):
                        right[k, n], down[k, n] = d[k, i + 1] - d[k, i], d[k, i + SIDE] - d[k, i]
                        ray_d[k, n] = d[k, i] + (fx * right[k, n] + fy * down[k, n]) / rays_of_q
                        ray_o[k, n] = o[k, i]
                    ray_quad[n], ray_row[n] = q, ty + i // SIDE - 1
                    owner[n], share[n] = i, rays_of_q / SUB
                    n += 1
            shade_rays(
                np.int64(n), ray_quad, ray_row, ray_o, ray_d, right, down, apex,
                geometry, paint, scale, texels, table, light, lamps, brightness, value, distance,
            )  # fmt: skip
            for e in range(edges):
                image[ty + edge[e] // SIDE - 1, tx + edge[e] % SIDE - 1] = 0.0
            for j in range(n):
                i = owner[j]
                image[ty + i // SIDE - 1, tx + i % SIDE - 1] += value[j] * share[j]
