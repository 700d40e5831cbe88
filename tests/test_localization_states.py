"""The states of localization: thresholds, hysteresis, budgets; and cameras in corridors that were redecorated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from corridors import MAPPING, NOISE_PX, ORB, OTHER, Corridor, walk
from lodelight.features.features import Features
from lodelight.geometry.se3 import SE3
from lodelight.localization.backwards import Backwards
from lodelight.localization.beside import ThreadedSearch
from lodelight.localization.follower import n_temporary
from lodelight.localization.growth import Growth
from lodelight.localization.ladder import Ladder, LadderConfig
from lodelight.localization.machine import Found
from lodelight.localization.relocalize import Hint
from lodelight.localization.second_look import SecondLookConfig
from lodelight.localization.states import State, States, StatesConfig, Step
from lodelight.localization.surroundings import Surroundings
from lodelight.localization.temporary import TemporaryConfig, TemporaryPoints
from lodelight.localization.tracked import Tracked

S = 10**9


def followed(**config):
    states = States(StatesConfig(**config))
    states.found(0, 200)
    return states


def judged(states, counts, start_s=10.0):
    """Steps for (points of the map, of both kinds) at 10 Hz."""
    return [states.judge(round((start_s + 0.1 * i) * S), *count, 0.05) for i, count in enumerate(counts)]


def test_the_map_is_enough_at_exactly_n1_and_not_one_point_below():
    assert judged(followed(), [(90, 90)] * 5) == [Step.keep] * 5
    assert judged(followed(), [(89, 89)] * 2) == [Step.keep, Step.enter]


def test_one_poor_frame_does_not_begin_carrying_and_a_good_one_starts_the_count_anew():
    states = followed()
    assert judged(states, [(60, 60), (95, 95), (60, 60), (95, 95)]) == [Step.keep] * 4
    assert states.state is State.following


def test_a_frame_below_n2_decides_nothing_and_the_second_is_lost():
    states = followed()
    assert judged(states, [(200, 200), (29, 29), (29, 29)]) == [Step.keep, Step.unsure, Step.lost]
    assert states.state is State.searching
    assert "29 points of the map agree, 30 are needed" in states.why


def test_carried_frames_need_points_of_either_kind_and_end_when_the_map_is_enough():
    states = followed()
    steps = judged(states, [(60, 60), (60, 60), (0, 30), (0, 29), (0, 30), (95, 120)])
    assert steps == [Step.keep, Step.enter, Step.keep, Step.unsure, Step.keep, Step.leave]
    assert states.state is State.following


def test_soon_after_being_found_more_points_are_asked_of_a_carried_frame_until_the_map_has_held_it():
    def last(found_by, *counts):
        states = States(StatesConfig())
        states.found(0, found_by)
        return judged(states, counts, start_s=0.1)[-1]

    assert last(60, (60, 60), (60, 60), (10, 49)) is Step.unsure
    assert last(60, (60, 60), (60, 60), (10, 50)) is Step.keep
    assert last(90, (60, 60), (60, 60), (10, 49)) is Step.keep
    assert last(60, (90, 90), (60, 60), (60, 60), (10, 49)) is Step.keep


def test_drift_is_borne_with_for_so_long_and_no_longer():
    states = followed(max_carried_s=2.0)
    steps = judged(states, [(60, 60)] * 2 + [(5, 80)] * 30)
    assert steps.index(Step.lost) == 1 + 21
    states = followed(max_carried_m=1.0)
    assert Step.lost in judged(states, [(60, 60)] * 2 + [(5, 80)] * 30)
    # while the map holds the pose, if only just, nothing drifts
    assert Step.lost not in judged(followed(max_carried_s=2.0), [(60, 100)] * 50)


def test_a_way_without_any_known_distance_is_borne_with_for_half_a_metre():
    states = followed()
    judged(states, [(60, 60), (60, 60)])
    steps = [states.judge((20 + i) * S, 0, 150, 0.1, guessed=True) for i in range(6)]
    assert steps == [Step.keep] * 5 + [Step.lost]
    assert "no distance is known" in states.why
    states = followed()
    judged(states, [(60, 60), (60, 60)])
    assert {states.judge((20 + i) * S, 0, 150, 0.1, guessed=False) for i in range(12)} == {Step.keep}


def test_without_temporary_points_the_camera_is_followed_down_to_n2():
    states = States(StatesConfig(), carrying=False)
    states.found(0, 200)
    assert judged(states, [(60, 60)] * 5 + [(20, 20)] * 2) == [Step.keep] * 5 + [Step.unsure, Step.lost]


# -- cameras in corridors ----------------------------------------------------------------------------------------


class Walk:
    """A walk with another camera through a corridor of which a stretch is not as it was mapped."""

    def __init__(self, gap=None, carrying=True, seed=0, x_m=(2.0, 21.0), config=None, live=False, dark_s=None):
        built = Corridor.built(seed)
        self.map = built.mapped(seed)
        self.before = {name: {c: v.copy() for c, v in t.columns.items()} for name, t in self.map.tables.items()}
        now = built.redecorated(*gap, seed=seed + 1000) if gap else built
        self.events = []
        self.ladder = Ladder(
            OTHER, self.map, ORB, config or LadderConfig(), 0, carrying, live,
            lambda t_ns, kind, **fields: self.events.append((t_ns, kind, fields)),
        )  # fmt: skip
        rng = np.random.default_rng(seed + 5)
        self.status, self.error_m, self.error_deg, self.carried_by, self.poses = [], [], [], [], []
        for i, x in enumerate(np.arange(*x_m, 0.08)):
            T_world_body = walk(x, 0.3 * np.sin(0.4 * x), 0.1 * np.sin(0.7 * x))
            seen, _ = now.seen(OTHER, T_world_body, rng)
            if dark_s and dark_s[0] <= 0.1 * i < dark_s[1]:
                seen = seen.take(np.zeros(0, int))
            tracked = self.ladder.locate(i * S // 10, seen)
            off = T_world_body.inverse() @ tracked.T_world_body
            self.status.append(self.ladder.status)
            self.error_m.append(float(np.linalg.norm(off.t)))
            self.error_deg.append(float(np.degrees(off.angle)))
            self.carried_by.append(n_temporary(tracked))
            self.poses.append(tracked.T_world_body)
        self.localized = np.array([s in ("tracking", "degraded", "relocalized") for s in self.status])
        self.error_m = np.array(self.error_m)

    def told(self, kind):
        return [fields for _, of, fields in self.events if of == kind]


@pytest.fixture(scope="module")
def plain():
    return Walk()


@pytest.fixture(scope="module")
def redecorated():
    return Walk(gap=(5.0, 16.0))


def test_another_camera_with_another_lens_is_exact_to_millimetres(plain):
    assert plain.localized.all()
    assert plain.status[0] == "relocalized"
    assert np.median(plain.error_m) < 0.005
    assert plain.error_m.max() < 0.02
    assert max(plain.error_deg) < 0.2


def test_temporary_points_carry_the_camera_where_the_map_is_out_of_date(redecorated):
    assert redecorated.localized.all()
    assert max(redecorated.carried_by) > 50
    assert redecorated.error_m[np.array(redecorated.status) == "tracking"].max() < 0.05
    assert redecorated.error_m.max() < 0.04 * 11.0  # a camera alone drifts along a way that no map shows
    without = Walk(gap=(5.0, 16.0), carrying=False)
    assert redecorated.localized.mean() - without.localized.mean() > 0.1
    assert without.ladder.temporary.created == 0


def test_carrying_begins_and_ends_with_its_reasons_and_a_small_jump(redecorated):
    begun, *_, ended = redecorated.told("carried")
    assert begun["begins"]
    assert "fewer than 90" in begun["why"]
    assert not ended["begins"]
    assert ended["cleared"] > 0
    assert ended["jump_m"] < 0.1
    assert {"tracking", "degraded"} <= set(redecorated.status)


def test_nothing_temporary_is_left_in_points_matches_or_map(redecorated):
    assert redecorated.ladder.temporary.created > 0
    assert redecorated.ladder.temporary_left == 0
    redecorated.ladder.close()
    assert redecorated.ladder.temporary_left == 0
    for name, table in redecorated.map.tables.items():
        for column, value in table.columns.items():
            np.testing.assert_array_equal(value, redecorated.before[name][column], err_msg=f"{name}.{column}")


def test_a_camera_lost_while_it_was_carried_leaves_nothing_temporary_behind():
    # darkness in the middle of the stretch that is not as it was mapped, so that nothing there is found again
    lost = Walk(gap=(5.0, 30.0), x_m=(2.0, 12.0), dark_s=(8.0, 9.0))
    assert "lost" in lost.status
    assert lost.status[75] == "degraded"
    assert lost.ladder.temporary.created > 0
    assert lost.ladder.temporary_left == 0


@pytest.mark.parametrize("carrying", [True, False])
def test_a_camera_that_turns_on_the_spot_to_where_nothing_is_mapped_is_carried_there_and_back(carrying):
    # nothing has parallax, so no point can be triangulated: directions alone hold the pose
    corridor = Corridor.built(1)
    rng, map = np.random.default_rng(6), corridor.mapped(1)
    ladder = Ladder(OTHER, map, ORB, LadderConfig(), 0, carrying, False, lambda *_, **__: None)
    away_deg = np.arange(0.0, 141.0, 4.0)
    status, off_m, off_deg = [], [], []
    for i, yaw_deg in enumerate([*away_deg, *away_deg[::-1]]):
        T_world_body = walk(10.0) @ SE3.exp(np.array([0.0, 0.0, np.radians(yaw_deg), 0.0, 0.0, 0.0]))
        tracked = ladder.locate(i * S // 10, corridor.seen(OTHER, T_world_body, rng)[0])
        off = T_world_body.inverse() @ tracked.T_world_body
        status.append(ladder.status)
        off_m.append(np.linalg.norm(off.t))
        off_deg.append(np.degrees(off.angle))
    assert status[-1] == "tracking"
    assert ladder.temporary_left == 0
    if carrying:
        assert "lost" not in status
        assert max(off_m) < 0.05
        assert max(off_deg) < 2.0
    else:
        assert status.count("lost") > 15


def test_darkness_in_a_known_place_is_over_with_the_first_frame_that_shows_something():
    dark = Walk(dark_s=(6.0, 9.0), x_m=(2.0, 12.0))
    assert dark.status[59] == "tracking"
    assert all(status == "lost" for status in dark.status[60:90])
    assert dark.status[90] == "relocalized"
    assert dark.error_m[90:].max() < 0.02


def test_the_same_walk_gives_the_same_bytes():
    a, b = (Walk(gap=(5.0, 16.0), x_m=(2.0, 8.0)) for _ in range(2))
    assert a.status == b.status
    assert all(p.matrix.tobytes() == q.matrix.tobytes() for p, q in zip(a.poses, b.poses, strict=True))


def test_the_search_beside_works_on_its_own_thread_too():
    walked = Walk(gap=(5.0, 16.0), x_m=(2.0, 18.0), live=True)
    walked.ladder.close()
    assert walked.localized.all()
    assert walked.ladder.temporary_left == 0


def test_a_camera_is_found_only_where_it_is_hinted():
    corridor = Corridor.built(3)
    map, rng = corridor.mapped(3), np.random.default_rng(3)
    seen, _ = corridor.seen(OTHER, walk(10.0), rng)

    def status(T_hint, covariance):
        ladder = Ladder(OTHER, map, ORB, LadderConfig(), 0, True, False, lambda *_, **__: None)
        ladder.second_look.hint = (0, Hint(T_hint, 1.5, covariance))
        ladder.locate(0, seen)
        return ladder.status, ladder.why

    sure = np.diag([0.02] * 3 + [0.01] * 3) ** 2
    assert status(walk(10.3), sure)[0] == "relocalized"
    assert status(walk(3.0), sure)[0] == "initializing"
    assert status(walk(3.0), np.diag([0.02] * 3 + [4.0] * 3) ** 2)[0] == "relocalized"
    turned = walk(10.0) @ SE3.exp(np.array([0.0, 0.0, np.pi, 0.0, 0.0, 0.0]))
    assert status(turned, sure)[0] == "initializing"
    assert status(turned, np.diag([1.0] * 3 + [0.01] * 3) ** 2)[0] == "relocalized"


def test_the_camera_that_made_the_map_and_another_see_a_point_at_octaves_that_differ_by_their_focal_lengths():
    from lodelight.mapping.sight import in_sight

    corridor = Corridor.built(0)
    map = corridor.mapped(0)
    by = {}
    for name, rig in (("same", MAPPING), ("other", OTHER)):
        spec = rig.cameras[0]
        sight = in_sight(map, map.alive_points, walk(8.0), spec.T_body_cam, spec.camera, ORB)
        by[name] = dict(zip(sight.point.tolist(), sight.octave.tolist(), strict=True))
    both = sorted(set(by["same"]) & set(by["other"]))
    inner = [p for p in both if 0 < by["same"][p] < 6]
    shift = np.mean([by["other"][p] - by["same"][p] for p in inner])
    assert shift == pytest.approx(np.log(470.5 / 380.5) / np.log(1.2), abs=0.15)  # levels are whole numbers


def test_what_a_search_on_its_own_thread_raises_reaches_who_asked():
    search = ThreadedSearch(lambda what: 1 // what)
    search.ask(1)
    search.close()
    assert search.answer() == 1
    assert search.answer() is None
    search.ask(0)
    search.close()
    with pytest.raises(ZeroDivisionError):
        search.answer()


def test_where_points_are_few_those_of_which_the_distance_is_only_supposed_get_one_in_time():
    # the camera walks straight at what was redecorated: no pair of frames has parallax enough before the map ends
    corridor = Corridor.built(3, 1500)
    now, map, rng = corridor.redecorated(5.0, 17.0, seed=1003), corridor.mapped(3), np.random.default_rng(8)
    ladder = Ladder(OTHER, map, ORB, LadderConfig(), 0, True, False, lambda *_, **__: None)
    status, off_m = [], []
    for i, x in enumerate(np.arange(2.0, 8.0, 0.1)):
        T_world_body = walk(x, 0.3 * np.sin(0.4 * x), 0.1 * np.sin(0.7 * x))
        tracked = ladder.locate(i * S // 10, now.seen(OTHER, T_world_body, rng)[0])
        status.append(ladder.status)
        off_m.append(np.linalg.norm(tracked.T_world_body.t - T_world_body.t))
    found = status.index("relocalized")
    assert found < 5
    assert set(status[found + 3 :]) == {"degraded"}
    assert max(off_m[found:]) < 0.1


def test_frames_before_a_camera_was_found_are_followed_back_from_there_one_beside_each_that_comes():
    """It is asked for only behind a stretch that was redecorated."""
    built = Corridor.built(3)
    map = built.mapped(3)
    now = built.redecorated(5.0, 12.0, seed=1003)
    looked_back = []

    class Counted(Ladder):
        def locate(self, t_ns, seen):
            looked_back.append(t_ns)
            return super().locate(t_ns, seen)

    def begun(rig, kind=Counted):
        return kind(rig, map, ORB, LadderConfig(), 0, True, False, lambda *_, **__: None)

    ladder, backwards, rng = begun(OTHER, Ladder), Backwards(OTHER, begun, 90), np.random.default_rng(8)
    true = {i * S // 10: walk(x, 0.3 * np.sin(0.4 * x), 0.0) for i, x in enumerate(np.arange(5.0, 13.0, 0.08))}
    poses, frames_back, lost = {}, [], []
    for t_ns, T_world_body in true.items():
        seen, _ = now.seen(OTHER, T_world_body, rng)
        tracked = ladder.locate(t_ns, seen if T_world_body.t[0] > 12.0 else seen.take(np.zeros(0, int)))
        lost += [t_ns] if tracked.why_lost else []
        poses.update(backwards.add(tracked, seen))
        frames_back.append(len(looked_back))
    poses.update(backwards.follow())
    assert 1 == np.diff(frames_back).max() < len(poses)
    assert len(set(poses) & set(lost)) >= 0.9 * len(lost)
    assert max(np.linalg.norm(T.t - true[t].t) for t, T in poses.items()) < 0.1
    assert backwards.created > 0
    assert backwards.left == 0
    assert backwards.follow() == []


def test_a_carried_camera_is_moved_only_by_two_answers_in_a_row_that_agree():
    """A place that looks alike is found once, or twice at poses that contradict one another."""
    nothing = Features.empty()
    here, there, elsewhere = walk(0.3), walk(0.35), walk(-0.3)
    carried = Tracked(0, nothing, walk(0.0), np.eye(6), np.zeros(0, np.int32), 0, right_in_map=40)

    class Answers:
        def __init__(self, *poses, points=80):
            self.found = [Found(pose, np.eye(6), np.arange(points), "80 points found") for pose in poses]

        def find(self, seen, hint):
            return self.found.pop(0) if self.found else "no keyframe looks alike"

    def moved(relocalizer):
        around = Surroundings(relocalizer, SecondLookConfig(every=1), live=False)
        return [around.look(carried, 0.0) for _ in range(3)]

    assert moved(Answers(here)) == [None] * 3
    assert moved(Answers(here, elsewhere)) == [None] * 3
    assert moved(Answers(walk(0.6), walk(0.6))) == [None] * 3  # farther off than carrying can have gone astray
    assert moved(Answers(here, there, points=55)) == [None] * 3  # no gain over the 40 points that tracking has
    first, second, third = moved(Answers(here, there))
    assert first is None
    assert third is None
    assert np.linalg.norm(second[0].t - there.t) < 1e-9
    assert second[1] == "80 points found beside, twice alike"


def test_a_pair_of_frames_makes_points_where_they_are_of_patches_as_large_as_their_distances_say():
    corridor, rng = Corridor.built(0), np.random.default_rng(4)
    overlay = TemporaryPoints(OTHER.cameras[0], ORB, TemporaryConfig(), NOISE_PX)
    poses = [walk(5.0), walk(5.6)]
    (before, _), (seen, which) = (corridor.seen(OTHER, pose, rng) for pose in poses)
    unlike = np.arange(len(seen)) % 2 == 1
    octave = np.where(unlike, (seen.octave + 4) % ORB.n_levels, seen.octave).astype(np.int32)
    frames = [
        Tracked(i * S, features, pose, np.eye(6), np.full(len(features), -1, np.int32), 0)
        for i, (features, pose) in enumerate(zip((before, replace(seen, octave=octave)), poses, strict=True))
    ]
    overlay.remember(frames[0], well=True)
    assert Growth(overlay).grow(frames[1], np.zeros(0)) > 0
    made = overlay.measured(frames[1].temporary)
    assert made.sum() > 50
    assert made[unlike].mean() < 0.3 * made[~unlike].mean()  # levels are whole numbers: some of four are three
    made &= ~unlike
    xyz = overlay.table.xyz[frames[1].temporary[made]]
    away_m = np.linalg.norm(corridor.xyz[which[made]] - poses[1].t, axis=1)
    assert np.median(np.linalg.norm(xyz - corridor.xyz[which[made]], axis=1) / away_m) < 0.05


def test_a_long_way_without_the_map_does_not_run_out_of_points():
    """Those left behind make room for new ones."""
    few = LadderConfig(temporary=TemporaryConfig(most=300))
    walked = Walk(gap=(6.0, 20.0), x_m=(2.0, 14.0), config=few)
    assert walked.localized.all()
    assert walked.error_m.max() < 0.1
    assert walked.ladder.temporary.created > 600
    assert len(walked.ladder.temporary) <= 300
