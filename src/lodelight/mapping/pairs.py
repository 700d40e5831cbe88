"""Do two keyframes show one place? Asked of their images and points alone, in both directions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lodelight.geometry.se3 import SE3
from lodelight.mapping.verification import Location, Refusal, Verifier


@dataclass(frozen=True)
class PairConfig:
    """What it takes to believe a pair; docs/places-and-loops.md has the measurements behind it.

    min_inliers, min_coverage : in either direction, points found, and the share of the image's cells in which points
        should be seen that has one
    min_agreement : share of each direction's inliers that the other direction's pose explains
    """

    min_inliers: int = 30
    min_coverage: float = 0.35
    min_agreement: float = 0.5


@dataclass(frozen=True, eq=False)
class Pair:
    """Keyframes a and b show one place. T_a_b : as measured in both directions, the better one weighing more
    there : a, located in the surroundings of b; back : b, located in those of a
    """

    a: int
    b: int
    T_a_b: SE3
    there: Location
    back: Location

    @property
    def inliers(self) -> int:
        """Inliers of the weaker direction."""
        return min(len(self.there), len(self.back))

    @property
    def coverage(self) -> float:
        return min(self.there.coverage, self.back.coverage)


def verify_pair(verifier: Verifier, a: int, b: int, config: PairConfig) -> Pair | Refusal:
    """Whether two keyframes show one place, by their images and points alone, or why not.

    The pose of each is found among the other's points, from other 3-D points each time: two measurements of T_a_b
    that share little but the truth. The poses that the map has for a and b play no part.
    """
    map = verifier.map
    around_a, around_b = verifier.neighbourhood(a), verifier.neighbourhood(b)
    around_b = around_b[(around_b == b) | ~np.isin(around_b, around_a)]
    around_a = around_a[(around_a == a) | ~np.isin(around_a, around_b)]
    seen = {a: map.features_of(a), b: map.features_of(b)}
    found: list[Location] = []
    for here, other, around in ((a, b, around_b), (b, a, around_a)):
        located = verifier.locate(seen[here], other, around)
        if isinstance(located, Refusal):
            return located
        if len(located) < config.min_inliers:
            return Refusal(f"{len(located)} points found, {config.min_inliers} are needed", len(located))
        if located.coverage < config.min_coverage:
            why = f"points found in {located.coverage:.0%} of the view, {config.min_coverage:.0%} are needed"
            return Refusal(why, len(located))
        found.append(located)
    there, back = found
    T_a_b = there.T_world_body.inverse() @ map.pose(b)
    T_a_b_back = map.pose(a).inverse() @ back.T_world_body
    agreement = min(
        verifier.explained(there, seen[a], map.pose(b) @ T_a_b_back.inverse()),
        verifier.explained(back, seen[b], map.pose(a) @ T_a_b),
    )
    if agreement < config.min_agreement:
        why = f"the two directions agree on {agreement:.0%} of the points, {config.min_agreement:.0%} are needed"
        return Refusal(why, min(len(there), len(back)))
    weight = len(back) / (len(there) + len(back))
    return Pair(a, b, T_a_b.interpolate(T_a_b_back, weight), there, back)
