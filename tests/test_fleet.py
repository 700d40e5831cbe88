"""Fleets: many recordings, here and on a cluster, stopped and gone on with, and one map of them."""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from dying import die_once
from lodelight.cli.fleet import run_one
from lodelight.cli.main import main
from lodelight.fleet.jobs import Job, jobs_of
from lodelight.fleet.workers import in_processes, on_cluster
from lodelight.mapping.store import check_map, load_map
from recordings import write_tum
from tagged_wall import N_POSES, STEP_NS, poses, wall_picture, write_walk


@pytest.fixture(scope="module")
def walks(tmp_path_factory) -> list[Path]:
    """Three recordings: two that overlap with the middle one; and a folder that is none."""
    root, wall = tmp_path_factory.mktemp("walks"), wall_picture()
    good = [write_walk(root / f"walk{i}", wall, 12 * i, 12 * i + 16) for i in range(3)]
    (root / "broken").mkdir()
    (root / "broken" / "readme.txt").write_text("no recording")
    return [*good, root / "broken"]


@pytest.fixture(scope="module")
def building(walks, tmp_path_factory):
    """The out folder of a fleet in processes, its exit status and what it said."""
    out = tmp_path_factory.mktemp("building")
    said, told = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(told), contextlib.redirect_stderr(said):
        status = main(["fleet", *map(str, walks), "--out", str(out), "--jobs", "2"])
    return out, status, told.getvalue(), said.getvalue()


def test_one_bad_recording_does_not_stop_the_others_and_is_named(building):
    out, status, told, said = building
    assert status == 1
    assert said.count("\n") == 1
    assert "broken failed: " in said
    rows = {row["name"]: row for row in json.loads((out / "summary.json").read_text())["recordings"]}
    assert {name: row["state"] for name, row in rows.items()} == {
        "walk0": "done", "walk1": "done", "walk2": "done", "broken": "failed",
    }  # fmt: skip
    for name in ("walk0", "walk1", "walk2"):
        assert (out / "runs" / name / "report.html").is_file()
        assert rows[name]["metrics"]["tracked_fraction"] == 1.0
        assert name in told


def test_all_that_was_mapped_is_in_one_map_in_one_frame(building):
    out = building[0]
    assert check_map(out / "map.lode") == []
    map, truth = load_map(out / "map.lode"), list(poses(N_POSES))
    true_p = np.array([truth[int(t) // STEP_NS - 1].t for t in map.keyframes.t_ns])
    apart = [np.linalg.norm(p[:, None] - p[None], axis=2) for p in (map.keyframes.p, true_p)]
    assert np.abs(apart[0] - apart[1]).max() < 0.02  # from one end of the wall to the other
    assert {row["in_map"]["by"] for row in json.loads((out / "summary.json").read_text())["recordings"][:3]} == {
        "base", "places",
    }  # fmt: skip


def test_the_report_stands_alone_and_shows_every_recording(building):
    page = (building[0] / "report.html").read_text()
    assert all(name in page for name in ("walk0", "walk1", "walk2", "broken"))
    assert '"above"' in page
    assert "<script src" not in page


def test_what_is_finished_is_kept_and_what_is_missing_is_done(building, walks, tmp_path, capsys):
    out = tmp_path / "building"
    shutil.copytree(building[0], out)
    stamps = {name: (out / "runs" / name / "map.lode").stat().st_mtime_ns for name in ("walk0", "walk1", "walk2")}
    (out / "runs" / "walk1" / "map.lode").unlink()  # a folder that does not hold all of a run is none
    (out / "runs" / ".walk1.elsewhere.7").mkdir()  # what a killed one left
    assert main(["fleet", *map(str, walks[:3]), "--out", str(out), "--jobs", "1", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [row["state"] for row in told["recordings"]] == ["kept", "done", "kept"]
    assert (out / "runs" / "walk0" / "map.lode").stat().st_mtime_ns == stamps["walk0"]
    assert not list((out / "runs").glob(".*"))
    assert (out / "map.lode").read_bytes() == (building[0] / "map.lode").read_bytes()
    # with other options they are other runs
    changed = jobs_of(walks[:1], out, {"sensors": "", "seed": 1, "settings": [], "rig": None, "anchors": None})
    assert not [job for job in changed if json.loads((out / "runs/walk0/fleet.json").read_text())["options"]["seed"]]


def test_processes_that_die_are_replaced_and_only_what_kills_them_every_time_fails(tmp_path):
    options = [{}, {"once": True}, {"always": True}, {}]
    jobs = [Job(f"job{i}", "", str(tmp_path / f"mark{i}"), o) for i, o in enumerate(options)]
    states = {o.name: (o.state, o.why) for o in in_processes(jobs, die_once, 2)}
    assert states["job2"] == ("failed", "the process that ran it died 3 times")
    assert [states[f"job{i}"][0] for i in (0, 1, 3)] == ["done"] * 3


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["rec", "--out", "o", "--scheduler", "tcp://127.0.0.1:1"], "no scheduler answers at tcp://127.0.0.1:1"),
        (["rec", "--out", "o", "--scheduler", "nonsense://x"], "no scheduler answers at nonsense://x"),
        (["rec", "rec", "--out", "o"], "named twice"),
        (["rec", "--out", "o", "--set", "no.such=1"], "unknown setting no.such"),
        ([], "Missing"),
    ],
)
def test_bad_usage_is_one_line_and_status_2(tmp_path, monkeypatch, capsys, arguments, said):
    if "--scheduler" in arguments:
        pytest.importorskip("distributed", reason='needs dask.distributed (pip install "lodelight[fleet]")')
        monkeypatch.setattr("lodelight.fleet.workers.CONNECT_S", 0.5)
    monkeypatch.chdir(tmp_path)
    write_tum(tmp_path / "rec", n=2)
    assert main(["fleet", *arguments]) == 2
    err = capsys.readouterr().err
    assert said in err
    assert err.count("\n") == 1


# -- a cluster ----------------------------------------------------------------------------------------------------


def free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """A real scheduler and two workers in processes of their own; the address and the workers."""
    pytest.importorskip("distributed", reason='needs dask.distributed (pip install "lodelight[fleet]")')
    folder = tmp_path_factory.mktemp("dask")
    address = f"tcp://127.0.0.1:{free_port()}"
    tests = str(Path(__file__).parent)
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([tests, os.environ.get("PYTHONPATH", "")])}
    env["DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL"] = "10s"

    def start(module, *arguments):
        return subprocess.Popen(
            [sys.executable, "-m", module, *arguments], cwd=folder, env=env, stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )  # fmt: skip

    processes = [start("distributed.cli.dask_scheduler", "--host", address, "--no-dashboard")]
    processes += [
        start("distributed.cli.dask_worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard")
        for _ in range(2)
    ]
    yield address, processes[1:]
    for process in processes:
        process.kill()
        process.wait()


def test_a_worker_killed_in_the_middle_of_its_work_loses_nothing(cluster, walks, tmp_path):
    address, workers = cluster
    options = {"sensors": "", "seed": 0, "settings": [], "rig": None, "anchors": None}
    jobs = jobs_of(walks[:3], tmp_path, options)
    (tmp_path / "runs").mkdir()
    by_pid = {worker.pid: worker for worker in workers}
    killed = None
    stream = on_cluster(jobs, run_one, address)

    def kill_one_at_work():
        nonlocal killed
        deadline = time.monotonic() + 120
        while killed is None and time.monotonic() < deadline:
            for attempt in (tmp_path / "runs").glob(".*"):
                pid = int(attempt.name.rpartition(".")[2])
                if (attempt / "events.jsonl").exists() and (attempt / "events.jsonl").stat().st_size > 0:
                    by_pid[pid].kill()  # it has begun to map and is not finished
                    killed = attempt
                    return
            time.sleep(0.02)

    watcher = threading.Thread(target=kill_one_at_work)
    watcher.start()
    outcomes = {outcome.name: outcome for outcome in stream}
    watcher.join()
    assert killed is not None
    assert {name: outcome.state for name, outcome in outcomes.items()} == dict.fromkeys(
        ("walk0", "walk1", "walk2"), "done"
    )
    for job in jobs:
        assert outcomes[job.name].metrics["tracked_fraction"] == 1.0
        assert check_map(Path(job.out) / "map.lode") == []
    assert sum(worker.poll() is None for worker in workers) == 1
