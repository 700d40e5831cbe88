"""What every recording offers, whatever its format: a rig, a stream of messages, perhaps the truth.

A format gives its frames as `Shot`s, undecoded; this file decodes them ahead on a thread, leaves out those that
cannot be used, weaves the IMU in, and says what was left out.
"""

from __future__ import annotations

import heapq
import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from lodelight.errors import ConfigError, SourceError
from lodelight.io.pictures import BadFrame
from lodelight.io.prefetch import prefetch
from lodelight.io.stamps import NS_PER_S
from lodelight.messages import Frame, Imu, Message
from lodelight.rig import Rig
from lodelight.trajectory import Trajectory

CAMERAS = {"mono": 1, "stereo": 2, "rgbd": 1}


@dataclass(frozen=True)
class Skipped:
    """A frame, or a row of a list, that was left out: its file, why, and its stamp where it has one."""

    t_ns: int | None
    where: str
    reason: str


@dataclass(frozen=True, eq=False)
class Shot:
    """A frame not decoded yet.

    load : runs on another thread, in the order of the shots, also after the last shot was given; may raise BadFrame
    """

    t_ns: int
    where: str
    load: Callable[[], Frame]


class Recording(ABC):
    """A recording that is read as a stream.

    name : of its folder or file; format : "euroc", "tum_rgbd", ...; rig : only of sensors the recording has
    skipped : what the last `messages` left out so far; before that, the rows that were no use on opening
    """

    AHEAD = 4  # frames decoded before they are asked for

    def __init__(self, path: Path, format: str, rig: Rig, bad_rows: tuple[Skipped, ...] = ()) -> None:
        self.path = path
        self.name = path.resolve().name
        self.format = format
        self.rig = rig
        self.skipped = list(bad_rows)
        self._bad_rows = bad_rows

    @property
    @abstractmethod
    def n_frames(self) -> int:
        """Frames it lists, usable or not."""

    @property
    @abstractmethod
    def span_ns(self) -> tuple[int, int]:
        """Stamps of the first and the last frame, on the recording's own camera clock."""

    @abstractmethod
    def shots(self, cameras: int, depth: bool) -> Iterator[Shot]:
        """All frames with that many images and with depth if asked. Stamps increase, but for shots that only raise."""

    def imu(self) -> Iterator[Imu]:
        """All inertial samples, stamps increasing, on the recording's own IMU clock."""
        return iter(())

    def light_shots(self) -> Iterator[Shot]:
        """All images of the light camera, as `shots`; none where the recording has no such camera."""
        return iter(())

    def ground_truth(self) -> Trajectory | None:
        """T_world_body where the recording has it; for evaluation alone."""
        return None

    @property
    def is_live(self) -> bool:
        """Whether it is a camera that runs now, and frames that are not taken in time are lost."""
        return False

    def stop(self) -> None:
        """End a live stream after the image that is being taken; from any thread. Others end by themselves."""
        return

    @property
    def duration_s(self) -> float:
        first, last = self.span_ns
        return (last - first) / NS_PER_S

    def messages(self, sensors: str, start_s: float = 0.0, end_s: float = math.inf) -> Iterator[Message]:
        """Frames and IMU samples in the order of their stamps, an IMU sample before the frame of the same stamp.

        sensors : "mono", "stereo" or "rgbd", each also with "-inertial"
        start_s, end_s : seconds from the first frame. IMU samples reach one beyond the first and the last frame,
            so that both can be interpolated to; at start_s = 0 all that precede the first frame come
        Stamps have the rig's time offsets added: they are on the body's clock.
        Raises ConfigError on unknown sensors, SourceError on ones the recording lacks or when no frame is usable.
        """
        base, _, suffix = sensors.partition("-")
        if base not in CAMERAS or suffix not in ("", "inertial") or sensors.endswith("-"):
            raise ConfigError(f"sensors {sensors!r} are unknown; choose one of {', '.join(CAMERAS)} (-inertial)")
        rig = self.rig
        if CAMERAS[base] > len(rig.cameras) or (base == "rgbd" and not rig.depth) or (suffix and not rig.imu):
            raise SourceError(f"{self.path} with its rig cannot serve {sensors}; the most it can is {rig.sensors}")
        frames = self.frames(CAMERAS[base], base == "rgbd", start_s, end_s)
        return woven(frames, self.inertial(start_s, end_s)) if suffix else frames

    def frames(
        self, cameras: int, depth: bool, start_s: float = 0.0, end_s: float = math.inf
    ) -> Generator[Frame, None, None]:
        """The frames alone, with the images of that many cameras and with depth if asked; else as `messages`."""
        self.skipped = list(self._bad_rows)
        offset_ns = self._on_body_clock(0)
        return self._decoded(self.shots(cameras, depth), *self._window(start_s, end_s), offset_ns)

    def light_frames(self, start_s: float = 0.0, end_s: float = math.inf) -> Generator[Frame, None, None]:
        """The light camera's images, one a frame, stamped when row 0 opened; else as `frames`.

        Raises SourceError where there is none that can be used.
        """
        if self.rig.lights is None:
            raise SourceError(f"{self.path} has no light camera; its rig has no [lights], or its folder no light0")
        self.skipped = list(self._bad_rows)
        offset_ns = round(self.rig.lights.time_offset_s * NS_PER_S)
        return self._decoded(self.light_shots(), *self._window(start_s, end_s), offset_ns)

    def inertial(self, start_s: float = 0.0, end_s: float = math.inf) -> Iterator[Imu]:
        """The inertial samples alone, as `messages`."""
        if self.rig.imu is None:
            return
        offset_ns = round(self.rig.imu.time_offset_s * NS_PER_S)
        first, last = self._window(start_s, end_s)
        last = min(last, self._on_body_clock(self.span_ns[1]))
        before: Imu | None = None
        for raw in self.imu():
            sample = Imu(raw.t_ns + offset_ns, raw.gyro, raw.accel)
            if sample.t_ns < first:
                before = sample
                continue
            if before is not None:
                yield before
                before = None
            yield sample
            if sample.t_ns >= last:
                return

    def _window(self, start_s: float, end_s: float) -> tuple[float, float]:
        """Stamps of a stretch counted from the first frame; open towards an end that is not cut."""
        zero_ns = self._on_body_clock(self.span_ns[0])
        first = zero_ns + round(start_s * NS_PER_S) if start_s > 0 else -math.inf
        return first, zero_ns + round(end_s * NS_PER_S) if end_s < math.inf else math.inf

    def _on_body_clock(self, t_ns: int) -> int:
        return t_ns + round(self.rig.cameras[0].time_offset_s * NS_PER_S)

    def _decoded(
        self, shots: Iterator[Shot], first: float, last: float, offset_ns: int
    ) -> Generator[Frame, None, None]:
        """offset_ns : added to the shots' stamps, which puts them on the body's clock."""

        def load(shot: Shot) -> Frame | Skipped:
            t_ns = shot.t_ns + offset_ns
            try:
                frame = shot.load()
            except BadFrame as bad:
                return Skipped(t_ns, shot.where, str(bad))
            return Frame(t_ns, frame.images, frame.depth)

        wanted = (shot for shot in shots if first <= shot.t_ns + offset_ns <= last)
        usable = False
        with closing(prefetch(wanted, load, self.AHEAD)) as loaded:
            for item in loaded:
                if isinstance(item, Frame):
                    usable = True
                    yield item
                else:
                    self.skipped.append(item)
        if not usable:
            raise SourceError(self._why_nothing())

    def _why_nothing(self) -> str:
        if not self.skipped:
            return f"{self.path} has no frame in the time asked for; it lasts {self.duration_s:.3f} s"
        return f"{self.path}: no frame can be used; {summarize(self.skipped)}"


def woven(messages: Iterator[Message], beside: Iterable[Message]) -> Iterator[Message]:
    """Both streams as one, in the order of their stamps; at one stamp what is beside comes first."""
    try:
        yield from heapq.merge(beside, messages, key=lambda message: message.t_ns)
    finally:
        for stream in (messages, beside):  # the threads that decode end with their iterators
            close = getattr(stream, "close", None)
            if close is not None:
                close()


def summarize(skipped: list[Skipped]) -> str:
    """One line: how many were left out for which reasons, with the first file of each."""
    if not skipped:
        return "nothing skipped"
    first = {item.reason: item.where for item in reversed(skipped)}
    counts = Counter(item.reason for item in skipped)
    reasons = "; ".join(f"{n}x {reason} (first: {first[reason]})" for reason, n in counts.most_common(4))
    return f"{len(skipped)} skipped: {reasons}"
