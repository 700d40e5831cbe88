"""Every rule that holds in a map is seen to break, one at a time; and sound maps break none."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from lodelight.features.orb import OrbConfig
from lodelight.geometry.se3 import SE3
from lodelight.mapping import invariants
from lodelight.mapping.local import LocalMapper, LocalMappingConfig, fuse_into
from lodelight.mapping.map import Map
from maps import large_map, room_map, room_rig, thinned


@pytest.mark.parametrize("seed", range(6))
def test_sound_maps_have_no_problem_alive_or_thinned(seed: int) -> None:
    map = room_map(seed, n_keyframes=3 + 4 * seed, n_points=50 * seed, sigma_px=1.0)
    assert invariants.problems(map) == []
    if seed:
        assert invariants.problems(thinned(map, seed)) == []
    assert invariants.problems(large_map(20, 100, 500, seed)) == []


@pytest.mark.parametrize("order", [range(1, 11), range(10, 0, -1)])
def test_a_culled_keyframe_stays_where_it_was_and_hangs_on_one_that_is_left(order: range) -> None:
    map = room_map(n_keyframes=12)
    believed = {k: map.pose(k) for k in range(12)}
    for keyframe in order:
        map.remove_keyframe(keyframe)
    assert map.keyframes.alive[map.keyframes.parent[1:]].all()  # no chain grows with the run
    for k in range(12):
        np.testing.assert_allclose(map.pose(k).matrix, believed[k].matrix, atol=1e-12)  # rounding of a few products
    map.set_pose(0, map.pose(0) @ SE3.exp(np.array([0.1, 0.0, 0.2, 1.0, 2.0, 3.0])))
    for k in range(1, 11):
        before = believed[0].inverse() @ believed[k]
        np.testing.assert_allclose((map.pose(0).inverse() @ map.pose(k)).matrix, before.matrix, atol=1e-12)


def broken(change: Callable[[Map], object]) -> list[str]:
    map = room_map()
    change(map)
    return invariants.problems(map)


def test_corners_of_a_rolling_shutter_may_lie_past_the_rim() -> None:
    rig = room_rig()
    rolling = replace(rig, cameras=(replace(rig.cameras[0], row_time_s=30e-6),))
    for px, allowed in ([650.0, 10.0], True), ([720.0, 10.0], False):
        map = room_map(rig=rolling)
        map.features.px[5] = px
        assert (invariants.problems(map) == []) is allowed


def set_column(table: str, column: str, row: int, value: object) -> Callable[[Map], object]:
    def change(map: Map) -> None:
        map.tables[table].columns[column][row] = value

    return change


@pytest.mark.parametrize(
    ("table", "column", "value", "said"),
    [
        ("keyframes", "parent", 12, "keyframes whose parent is no row of keyframes: 5"),
        ("keyframes", "first_feature", -2, "keyframes whose first_feature is no row of features: 5"),
        ("keyframes", "first_feature", 3, "keyframes whose features do not follow those of the one before: 5"),
        ("keyframes", "n_features", -1, "keyframes with a negative number of features: 5"),
        ("features", "point", 1 << 20, "features whose point is no row of points: 5"),
        ("features", "next", -2, "features whose next is no row of features: 5"),
        ("features", "keyframe", 1, "features that name another keyframe than the one that names them: 5"),
        ("points", "head", 1 << 20, "points whose head is no row of features: 5"),
        ("points", "first_keyframe", 99, "points whose first_keyframe is no row of keyframes: 5"),
        ("points", "n_obs", 77, "points whose n_obs is not the length of their list: 5"),
        ("points", "head", -1, "points whose n_obs is not the length of their list: 5"),
        ("points", "replaced_by", 5, "points that were replaced by themselves in the end: 5"),
        ("points", "replaced_by", 6, "points alive though another replaced them: 5"),
        ("points", "alive", False, "dead points that features still see: 5"),
        ("points", "xyz", np.nan, "points whose xyz is not finite: 5"),
        ("keyframes", "R", 1.001 * np.eye(3), "keyframes whose R is no rotation: 5"),
        ("keyframes", "R", np.diag([1.0, 1.0, -1.0]), "keyframes whose R is no rotation: 5"),
        ("keyframes", "R", np.nan, "keyframes whose R is not finite: 5"),
        ("keyframes", "p", np.inf, "keyframes whose p is not finite: 5"),
        ("keyframes", "parent", 5, "keyframes that are their own ancestors: 5, 6"),
        ("keyframes", "parent", -1, "keyframes without a parent, where one is the root of all: 0, 5"),
        ("keyframes", "alive", False, "keyframes whose parent is dead: 6"),
        ("features", "px", [640.0, 10.0], "features outside the 640x480 image: 5"),
        ("features", "px", np.nan, "features whose px is not finite: 5"),
    ],
)
def test_broken_value_is_found(table: str, column: str, value: object, said: str) -> None:
    found = broken(set_column(table, column, 5, value))
    assert any(said in line for line in found), found


def test_loops_between_keyframes_that_are_not_there_are_found() -> None:
    assert broken(set_column("loops", "b", 0, 12)) == ["loops whose b is no row of keyframes: 0"]


def test_lists_that_run_in_circles_or_together_are_found_and_the_search_ends() -> None:
    def circle(map: Map) -> None:
        rows = map.observations(4)
        map.features.next[rows[-1]] = rows[0]

    def into_another(map: Map) -> None:
        map.features.next[map.observations(4)[-1]] = map.points.head[9]

    for change in (circle, into_another):
        assert any("points whose list of features runs into another list" in line for line in broken(change))


def test_feature_left_out_of_its_points_list_is_found() -> None:
    def skip_one(map: Map) -> None:
        point = int(np.argmax(map.points.n_obs))
        rows = map.observations(point)
        map.features.next[rows[0]] = rows[2]

    assert any("features that name a point which does not list them" in line for line in broken(skip_one))


def test_keyframe_that_sees_a_point_twice_is_found() -> None:
    def twice(map: Map) -> None:
        rows = map.feature_range(3)
        map.link([rows.start], [map.features.point[rows.start + 1]])

    found = broken(twice)
    assert any("features whose keyframe sees the same point twice" in line for line in found)


def test_point_alive_without_a_feature_is_found() -> None:
    def forget(map: Map) -> None:
        map.unlink(map.observations(7))
        map.points.alive[7] = True

    assert broken(forget) == ["points alive that no feature sees: 7"]


def test_longer_circles_of_parents_are_found() -> None:
    assert broken(set_column("keyframes", "parent", 2, 9)) == [
        "keyframes that are their own ancestors: 2, 3, 4, 5, 6, ... (10 in all)"
    ]


# -- what mapping does to a map keeps it sound ----------------------------------------------------------------------


def test_a_keyframe_whose_matches_were_fused_since_sees_each_point_once() -> None:
    map, mapper = mapper_of(room_map())
    seen, point = map.features_of(3), map.points_of(3).copy()
    map.fuse_points(int(point[0]), int(point[1]))
    mapper.insert(10**12, map.pose(3), seen, point, weight=1.0, parent=11)
    assert invariants.problems(map) == []


def test_fusing_neighbours_points_into_a_keyframe_keeps_the_map_sound() -> None:
    """The points of a second map of the same room, laid over the first with errors of some pixels."""
    map, mapper = mapper_of(room_map(n_points=600))
    other = room_map(n_points=600, sigma_px=1.0)
    rng = np.random.default_rng(0)
    for k in range(0, 12, 2):
        points = other.points_of(k).copy()
        mapper.insert(10**12 + k, other.pose(k), other.features_of(k), np.full(len(points), -1, np.int32), 1.0, 11)
    n_before = len(map.alive_points)
    for keyframe in rng.permutation(len(map.keyframes)):
        fuse_into(map, int(keyframe), map.alive_points, mapper.orb, radius_px=6.0)
    assert len(map.alive_points) < n_before  # something was fused
    assert invariants.problems(map) == []


def mapper_of(map: Map) -> tuple[Map, LocalMapper]:
    return map, LocalMapper(map, OrbConfig(), LocalMappingConfig())


def test_joining_leaves_alone_what_the_keyframe_sees_elsewhere_and_what_is_dead():
    map = room_map()
    rows = np.flatnonzero((map.features.keyframe == 0) & (map.features.point >= 0))[:3]
    first, second, third = map.features.point[rows].tolist()
    map.remove_points([third])
    map.join(rows[:2], [second, third])
    assert map.features.point[rows].tolist() == [first, second, -1]
    assert invariants.problems(map) == []
