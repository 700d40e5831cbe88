"""Lights are believed against the map while they go on as before, and no longer."""

import numpy as np

from lodelight.geometry.se3 import SE3
from lodelight.lights.continuity import Continuity

RNG = np.random.default_rng(0)


def at(t_s, aside_m=0.0):
    noise = RNG.normal(size=6) * [0.003, 0.003, 0.002, 0.015, 0.015, 0.005]
    return SE3.exp(np.array([0.0, 0.0, 0.5 * t_s, 1.0 * t_s, aside_m, 1.0])).perturbed(noise)


def fed(until_s, aside_from_s=np.inf, gap=None):
    lights = Continuity()
    for k in range(round(10 * until_s)):
        t_s = 0.1 * k
        if gap and gap[0] <= t_s < gap[1]:
            continue
        lights.fixed(round(t_s * 1e9), at(t_s, 0.5 if t_s >= aside_from_s else 0.0))
        if t_s < 1.0:
            lights.agreed(round(t_s * 1e9))
    return lights


def test_what_goes_on_is_believed_for_a_second():
    assert fed(1.6).vouches(1_550_000_000)
    assert not fed(2.2).vouches(2_150_000_000)
    assert not fed(1.6).vouches(1_900_000_000)  # no fix lately
    assert not Continuity().vouches(0)


def test_what_jumps_or_comes_after_a_gap_is_not():
    assert not fed(1.6, aside_from_s=1.3).vouches(1_550_000_000)
    assert not fed(1.6, gap=(1.1, 1.45)).vouches(1_550_000_000)
