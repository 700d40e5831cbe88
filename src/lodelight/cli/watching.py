"""`--view`, `--web` and `--rrd`: what a system says and sees, handed to the observer, which it does not know."""

from __future__ import annotations

import sys
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from lodelight.anchors import Anchors
    from lodelight.io.recording import Recording
    from lodelight.localizer import Localizer
    from lodelight.messages import Estimate, Frame, LightFix, Message
    from lodelight.report.rerun_view import RerunView, Sight
    from lodelight.slam import Slam
    from lodelight.types import Array, Bools

KEPT_FRAMES = 64  # that may be under way between a recording and its estimates


@dataclass(frozen=True)
class ViewOptions:
    """Where a run is shown."""

    window: bool = False
    web: bool = False
    rrd: Path | None = None

    def watcher(self, recording: Recording, anchors: Anchors | None = None) -> Watcher | None:
        """None where nobody asked to see anything."""
        if not (self.window or self.web or self.rrd):
            return None
        from lodelight.report.rerun_view import RerunView

        return Watcher(RerunView(recording.name, recording.rig, self.window, self.web, self.rrd), anchors)


@dataclass
class Watcher:
    """Notes messages on their way into a system, and shows them together with its estimates."""

    view: RerunView
    anchors: Anchors | None = None
    _frames: OrderedDict[int, Frame] = field(default_factory=OrderedDict)
    _fix: LightFix | None = None
    _n_keyframes: int = -1

    def of(self, recording: Recording) -> Any:
        """The recording, with its messages overheard."""
        return _Overheard(recording, self._note)

    def lights(self, fixes: Iterable[LightFix]) -> Iterator[LightFix]:
        for fix in fixes:
            self._fix = fix
            yield fix

    def events(self, sink: Callable[..., None]) -> Callable[..., None]:
        """Events for the sink, and for the observer."""

        def both(t_ns: int | None, kind: str, **fields: Any) -> None:
            sink(t_ns, kind, **fields)
            self.view.event(t_ns, kind, **fields)

        return both

    def show(self, estimate: Estimate, system: Slam | Localizer) -> None:
        """A frame; and the map, where a keyframe has come or gone."""
        self.view.frame(estimate, self._sight(estimate, system))
        n_keyframes = int(np.count_nonzero(system.map.keyframes.alive))
        if n_keyframes != self._n_keyframes:
            self._n_keyframes = n_keyframes
            self._show_map(system)

    def finish(self, system: Slam | Localizer) -> None:
        """The map as it is in the end."""
        self._show_map(system)
        self.view.close()

    def stay(self) -> None:
        """Keep the web viewer, if there is one, until Ctrl-C."""
        if not self.view.url:
            return
        import signal
        import threading

        print(f"viewer: {self.view.url} (Ctrl-C ends)", file=sys.stderr, flush=True)
        ended = threading.Event()
        before = signal.signal(signal.SIGINT, lambda *_: ended.set())
        while not ended.wait(1.0):
            pass
        signal.signal(signal.SIGINT, before)

    def _note(self, message: Message) -> None:
        from lodelight.messages import Frame

        if isinstance(message, Frame):
            self._frames[message.t_ns] = message
            while len(self._frames) > KEPT_FRAMES:
                self._frames.popitem(last=False)

    def _sight(self, estimate: Estimate, system: Slam | Localizer) -> Sight:
        from lodelight.report.rerun_view import Sight

        frame = self._frames.get(estimate.t_ns)
        image = frame.images[0] if frame is not None else None
        px, mapped = _tracks(system, estimate.t_ns)
        seen = system.tags.detector.seen if hasattr(system, "tags") else []
        tags = [tag for tag in seen if tag.t_ns == estimate.t_ns]
        lights = self._fix.seen if self._fix is not None else ()
        return Sight(image, px, mapped, tags, lights)

    def _show_map(self, system: Slam | Localizer) -> None:
        from lodelight.anchors import tag_corners
        from lodelight.mapping.tag_corners import tag_world
        from lodelight.mapping.tag_views import tag_name
        from lodelight.report.rerun_view import Scene

        map = system.map
        with map.lock:
            xyz, keyframes = map.points.xyz[map.alive_points].copy(), map.keyframes.p[map.alive_keyframes].copy()
            tags = {
                tag_name(map, i): tag_world(map, i) @ tag_corners(float(map.tags.size_m[i]))
                for i in np.flatnonzero(map.tags.placed).tolist()
            }
        lights = {light.id: light.xyz for light in self.anchors.lights} if self.anchors else {}
        self.view.scene(Scene(xyz, keyframes, tags, lights))


def _tracks(system: Any, t_ns: int) -> tuple[Array, Bools]:
    """Corners (N, 2) px of a frame that was just estimated, and which of them are points of the map."""
    if getattr(system, "inertial", None) is not None:
        odometry = system.inertial.odometry
        tracks = odometry.tracker.tracks
        if tracks is not None and tracks.t_ns == t_ns:
            known = [] if odometry.window is None else odometry.window.landmarks().track
            return tracks.px.astype(np.float64), np.isin(tracks.id, known)
    else:
        last = system.machine.tracker.last if hasattr(system, "machine") else system.ladder.follower.last
        if last is not None and last.t_ns == t_ns:
            return last.seen.px.astype(np.float64), last.point >= 0
    return np.zeros((0, 2)), np.zeros(0, np.bool_)


class _Overheard:
    """A recording that tells of every message it gives."""

    def __init__(self, recording: Recording, note: Callable[[Message], None]) -> None:
        self._recording = recording
        self._note = note

    def messages(self, *arguments: Any) -> Iterator[Message]:
        for message in self._recording.messages(*arguments):
            self._note(message)
            yield message

    def __getattr__(self, name: str) -> Any:
        return getattr(self._recording, name)
