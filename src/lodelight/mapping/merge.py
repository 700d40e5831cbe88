"""Maps of one building become one map. A merge is a loop closure between two maps: see `merged`.

The map that is surest of its frame is the base, the one surveyed in the world before the largest. The others join it
one by one; what does not lie in it may when a third has joined. Where not all hang together, most of them do. Nothing
of the inputs changes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from lodelight.features.orb import OrbConfig
from lodelight.geometry.se3 import SE3
from lodelight.mapping.compact import compacted
from lodelight.mapping.joining import joined, lay, through
from lodelight.mapping.local import adjust
from lodelight.mapping.loop_correction import FUSED_KEYFRAMES, fuse_doubles, spread_error, unite
from lodelight.mapping.loops import LoopConfig
from lodelight.mapping.map import Map
from lodelight.mapping.overlap import Overlap, find_overlap
from lodelight.mapping.sight import keyframes_near
from lodelight.mapping.tags import MapTags
from lodelight.mapping.verification import Verifier
from lodelight.types import Ints

NEAR_M, NEAR_DEG, NEAR = 2.0, 45.0, 10  # keyframes of the other map in whose images a keyframe's points are looked for
SCALE_SIGMA = (0.01, 0.03)  # rad, m: poses of a map without depth are believed so far, which keeps its scale


@dataclass(frozen=True)
class MergeConfig:
    """orb, loops : what the maps were made with, and what it takes to believe that two of them show one place"""

    orb: OrbConfig = field(default_factory=OrbConfig)
    loops: LoopConfig = field(default_factory=LoopConfig)


@dataclass(frozen=True, eq=False)
class Part:
    """What became of one input.

    by : "base", or what laid it down: "the world", "tags", "places"; empty where it was left out, and `why` says it
    T_merged_own : from its own frame, as it was laid down and before all were adjusted together
    pairs, tags : places and tags that agree with that
    keyframes : rows of the merged map that came from it, first and one behind the last
    """

    by: str
    why: str = ""
    T_merged_own: SE3 | None = None
    pairs: int = 0
    tags: tuple[str, ...] = ()
    keyframes: tuple[int, int] = (0, 0)


@dataclass(frozen=True, eq=False)
class Merged:
    """map : of all parts that have a `by`; parts : in the order of the inputs"""

    map: Map
    parts: list[Part]

    def shared_points(self, part: int) -> int:
        """Points of the merged map that keyframes of this part and of another one see."""
        first, last = self.parts[part].keyframes
        point, by = self.map.features.point, self.map.features.keyframe
        own = (by >= first) & (by < last)
        seen = point >= 0
        return len(np.intersect1d(point[seen & own], point[seen & ~own]))


def merged(
    maps: Sequence[Map], config: MergeConfig | None = None, on_part: Callable[[int, Part], None] | None = None
) -> Merged:
    """One map of all that can be laid down in the frame of one of them, whatever the order they are given in.

    on_part : told of each input when it has joined or was left out
    """
    config = config or MergeConfig()
    tell = on_part or (lambda i, part: None)
    waiting = sorted(range(len(maps)), key=lambda i: _rank(maps[i]))
    best: _Group | None = None
    why = dict.fromkeys(waiting, "it has no tag and no place with the others")
    while waiting:
        group = _around(maps, waiting, config, why)
        if best is None or len(group.parts) > len(best.parts):
            best = group
        waiting = [i for i in waiting if i not in group.parts]
        if len(waiting) <= len(best.parts):  # no group of those can be larger
            break
    assert best is not None
    parts = [best.parts.get(i) or Part("", why[i]) for i in range(len(maps))]
    for i in [*best.parts, *(i for i in range(len(maps)) if i not in best.parts)]:
        tell(i, parts[i])
    return Merged(best.map, parts)


@dataclass(eq=False)
class _Group:
    """Maps that hang together; parts by their number among the inputs, in the order in which they joined."""

    map: Map
    parts: dict[int, Part]


def _around(maps: Sequence[Map], numbers: Sequence[int], config: MergeConfig, why: dict[int, str]) -> _Group:
    """All of the maps of those numbers that can be laid down in the first one; the others' reasons go to `why`."""
    base, *waiting = numbers
    whole = compacted(maps[base])
    parts = {base: Part("base", T_merged_own=SE3.identity(), keyframes=(0, len(whole.keyframes)))}
    came = True
    while came:
        came = False
        for i in list(waiting):
            answer = _join(whole, through(maps[i], whole.rig, config.orb), config)
            if isinstance(answer, str):
                why[i] = answer
                continue
            first = len(whole.keyframes)
            whole, by = answer
            rows = first, len(whole.keyframes)
            parts[i] = Part(by.by, "", by.T_base_other, len(by.pairs), tuple(by.tags), rows)
            waiting.remove(i)
            came = True
    return _Group(whole, parts)


def _rank(map: Map) -> tuple[bool, int, int, int]:
    """The lowest is the base: surveyed, then large, then early."""
    k = map.keyframes
    return not np.any(map.tags.surveyed), -len(map.alive_keyframes), int(k.t_ns.min(initial=2**62)), len(map.points)


def _join(base: Map, other: Map, config: MergeConfig) -> tuple[Map, Overlap] | str:
    """Both maps as one, adjusted together; or why that cannot be."""
    if len(other.keyframes) == 0:
        return "it has no keyframe"
    both, shared = joined(base, other)
    verifier = Verifier(both, config.orb, config.loops.sigma_px)
    overlap = find_overlap(both, base, other, shared, verifier, config.loops)
    if isinstance(overlap, str):
        return overlap
    n = len(base.keyframes)
    lay(both, n, len(base.points), len(base.tags), overlap.T_base_other)
    _graft(both, n, overlap)
    if overlap.pairs:
        spread_error(both, overlap.pairs, config.loops.sigma_px / verifier.camera.focal_px)
        for pair in overlap.pairs:
            both.loops.append(1, a=pair.a, b=pair.b, R=pair.T_a_b.R, p=pair.T_a_b.t)
        for pair in overlap.pairs:
            here = verifier.neighbourhood(pair.a, np.arange(n), FUSED_KEYFRAMES)
            there = verifier.neighbourhood(pair.b, np.arange(n, len(both.keyframes)), FUSED_KEYFRAMES)
            unite(both, pair)
            fuse_doubles(both, here, there, config.orb)
    _adjust(both, n, config)
    return compacted(both), overlap


def _graft(both: Map, n: int, overlap: Overlap) -> None:
    """Make the other tree hang on the base's, at the keyframes where both were found to meet."""
    parent, child = both.keyframes.parent, overlap.a
    above = overlap.b
    while child >= 0:  # turn round the way from there to the old root
        parent[child], child, above = above, int(parent[child]), child
    roots = np.flatnonzero((parent < 0) & both.keyframes.alive)
    parent[roots[roots >= n]] = overlap.b


def _adjust(both: Map, n: int, config: MergeConfig) -> None:
    """Tags, then all poses and points; twice, since doubles away from the pairs are found only when it fits."""
    orb, sigma_px = config.orb, config.loops.sigma_px
    tags = MapTags(both, orb, sigma_px)
    tags.prepare()
    pose_sigma = None if np.any(both.features.inv_depth > 0) else SCALE_SIGMA
    for final in (False, True):
        adjust(both, both.alive_keyframes, orb, sigma_px, config.loops.iterations, None, pose_sigma=pose_sigma)
        if not final:
            _fuse_near(both, n, orb)
    tags.finish()


def _fuse_near(both: Map, n: int, orb: OrbConfig) -> None:
    """Look for the points of each map in the images of the other, wherever both looked at one thing."""
    spec = both.rig.cameras[0]
    for a in range(n, len(both.keyframes)):
        near = keyframes_near(both, both.pose(a) @ spec.T_body_cam, NEAR_M, NEAR_DEG)
        near = near[near < n][:NEAR]
        if len(near):
            here: Ints = np.array([a], np.int32)
            fuse_doubles(both, here, near, orb)
            fuse_doubles(both, near, here, orb)
