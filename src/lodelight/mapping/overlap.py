"""Where one map lies in another: by the world, by tags that both have, or by places that both show.

Two maps in one list of rows (`joining.joined`) are two trees of keyframes. A place that both show is a loop between
them; but where a loop in one map is held against drift, here nothing is known beforehand, so several must agree.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lodelight.geometry.se3 import SE3
from lodelight.mapping.drift import path_between
from lodelight.mapping.loops import LoopConfig
from lodelight.mapping.map import Map
from lodelight.mapping.pairs import Pair, verify_pair
from lodelight.mapping.places import Places
from lodelight.mapping.tag_alignment import consensus
from lodelight.mapping.tag_corners import tag_world
from lodelight.mapping.tag_views import find_tag, tag_name
from lodelight.mapping.verification import Verifier, elsewhere

QUERIES = 300  # keyframes of a map that are looked for in the other one, evenly chosen
MIN_KEYFRAMES = 2  # that must find themselves in the other map, and agree
HYPOTHESES = 5  # of the strongest pairs that do not agree with one another: how many others agree with each
MOST_PAIRS = 120  # the strongest, that are asked


@dataclass(frozen=True, eq=False)
class Overlap:
    """T_base_other : where the other map's frame lies in the base's, by `by`: "the world", "tags" or "places"
    pairs : of keyframes, a of the other map and b of the base, that agree with it, the best first
    tags : names of the tags that do
    a, b : keyframes of the other map and of the base that are near where it was found
    """

    T_base_other: SE3
    by: str
    pairs: Sequence[Pair]
    tags: Sequence[str]
    a: int
    b: int


def find_overlap(
    both: Map, base: Map, other: Map, shared: Sequence[str], verifier: Verifier, config: LoopConfig
) -> Overlap | str:
    """Where `other`, whose rows come after those of `base` in `both`, lies in it; or why that is not known.

    shared : names of the tags that both have
    """
    pairs = matching_places(both, len(base.keyframes), verifier, config)
    agreed, ambiguous = _most_agreed(both, pairs, config)
    by_places = agreed if len({p.a for p in agreed}) >= MIN_KEYFRAMES else []
    found = _by_tags(base, other, shared)
    if found is not None and (found[0] == "the world" or len(found[2]) > 1 or not by_places):
        by, T, tags = found
        anchor = _anchor(both, len(base.keyframes), T, by_places)
        pairs = [p for p in by_places if _agree(both, T, anchor, p, config)]
        if by_places and not pairs and by == "tags":
            return (
                f"tags ({', '.join(tags)}) and places put it {_apart_m(both, T, by_places[0]):.1f} m from one another"
            )
        return Overlap(T, by, pairs, tags, *anchor)
    if by_places and not ambiguous:
        best = by_places[0]
        return Overlap(_T_base_other(both, best), "places", by_places, [], best.a, best.b)
    if by_places:
        return ambiguous
    if pairs:
        most = max(pair.inliers for pair in pairs)
        return f"only one keyframe was found in it (with {most} points), {MIN_KEYFRAMES} that agree are needed"
    return "no tag and no place is in both"


def matching_places(both: Map, n_base: int, verifier: Verifier, config: LoopConfig) -> list[Pair]:
    """Pairs of keyframes, a behind row n_base and b before it, that show one place; the best first."""
    places = Places(both)
    theirs = np.arange(n_base, len(both.keyframes))
    asked = theirs if len(theirs) <= QUERIES else theirs[np.linspace(0, len(theirs) - 1, QUERIES).round().astype(int)]
    pairs = []
    for a in asked.tolist():
        score, common = places.similarity(both.features.desc[both.feature_range(a)])
        for b in places.best(score, common, config.candidates, excluded=theirs).tolist():
            pair = verify_pair(verifier, a, b, config.pair)
            if isinstance(pair, Pair):
                pairs.append(pair)
    return sorted(pairs, key=lambda pair: (-pair.inliers, pair.a, pair.b))[:MOST_PAIRS]


def _most_agreed(both: Map, pairs: list[Pair], config: LoopConfig) -> tuple[list[Pair], str]:
    """The pairs that agree with that one with which most do, by points; and the rival, if there is one."""
    groups: list[tuple[int, SE3, list[Pair]]] = []
    left = pairs
    while left and len(groups) < HYPOTHESES:
        first = left[0]  # the strongest that no group explains yet
        T = _T_base_other(both, first)
        agreeing = [pair for pair in pairs if _agree(both, T, (first.a, first.b), pair, config)]
        groups.append((sum(pair.inliers for pair in agreeing), T, agreeing))
        left = [pair for pair in left if pair not in agreeing]
    if not groups:
        return [], ""
    points, T_best, best = max(groups, key=lambda group: group[0])
    for rival_points, T, _ in groups:
        here, there = T_best @ both.pose(best[0].a), T @ both.pose(best[0].a)
        if elsewhere(here, there) and rival_points > config.rival * points:
            return best, f"it fits in two places, {np.linalg.norm(here.t - there.t):.1f} m from one another"
    return best, ""


def _agree(both: Map, T_base_other: SE3, at: tuple[int, int], pair: Pair, config: LoopConfig) -> bool:
    """Whether a pair is where an overlap that was found at keyframes `at` has it, given how much both maps may bend."""
    off = (T_base_other @ both.pose(pair.a)).inverse() @ (_T_base_other(both, pair) @ both.pose(pair.a))
    ways = [path_between(both, here, there) for here, there in zip(at, (pair.a, pair.b), strict=True)]
    length_m, turns_deg = (sum(way[i] for way in ways) for i in (0, 1))
    near = float(np.linalg.norm(off.t)) <= config.drift_m + config.drift * length_m
    return near and math.degrees(off.angle) <= config.drift_deg + config.drift * turns_deg


def _by_tags(base: Map, other: Map, shared: Sequence[str]) -> tuple[str, SE3, list[str]] | None:
    """By what, T_base_other, and the tags that agree."""
    in_base = {i: row for i in range(len(other.tags)) if (row := _placed(base, tag_name(other, i), shared)) >= 0}
    rows = {i: row for i, row in in_base.items() if other.tags.placed[i]}
    if np.any(base.tags.surveyed) and np.any(other.tags.surveyed):
        return "the world", SE3.identity(), sorted(tag_name(other, i) for i in rows)
    spread = {i: float(np.trace(other.tags.covariance[i][3:, 3:])) for i in rows}
    best = consensus({i: tag_world(other, i) for i in rows}, {i: tag_world(base, rows[i]) for i in rows}, spread)
    if best is None or (len(best.agreeing) < 2 and len(rows) > 1):
        return None
    return "tags", best.T_world_map, sorted(tag_name(other, i) for i in best.agreeing)


def _placed(base: Map, name: str, shared: Sequence[str]) -> int:
    row = find_tag(base, name) if name in shared else -1
    return row if row >= 0 and base.tags.placed[row] else -1


def _anchor(both: Map, n_base: int, T_base_other: SE3, pairs: Sequence[Pair]) -> tuple[int, int]:
    """A keyframe of each map, near each other once one map lies in the other."""
    if pairs:
        return pairs[0].a, pairs[0].b
    theirs = T_base_other @ both.keyframes.p[n_base:]
    apart = np.linalg.norm(theirs[:, None] - both.keyframes.p[None, :n_base], axis=2)
    a, b = np.unravel_index(int(np.argmin(apart)), apart.shape)
    return n_base + int(a), int(b)


def _T_base_other(both: Map, pair: Pair) -> SE3:
    return both.pose(pair.b) @ pair.T_a_b.inverse() @ both.pose(pair.a).inverse()


def _apart_m(both: Map, T_base_other: SE3, pair: Pair) -> float:
    here, there = T_base_other @ both.pose(pair.a), _T_base_other(both, pair) @ both.pose(pair.a)
    return float(np.linalg.norm(here.t - there.t))
