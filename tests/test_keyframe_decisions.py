"""Every condition of a keyframe decision alone, and how they combine."""

from dataclasses import replace

import pytest

from lodelight.mapping.keyframes import Candidate, KeyframeConfig, Verdict, decide

CONFIG = KeyframeConfig()
GOOD = Candidate(
    t_ns=0, inliers=150, reference_points=300, close_tracked=150, close_untracked=20, n_keyframes=10, noise=1.0,
    since_keyframe_s=0.2, since_relocalization_s=100.0,
)  # fmt: skip


def test_half_the_overlap_with_mapping_idle_makes_a_keyframe():
    assert decide(GOOD, CONFIG).insert


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"localization_only": True}, "localization only"),
        ({"mapping_stopped": True}, "stopped"),
        ({"since_relocalization_s": 0.5, "n_keyframes": 31}, "relocalization"),
        ({"inliers": 15}, "too few"),
        ({"inliers": 290}, "still in view"),
        ({"noise": 2.0}, "noisy"),
        ({"mapping_idle": False}, "busy"),
        ({"mapping_idle": False, "queue": 3}, "wait for mapping"),
    ],
)
def test_one_condition_alone_refuses_and_says_so(change, why):
    decision = decide(replace(GOOD, **change), CONFIG)
    assert not decision.insert
    assert why in decision.why


@pytest.mark.parametrize(
    "change",
    [
        {"mapping_idle": False, "since_keyframe_s": 1.0},  # the longest interval has passed
        {"mapping_idle": False, "inliers": 60},  # weak tracking cannot wait
        {"noise": 2.0, "inliers": 60},
        {"noise": 2.0, "since_keyframe_s": 1.0},
        {"inliers": 290, "close_tracked": 50, "close_untracked": 200},  # close points are needed
        {"since_relocalization_s": 0.5, "n_keyframes": 30},  # the map is small still
    ],
)
def test_what_makes_a_keyframe_all_the_same(change):
    assert decide(replace(GOOD, **change), CONFIG).insert


def test_weak_tracking_waits_where_the_override_is_off():
    busy = replace(GOOD, inliers=60, mapping_idle=False)
    assert not decide(busy, replace(CONFIG, weak_tracking_override=False)).insert


def test_a_veto_refuses_an_abstention_does_not_and_the_least_weight_counts():
    def says(verdict, weight=1.0):
        return lambda candidate: Verdict(verdict, f"gate says {verdict}", weight)

    assert decide(GOOD, CONFIG, (says("PASS", 0.8), says("ABSTAIN", 0.5))).weight == 0.5
    refused = decide(GOOD, CONFIG, (says("PASS"), says("VETO")))
    assert not refused.insert
    assert refused.why == "gate says VETO"


def test_gates_are_not_asked_about_frames_that_other_conditions_refuse():
    def fails(candidate):
        raise AssertionError("asked")

    assert not decide(replace(GOOD, inliers=3), CONFIG, (fails,)).insert
