"""Lights are believed against the map while they go on as before, and no longer."""

import numpy as np
import pytest

from lodelight.features.features import Features
from lodelight.geometry.se3 import SE3
from lodelight.lights.continuity import Continuity
from lodelight.localization.machine import LocalizationMachine
from lodelight.localization.tracked import Tracked, TrackerConfig
from lodelight.messages import Doubt

RNG = np.random.default_rng(0)


def at(t_s, aside_m=0.0, noisy=True):
    noise = RNG.normal(size=6) * [0.003, 0.003, 0.002, 0.005, 0.005, 0.002] * noisy
    return SE3.exp(np.array([0.0, 0.0, 0.5 * t_s, 1.0 * t_s, aside_m, 1.0])).perturbed(noise)


def expected(until_s, aside_from_s=np.inf, gap=None, now_s=None, creeps_m_s=0.0):
    """Where the map should have the body: it agreed with the lights for a second, but for 3 cm."""
    lights = Continuity()
    for k in range(round(10 * until_s)):
        t_s = 0.1 * k
        if gap and gap[0] <= t_s < gap[1]:
            continue
        T = at(t_s, 0.5 if t_s >= aside_from_s else 0.0)
        lights.fixed(round(t_s * 1e9), T)
        if t_s < 1.0:
            map_says = at(t_s, noisy=False)
            lights.agreed(
                round(t_s * 1e9), T, SE3(map_says.R, map_says.t + np.array([0.0, 0.03 + creeps_m_s * t_s, 0.0]))
            )
    now_s = until_s - 0.05 if now_s is None else now_s
    return lights.expected(round(now_s * 1e9), at(now_s)), at(now_s, noisy=False).t + np.array([0.0, 0.03, 0.0])


def test_the_lights_motion_is_believed_for_a_second_and_not_their_place():
    found, true = expected(1.6)
    assert np.linalg.norm(found.t - true) < 0.03
    assert expected(2.2)[0] is None
    assert expected(1.6, now_s=1.9)[0] is None  # no fix lately
    assert Continuity().expected(0, SE3.identity()) is None


def test_tracking_that_is_carried_along_a_little_at_a_time_shows():
    found, true = expected(1.0, creeps_m_s=0.1)  # to 0.1 m off
    assert np.linalg.norm(found.t - true) < 0.03


def test_what_jumps_or_comes_after_a_gap_is_not_believed():
    assert expected(1.6, aside_from_s=1.3)[0] is None
    assert expected(1.6, gap=(1.1, 1.45))[0] is None


class Tracking:
    """Tracks every frame to one pose with all its corners, and finds nothing anywhere else."""

    config = TrackerConfig()

    def __init__(self):
        self.last = None

    def track(self, t_ns, seen):
        return Tracked(t_ns, seen, SE3.identity(), np.eye(6), np.arange(len(seen), dtype=np.int32), 0)

    def track_at(self, t_ns, seen, T_world_body):
        return Tracked(t_ns, seen, T_world_body, np.eye(6), np.full(len(seen), -1, np.int32), 0, why_lost="nothing")

    def accept(self, tracked):
        self.last = tracked


@pytest.mark.parametrize("sure", [True, False])
def test_a_frame_that_contradicts_sure_lights_has_their_pose_and_no_matches(sure):
    n = 100
    seen = Features(
        np.zeros((n, 2), np.float32), np.zeros(n, np.int32), np.zeros(n, np.float32), np.zeros((n, 4), np.uint64),
        np.zeros((n, 3)), np.zeros(n, np.float32), np.zeros(n, np.float32),
    )  # fmt: skip
    machine, there = LocalizationMachine(Tracking(), lambda seen: "nothing"), at(1.0)
    machine.start(machine.tracker.track(0, seen))
    tracked = machine.locate(1, seen, lambda t_ns, T: Doubt(there, 1e-4 * np.eye(6), sure))
    if sure:
        assert tracked.T_world_body is there
        assert (tracked.n_inliers, tracked.why_lost, machine.status) == (0, "", "degraded")
        assert "moves" in machine.why
    else:
        assert (tracked.n_inliers, machine.status) == (n, "tracking")
