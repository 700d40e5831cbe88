"""Lights in the loop of SLAM, without images: one keyframe, a body that is tracked well, fixes with noise."""

import math
from dataclasses import replace

import numpy as np
import pytest

from light_scenes import SPEC, along, pose_at
from lodelight.anchors import Light
from lodelight.features.features import Features
from lodelight.geometry.se3 import SE3
from lodelight.mapping.keyframes import Candidate
from lodelight.mapping.light_anchor import LightAnchor
from lodelight.mapping.light_gate import GateConfig
from lodelight.mapping.light_ties import LightsConfig
from lodelight.mapping.map import Map
from lodelight.sim.rigs import standard
from lodelight.trajectory import Trajectory

RIG = replace(standard(), lights=SPEC)
# Two rows of a corridor's ceiling; two to four lights in view at a time
LIGHTS = tuple(
    Light(f"L{i}", 2000.0 + 200.0 * i, np.array([0.9 * (i // 2) - 0.5, 0.7 * (i % 2) - 0.35, 2.6])) for i in range(24)
)
T_WORLD_MAP = SE3.exp(np.array([0.0, 0.0, 0.7, 3.0, -1.0, 0.4]))
NOTHING = Features(
    np.zeros((0, 2), np.float32), np.zeros(0, np.int32), np.zeros(0, np.float32), np.zeros((0, 4), np.uint64),
    np.zeros((0, 3)), np.zeros(0, np.float32), np.zeros(0, np.float32),
)  # fmt: skip


def walk(seconds=14.0):
    t = np.arange(0.0, seconds, 0.02)
    poses = [SE3.exp(np.array([0.0, 0.0, 0.3 * math.sin(s), 0.5 * s, 0.1 * math.sin(s), 0.9])) for s in t]
    return Trajectory.from_poses([round(s * 1e9) for s in t], poses)


class Loop:
    """What Slam does with lights, for a body that is tracked without error in a map that lies elsewhere."""

    def __init__(self, gate=None, lights=None, known=LIGHTS, seed=0, true=LIGHTS):
        self.truth, self.events, self.map = walk(), [], Map(RIG)
        self.map.add_keyframe(0, SE3.identity(), NOTHING)
        self.fixes = along(self.truth, true, SPEC, np.random.default_rng(seed), known=known)
        self.anchor = LightAnchor(self.map, gate or GateConfig("lights"), lights or LightsConfig(), known, self.tell)
        self.map.set_pose(0, T_WORLD_MAP.inverse() @ self.truth.pose(0))

    def tell(self, t_ns, kind, **fields):
        self.events.append((t_ns, kind, fields))

    def run(self, until_s=14.0, each=lambda t_ns: None):
        fixes = iter(self.fixes)
        waiting = next(fixes)
        for t_ns in range(0, round(until_s * 1e9) - 10**8, 66_666_667):
            while waiting is not None and waiting.t_ns <= t_ns:
                self.anchor.feed(waiting)
                waiting = next(fixes, None)
            move = self.anchor.take_move()
            if move is not None:
                self.map.move(move)
            self.anchor.tracked(t_ns, 0, self.truth.pose(0).inverse() @ pose_at(self.truth, t_ns))
            each(t_ns)
        return self

    def of(self, kind):
        return [fields for _, what, fields in self.events if what == kind]


def candidate(t_ns, T_world_body):
    return Candidate(
        t_ns=t_ns, inliers=100, reference_points=300, close_tracked=150, close_untracked=20, n_keyframes=10, noise=1.0,
        since_keyframe_s=0.2, since_relocalization_s=100.0, T_world_body=T_world_body, covariance=1e-6 * np.eye(6),
    )  # fmt: skip


def test_the_map_comes_to_lie_where_the_lights_say():
    loop = Loop().run()
    off = loop.map.pose(0).inverse() @ loop.truth.pose(0)
    assert np.linalg.norm(off.t) < 0.03  # two centimetres a fix, of which neighbours share some
    assert math.degrees(off.angle) < 0.5
    assert loop.of("world")[0]["pairs"] == 1  # by the first fix, and then for good
    assert len(loop.of("world")) == 2
    assert loop.of("light_misplaced") == []


def test_the_gate_passes_what_is_right_and_refuses_what_is_not():
    said = []

    def ask(t_ns):
        if t_ns > 3_000_000_000 and loop.anchor.aligned:
            there = loop.map.pose(0) @ loop.truth.pose(0).inverse() @ pose_at(loop.truth, t_ns)
            wrong = len(said) % 2 == 1
            T = SE3(there.R, there.t + np.array([0.2, 0.0, 0.0]) * wrong)
            said.append((wrong, loop.anchor.ask(candidate(t_ns, T)).verdict))

    loop = Loop()
    loop.run(each=ask)
    right = [verdict for wrong, verdict in said if not wrong]
    assert right.count("PASS") > 0.95 * len(right)
    assert "PASS" not in [verdict for wrong, verdict in said if wrong]
    assert loop.anchor.gate.counts["pass"] == right.count("PASS")


def test_a_keyframe_that_passed_is_tied_by_a_prior_about_the_lights_pose():
    loop = Loop().run(6.0)
    t_ns = loop.anchor._path._nodes[-1].t_ns
    T = loop.map.pose(0) @ loop.truth.pose(0).inverse() @ pose_at(loop.truth, t_ns)
    keyframe = loop.map.add_keyframe(t_ns, T, NOTHING, parent=0)
    assert loop.anchor.ask(candidate(t_ns, T)).verdict == "PASS"
    loop.anchor.inserted(keyframe, t_ns)
    rows = np.array([0, keyframe], np.int32)
    (prior,) = loop.map.anchoring.priors(rows, rows)
    assert prior.keyframe == 1
    assert np.linalg.norm(prior.mean.t - pose_at(loop.truth, t_ns).t) < 0.05
    assert loop.map.anchoring.holds(rows)
    assert not loop.map.anchoring.holds(rows[:1])


def test_tight_lights_are_sightings_of_a_keyframe_at_the_time_of_their_rows():
    loop = Loop(GateConfig(), LightsConfig("tight")).run(6.0)
    t_ns = loop.anchor._path._nodes[-1].t_ns
    T = loop.map.pose(0) @ loop.truth.pose(0).inverse() @ pose_at(loop.truth, t_ns)
    keyframe = loop.map.add_keyframe(t_ns, T, NOTHING, parent=0)
    loop.anchor.inserted(keyframe, t_ns)
    rows = np.array([0, keyframe], np.int32)
    views = loop.map.anchoring.views(rows, rows)
    assert views is not None
    assert loop.map.anchoring.priors(rows, rows) == []  # not its pose as well: that would count the lights twice
    for i in range(len(views.px)):
        T_cam = pose_at(loop.truth, t_ns) @ SE3(views.R[i], views.p[i])  # with the true pose, where it must be seen
        px, _ = SPEC.camera.project((T_cam.inverse() @ views.xyz[views.light[i]])[None])
        assert np.linalg.norm(px[0] - views.px[i]) < 2.0  # 0.3 px of noise; 0.5 m/s for 0.1 s alone would be 30 px


@pytest.mark.parametrize("fault", ["moved", "swapped"])
def test_lights_that_hang_elsewhere_are_named_and_no_others(fault):
    if fault == "moved":
        wrong = {"L8": LIGHTS[8].xyz + np.array([0.0, 1.0, 0.0])}
    else:  # 3.7 m apart
        wrong = {"L8": LIGHTS[17].xyz, "L17": LIGHTS[8].xyz}
    known = tuple(replace(light, xyz=wrong.get(light.id, light.xyz)) for light in LIGHTS)
    loop = Loop(known=known).run()
    assert {event["light"] for event in loop.of("light_misplaced")} == set(wrong)
    off = loop.map.pose(0).inverse() @ loop.truth.pose(0)
    assert np.linalg.norm(off.t) < 0.03


def test_poses_that_fit_no_alignment_abstain_and_say_so():
    """Odometry in another convention, the inverse of what it should hold."""
    loop = Loop()
    loop.fixes = [
        f if f.T_world_body is None else replace(f, T_world_body=f.T_world_body.inverse(), seen=()) for f in loop.fixes
    ]
    said = []
    loop.run(each=lambda t: said.append(loop.anchor.ask(candidate(t, SE3.identity()))) if t > 8_000_000_000 else None)
    assert not loop.anchor.aligned
    assert "PASS" not in {v.verdict for v in said}
    assert any("agree" in v.why for v in said if v.verdict == "ABSTAIN")


def test_lights_of_another_clock_are_named_and_hold_nothing_until_it_is_set():
    late_s, said = 0.06, []
    ask = lambda t_ns: said.append(loop.anchor.ask(candidate(t_ns, SE3.identity())))  # noqa: E731
    for config in (LightsConfig(), LightsConfig(late_s=late_s)):
        loop = Loop(lights=config)
        loop.fixes = [replace(f, t_ns=f.t_ns + round(late_s * 1e9), seen=()) for f in loop.fixes]
        said.clear()
        loop.run(each=lambda t_ns: ask(t_ns) if t_ns > 12_000_000_000 else None)
        whys = {v.why for v in said}
        if config.late_s:
            assert loop.of("light_clock") == []
            assert not any("clock" in why for why in whys)
        else:
            (event,) = loop.of("light_clock")
            assert event["late_s"] == pytest.approx(late_s, abs=0.02)
            assert {v.verdict for v in said} == {"ABSTAIN"}
            assert all("of another clock" in why for why in whys)


def test_one_light_at_a_time_abstains_and_says_so():
    loop = Loop(known=LIGHTS)
    loop.fixes = along(loop.truth, LIGHTS[::6], SPEC, np.random.default_rng(0), known=LIGHTS[::6])
    said = []
    loop.run(each=lambda t_ns: said.append(loop.anchor.ask(candidate(t_ns, SE3.identity()))))
    assert {v.verdict for v in said} == {"ABSTAIN"}
    assert any("one light only: its yaw is unknown" in v.why for v in said)


def test_single_lights_passed_one_after_another_lay_the_map_down():
    sparse = tuple(
        Light(f"S{i}", 2000.0 + 200.0 * (i % 3), np.array([1.9 * i + 0.4, 0.3 * (-1) ** i, 2.6])) for i in range(5)
    )
    loop = Loop(known=sparse, true=sparse)
    assert not any(fix.T_world_body for fix in loop.fixes)
    loop.run()
    (event,) = loop.of("world")
    assert "S0, S1, S2" in event["why"]
    off = loop.map.pose(0).inverse() @ loop.truth.pose(0)
    assert np.linalg.norm(off.t) < 0.05  # half a degree of level, 1.7 m under the lights
    assert loop.of("light_misplaced") == []
    settled = loop.anchor.settled() @ loop.map.pose(0)  # by all five, once the run is over
    assert np.linalg.norm(settled.t - loop.truth.pose(0).t) < 0.03


def test_a_frame_that_is_carried_along_is_sent_where_the_lights_motion_leads():
    said = []

    def doubt(t_ns):
        there = pose_at(loop.truth, t_ns)
        carried = SE3(there.R, there.t + np.array([0.07, 0.0, 0.0]))  # less than the gate's 0.1 m
        said.append((loop.anchor.doubt(t_ns, there), loop.anchor.doubt(t_ns, carried), there))

    loop = Loop()
    loop.run(each=lambda t_ns: doubt(t_ns) if loop.anchor.aligned and 5_000_000_000 < t_ns < 9_000_000_000 else None)
    assert not any(right for right, _, _ in said)
    doubts = [(wrong, there) for _, wrong, there in said if wrong]
    assert len(doubts) > 0.2 * len(said)  # where a fix is 50 ms old at most, and none was doubted just before
    assert all(wrong.sure and np.linalg.norm(wrong.T_world_body.t - there.t) < 0.03 for wrong, there in doubts)
