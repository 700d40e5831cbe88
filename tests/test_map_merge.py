"""Maps of one place become one map: where it is right, and where it must not be done."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from lodelight.anchors import Anchors
from lodelight.cli.main import main
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.localizer import Localizer, LocalizerConfig
from lodelight.mapping.invariants import problems
from lodelight.mapping.joining import through
from lodelight.mapping.map import Map
from lodelight.mapping.merge import Merged, merged
from lodelight.mapping.store import load_map, save_map
from lodelight.mapping.tags import MapTagsConfig
from lodelight.rig import CameraSpec, Rig
from lodelight.slam import Slam, SlamConfig
from maps import room_map
from rings import Ring
from single_frames import ORB
from tagged_wall import RIG, STEP_NS, T_WORLD_WALL, TAGS, frame, poses, surveyed, wall_picture

NO_TAGS = SlamConfig(tags=MapTagsConfig(use=False))
ANYWHERE = SE3.exp(np.array([0.3, -1.2, 2.0, 4.0, -3.0, 7.0]))


@pytest.fixture(scope="module")
def frames():
    wall = wall_picture()
    return [frame(wall, T, (k + 1) * STEP_NS) for k, T in enumerate(poses(40))]


def mapped(frames, config=NO_TAGS, anchors=None) -> Map:
    slam = Slam(RIG, config, anchors=anchors)
    for f in frames:
        slam.feed(f)
    slam.close()
    return slam.map


def laid_on(p: np.ndarray, true_p: np.ndarray) -> SE3:
    """The motion that lays positions (N, 3) on the true ones best (Kabsch)."""
    u, _, vt = np.linalg.svd((true_p - true_p.mean(axis=0)).T @ (p - p.mean(axis=0)))
    R = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return SE3(R, true_p.mean(axis=0) - R @ p.mean(axis=0))


def residuals_m(p: np.ndarray, true_p: np.ndarray) -> np.ndarray:
    return np.linalg.norm(laid_on(p, true_p) @ p - true_p, axis=1)


def off_truth_m(together: Merged) -> np.ndarray:
    """Of the keyframes of all parts, after one alignment of them all."""
    k, truth = together.map.keyframes, list(poses(40))
    true_p = np.array([truth[int(t) // STEP_NS - 1].t for t in k.t_ns])
    return residuals_m(k.p, true_p)


@pytest.fixture(scope="module")
def halves(frames):
    return mapped(frames[:26]), mapped(frames[14:])


@pytest.fixture(scope="module")
def together(halves):
    return merged(halves)


def test_two_walks_that_share_places_become_one_map_in_one_frame(together, halves):
    assert sorted(part.by for part in together.parts) == ["base", "places"]
    assert problems(together.map) == []
    assert len(together.map.keyframes) == sum(len(h.alive_keyframes) for h in halves)
    assert off_truth_m(together).max() < 0.01  # each half alone is exact to half of that
    assert together.shared_points(0) == together.shared_points(1) > 200
    apart = sum(len(h.alive_points) for h in halves)
    assert len(together.map.points) < apart - 200  # what both had is there once


def test_points_of_both_walks_lie_on_the_wall(together):
    """In the wall's frame, by where the keyframes truly were, z of every point is 0."""
    k, truth = together.map.keyframes, list(poses(40))
    T_wall_map = laid_on(k.p, np.array([truth[int(t) // STEP_NS - 1].t for t in k.t_ns]))
    for part in together.parts:
        seen = together.map.features.point[
            (together.map.features.keyframe >= part.keyframes[0])
            & (together.map.features.keyframe < part.keyframes[1])
        ]  # fmt: skip
        z = (T_wall_map @ together.map.points.xyz[np.unique(seen[seen >= 0])])[:, 2]
        assert np.median(np.abs(z)) < 0.01


def test_frames_of_either_walk_find_themselves_in_the_merged_map(together, frames):
    for i in (3, 36):
        localizer = Localizer(RIG, together.map, LocalizerConfig(sensors="rgbd"))
        estimates = [localizer.feed(f) for f in frames[i : i + 3]]
        localizer.close()
        assert all(e.localized for e in estimates), i


def test_neither_the_order_of_the_inputs_matters_nor_are_they_changed(halves, together, tmp_path):
    before = [h.keyframes.p.tobytes() + h.points.xyz.tobytes() for h in halves]
    other_way = merged(halves[::-1])
    save_map(together.map, tmp_path / "a.lode")
    save_map(other_way.map, tmp_path / "b.lode")
    assert (tmp_path / "a.lode").read_bytes() == (tmp_path / "b.lode").read_bytes()
    assert [h.keyframes.p.tobytes() + h.points.xyz.tobytes() for h in halves] == before


def test_a_tag_that_both_walks_saw_joins_maps_that_have_no_place_in_common(frames):
    """Two tags are seen in both; all points that could be recognised are taken away."""
    sizes = Anchors(tuple(replace(tag, T_world_tag=None) for tag in TAGS))
    halves = mapped(frames[:28], SlamConfig(), sizes), mapped(frames[12:], SlamConfig(), sizes)
    halves[1].features.desc[:] = np.random.default_rng(0).integers(0, 2**64, halves[1].features.desc.shape, np.uint64)
    halves[1].refresh_points(halves[1].alive_points, ORB.scale_factor, ORB.n_levels)
    together = merged(halves)
    assert sorted(part.by for part in together.parts) == ["base", "tags"]
    assert problems(together.map) == []
    assert int(together.map.tags.placed.sum()) == len(TAGS)  # each is there once
    assert off_truth_m(together).max() < 0.02  # half a degree of a tag from 1.3 m


def test_maps_that_stand_in_the_world_need_nothing_in_common(frames):
    first, second = (mapped(frames[a:b], SlamConfig(), Anchors((surveyed(tag),))) for a, b, tag in (
        (0, 13, TAGS[0]), (27, 40, TAGS[2]),
    ))  # fmt: skip
    together = merged([first, second])
    assert sorted(part.by for part in together.parts) == ["base", "the world"]
    k, truth = together.map.keyframes, list(poses(40))
    true_p = np.array([(T_WORLD_WALL @ truth[int(t) // STEP_NS - 1]).t for t in k.t_ns])
    assert np.linalg.norm(k.p - true_p, axis=1).max() < 0.05  # a single tag turns each map by up to 2 degrees


def test_maps_of_drifting_walks_round_a_ring_close_it_together():
    """Each goes little more than half round; where they meet at both ends, 20 cm of drift are spread."""
    first, second = (Ring(span=np.pi + 0.6, begin=b, drift_deg=0.08, drift_m=0.006) for b in (0.0, np.pi))
    second.map.move(ANYWHERE)
    together = merged([first.map, second.map])
    assert problems(together.map) == []
    truth = np.array([T.t for ring in (first, second) for T in ring.truth])
    if together.parts[0].by != "base":
        truth = np.array([T.t for ring in (second, first) for T in ring.truth])
    alone = [residuals_m(r.map.keyframes.p, np.array([T.t for T in r.truth])).max() for r in (first, second)]
    assert residuals_m(together.map.keyframes.p, truth).max() < 0.5 * max(alone)


def test_a_map_that_fits_in_two_places_is_left_out():
    base = Ring(copied=True, span=4.6, drift_deg=0.0, drift_m=0.0)
    part = Ring(copied=True, span=0.9, begin=0.05, drift_deg=0.0, drift_m=0.0)
    together = merged([base.map, part.map])
    assert together.parts[1].by == ""
    assert "fits in two places" in together.parts[1].why
    assert len(together.map.keyframes) == len(base.truth)


def test_another_lens_on_another_body_joins_by_what_it_saw():
    base, other = Ring(span=3.0, drift_deg=0.0, drift_m=0.0), Ring(span=2.0, begin=1.5, drift_deg=0.0, drift_m=0.0)
    lens = Camera.create("equidistant", 800, 600, (430.0, 431.0, 398.0, 301.0), (-0.01, 0.002))
    seen = through(other.map, Rig((CameraSpec("cam0", lens, ANYWHERE),)), ORB)
    assert problems(seen) == []
    assert len(seen.features) == len(other.map.features)  # the other image shows more
    k, rows = 5, other.map.feature_range(5)
    ray = lens.unproject(seen.features.px[rows])[0]
    np.testing.assert_allclose(ray, other.map.features_of(k).ray, atol=2e-6)  # pixels are float32
    T_world_cam = seen.pose(k) @ ANYWHERE
    np.testing.assert_allclose(T_world_cam.matrix, other.map.pose(k).matrix, atol=1e-9)
    together = merged([base.map, seen])
    assert [part.by for part in together.parts] == ["base", "places"]
    truth = np.array([T.t for ring in (base, other) for T in ring.truth])
    assert residuals_m(together.map.keyframes.p, truth).max() < 0.05


def test_the_command_writes_what_joined_and_names_what_did_not(halves, tmp_path, capsys):
    names = [str(tmp_path / f"{name}.lode") for name in ("first", "second", "room")]
    for name, map in zip(names, (*halves, room_map()), strict=True):
        save_map(map, name)
    out = str(tmp_path / "building.lode")
    assert main(["map", "merge", *names, "--out", out, "--json"]) == 1
    said = capsys.readouterr()
    assert "room.lode was left out: it has no tag and no place with the others" in said.err
    assert said.err.count("\n") == 1
    told = json.loads(said.out)
    assert sorted(part["by"] for part in told["parts"]) == ["", "base", "places"]
    assert len(load_map(out).keyframes) == told["keyframes"]
    assert main(["map", "check", out]) == 0
    capsys.readouterr()
    assert main(["map", "merge", names[0], names[2], "--out", str(tmp_path / "none.lode")]) == 1
    assert "nothing was written" in capsys.readouterr().err
    assert not (tmp_path / "none.lode").exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["a.lode", "--out", "c.lode"], "at least two"),
        (["a.lode", "a.lode", "--out", "c.lode"], "named twice"),
        (["a.lode", "b.lode", "--out", "b.lode"], "never changes"),
        (["a.lode", "gone.lode", "--out", "c.lode"], "does not exist"),
        (["a.lode", "text.lode", "--out", "c.lode"], "is not a map"),
    ],
)
def test_bad_input_is_one_line_and_status_2(tmp_path, monkeypatch, capsys, arguments, said):
    monkeypatch.chdir(tmp_path)
    for name in ("a.lode", "b.lode"):
        save_map(room_map(), tmp_path / name)
    (tmp_path / "text.lode").write_text("no map")
    assert main(["map", "merge", *arguments]) == 2
    err = capsys.readouterr().err
    assert said in err
    assert err.count("\n") == 1
    assert not (tmp_path / "c.lode").exists()
