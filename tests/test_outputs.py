"""The out folder: every promised file, the same bytes twice, one line when the disk says no."""

import csv
import itertools
import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from lodelight.errors import SourceError
from lodelight.evaluation.associate import matched
from lodelight.evaluation.ate import ate
from lodelight.io.covariances import read_covariances
from lodelight.io.trajectories import read_trajectory
from lodelight.report.metrics import spread_ms
from lodelight.report.outputs import FILES, Outputs
from lodelight.report.plain import json_line, plain
from lodelight.trajectory import Trajectory
from out_folder import START_NS, make_run, walk

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

METRICS = {
    *("frames", "tracked_fraction", "keyframes", "map_points", "ms_per_frame", "ms_per_keyframe", "compile_s"),
    *("real_time_factor", "peak_rss_mb", "states", "gate", "temporary_points", "loops", "relocalizations", "ate"),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("run")
    make_run(out)
    return out


def test_every_file_is_written_and_no_temporary_one_left(folder):
    assert {p.name for p in folder.iterdir()} == set(FILES)


def test_metrics_have_every_key(folder):
    metrics = json.loads((folder / "metrics.json").read_text())
    assert set(metrics) == METRICS
    assert set(metrics["ms_per_frame"]) == set(metrics["ms_per_keyframe"]) == {"mean", "p50", "p95", "p99", "max"}
    assert set(metrics["states"]) == {"initializing", "tracking", "degraded", "lost", "relocalized"}
    assert sum(metrics["states"].values()) == pytest.approx(1)
    assert set(metrics["gate"]) == {"pass", "veto", "abstain"}
    assert set(metrics["temporary_points"]) == {"created", "left"}
    for which in ("final", "live"):
        assert {"rmse_m", "median_m", "p95_m", "rotation_deg"} <= set(metrics["ate"][which])
    assert metrics["real_time_factor"] == pytest.approx(0.62)  # wall time less compilation, over the recording's


def test_metrics_have_every_key_when_nothing_was_seen(tmp_path):
    with Outputs(tmp_path, {"seed": 0}) as outputs:
        empty = Trajectory.from_poses([], [])
        metrics = outputs.finish(empty, np.zeros((0, 3)), {}, None, wall_s=1.0, compile_s=0.0, recording_s=0.0)
    assert set(metrics) == METRICS
    assert metrics["ate"] is None
    assert metrics["real_time_factor"] is None
    assert metrics["ms_per_frame"]["p95"] is None


@pytest.mark.parametrize(("name", "which"), [("trajectory.tum", "final"), ("trajectory_live.tum", "live")])
def test_ate_in_the_metrics_is_that_of_the_written_files(folder, name, which):
    metrics = json.loads((folder / "metrics.json").read_text())
    result = ate(*matched(read_trajectory(folder / name), walk(300)))
    # files hold nine decimals
    assert metrics["ate"][which]["rmse_m"] == pytest.approx(result.rmse_m, abs=1e-8)
    assert metrics["ate"][which]["rotation_deg"] == pytest.approx(result.rotation_deg, abs=1e-6)


def test_the_live_trajectory_and_covariances_are_of_localized_frames_only(folder):
    with (folder / "frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 300
    localized = [int(r["t_ns"]) for r in rows if r["status"] in ("tracking", "degraded", "relocalized")]
    live = read_trajectory(folder / "trajectory_live.tum")
    t_ns, covariances = read_covariances(folder / "covariance.csv")
    assert live.t_ns.tolist() == t_ns.tolist() == localized
    assert (np.linalg.eigvalsh(covariances) > 0).all()


def test_events_tell_every_change_of_state(folder):
    events = [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]
    states = [(e["before"], e["now"]) for e in events if e["kind"] == "state"]
    assert states[0] == (None, "initializing")
    assert [now for _, now in states] == ["initializing", "tracking", "degraded", "lost", "relocalized", "tracking"]
    assert all(a[1] == b[0] for a, b in itertools.pairwise(states))
    assert "tracks survived" in next(e["why"] for e in events if e.get("now") == "lost")


def test_an_event_is_on_disk_as_soon_as_it_is_told(tmp_path):
    with Outputs(tmp_path, {}) as outputs:
        outputs.event(START_NS, "keyframe", inserted=np.bool_(True), weight=np.float32(0.5), near=np.arange(2))
        line = json.loads((tmp_path / "events.jsonl").read_text())
    assert line == {"t_ns": START_NS, "kind": "keyframe", "inserted": True, "weight": 0.5, "near": [0, 1]}


def test_the_same_run_gives_the_same_bytes_whatever_time_it_took(folder, tmp_path):
    make_run(tmp_path, slow_ms=3.0)
    timed = {"metrics.json", "frames.csv", "report.html"}
    for name in set(FILES) - timed:
        assert (folder / name).read_bytes() == (tmp_path / name).read_bytes(), name


def test_the_config_holds_what_was_in_force_with_versions(folder):
    config = tomllib.loads((folder / "config.toml").read_text())
    assert config["seed"] == 0
    assert config["slam"] == {"window": 10}  # what was not set is not there
    assert set(config["versions"]) == {"lodelight", "python", "numpy", "numba", "opencv"}


def test_the_cloud_reads_elsewhere(folder):
    assert len(PlyData.read(str(folder / "cloud.ply"))["vertex"]) == 2000


def test_a_new_run_does_not_leave_an_old_runs_results_beside_it(tmp_path):
    make_run(tmp_path, frames=20, points=10)
    (tmp_path / "map.lode").write_bytes(b"kept: the run may continue it")
    Outputs(tmp_path, {}).close()
    assert {p.name for p in tmp_path.iterdir()} == {"config.toml", "events.jsonl", "map.lode"}


def test_a_place_that_cannot_be_written_is_one_clear_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(SourceError, match=r"cannot write .*file"):
        Outputs(tmp_path / "file", {})


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full, a disk that is always full")
def test_a_full_disk_is_one_clear_error(tmp_path):
    outputs = Outputs(tmp_path, {})
    outputs._events.close()
    outputs._events = open("/dev/full", "w")  # noqa: SIM115
    with pytest.raises(SourceError, match=r"events\.jsonl: No space left"):
        write_and_leave(outputs)


def write_and_leave(outputs):
    """As a run does: what could not be written is tried again when the folder is closed."""
    with outputs:
        outputs.event(0, "state")


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root writes everywhere")
def test_a_read_only_folder_is_one_clear_error(tmp_path):
    tmp_path.chmod(0o555)
    with pytest.raises(SourceError, match="cannot write"):
        Outputs(tmp_path / "out", {})


def test_percentiles_are_numpys():
    values = np.random.default_rng(0).gamma(2, 5, 100)
    assert spread_ms(values.tolist())["p95"] == pytest.approx(np.percentile(values, 95))


def test_what_is_no_number_is_null_and_what_is_unknown_refused():
    assert json_line({"a": float("nan"), "b": np.inf, "c": None}) == '{"a": null, "b": null, "c": null}\n'
    assert plain(Path("a") / "b") == str(Path("a") / "b")
    with pytest.raises(TypeError, match="object"):
        plain(object())
