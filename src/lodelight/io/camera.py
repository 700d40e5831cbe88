"""A live camera: V4L2, USB or whatever else OpenCV opens by a number or a device path.

What its lens is, a rig file says. A rig of two cameras takes a device that gives both images side by side.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Generator, Iterator
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
from lodelight.types import AnyArray

BREATHS = 10  # images a camera may fail to give one after the other before it counts as gone


def recognize(path: Path) -> bool:
    """A device, or a number that is not the name of anything else."""
    return path.is_char_device() or (str(path).isdigit() and not path.exists())


def open_camera(path: Path, rig: Rig | None) -> LiveCamera:
    """Raises CalibrationError without a rig or with one of another size, SourceError where there is no camera."""
    if rig is None:
        raise CalibrationError(f"camera {path} says nothing of its lens; give --rig FILE")
    return LiveCamera(path, rig)


class LiveCamera(Recording):
    """A camera as a recording that lasts until `stop`, or until it gives no more images.

    Stamps are Unix time, from the driver's clock where it has one.
    """

    AHEAD = 0  # an image that waits for the next one is late

    def __init__(self, path: Path, rig: Rig) -> None:
        self._capture = _open(path, rig)
        ok, image = self._capture.read()
        if not ok:
            self._capture.release()
            raise SourceError(f"camera {path} gives no image; another program may be using it")
        cameras = _cameras_in(image, rig, path)
        super().__init__(path, "camera", Rig(rig.cameras[:cameras]))
        self.name = f"camera {path}"
        self._first_ns = time.time_ns()
        self._clock = _Clock(self._first_ns)
        self._stopped = threading.Event()
        self._end_s = math.inf

    @property
    def n_frames(self) -> int:
        """Not known before it ends."""
        return 0

    @property
    def span_ns(self) -> tuple[int, int]:
        return self._first_ns, self._first_ns

    @property
    def is_live(self) -> bool:
        return True

    def stop(self) -> None:
        """End the stream after the image that is being taken; from any thread."""
        self._stopped.set()

    def frames(
        self, cameras: int, depth: bool, start_s: float = 0.0, end_s: float = math.inf
    ) -> Generator[Frame, None, None]:
        """As of any recording; end_s seconds from when it was opened, the camera is let go."""
        self._end_s = end_s
        return super().frames(cameras, depth, start_s, end_s)

    def shots(self, cameras: int, depth: bool) -> Iterator[Shot]:
        failed = 0
        try:
            while not self._stopped.is_set():
                ok, image = self._capture.read()
                t_ns = self._clock.stamp(self._capture)
                if t_ns - self._first_ns > self._end_s * NS_PER_S:
                    return
                failed = 0 if ok else failed + 1
                yield Shot(t_ns, f"{self.name} image", partial(self._frame, t_ns, image if ok else None, cameras))
                if failed == BREATHS:
                    return
        finally:
            self._capture.release()

    def _frame(self, t_ns: int, image: AnyArray | None, cameras: int) -> Frame:
        if image is None:
            raise BadFrame("camera gives no image")
        lens = self.rig.cameras[0].camera
        if image.shape[:2] != (lens.height, lens.width * len(self.rig.cameras)):
            raise BadFrame(f"image is {image.shape[1]}x{image.shape[0]}, the first one was of another size")
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        parts = [grey[:, i * lens.width : (i + 1) * lens.width] for i in range(cameras)]
        return Frame(t_ns, tuple(np.ascontiguousarray(part, dtype=np.uint8) for part in parts))


class _Clock:
    """Unix stamps of images: by the driver's clock once it is known to run, else by when they were handed over."""

    def __init__(self, first_ns: int) -> None:
        self._last_ns = first_ns
        self._ahead_ns: int | None = None
        self._driver_ms = -1.0
        self._mono_ahead_ns = time.time_ns() - time.monotonic_ns()  # steps of the wall clock are none of ours

    def stamp(self, capture: cv2.VideoCapture) -> int:
        now_ns = time.monotonic_ns() + self._mono_ahead_ns
        driver_ms = float(capture.get(cv2.CAP_PROP_POS_MSEC)) if _is_driver_time(capture) else 0.0
        t_ns = now_ns
        if driver_ms > self._driver_ms > 0:
            driver_ns = round(driver_ms * 1e6)
            if self._ahead_ns is None:
                self._ahead_ns = now_ns - driver_ns
            t_ns = driver_ns + self._ahead_ns
        self._driver_ms = driver_ms
        self._last_ns = max(t_ns, self._last_ns + 1)
        return self._last_ns


def _is_driver_time(capture: cv2.VideoCapture) -> bool:
    """Only V4L2 gives the time an image was taken; others give the position in a file."""
    return bool(capture.getBackendName() == "V4L2")


def _open(path: Path, rig: Rig) -> cv2.VideoCapture:
    logging = cv2.utils.logging
    level = logging.setLogLevel(logging.LOG_LEVEL_SILENT)  # what is wrong is told below, in one line
    try:
        capture = capture_of(path)
    finally:
        logging.setLogLevel(level)
    if not capture.isOpened():
        raise SourceError(f"there is no camera {path}, or another program is using it; see which /dev/video* there are")
    first = rig.cameras[0]
    for key, value in (
        (cv2.CAP_PROP_FRAME_WIDTH, first.camera.width * len(rig.cameras)),
        (cv2.CAP_PROP_FRAME_HEIGHT, first.camera.height),
        (cv2.CAP_PROP_FPS, first.rate_hz),
        (cv2.CAP_PROP_BUFFERSIZE, 1),
    ):
        if value > 0:
            capture.set(key, value)
    return capture


def capture_of(path: Path) -> cv2.VideoCapture:
    """OpenCV's capture of a device."""
    return cv2.VideoCapture(int(str(path)) if str(path).isdigit() else str(path))


def _cameras_in(image: AnyArray, rig: Rig, path: Path) -> int:
    """How many of the rig's cameras an image holds, side by side. Raises CalibrationError where none fits."""
    height, width = image.shape[:2]
    lens = rig.cameras[0].camera
    for count in range(len(rig.cameras), 0, -1):
        if (width, height) == (lens.width * count, lens.height):
            return count
    raise CalibrationError(
        f"camera {path} gives images of {width}x{height}, the rig is of {lens.width}x{lens.height}; "
        "calibrate it at a size it gives"
    )
