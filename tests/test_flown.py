"""What is kept of a flight for its last adjustment, when keyframes of it leave the map."""

from __future__ import annotations

import numpy as np
import pytest

from lodelight.geometry.se3 import SE3
from lodelight.imu.preintegration import NavState
from lodelight.imu.samples import ImuSamples
from lodelight.odometry.flown import LONGEST_LINK_S, Flown
from lodelight.rig import ImuSpec

STEP_NS = 500_000_000


def at_rest(legs: int, still: tuple[int, ...] = ()) -> Flown:
    flown = Flown()
    for k in range(legs):
        t_ns = STEP_NS * k + np.arange(0, STEP_NS + 1, 5_000_000)
        imu = ImuSamples(t_ns, np.zeros((len(t_ns), 3)), np.tile([0.0, 0.0, 9.81], (len(t_ns), 1)))
        state = NavState(STEP_NS * k, SE3.identity(), np.zeros(3), np.zeros(3), np.zeros(3))
        flown.add(state, imu if k < legs - 1 else None, ImuSpec(), k in still)
        flown.number[state.t_ns] = k
    return flown


def chain_of(flown: Flown, keyframes: list[int]):
    return flown.chain(np.array(keyframes, np.int32), np.tile(np.eye(3), (len(keyframes), 1, 1)))


@pytest.mark.parametrize("thinned_before", [False, True])
def test_the_way_goes_on_through_keyframes_that_are_gone_and_no_farther_than_the_imu_is_worth(thinned_before):
    flown = at_rest(14)
    left = [0, 3, 4, 12, 13]  # 1.5 s, 0.5 s, 4 s, 0.5 s apart
    assert 1.5 < LONGEST_LINK_S < 4.0
    if thinned_before:
        alive = np.ones(14, np.bool_)
        for gone in ([1, 5, 9], [2, 6, 7, 8, 10, 11]):
            alive[gone] = False
            flown.thin(alive, 10 * STEP_NS)
        kept = [leg.state.t_ns // STEP_NS for leg in flown.legs]
        assert kept == [0, 3, 4, 11, 12, 13]  # of the newest none is judged
        assert sum(len(leg.imu) for leg in flown.legs if leg.imu is not None) < 9 * 100  # the others' samples are gone
    chain = chain_of(flown, left)
    assert list(zip(chain.before.tolist(), chain.after.tolist(), strict=True)) == [(0, 1), (1, 2), (3, 4)]
    assert chain.first.tolist() == [0, 3]
    np.testing.assert_allclose(chain.measured[:, -1], [1.5, 0.5, 0.5], atol=1e-9)


def test_two_keyframes_stand_together_if_all_between_them_stood():
    flown = at_rest(6, still=(0, 1, 2, 3, 5))
    chain = chain_of(flown, [0, 3, 5])
    assert chain.before.tolist() == [0, 0, 1]  # twice: the IMU, and that there is no way between them
    assert chain.still.tolist() == [0, 1, 2]


def test_a_flight_of_which_no_two_keyframes_are_left_has_no_chain():
    assert chain_of(at_rest(9), [0, 8]) is None
    assert chain_of(at_rest(3), [1]) is None
