"""The report page in a real browser: it draws, without an error and without a request to anywhere."""

import json
import re
import shutil
import subprocess

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lodelight.errors import SourceError
from lodelight.geometry.se3 import SE3
from lodelight.messages import Estimate
from lodelight.report.folder import read_folder
from lodelight.report.html import MAX_EVENTS_OF_A_KIND, write_report
from lodelight.report.outputs import Outputs
from lodelight.trajectory import Trajectory
from out_folder import make_run, walk

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FLAGS = [
    *("--headless", "--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader", "--disable-quic"),
    *("--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync"),
    # Chromium calls its makers on its own; no name resolves, so nothing leaves this machine.
    *("--no-proxy-server", "--host-resolver-rules=MAP * ~NOTFOUND"),
    *("--enable-logging=stderr", "--window-size=1400,3000", "--virtual-time-budget=20000"),
]
FLAT_PLOTS = {"states", "above", "side", "timing", "inliers", "sigma", "velocity", "bias-gyro", "bias-accel"}
TRUTH_PLOTS = {"error-time", "error-distance", "nees"}


def browse(page, profile):
    """(DOM after the scripts ran, lines of the console, addresses the page asked for)."""
    if CHROMIUM is None:
        pytest.skip("needs Chromium (apt-get install chromium)")
    net_log = profile / "net.json"
    command = [CHROMIUM, *FLAGS, f"--user-data-dir={profile}", f"--log-net-log={net_log}", "--dump-dom", page.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=180, check=True)
    console = [line for line in done.stderr.splitlines() if ":CONSOLE:" in line]
    requests = [event.get("params", {}) for event in json.loads(net_log.read_text())["events"]]
    # "null" is the origin of a page from disk; what the browser asks for itself is "not an origin"
    asked = {r["url"] for r in requests if r.get("initiator") == "null"}
    return done.stdout, console, {url for url in asked if not url.startswith(("file:", "data:", "blob:"))}


def faults(console):
    """Errors and warnings, less what the software renderer says of itself."""
    return [line for line in console if re.search(r"Uncaught|Error|ERR_|Failed|WebGL is not", line)]


def drawn(dom):
    """For every plot the number of traces in it, from the markup that plotly leaves."""
    counts = {}
    for part in dom.split("<section")[1:]:
        plot = re.search(r'<div class="plot[^"]*" id="([^"]+)"', part)
        if plot:
            counts[plot.group(1)] = len(re.findall(r'class="(?:trace scatter|trace bars)', part))
    return counts


@pytest.mark.parametrize("truth", [True, False])
def test_the_page_draws_every_plot_without_error_or_request(tmp_path, truth):
    make_run(tmp_path / "out", truth=truth, tag=True)
    dom, console, asked = browse(tmp_path / "out" / "report.html", tmp_path / "profile")
    assert faults(console) == []
    assert asked == set()
    counts = drawn(dom)
    assert set(counts) == FLAT_PLOTS | {"map"} | (TRUTH_PLOTS if truth else set())
    assert all(counts[name] >= 1 for name in counts if name != "map"), counts
    assert counts["above"] == (8 if truth else 7)  # map points, truth, live, final, two states, keyframes, tags
    assert dom.count("T07") >= 2  # beside its tag, from above and from the side
    assert counts["bias-gyro"] == 9  # three axes, each with its band
    assert counts["velocity"] == (5 if truth else 4)  # three axes, speed, true speed
    assert counts["states"] == 5
    space = dom.split('id="map"')[1].split("</section>")[0]
    assert re.search(r'<canvas[^>]*width="\d{3}', space), "the map is drawn on a canvas"
    assert "WebGL is not supported" not in space
    assert dom.count("<tr>") > 20  # events


def test_a_request_or_an_error_of_a_page_is_noticed(tmp_path):
    page = tmp_path / "page.html"
    page.write_text("<img src='http://127.0.0.1:9/x'><script>setTimeout(() => { throw new Error('so') }, 10)</script>")
    _, console, asked = browse(page, tmp_path / "profile")
    assert asked == {"http://127.0.0.1:9/x"}
    assert faults(console) != []


def test_a_text_with_markup_stays_text(tmp_path):
    evil = "</script><img src=http://127.0.0.1:9/x onerror=alert(1)>"
    make_run(tmp_path / "out", frames=30)
    with (tmp_path / "out" / "events.jsonl").open("a") as file:
        file.write(json.dumps({"t_ns": 1_700_000_000_000_000_000, "kind": "note", "why": evil}) + "\n")
    write_report(tmp_path / "out", None)
    dom, _, asked = browse(tmp_path / "out" / "report.html", tmp_path / "profile")
    assert asked == set()
    assert "<td>&lt;/script&gt;&lt;img" in dom


def test_an_hours_run_still_fits_a_page_and_keeps_its_worst_frame(tmp_path):
    make_run(tmp_path, frames=20_000, points=100_000)
    page = (tmp_path / "report.html").read_text()
    assert len(page) < 8e6
    assert "30,000 of 100,000 map points" in page
    assert f"{MAX_EVENTS_OF_A_KIND} of " in page


def test_the_page_names_no_other_place(tmp_path):
    make_run(tmp_path, frames=30)
    page = (tmp_path / "report.html").read_text()
    ours = page[: page.index("plotly.js v")] + page[page.index('id="data"') :]
    assert "http" not in ours
    assert re.search(r"<(?:script|link|img|iframe)[^>]+(?:src|href)=\"(?!data:)", page) is None


def test_an_incomplete_folder_is_one_clear_error(tmp_path):
    make_run(tmp_path, frames=30)
    (tmp_path / "frames.csv").unlink()
    with pytest.raises(SourceError, match=r"no complete out folder .*frames\.csv"):
        write_report(tmp_path, walk(30))


def test_a_live_pose_counts_in_the_world_from_where_it_lies_there(tmp_path):
    true, away = walk(30), SE3(np.eye(3), np.array([5.0, 0.0, 0.0]))
    with Outputs(tmp_path, {}) as outputs:
        for i, t_ns in enumerate(true.t_ns.tolist()):
            T = SE3(Rotation.from_quat(true.quat_xyzw[i]).as_matrix(), true.xyz[i])
            there = {"aligned": float(i >= 10)}
            told = Estimate(t_ns, "tracking", T if i >= 10 else away @ T, np.eye(6), details=there)
            outputs.frame(told, 1.0, 0.0, **there)
        outputs.finish(true, np.zeros((1, 3)), {}, true, wall_s=1.0, compile_s=0.0, recording_s=1.0, align="none")
    live = read_folder(tmp_path, true, "none").live
    assert live.errors is not None
    assert len(live.errors.t_ns) == 20
    assert live.errors.position_m.max() < 1e-6


@pytest.mark.parametrize("frames", [0, 1, 2])
def test_a_run_that_saw_next_to_nothing_has_a_report_too(tmp_path, frames):
    stamps = [1_700_000_000_000_000_000 + i * 33_333_333 for i in range(frames)]
    with Outputs(tmp_path, {}) as outputs:
        for t_ns in stamps:
            outputs.frame(Estimate(t_ns, "tracking", SE3.identity(), np.eye(6)), 1.0, 0.0)
        path = Trajectory.from_poses(stamps, [SE3.identity()] * frames)
        outputs.finish(path, np.full((frames, 3), np.nan), {}, walk(30), wall_s=1.0, compile_s=0.0, recording_s=0.0)
    assert "Tracked" in (tmp_path / "report.html").read_text()
