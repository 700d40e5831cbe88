"""A ROS bag as a recording: streamed, images paired with their partners as they come."""

from __future__ import annotations

from bisect import insort
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from lodelight.errors import SourceError
from lodelight.io.depth import DepthReader
from lodelight.io.pictures import BadFrame
from lodelight.io.recording import Recording, Shot, Skipped
from lodelight.io.rosbag import Bag, recognize, stamp_ns
from lodelight.io.rosbag_images import grey, raw_depth
from lodelight.io.rosbag_poses import read_poses
from lodelight.io.rosbag_rig import rig_of, with_rates, written_rig
from lodelight.io.rosbag_topics import Topics, find_topics
from lodelight.io.stamps import NS_PER_S, seconds_text
from lodelight.messages import Frame, Imu
from lodelight.rig import Rig
from lodelight.trajectory import Trajectory

__all__ = ["carries_rig", "open_rosbag", "recognize"]

STEREO_NS, DEPTH_NS = 5_000_000, 20_000_000  # how far apart partners may be: as in EuRoC folders, as in TUM's
PATIENCE_NS = NS_PER_S  # of recording, after which a frame no longer waits for its partners
DEPTH_LOOKS = 30  # depth images looked at for one with a reading


def open_rosbag(path: Path, rig: Rig | None, roles: Mapping[str, str] | None = None) -> RosbagRecording:
    """roles : topics by name: cam0, cam1, ..., depth, imu, lights, truth; the others by type."""
    with Bag(path) as bag:
        carried = written_rig(bag) if rig is None else rig
        topics = find_topics(bag, roles or {}, len(carried.cameras) if carried is not None else None)
        left_out: tuple[Skipped, ...] = ()
        if carried is None:
            carried, topics, left_out = rig_of(bag, topics)
        return RosbagRecording(bag, carried, topics, left_out)


def carries_rig(path: Path) -> bool:
    """Whether the bag has the text of a rig file, as this project's bags do."""
    with Bag(path) as bag:
        return written_rig(bag) is not None


class RosbagRecording(Recording):
    """Every pass over it opens the bag anew."""

    def __init__(self, bag: Bag, rig: Rig, topics: Topics, left_out: tuple[Skipped, ...]) -> None:
        cameras = rig.cameras[: len(topics.cameras)]
        rig = replace(
            rig,
            cameras=cameras,
            depth=rig.depth if topics.depth else None,
            imu=rig.imu if topics.imu else None,
            lights=rig.lights if topics.lights else None,
        )
        first, last = bag.first(topics.cameras[0]), bag.last(topics.cameras[0])
        self._span_ns = stamp_ns(first), stamp_ns(last)
        self._count = bag.counts[topics.cameras[0]]
        if self._count > 1 and self._span_ns[1] <= self._span_ns[0]:
            raise SourceError(
                f"{bag.path} {topics.cameras[0]}: its images bear no stamps that increase; record header.stamp too"
            )
        span_s = (self._span_ns[1] - self._span_ns[0]) / NS_PER_S
        if span_s > 0:
            imu_hz = round(bag.counts[topics.imu] / span_s, 1) if topics.imu else 0.0
            rig = with_rates(rig, round((self._count - 1) / span_s, 3), imu_hz)
        super().__init__(bag.path, "rosbag", rig, left_out)
        self.topics = topics
        self._depth_reader = DepthReader(rig.depth, rig.cameras[0]) if rig.depth else None

    @property
    def n_frames(self) -> int:
        return self._count

    @property
    def span_ns(self) -> tuple[int, int]:
        return self._span_ns

    def ground_truth(self) -> Trajectory | None:
        return read_poses(self.path, self.topics.truth) if self.topics.truth else None

    def imu(self) -> Iterator[Imu]:
        if self.topics.imu is None:
            return
        last = -1
        with Bag(self.path) as bag:
            for _, _, message in bag.messages((self.topics.imu,)):
                t_ns = stamp_ns(message)
                if t_ns <= last:
                    self.skipped.append(Skipped(t_ns, self._at(self.topics.imu, t_ns), "IMU stamp is out of order"))
                    continue
                last = t_ns
                w, a = message.angular_velocity, message.linear_acceleration
                yield Imu(t_ns, np.array([w.x, w.y, w.z]), np.array([a.x, a.y, a.z]))

    def shots(self, cameras: int, depth: bool) -> Iterator[Shot]:
        if depth:
            self._check_depth()
        rig = self.rig
        base_s = rig.cameras[0].time_offset_s
        partners = [
            _Partner(topic, STEREO_NS, round((spec.time_offset_s - base_s) * NS_PER_S))
            for topic, spec in zip(self.topics.cameras[1:cameras], rig.cameras[1:cameras], strict=True)
        ]
        if depth:
            assert self.topics.depth is not None
            partners.append(_Partner(self.topics.depth, DEPTH_NS, round(-base_s * NS_PER_S)))
        period_ns = (self._span_ns[1] - self._span_ns[0]) // max(self._count - 1, 1)
        for partner in partners:
            partner.tolerance_ns = (
                min(partner.tolerance_ns, period_ns // 2) if self._count > 1 else partner.tolerance_ns
            )
        first = self.topics.cameras[0]
        with Bag(self.path) as bag, closing(bag.messages((first, *(p.topic for p in partners)))) as stream:
            for t_ns, why, messages in _paired(stream, first, partners):
                yield Shot(t_ns, self._at(first, t_ns), partial(self._load, t_ns, why, messages, depth))

    def light_shots(self) -> Iterator[Shot]:
        topic = self.topics.lights
        if topic is None or self.rig.lights is None:
            return
        with Bag(self.path) as bag, closing(bag.messages((topic,))) as stream:
            for t_ns, why, messages in _paired(stream, topic, []):
                yield Shot(t_ns, self._at(topic, t_ns), partial(self._load_light, t_ns, why, messages[0]))

    def _load(self, t_ns: int, why: str, messages: list[Any], depth: bool) -> Frame:
        if why:
            raise BadFrame(why)
        images = messages[:-1] if depth else messages
        for spec, message in zip(self.rig.cameras, images, strict=False):
            if message is None:
                raise BadFrame(f"{spec.name} has no image near enough in time")
        lenses = [spec.camera for spec in self.rig.cameras]
        grey_images = tuple(grey(m, (lens.width, lens.height)) for m, lens in zip(images, lenses, strict=False))
        return Frame(t_ns, grey_images, self._depth(messages[-1]) if depth else None)

    def _depth(self, message: Any) -> Any:
        if message is None:
            raise BadFrame("no depth image near enough in time")
        assert self._depth_reader is not None
        lens = self._depth_reader.spec.camera
        raw = raw_depth(message, (lens.width, lens.height))
        return self._depth_reader.metres(raw) if raw.dtype == np.uint16 else self._depth_reader.registered(raw)

    def _load_light(self, t_ns: int, why: str, message: Any) -> Frame:
        if why:
            raise BadFrame(why)
        assert self.rig.lights is not None
        lens = self.rig.lights.camera
        return Frame(t_ns, (grey(message, (lens.width, lens.height)),))

    def _check_depth(self) -> None:
        """Stop early where the depth is in another unit than the rig says: by the first image with a reading."""
        reader, topic = self._depth_reader, self.topics.depth
        assert reader is not None
        assert topic is not None
        lens = reader.spec.camera
        with Bag(self.path) as bag, closing(bag.messages((topic,))) as stream:
            for _, _, message in islice(stream, DEPTH_LOOKS):
                try:
                    raw = raw_depth(message, (lens.width, lens.height))
                except BadFrame:
                    continue
                if raw.dtype != np.uint16:
                    return
                if median_m := reader.median_m(raw):
                    reader.check_unit(median_m, str(self.path))
                    return

    def _at(self, topic: str, t_ns: int) -> str:
        return f"{self.path} {topic} at {seconds_text(t_ns)} s"


@dataclass
class _Partner:
    """A topic whose messages belong to those of the first camera: the nearest within `tolerance_ns`.

    ahead_ns : is added to its stamps; waiting : (stamp, number, message), by stamp
    """

    topic: str
    tolerance_ns: int
    ahead_ns: int
    waiting: list[tuple[int, int, Any]] = field(default_factory=list)
    newest_ns: int = -(1 << 62)

    def add(self, t_ns: int, number: int, message: Any) -> None:
        t_ns += self.ahead_ns
        insort(self.waiting, (t_ns, number, message), key=lambda item: item[:2])
        self.newest_ns = max(self.newest_ns, t_ns)

    def of(self, t_ns: int, next_ns: int | None) -> Any | None:
        """The message nearest to t_ns, if none of the next frame; older ones are let go."""
        best = min(self.waiting, key=lambda item: abs(item[0] - t_ns), default=None)
        self.waiting = [item for item in self.waiting if item[0] > t_ns - self.tolerance_ns]
        if best is None or abs(best[0] - t_ns) > self.tolerance_ns:
            return None
        if next_ns is not None and abs(best[0] - next_ns) < abs(best[0] - t_ns):
            return None
        self.waiting = [item for item in self.waiting if item[1] != best[1]]
        return best[2]


def _paired(
    stream: Iterator[tuple[str, int, Any]], first: str, partners: list[_Partner]
) -> Iterator[tuple[int, str, list[Any]]]:
    """(stamp, what is wrong with it, messages of the first and its partners) for each message of `first`.

    A frame waits until one frame and all its partners' streams have gone past it, or PATIENCE_NS of recording have.
    A stamp that jumps ahead of the next one, or does not come after the last one, is wrong.
    """
    queue: deque[tuple[int, int, Any]] = deque()  # stamp, when recorded, message
    last = -(1 << 62)
    by_topic = {partner.topic: partner for partner in partners}

    def release(bag_ns: float) -> Iterator[tuple[int, str, list[Any]]]:
        nonlocal last
        while queue:
            t_ns, recorded_ns, message = queue[0]
            next_ns = queue[1][0] if len(queue) > 1 else None
            complete = next_ns is not None and all(p.newest_ns > t_ns + p.tolerance_ns for p in partners)
            if not complete and bag_ns - recorded_ns < PATIENCE_NS:
                return
            queue.popleft()
            if t_ns <= last or (next_ns is not None and last < next_ns <= t_ns and next_ns != t_ns):
                yield t_ns, "stamp is a duplicate or out of order", [message]
                continue
            last = t_ns
            yield t_ns, "", [message, *(partner.of(t_ns, next_ns) for partner in partners)]

    for number, (topic, bag_ns, message) in enumerate(stream):
        if topic == first:
            queue.append((stamp_ns(message), bag_ns, message))
        else:
            by_topic[topic].add(stamp_ns(message), number, message)
        yield from release(bag_ns)
    yield from release(float("inf"))
