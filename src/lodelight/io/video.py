"""A video file of one camera; what the camera is, the rig file says."""

from __future__ import annotations

import os
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from lodelight.errors import CalibrationError, SourceError
from lodelight.io.pictures import BadFrame
from lodelight.io.recording import Recording, Shot
from lodelight.io.stamps import NS_PER_S
from lodelight.messages import Frame
from lodelight.rig import Rig

SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg")


def recognize(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() in SUFFIXES


def open_video(path: Path, rig: Rig | None) -> Recording:
    """Frame i is at i / rate: the file's own rate, else the rig's."""
    if rig is None:
        raise CalibrationError(f"{path} says nothing of its camera; give --rig FILE or put a rig.toml beside it")
    return VideoRecording(path, rig)


class VideoRecording(Recording):
    """A video, decoded in order as it is asked for."""

    def __init__(self, path: Path, rig: Rig) -> None:
        super().__init__(path, "video", rig.with_cameras(1))
        video = self._open()
        rate_hz = video.get(cv2.CAP_PROP_FPS) or rig.cameras[0].rate_hz
        self._count = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
        video.release()
        if not 0 < rate_hz < 10_000:
            raise CalibrationError(f"{path} does not say its frame rate; set camera[0].rate_hz in the rig file")
        if self._count < 1:
            raise SourceError(f"{path} has no frames")
        self._period_ns = NS_PER_S / rate_hz

    @property
    def n_frames(self) -> int:
        return self._count

    @property
    def span_ns(self) -> tuple[int, int]:
        return 0, round((self._count - 1) * self._period_ns)

    def shots(self, cameras: int, depth: bool) -> Iterator[Shot]:
        video = self._open()  # closed when the last shot is gone
        position = [0]
        for i in range(self._count):
            t_ns = round(i * self._period_ns)
            yield Shot(t_ns, f"{self.path} frame {i}", partial(self._load, video, position, i, t_ns))

    def _open(self) -> cv2.VideoCapture:
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # what is wrong is told below, in one line
        video = cv2.VideoCapture(str(self.path))
        if not video.isOpened():
            raise SourceError(f"{self.path} is no video that can be read here; try an image folder instead")
        return video

    def _load(self, video: cv2.VideoCapture, position: list[int], i: int, t_ns: int) -> Frame:
        while position[0] <= i:
            position[0] += 1
            if not video.grab():
                raise BadFrame("video frame cannot be read")
        ok, image = video.retrieve()
        if not ok:
            raise BadFrame("video frame cannot be decoded")
        lens = self.rig.cameras[0].camera
        if image.shape[1::-1] != (lens.width, lens.height):
            size = f"{image.shape[1]}x{image.shape[0]}"
            raise BadFrame(f"image is {size}, the rig says {lens.width}x{lens.height}")
        return Frame(t_ns, (np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8),))
