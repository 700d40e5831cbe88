"""Is the lights' clock the images'? Along a walk that is known, with fixes stamped late or early by a known time."""

import math

import numpy as np
import pytest

from light_scenes import pose_at
from lodelight.geometry.se3 import SE3
from lodelight.lights.clock import ClockCheck
from lodelight.trajectory import Trajectory

SMALL = np.diag([math.radians(0.3) ** 2] * 3 + [0.02**2] * 3)


def steered(t):
    return 0.5 * math.sin(0.9 * t) + 0.05 * math.sin(11.0 * t)


def drifted(t):
    """A heading of a map that turns away by half a degree a second."""
    return steered(t) + math.radians(0.5) * t


def checked(late_s, heading=steered, of_map=None, seconds=20.0, seed=0):
    rng, check = np.random.default_rng(seed), ClockCheck()
    t = np.arange(0.0, seconds, 0.01)
    truth = Trajectory.from_poses(
        [round(s * 1e9) for s in t], [SE3.exp(np.array([0, 0, heading(s), 0.5 * s, 0, 1.0])) for s in t]
    )
    elsewhere = SE3.exp(np.array([0.0, 0.0, 2.0, 4.0, 0.0, 0.0]))  # the map's place
    for s in np.arange(0.0, seconds, 1.0 / 15.0):
        away = 0.0 if of_map is None else of_map(s) - heading(s)
        R = elsewhere.R @ SE3.exp(np.array([0, 0, away, 0, 0, 0])).R @ pose_at(truth, round(s * 1e9)).R
        check.tracked(round(s * 1e9), R)
    for s in np.arange(0.5, seconds - 0.5, 0.1):
        noise = math.radians(0.3) * rng.normal(size=3)
        T = pose_at(truth, round(s * 1e9)).perturbed(np.array([*noise, 0, 0, 0]))
        check.fixed(round((s + late_s) * 1e9), T.R, SMALL)
    return check.offset()


@pytest.mark.parametrize("late_s", [-0.2, -0.03, 0.02, 0.05, 0.3])
def test_an_offset_is_found(late_s):
    found = checked(late_s)
    assert found is not None
    assert found.sigma_s < 0.004
    assert abs(found.late_s - late_s) < max(4.0 * found.sigma_s, 0.002)
    assert ("late" if late_s > 0 else "early") in found.why


@pytest.mark.parametrize("seed", range(5))
def test_one_clock_is_not_accused(seed):
    assert checked(0.0, seed=seed) is None
    assert checked(0.004, seed=seed) is None


def test_a_map_that_drifts_has_no_other_clock():
    assert checked(0.0, of_map=drifted) is None
    assert checked(0.05, of_map=drifted).late_s == pytest.approx(0.05, abs=0.005)


def test_straight_ahead_nothing_can_be_said():
    assert checked(0.05, heading=lambda t: 0.3) is None
    assert checked(0.05, heading=lambda t: 0.2 * t) is None  # a turn that never changes
