"""Settings, pacing, the mapping thread, and `lodelight run` as a user meets it, mistakes included."""

import json
import shutil
import sqlite3
import threading
import time

import numpy as np
import pytest

from conftest import shared_data
from lodelight.cli.main import main
from lodelight.errors import ConfigError
from lodelight.io.pacing import Paced
from lodelight.mapping.worker import ThreadedMapping
from lodelight.messages import Frame
from lodelight.settings import as_table, with_settings
from lodelight.slam import SlamConfig


def test_settings_reach_any_depth_and_keep_their_types():
    config = with_settings(SlamConfig(), ["orb.n_features=500", "keyframes.overlap=0.9", "sensors=stereo"])
    assert (config.orb.n_features, config.keyframes.overlap, config.sensors) == (500, 0.9, "stereo")
    assert as_table(config)["orb"]["n_features"] == 500
    assert with_settings(config, ["keyframes.weak_tracking_override=false"]).keyframes.weak_tracking_override is False


@pytest.mark.parametrize(
    ("assignment", "says"),
    [
        ("orb.n_feature=500", "unknown setting orb.n_feature"),
        ("orb.n_features=many", "must be of type int"),
        ("orb=3", "is a section"),
        ("orb.n_features", "section.key=value"),
        ("sensors.x=1", "not a section"),
        ("keyframes.weak_tracking_override=maybe", "must be of type bool"),
    ],
)
def test_a_wrong_setting_is_named(assignment, says):
    with pytest.raises(ConfigError, match=says):
        with_settings(SlamConfig(), [assignment])


def frames(n, period_ms):
    return iter([Frame(i * period_ms * 10**6, (np.zeros((2, 2), np.uint8),)) for i in range(n)])


def test_pacing_drops_the_oldest_waiting_frames_of_a_slow_consumer_and_none_of_a_fast_one():
    dropped = []
    assert len(list(Paced(frames(20, 50), dropped.append))) == 20  # a machine may be busy for some of these 50 ms
    assert dropped == []
    got = []
    for frame in Paced(frames(20, 5), dropped.append):
        got.append(frame.t_ns)
        time.sleep(0.03)
    assert len(got) + len(dropped) == 20
    assert len(dropped) > 5
    assert got == sorted(got)


def test_pacing_ends_its_thread_when_the_consumer_leaves():
    paced = iter(Paced(frames(1000, 50), lambda t_ns: None))
    next(paced)
    paced.close()
    deadline = time.monotonic() + 5.0
    while any(t.name == "pacing" for t in threading.enumerate()) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not any(t.name == "pacing" for t in threading.enumerate())


def test_the_mapping_thread_does_everything_in_order_and_hands_on_what_fails():
    done = []
    mapping = ThreadedMapping(done.append)
    for k in range(20):
        mapping.submit(k)
    mapping.close()
    assert done == list(range(20))

    def fails(keyframe):
        raise ValueError("broken map")

    mapping = ThreadedMapping(fails)
    mapping.submit(0)
    with pytest.raises(ValueError, match="broken map"):
        mapping.close()


@pytest.fixture(scope="module")
def short_run(tmp_path_factory):
    """The out folder of two seconds of a real recording."""
    out = tmp_path_factory.mktemp("out")
    assert main(["run", str(shared_data("tum_fr1_rpy")), "--out", str(out), "--end", "1.5"]) == 0
    return out


def test_run_writes_every_file_of_the_contract(short_run):
    names = {p.name for p in short_run.iterdir()}
    assert names >= {
        "trajectory.tum", "trajectory_live.tum", "covariance.csv", "map.lode", "cloud.ply", "events.jsonl",
        "metrics.json", "report.html", "config.toml",
    }  # fmt: skip
    metrics = json.loads((short_run / "metrics.json").read_text())
    assert metrics["tracked_fraction"] == 1.0
    assert metrics["ate"]["final"]["rmse_m"] < 0.03
    decisions = [json.loads(line) for line in (short_run / "events.jsonl").read_text().splitlines()]
    keyframes = [d for d in decisions if d["kind"] == "keyframe"]
    assert len(keyframes) == metrics["frames"]
    assert all(d["why"] for d in keyframes)


def test_run_continues_a_saved_map_and_leaves_the_file_it_came_from_alone(short_run, tmp_path):
    before = (short_run / "map.lode").read_bytes()
    source = str(shared_data("tum_fr1_rpy"))
    again = ["run", source, "--out", str(tmp_path), "--map", str(short_run / "map.lode"), "--start", "1", "--end", "2"]
    assert main(again) == 0
    assert (short_run / "map.lode").read_bytes() == before
    assert json.loads((tmp_path / "metrics.json").read_text())["relocalizations"] == 1


def fails(capsys, *arguments):
    """One line on standard error, exit status 2."""
    assert main(["run", *map(str, arguments)]) == 2
    said = capsys.readouterr().err.strip()
    assert "\n" not in said
    assert "Traceback" not in said
    return said


def test_mistakes_get_one_line_and_exit_status_2(capsys, short_run, tmp_path):
    source = shared_data("tum_fr1_rpy")
    assert "no-such" in fails(capsys, tmp_path / "no-such", "--out", tmp_path / "o")
    assert "stereo" in fails(capsys, source, "--out", tmp_path / "o", "--sensors", "stereo")
    assert "lidar" in fails(capsys, source, "--out", tmp_path / "o", "--sensors", "lidar")
    assert "orb.x" in fails(capsys, source, "--out", tmp_path / "o", "--set", "orb.x=1")
    (tmp_path / "file").write_text("")
    assert "file" in fails(capsys, source, "--out", tmp_path / "file" / "o")
    cut = tmp_path / "cut.lode"
    cut.write_bytes((short_run / "map.lode").read_bytes()[:20000])
    assert "cut.lode" in fails(capsys, source, "--out", tmp_path / "o", "--map", cut)
    newer = tmp_path / "newer.lode"
    shutil.copy(short_run / "map.lode", newer)
    with sqlite3.connect(newer) as db:
        db.execute("PRAGMA user_version = 999")
    assert "999" in fails(capsys, source, "--out", tmp_path / "o", "--map", newer)
    (tmp_path / "notes.lode").write_text("not a map")
    assert "notes.lode" in fails(capsys, source, "--out", tmp_path / "o", "--map", tmp_path / "notes.lode")
    assert "no frame" in fails(capsys, source, "--out", tmp_path / "o", "--start", "1000")
