"""Other ways through a building than its own route: beside it, from another start."""

from __future__ import annotations

import numpy as np

from lodelight.sim.gaits import Gait, rounded
from lodelight.sim.space import Space
from lodelight.types import Array

ASIDE_M = 0.6  # of a corner from where the route has it, at most, along x and along y
CLEAR_M = 0.4  # of the way from everything; less only where the route itself comes nearer
HALVINGS = 8


def another_way(route: Array, space: Space, gait: Gait, rng: np.random.Generator) -> Array:
    """The route (N, 2) m with its corners moved aside and another one of them first, clear of everything.

    Corners whose neighbourhood is too near to something are moved back by halves, in the end to where they were.
    """
    aside = rng.uniform(-ASIDE_M, ASIDE_M, route.shape)
    for _ in range(HALVINGS):
        line, _ = rounded(route + aside, gait.round_m)
        near = space.clearance(np.column_stack([line, np.full(len(line), gait.height)])) < CLEAR_M
        if not near.any():
            break
        far = np.linalg.norm(line[near][:, None] - (route + aside), axis=2)
        closest = np.argsort(far, axis=1)[:, :2]
        aside[np.unique(closest)] *= 0.5
    out: Array = np.roll(route + aside, -int(rng.integers(len(route))), axis=0)
    return out
