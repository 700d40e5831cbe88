"""Lights in the loop without images: interpolation, alignment, verdicts, blame, misplaced lights."""

import math
from dataclasses import replace

import numpy as np
import pytest

from light_scenes import SPEC
from lodelight.anchors import Light
from lodelight.errors import ConfigError
from lodelight.geometry.se3 import SE3
from lodelight.lights.alignment import Pair, align
from lodelight.lights.buffer import FixBuffer, LightPose
from lodelight.lights.watch import LightWatch
from lodelight.mapping.keyframes import Candidate
from lodelight.mapping.light_gate import GateConfig, LightGate, difference
from lodelight.messages import LightFix
from lodelight.settings import with_settings
from lodelight.slam import Slam, SlamConfig

T_BODY_CAM = SE3.exp(np.array([1.2, -0.9, 0.7, 0.06, -0.02, 0.04]))
SMALL = np.diag([1e-4] * 3 + [4e-4] * 3)
CANDIDATE = Candidate(
    t_ns=0, inliers=150, reference_points=300, close_tracked=150, close_untracked=20, n_keyframes=10, noise=1.0,
    since_keyframe_s=0.2, since_relocalization_s=100.0, covariance=SMALL,
)  # fmt: skip


def fix(t_s, T, lights=("L1", "L2", "L3"), rms_px=0.4):
    return LightFix(round(t_s * 1e9), T, SMALL, lights, rms_px)


def at(x, yaw=0.0):
    return SE3.exp(np.array([0.0, 0.0, yaw, x, 0.0, 1.0]))


# -- in time --------------------------------------------------------------------------------------------------------


def test_fixes_are_interpolated_and_hardly_extrapolated():
    buffer = FixBuffer()
    for t_s, x in ((0.2, 0.2), (0.0, 0.0), (0.1, 0.1), (0.6, 0.6)):
        buffer.add(fix(t_s, at(x, x)))
    inside = buffer.at(50_000_000)
    np.testing.assert_allclose(inside.T_world_body.matrix, at(0.05, 0.05).matrix, atol=1e-12)
    np.testing.assert_allclose(buffer.at(240_000_000).T_world_body.matrix, at(0.24, 0.24).matrix, atol=1e-12)
    assert buffer.at(260_000_000) is None  # 60 ms beyond, and the gap to the next is 0.4 s
    assert buffer.at(-10_000_000) is None
    assert buffer.at(640_000_000) is None  # near the last one, but its motion is not known
    assert buffer.before(700_000_000, 0.2).t_ns == 600_000_000
    assert buffer.before(900_000_000, 0.2) is None


# -- in space -------------------------------------------------------------------------------------------------------


def test_alignment_stands_wrong_pairs_and_tips_nothing_over():
    rng = np.random.default_rng(0)
    T_world_map = SE3.exp(np.array([0.02, -0.01, 1.3, 4.0, -2.0, 0.5]))
    pairs = []
    for i in range(40):
        T_map = SE3.exp(np.array([*rng.normal(size=2) * 0.05, 0.1 * i, 0.05 * i, 0.5 * math.sin(0.2 * i), 0.0]))
        noise = rng.normal(size=6) * np.array([0.006, 0.006, 0.006, 0.02, 0.02, 0.02])
        far = SE3.exp(np.array([0.0, 0.0, 0.4, 1.0, 0.0, 0.0])) if i % 4 == 3 else SE3.identity()
        pairs.append(Pair(far @ (T_world_map @ T_map).perturbed(noise), T_map))
    found = align(pairs)
    assert found.count == 30
    off = found.T_world_map.inverse() @ T_world_map
    assert np.linalg.norm(off.t) < 0.02
    assert math.degrees(off.angle) < 0.3  # 0.34 deg a fix, thirty of them, and their positions


# -- the gate -------------------------------------------------------------------------------------------------------


def pose(T, lights=("L1", "L2", "L3"), rms_px=0.4):
    return LightPose(0, T, SMALL, lights, rms_px)


def test_differences_are_those_of_the_depth_camera():
    T = SE3.exp(np.array([0.3, 0.2, 1.0, 10.0, 3.0, 1.0]))
    turned = SE3.exp(np.array([0.0, 0.0, math.radians(1.0), 0.0, 0.0, 0.0]))
    same_centre = (T @ T_BODY_CAM @ turned) @ T_BODY_CAM.inverse()  # the camera turns about its own centre
    d = difference(T, SMALL, pose(same_centre), T_BODY_CAM)
    assert d.angle_deg == pytest.approx(1.0, abs=1e-9)
    assert d.centre_m == pytest.approx(0.0, abs=1e-9)
    away = np.linalg.norm((T @ T_BODY_CAM).t)
    assert 0.0 < d.translation_m <= away * math.radians(1.0) + 1e-9  # the lever arm of the method's original wording
    assert d.translation_m > 0.05
    moved = SE3(T.R, T.t + np.array([0.3, 0.0, 0.0]))
    d = difference(T, SMALL, pose(moved), T_BODY_CAM)
    assert (d.angle_deg, d.centre_m, d.translation_m) == pytest.approx((0.0, 0.3, 0.3), abs=1e-9)
    assert d.chi2 == pytest.approx(0.09 / 8e-4)


def test_tiny_angles_are_not_lost():
    for angle in (1e-9, 1e-6, 1e-3, 3.0):
        turned = SE3.exp(np.array([0.0, angle, 0.0, 0.0, 0.0, 0.0]))
        assert math.radians(difference(SE3.identity(), SMALL, pose(turned), SE3.identity()).angle_deg) == pytest.approx(
            angle, rel=1e-6
        )


@pytest.mark.parametrize(
    ("mode", "x", "yaw_deg", "verdict"),
    [
        ("centre", 0.05, 1.0, "PASS"),
        ("centre", 0.15, 0.0, "VETO"),
        ("centre", 0.0, 4.0, "VETO"),
        ("chi2", 0.05, 1.0, "PASS"),  # 2.8 cm a side: 3.1 and 1.5
        ("chi2", 0.15, 0.0, "VETO"),
        ("patent", 0.05, 1.0, "PASS"),
    ],
)
def test_verdicts(mode, x, yaw_deg, verdict):
    gate = LightGate(GateConfig("lights", mode), SE3.identity())
    light = pose(SE3.exp(np.array([0.0, 0.0, math.radians(yaw_deg), x, 0.0, 0.0])))
    said = gate.ask(CANDIDATE, light, "")
    assert said.verdict == verdict
    if mode == "centre" and verdict == "PASS":
        assert said.weight == pytest.approx(math.exp(-0.5 * ((yaw_deg / 3.0) ** 2 + (x / 0.1) ** 2)))
    assert "lights differ by" in said.why


def test_a_turn_far_from_the_origin_fails_by_the_original_wording_alone():
    there = SE3(np.eye(3), np.array([10.0, 0.0, 0.0]))
    turned = there.perturbed(np.array([0.0, 0.0, math.radians(1.0), 0.0, 0.0, 0.0]))
    candidate = replace(CANDIDATE, T_world_body=there)
    assert LightGate(GateConfig("lights", "patent"), SE3.identity()).ask(candidate, pose(turned), "").verdict == "VETO"
    assert LightGate(GateConfig("lights"), SE3.identity()).ask(candidate, pose(turned), "").verdict == "PASS"


def test_fewer_lights_weigh_less_and_none_abstain():
    gate = LightGate(GateConfig("lights"), SE3.identity())
    assert gate.ask(CANDIDATE, pose(SE3.identity(), ("L1", "L2")), "").weight == pytest.approx(2.0 / 3.0)
    said = gate.ask(CANDIDATE, None, "no light seen yet")
    assert (said.verdict, said.weight, said.why) == ("ABSTAIN", 0.5, "no light seen yet")
    assert gate.ask(CANDIDATE, pose(SE3.identity(), rms_px=2.5), "").verdict == "ABSTAIN"
    assert gate.counts == {"pass": 1, "veto": 0, "abstain": 2}


def asked(gate, light_of, until_s, step_s=0.1, **change):
    """Verdicts on a candidate every step, until somebody is blamed."""
    said = []
    for i in range(round(until_s / step_s)):
        said.append(gate.ask(replace(CANDIDATE, t_ns=round(i * step_s * 1e9), **change), light_of(i), "").verdict)
        if gate.blamed:
            break
    return said


def test_vetoes_end_after_a_second_and_two_lights_are_blamed():
    gate = LightGate(GateConfig("lights"), SE3.identity())
    said = asked(gate, lambda i: pose(at(0.5), ("L1", "L2")), 3.0)
    assert said == ["VETO"] * 11 + ["ABSTAIN"]
    assert gate.blamed == "lights"
    later = replace(CANDIDATE, t_ns=2_000_000_000)
    assert "not trusted" in gate.ask(later, pose(at(0.5), ("L1", "L2")), "").why


@pytest.mark.parametrize(
    "lights", [lambda i: ("L1", "L2", "L3"), lambda i: (("L1", "L2"), ("L3", "L4"))[i % 2]]
)  # three at once contradict a wrong one of them, and so do two pairs that share none
def test_vetoes_by_lights_that_prove_themselves_blame_the_map(lights):
    gate = LightGate(GateConfig("lights"), SE3.identity())
    said = asked(gate, lambda i: pose(at(0.5), lights(i)), 3.0)
    assert said == ["VETO"] * 12
    assert gate.blamed == "map"


def test_tracking_that_cannot_wait_is_not_refused():
    gate = LightGate(GateConfig("lights"), SE3.identity())
    assert asked(gate, lambda i: pose(at(0.5)), 0.3, inliers=60) == ["ABSTAIN"] * 3


@pytest.mark.parametrize("text", ["gate.use=cameras", "gate.mode=both", "gate.max_m=0", "lights.use=loose"])
def test_settings_that_make_no_sense(text):
    with pytest.raises(ConfigError):
        with_settings(SlamConfig(), [text])


def test_one_light_is_not_counted_twice():
    from lodelight.sim.rigs import standard

    with pytest.raises(ConfigError, match="twice"):
        Slam(standard(), with_settings(SlamConfig(), ["gate.use=lights", "lights.use=tight"]))
    with pytest.raises(ConfigError, match="anchors"):
        Slam(standard(), with_settings(SlamConfig(), ["lights.use=tight"]))


# -- misplaced lights -----------------------------------------------------------------------------------------------


def test_a_light_that_hangs_elsewhere_is_named_and_the_others_are_not():
    lights = {
        f"L{i}": Light(f"L{i}", 2000.0 + 200.0 * min(i, 4), np.array([1.2 * (i % 3), 1.2 * (i // 3), 2.5]))
        for i in range(6)
    }
    true = {name: light.xyz for name, light in lights.items()}
    true["L1"] = true["L1"] + [0.0, 1.0, 0.0]  # moved
    true["L3"], true["L5"] = true["L5"], true["L3"]  # swapped
    rng, watch, found = np.random.default_rng(0), LightWatch(lights), {}
    for i in range(60):
        T = SE3(SPEC.T_body_cam.R, np.array([0.04 * i, 0.5 + 0.3 * math.sin(0.2 * i), 1.0]) + 0.01 * rng.normal(size=3))
        for name, xyz in true.items():
            for misplaced in watch.see(i * 100_000_000, name, T, T.R.T @ (xyz - T.t)):
                found[misplaced.light.id] = misplaced
    assert set(found) == {"L1", "L3", "L5"}
    assert found["L1"].off_m == pytest.approx(1.0, abs=0.05)
    assert (found["L3"].other, found["L5"].other) == ("L5", "L3")
    assert "where L5 should hang" in found["L3"].why
    assert (found["L5"].alike, found["L3"].alike) == (("L4",), ())
    assert "L5 (or L4, of its code)" in found["L5"].why


def test_a_map_that_has_drifted_names_no_light():
    lights = {f"L{i}": Light(f"L{i}", 2000.0, np.array([0.6 * i, 0.5 * (i % 2), 2.5])) for i in range(12)}
    watch = LightWatch(lights)
    for i in range(120):
        true = SE3(SPEC.T_body_cam.R, np.array([0.05 * i, 0.2 + 0.3 * math.sin(0.2 * i), 1.0]))
        drifted = SE3(true.R, true.t + np.array([0.0, 0.012 * i, 0.0]))  # to 1.4 m aside
        for name, light in lights.items():
            ray = true.R.T @ (light.xyz - true.t)
            if np.linalg.norm(ray[:2]) < 0.6 * ray[2]:
                assert watch.see(i * 100_000_000, name, drifted, ray) == []
