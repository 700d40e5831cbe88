"""Tags in SLAM with depth: a textured wall with tags on it, seen through an exact warp."""

import json
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from lodelight.anchors import Anchors
from lodelight.cli.main import main
from lodelight.io.anchors_toml import read_anchors, write_anchors
from lodelight.io.rig_toml import write_rig
from lodelight.mapping.invariants import problems
from lodelight.mapping.store import load_map, save_map
from lodelight.messages import Frame
from lodelight.rig import Rig
from lodelight.slam import Slam, SlamConfig
from tagged_wall import RIG, STEP_NS, T_WORLD_WALL, TAGS, frame, poses, surveyed, wall_picture


@pytest.fixture(scope="module")
def wall() -> np.ndarray:
    return wall_picture()


@pytest.fixture(scope="module")
def frames(wall) -> list[Frame]:
    return [frame(wall, T, (k + 1) * STEP_NS) for k, T in enumerate(poses())]


def run(frames, anchors, config=None):
    events = []
    slam = Slam(RIG, config or SlamConfig(), anchors=anchors, on_event=lambda t, kind, **f: events.append((kind, f)))
    estimates = [slam.feed(f) for f in frames]
    slam.close()
    return slam, estimates, events


def errors_m(slam: Slam) -> np.ndarray:
    truth = [T_WORLD_WALL @ T for T in poses()]
    path = slam.trajectory()
    return np.array([np.linalg.norm(path.xyz[i] - truth[t // STEP_NS - 1].t) for i, t in enumerate(path.t_ns.tolist())])


def test_surveyed_tags_tie_the_map_to_the_world(frames, tmp_path):
    slam, estimates, events = run(frames, Anchors(tuple(map(surveyed, TAGS))))
    assert len([f for kind, f in events if kind == "aligned"]) == 1
    assert errors_m(slam).max() < 0.01
    aligned = [e for e in estimates if e.details["aligned"]]
    assert len(aligned) > 15
    truth = {(k + 1) * STEP_NS: T_WORLD_WALL @ T for k, T in enumerate(poses())}
    live = [np.linalg.norm(e.T_world_body.t - truth[e.t_ns].t) for e in aligned]
    assert max(live) < 0.05  # one tag's attitude is all that is known at first
    assert problems(slam.map) == []
    save_map(slam.map, tmp_path / "wall.lode")
    again = load_map(tmp_path / "wall.lode")
    assert again.tags.name.tolist() == slam.map.tags.name.tolist()
    assert Slam(RIG, SlamConfig(), map=again).tags.aligned  # the world is where it was left


def test_unknown_tags_are_mapped_to_a_centimetre(frames):
    sizes = Anchors(tuple(replace(tag, T_world_tag=None) for tag in TAGS))
    slam, _, events = run(frames, sizes)
    assert not slam.tags.aligned
    found = {tag.id: tag.T_world_tag for tag in slam.tags.found()}
    assert set(found) == {"1", "2", "3"}
    T_map_wall = found["1"] @ TAGS[0].T_world_tag.inverse()
    for tag in TAGS[1:]:
        expected = found["1"].inverse() @ found[tag.id]
        truth = TAGS[0].T_world_tag.inverse() @ tag.T_world_tag
        assert np.linalg.norm(expected.t - truth.t) < 0.02
    start = next(iter(poses()))
    assert np.linalg.norm((T_map_wall @ start).t) < 0.02  # the map begins at the first camera
    assert not [f for kind, f in events if kind == "tag"]


@pytest.mark.parametrize("wrong", [0, 1, 2])
def test_a_tag_that_was_moved_is_named_and_bends_nothing(frames, wrong):
    """Whichever it is: also the one that is seen first."""
    tags = [surveyed(tag, (0.5, 0.0, 0.1) if i == wrong else (0.0, 0.0, 0.0)) for i, tag in enumerate(TAGS)]
    slam, _, events = run(frames, Anchors(tuple(tags)))
    named = [f for kind, f in events if kind == "tag" and f["verdict"] == "contradicts" and "," not in f["tag"]]
    assert {f["tag"] for f in named} == {f"tag36h11 {wrong + 1}"}
    assert re.search(r"0\.[45]\d m", named[0]["why"])
    assert errors_m(slam).max() < 0.03


def test_without_anchors_squares_are_not_looked_for(frames):
    slam, _, events = run(frames[:4], None)
    assert slam.tags.detector.families == ("qr",)
    assert len(slam.map.tags) == 0
    assert not [f for kind, f in events if kind in ("tag", "aligned")]


def recording(folder, frames):
    """The frames as a TUM RGB-D folder that knows where its tags hang."""
    rows = {"rgb": [], "depth": []}
    for f in frames:
        stamp = f"{f.t_ns // 10**9}.{f.t_ns % 10**9:09d}"
        depth = np.round(f.depth * 5000.0).astype(np.uint16)
        for kind, image in (("rgb", f.images[0]), ("depth", depth)):
            (folder / kind).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / kind / f"{stamp}.png"), image)
            rows[kind].append(f"{stamp} {kind}/{stamp}.png\n")
    for kind, lines in rows.items():
        (folder / f"{kind}.txt").write_text("".join(lines))
    write_rig(folder / "rig.toml", Rig(RIG.cameras, depth=replace(RIG.depth, units_per_m=5000.0)))
    write_anchors(folder / "anchors.toml", Anchors(tuple(map(surveyed, TAGS))))
    return folder


def test_the_survey_of_a_recording_is_written_and_measured(frames, tmp_path, capsys):
    source = recording(tmp_path / "wall", frames)
    write_anchors(tmp_path / "sizes.toml", Anchors(tuple(replace(tag, T_world_tag=None) for tag in TAGS)))
    out = tmp_path / "out"
    args = ["--anchors", str(tmp_path / "sizes.toml"), "--out", str(out), "--json"]
    assert main(["tags", "map", str(source), *args]) == 0
    metrics = json.loads(capsys.readouterr().out)
    assert metrics["tags"] == 3
    assert metrics["tag_errors"]["count"] == 3
    assert metrics["tag_errors"]["max_m"] < 0.02
    assert {tag.id for tag in read_anchors(out / "anchors.toml").tags} == {"1", "2", "3"}
    assert cv2.imread(str(out / "tags.png")).shape[0] > 100
    header = (out / "cloud.ply").read_bytes().split(b"end_header")[0].decode()
    assert "comment tag 1 is tag36h11 1" in header
    assert "property int tag" in header
    # and from there: another run in the world of that survey
    args = ["run", str(source), "--anchors", str(source / "anchors.toml"), "--out", str(out), "--json"]
    assert main(args) == 0
    assert json.loads(capsys.readouterr().out)["aligned"] is True


def test_a_recording_without_tags_of_known_size_is_a_failure_in_one_line(frames, tmp_path, capsys):
    source = recording(tmp_path / "wall", frames[:5])
    assert main(["tags", "map", str(source), "--out", str(tmp_path / "out")]) == 1
    assert "no tag could be mapped" in capsys.readouterr().err
