"""A live camera, played by a video file where OpenCV would open a device."""

import itertools
import os
import signal
import threading
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from lodelight.cli.main import main
from lodelight.errors import CalibrationError, SourceError
from lodelight.geometry.se3 import SE3
from lodelight.io import camera, open_source
from lodelight.io.rig_toml import write_rig
from lodelight.rig import CameraSpec, Rig
from recordings import LENS, picture, tiny_rig


class Device:
    """A video file that gives its images at the speed of a camera, over and over, or is then unplugged."""

    def __init__(self, video, fps=100.0, unplugged=True):
        self.video, self.period_s, self.unplugged = cv2.VideoCapture(str(video)), 1 / fps, unplugged
        self.next_s = time.monotonic()
        self.asked, self.released = {}, False

    def isOpened(self):
        return self.video.isOpened()

    def set(self, key, value):
        self.asked[key] = value

    def get(self, key):
        return self.video.get(key)

    def getBackendName(self):
        return "V4L2"

    def read(self):
        time.sleep(max(0.0, self.next_s - time.monotonic()))
        self.next_s = time.monotonic() + self.period_s
        ok, image = self.video.read()
        if not ok and not self.unplugged:
            self.video.set(cv2.CAP_PROP_POS_FRAMES, 0)
            ok, image = self.video.read()
        return ok, image

    def release(self):
        self.released = True


def film(path, n=12, width=64):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 20.0, (width, 48))
    for i in range(n):
        image = np.hstack([picture(i % 20), picture(i % 20 + 1)])[:, :width]
        writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    writer.release()
    return path


@pytest.fixture
def plug(monkeypatch, tmp_path):
    """plug(...) makes a film the camera that opens under every number."""

    def plugged(n=12, width=64, **options):
        device = Device(film(tmp_path / "film.avi", n, width), **options)
        monkeypatch.setattr(camera, "capture_of", lambda path: device)
        return device

    return plugged


def stereo_rig():
    right = CameraSpec("cam1", LENS, SE3(np.eye(3), np.array([0.1, 0, 0])))
    return Rig((*tiny_rig().cameras, right))


def test_a_camera_gives_its_images_stamped_with_the_time_of_day_until_it_is_unplugged(plug):
    device, before_ns = plug(n=8), time.time_ns()
    recording = open_source("0", tiny_rig())
    assert (recording.format, recording.is_live, recording.rig.sensors) == ("camera", True, "mono")
    frames = list(recording.messages("mono"))
    stamps = [f.t_ns for f in frames]
    assert len(frames) == 7  # the first one was looked at to see its size
    assert all(a < b for a, b in itertools.pairwise(stamps))
    assert before_ns < stamps[0] < stamps[-1] < time.time_ns() + 400_000_000
    assert abs(float(frames[0].images[0].mean()) - 15) < 2
    assert device.released
    assert {s.reason for s in recording.skipped} == {"camera gives no image"}
    assert device.asked[cv2.CAP_PROP_FRAME_WIDTH] == 64


def test_a_camera_ends_after_the_seconds_asked_for_and_when_it_is_stopped(plug):
    plug(unplugged=False)
    begun = time.monotonic()
    assert 5 < len(list(open_source("0", tiny_rig()).messages("mono", end_s=0.3))) <= 31
    assert time.monotonic() - begun < 3
    recording = open_source("0", tiny_rig())
    for k, _ in enumerate(recording.messages("mono")):
        if k == 5:
            recording.stop()
    assert k in (5, 6)


def test_a_camera_of_two_images_side_by_side_is_a_stereo_pair(plug):
    plug(width=128)
    recording = open_source("2", stereo_rig())
    assert recording.rig.sensors == "stereo"
    frame = next(iter(recording.messages("stereo")))
    means = [float(image.mean()) for image in frame.images]
    assert [image.shape for image in frame.images] == [(48, 64), (48, 64)]
    assert means[1] - means[0] == pytest.approx(10, abs=3)
    plug(width=64)  # the same rig on a camera that gives one
    assert open_source("2", stereo_rig()).rig.sensors == "mono"


def test_no_rig_another_size_and_no_camera_are_one_line_each(plug, tmp_path, capsys):
    with pytest.raises(CalibrationError, match="camera 0 says nothing of its lens; give --rig"):
        open_source("0")
    plug(width=100)
    with pytest.raises(CalibrationError, match="images of 100x48, the rig is of 64x48"):
        open_source("0", tiny_rig())
    plug(n=0)
    with pytest.raises(SourceError, match="camera 0"):
        open_source("0", tiny_rig())


def test_a_camera_that_is_not_there_is_one_line_and_status_2(tmp_path, capfd):
    write_rig(tmp_path / "rig.toml", tiny_rig())
    arguments = ["run", "97", "--rig", str(tmp_path / "rig.toml"), "--out", str(tmp_path / "out")]
    assert main(arguments) == 2
    assert capfd.readouterr().err.count("\n") == 1


def test_a_folder_called_like_a_number_is_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("7").mkdir()
    cv2.imwrite("7/000.png", picture(0))
    assert open_source("7", tiny_rig()).format == "images"


@pytest.mark.skipif(os.name == "nt", reason="interrupts are sent as POSIX signals")
def test_an_interrupt_ends_a_live_run_and_writes_it(plug, tmp_path):
    device = plug(n=60, width=128, unplugged=False)
    rig = stereo_rig()
    write_rig(tmp_path / "rig.toml", replace(rig, cameras=rig.cameras))
    stopper = threading.Timer(2.0, os.kill, (os.getpid(), signal.SIGINT))
    stopper.start()
    out = tmp_path / "out"
    status = main(["run", "0", "--rig", str(tmp_path / "rig.toml"), "--out", str(out)])
    stopper.join()
    assert status == 1  # flat grey images localize nothing: it ran, wrote everything, and failed
    assert (out / "metrics.json").is_file()
    assert (out / "report.html").is_file()
    assert device.released
