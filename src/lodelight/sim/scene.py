"""A building ready to be looked at: geometry, paint and light as plain arrays."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lodelight.sim.bvh import Tree, build_tree, geometry_table
from lodelight.sim.materials import Material
from lodelight.sim.mesh import Mesh, Quad
from lodelight.sim.textures import Textures, pack
from lodelight.types import Array, ArrayF32, Ints

LIGHT_PITCH_M = 0.2  # distance of two texels of the light map: soft shadows of furniture, not of pencils
LIGHT_SIDE_MAX = 96

# Columns of Scene.paint
TEXTURE, LIGHT_FIRST, LIGHT_W, LIGHT_H, LAMP, FILLS = range(6)
# Columns of Scene.scale
PERIODS_U, PERIODS_V, SHIFT_U, SHIFT_V, SHADE, WIDTH_M, HEIGHT_M, STAIN, ALBEDO = range(9)


@dataclass(frozen=True, eq=False)
class Lamp:
    """A luminous rectangle or disc under the ceiling.

    center, normal (3,) m; size_m : sides, or the diameter twice for a disc; radiance : arbitrary unit
    frequency_hz : of its code, 0 for a lamp that only hums at twice the mains
    """

    center: Array
    normal: Array
    size_m: tuple[float, float]
    radiance: float
    disc: bool = False
    id: str = ""
    frequency_hz: float = 0.0
    duty: float = 0.5
    phase: float = 0.0
    on: bool = True


@dataclass(frozen=True, eq=False)
class Scene:
    """geometry (n, 18), see bvh; paint (n, 6) int32 and scale (n, 9) float32, columns above

    light : (texels,) float32 irradiance, filled by `lightmap.bake`; the last `loose` quads can move and stand
    outside the tree.
    """

    geometry: Array
    paint: Ints
    scale: ArrayF32
    textures: Textures
    tree: Tree
    lamps: tuple[Lamp, ...]
    light: ArrayF32
    loose: int = 0
    names: tuple[str, ...] = field(default=())

    @property
    def static(self) -> int:
        return len(self.geometry) - self.loose


def assemble(mesh: Mesh, surfaces: dict[str, Material], lamps: list[Lamp], loose: list[Quad] | None = None) -> Scene:
    """Arrays of all quads; only surfaces that are used are packed. `surfaces["stain"]` is laid over everything."""
    quads = mesh.quads + (loose or [])
    used = ["stain", *sorted({q.surface for q in quads} - {"stain"})]
    number = {name: i for i, name in enumerate(used)}
    geometry = geometry_table(*(np.array([getattr(q, part) for q in quads]) for part in ("origin", "u", "v")))
    paint = np.zeros((len(quads), 6), dtype=np.int32)
    scale = np.zeros((len(quads), 9), dtype=np.float32)
    first = 0
    for i, q in enumerate(quads):
        material = surfaces[q.surface]
        size = float(np.linalg.norm(q.u)), float(np.linalg.norm(q.v))
        w, h = (int(np.clip(np.ceil(s / LIGHT_PITCH_M), 1, LIGHT_SIDE_MAX)) for s in size)
        paint[i] = number[q.surface], first, w, h, q.lamp, q.fills
        first += w * h
        periods = (1.0, 1.0) if q.fills else (size[0] / material.tile_m, size[1] / material.tile_m)
        shift = (0.0, 0.0) if q.fills else (q.shift[0] / material.tile_m, q.shift[1] / material.tile_m)
        scale[i] = (*periods, *shift, q.shade, *size, material.stain, q.shade * float(material.picture.mean()))
    textures = pack([surfaces[name].picture for name in used])
    tree = build_tree(geometry[: len(mesh.quads)])
    light = np.zeros(first, dtype=np.float32)
    names = tuple(q.surface for q in quads)
    return Scene(geometry, paint, scale, textures, tree, tuple(lamps), light, len(loose or []), names)
