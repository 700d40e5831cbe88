"""Watching a run: recorded to a file, and live in a browser."""

from __future__ import annotations

import subprocess
import sys
import time
from dataclasses import replace

import cv2
import numpy as np
import pytest

from browser import CHROMIUM, Browser
from lodelight.anchors import Anchors
from lodelight.cli.main import main
from lodelight.cli.watching import Watcher
from lodelight.slam import Slam, SlamConfig
from tagged_wall import RIG, STEP_NS, TAGS, frame, poses, wall_picture, write_walk

pytest.importorskip("rerun", reason='needs rerun (pip install "lodelight[viewer]")')
ENTITIES = (
    *("/world/points", "/world/keyframes", "/world/path/0", "/world/camera/image", "/world/camera/image/tracks"),
    *("/world/camera/image/tags", "/world/tags", "/plots/inliers", "/plots/track_ms", "/log"),
)


@pytest.fixture
def home(tmp_path, monkeypatch):
    """A home of its own, where rerun keeps its settings."""
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("XDG_CONFIG_HOME", raising=False)
    return tmp_path


def test_a_recorded_view_holds_everything_and_changes_nothing(home, capsys):
    recording = write_walk(home / "walk", wall_picture(), 0, 10)
    assert main(["run", str(recording), "--out", str(home / "plain")]) == 0
    assert main(["run", str(recording), "--out", str(home / "seen"), "--rrd", str(home / "view" / "run.rrd")]) == 0
    capsys.readouterr()
    for name in ("trajectory.tum", "trajectory_live.tum", "map.lode", "covariance.csv"):
        assert (home / "plain" / name).read_bytes() == (home / "seen" / name).read_bytes()
    stats = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "stats", str(home / "view" / "run.rrd")],
        capture_output=True, text=True, timeout=60, check=True,
    ).stdout  # fmt: skip
    assert [name for name in ENTITIES if f"\n{name}: " not in stats] == []
    assert '"analytics_enabled":false' in next(home.rglob("analytics.json")).read_text().replace(" ", "")
    map_file = str(home / "plain" / "map.lode")
    again = ["localize", str(recording), "--map", map_file, "--out", str(home / "found"), "--rrd", str(home / "l.rrd")]
    assert main(again) == 0
    assert (home / "l.rrd").stat().st_size > 100_000  # ten pictures


class Pictures:
    """Just enough of a recording."""

    def __init__(self, frames):
        self.frames = frames

    def messages(self, *arguments):
        return iter(self.frames)


def of_colour(picture, colour):
    """Pixels that have it, nearly."""
    bgr = [int(colour[i : i + 2], 16) for i in (5, 3, 1)]
    return np.count_nonzero(np.abs(picture.astype(int) - bgr).max(axis=2) < 16)


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium (apt-get install chromium)")
def test_a_run_is_seen_in_a_browser_which_speaks_to_nobody_else(home):
    from lodelight.report.rerun_view import MAPPED, NEW, TAG, RerunView

    view = RerunView("wall", RIG, web=True)
    watcher = Watcher(view)
    slam = Slam(RIG, SlamConfig(), anchors=Anchors(tuple(replace(tag, T_world_tag=None) for tag in TAGS)))
    wall = wall_picture()
    overheard = watcher.of(Pictures([frame(wall, T, (k + 1) * STEP_NS) for k, T in list(enumerate(poses(40)))[:8]]))
    for estimate in slam.run(overheard):
        watcher.show(estimate, slam)
    watcher.finish(slam)
    browser = Browser(home / "profile")
    try:
        browser.call("Page.navigate", url=view.url)
        deadline = time.monotonic() + 90.0
        shown = False
        while not shown and time.monotonic() < deadline:
            browser.wait(1.0)
            picture = browser.picture()
            camera = picture[:, int(0.6 * picture.shape[1]) :]
            shown = of_colour(camera, MAPPED) + of_colour(camera, NEW) > 100 and of_colour(camera, TAG) > 20
        cv2.imwrite(str(home / "viewer.png"), picture)
        assert shown, home / "viewer.png"  # tracks and tags upon the image
        map_side = picture[:, : int(0.55 * picture.shape[1])].reshape(-1, 3)
        assert len(np.unique(map_side, axis=0)) > 50  # points coloured by height, path, camera
        assert {url.split("/")[2].partition(":")[0] for url in browser.requests.values()} == {"127.0.0.1"}
        assert any("MessageProxyService" in url for url in browser.requests.values())
    finally:
        browser.close()


def test_a_window_needs_a_display(home, monkeypatch, capsys):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    recording = write_walk(home / "walk", wall_picture(), 0, 3)
    assert main(["run", str(recording), "--out", str(home / "out"), "--view"]) == 2
    err = capsys.readouterr().err
    assert "--view needs a display" in err
    assert err.count("\n") == 1


def test_a_file_that_cannot_be_written_is_one_line(home, capsys):
    recording = write_walk(home / "walk", wall_picture(), 0, 3)
    (home / "taken").mkdir()
    assert main(["run", str(recording), "--out", str(home / "out"), "--rrd", str(home / "taken")]) == 2
    err = capsys.readouterr().err
    assert "choose another --rrd" in err
    assert err.count("\n") == 1
