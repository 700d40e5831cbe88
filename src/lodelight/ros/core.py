"""The node without ROS: images, samples and fixes in, what is to be published out, commands in between.

Everything that touches the system is done on one thread of its own, in the order it came. Of frames that come faster
than they can be worked on, the oldest is dropped and counted.
"""

from __future__ import annotations

import queue
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lodelight.errors import ConfigError, LodelightError
from lodelight.geometry.se3 import SE3, carried_covariance
from lodelight.io.anchors_toml import read_anchors
from lodelight.localizer import Localizer, LocalizerConfig
from lodelight.mapping.map import Map
from lodelight.mapping.store import load_map, save_map
from lodelight.messages import Estimate, Frame, Imu, LightFix, Message
from lodelight.rig import Rig
from lodelight.ros.frames import OdomFrame
from lodelight.ros.partners import Partners
from lodelight.settings import with_settings
from lodelight.slam import Slam, SlamConfig
from lodelight.types import AnyArray, Array

QUEUE_FRAMES = 2  # that may wait
MAX_UNDER_WAY = 100  # frames of which it is known when they came
CLOUD_S, PATH_S, DIAGNOSTICS_S = 2.0, 1.0, 1.0  # at most so often
MAX_PATH = 2000  # poses in a path message


@dataclass(frozen=True)
class NodeConfig:
    """sensors : as of `lodelight run`; "" is the most the rig has. mode : slam, or localize in `map_file`
    map_file : saved to, loaded from, and loaded in the beginning where it is there; anchors : file; "" is none
    settings : section.key=value
    """

    sensors: str = ""
    mode: str = "slam"
    map_file: str = ""
    anchors: str = ""
    settings: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Output:
    """After a frame. latency_ms : from its last image to here; path, cloud : where they are due
    covariance : (6, 6) of T_odom_base, chart of SE3.perturbed
    """

    estimate: Estimate
    T_map_odom: SE3
    T_odom_base: SE3
    velocity: Array
    covariance: Array
    latency_ms: float
    path: list[tuple[int, SE3]] | None = None
    cloud: Array | None = None
    diagnostics: dict[str, str] | None = None


@dataclass
class _Due:
    """Times at which what is published seldom was published last."""

    path_s: float = -1e9
    cloud_s: float = -1e9
    diagnostics_s: float = -1e9
    n_keyframes: int = -1


class NodeCore:
    """One system at work. publish : called with every Output, on the core's thread; `tell` with lines for the log.

    T_base_body : where the rig's body is on base_link
    """

    def __init__(
        self, rig: Rig, config: NodeConfig, publish: Callable[[Output], None], T_base_body: SE3 | None = None,
        tell: Callable[[str], None] = print,
    ) -> None:  # fmt: skip
        if config.mode not in ("slam", "localize"):
            raise ConfigError(f"mode {config.mode!r} is unknown; choose slam or localize")
        self.rig, self.config, self.publish, self.tell = rig, config, publish, tell
        self.T_body_base = (T_base_body or SE3.identity()).inverse()
        self.sensors = config.sensors or rig.sensors
        visual = self.sensors.partition("-")[0]
        self.partners = Partners(2 if visual == "stereo" else 1, visual == "rgbd")
        self.frames = self.dropped = 0
        self._lock = threading.Lock()
        self._inbox: queue.Queue[Any] = queue.Queue()
        self._waiting = 0
        self._came_s: OrderedDict[int, float] = OrderedDict()  # when a frame was whole, by its stamp
        self._due = _Due()
        self._last: Estimate | None = None
        self._path: list[tuple[int, SE3]] = []  # of the localizer, which keeps none
        there = bool(config.map_file) and Path(config.map_file).exists()
        if config.mode == "localize" and not there:
            raise ConfigError(f"mode localize needs a map; map_file {config.map_file or 'is not given'!r} is not there")
        self._begin(load_map(config.map_file) if there else None)
        self._thread = threading.Thread(target=self._work, name="lodelight", daemon=True)
        self._thread.start()

    # -- in, from any thread --------------------------------------------------------------------------------------

    def image(self, name: str, t_ns: int, image: AnyArray) -> None:
        """Of "cam0" or "cam1" (H, W) uint8, or "depth" (H, W) float32 m."""
        with self._lock:
            frame = self.partners.add(name, self._on_body_clock(t_ns), image)
        if frame is not None:
            with self._lock:
                self._waiting += 1
                self._came_s[frame.t_ns] = time.monotonic()
                while len(self._came_s) > MAX_UNDER_WAY:
                    self._came_s.popitem(last=False)
            self._inbox.put(frame)

    def imu(self, t_ns: int, gyro: Array, accel: Array) -> None:
        if self.rig.imu is not None and self.sensors.endswith("-inertial"):
            offset_ns = round(self.rig.imu.time_offset_s * 1e9)
            self._inbox.put(Imu(t_ns + offset_ns, gyro, accel))

    def light(self, fix: LightFix) -> None:
        self._inbox.put(fix)

    # -- commands, from any thread: what came of them, in words; LodelightError where it failed ----------------------

    def save_map(self) -> str:
        return self._do(self._save)

    def load_map(self) -> str:
        return self._do(self._load)

    def reset(self) -> str:
        """Begin anew: an empty map, or the same one to be found in."""
        return self._do(self._reset)

    def localize_only(self, on: bool) -> str:
        return self._do(lambda: self._hold(on))

    def close(self) -> None:
        self._inbox.put(None)
        self._thread.join(timeout=30.0)

    # -- the thread ---------------------------------------------------------------------------------------------------

    def _work(self) -> None:
        while (item := self._inbox.get()) is not None:
            if isinstance(item, tuple):
                self._obey(*item)
                continue
            try:
                self._feed(item)
            except LodelightError as error:
                self.tell(f"{type(error).__name__}: {error}")

    def _feed(self, message: Message) -> None:
        if isinstance(message, Frame):
            with self._lock:
                self._waiting -= 1
                late = self._waiting >= QUEUE_FRAMES
            if late:
                self.dropped += 1
                return
            self.frames += 1
        estimate = self.system.feed(message)
        if estimate is not None:
            self._publish(estimate)

    def _publish(self, estimate: Estimate) -> None:
        T_map_base = estimate.T_world_body @ self.T_body_base
        if estimate.localized:
            self.odom.update(estimate.t_ns, T_map_base, self._before(estimate))
            self._last = estimate
            if isinstance(self.system, Localizer):
                self._path.append((estimate.t_ns, estimate.T_world_body))
        latency_ms = 1e3 * (time.monotonic() - self._came_s.pop(estimate.t_ns, time.monotonic()))
        seldom = self._seldom(estimate, latency_ms)
        self.publish(
            Output(
                estimate, self.odom.T_map_odom, self.odom.T_odom_base, self.odom.velocity,
                self._covariance(estimate, T_map_base), latency_ms, **seldom,
            )
        )  # fmt: skip

    def _covariance(self, estimate: Estimate, T_map_base: SE3) -> Array:
        carried = carried_covariance(estimate.T_world_body, estimate.covariance, T_map_base)
        turn = np.eye(6)
        turn[3:, 3:] = self.odom.T_map_odom.R.T
        out: Array = turn @ carried @ turn.T
        return out

    def _before(self, estimate: Estimate) -> SE3 | None:
        """Where the map has base_link at the last localized frame, as it stands now; None where it was found anew."""
        if self._last is None or (isinstance(self.system, Localizer) and estimate.status == "relocalized"):
            return None
        if isinstance(self.system, Localizer):
            return self._last.T_world_body @ self.T_body_base
        if len(self.system.path) < 2 or self.system.path[-2].t_ns != self._last.t_ns:
            return None
        node = self.system.path[-2]
        return self.system.tags.world(self.system.map.pose(node.reference) @ node.T_reference_body) @ self.T_body_base

    def _seldom(self, estimate: Estimate, latency_ms: float) -> dict[str, Any]:
        now_s, due, map, out = time.monotonic(), self._due, self.system.map, dict[str, Any]()
        n_keyframes = int(np.count_nonzero(map.keyframes.alive))
        if n_keyframes != due.n_keyframes and now_s - due.cloud_s > CLOUD_S:
            due.cloud_s, due.n_keyframes = now_s, n_keyframes
            with map.lock:
                out["cloud"] = self._in_world(map.points.xyz[map.alive_points].copy())
        if now_s - due.path_s > PATH_S:
            due.path_s = now_s
            out["path"] = self._whole_path()
        if now_s - due.diagnostics_s > DIAGNOSTICS_S:
            due.diagnostics_s = now_s
            out["diagnostics"] = {
                "state": estimate.status, "why": estimate.why, "latency_ms": f"{latency_ms:.1f}",
                "inliers": str(estimate.inliers), "frames": str(self.frames), "dropped": str(self.dropped),
                "unmatched": str(self.partners.unmatched), "keyframes": str(n_keyframes),
                "map_points": str(len(map.alive_points)),
            }  # fmt: skip
        return out

    def _whole_path(self) -> list[tuple[int, SE3]]:
        if isinstance(self.system, Localizer):
            nodes = self._path
        else:
            path = self.system.trajectory()
            nodes = [(int(t), path.pose(i)) for i, t in enumerate(path.t_ns)]
        step = -(-len(nodes) // MAX_PATH) or 1
        return [(t, T @ self.T_body_base) for t, T in [*nodes[: len(nodes) - 1 : step], *nodes[-1:]]]

    def _in_world(self, xyz: Array) -> Array:
        T = self.system.tags.T_world_map if isinstance(self.system, Slam) else None
        return xyz if T is None else T @ xyz

    def _on_body_clock(self, t_ns: int) -> int:
        return t_ns + round(self.rig.cameras[0].time_offset_s * 1e9)

    # -- commands, on the thread --------------------------------------------------------------------------------------

    def _do(self, work: Callable[[], str]) -> str:
        done: Future[str] = Future()
        self._inbox.put((done, work))
        return done.result()

    def _obey(self, done: Future[str], work: Callable[[], str]) -> None:
        try:
            done.set_result(work())
        except Exception as error:
            done.set_exception(error)

    def _begin(self, known: Map | None) -> None:
        self.odom, self._last = OdomFrame(), None
        self._path.clear()
        self._due = _Due()
        anchors = read_anchors(self.config.anchors) if self.config.anchors else None
        if self.config.mode == "localize":
            assert known is not None
            wanted = with_settings(LocalizerConfig(sensors=self.sensors), list(self.config.settings))
            self.system: Slam | Localizer = Localizer(self.rig, known, wanted, live=True)
        else:
            config = with_settings(SlamConfig(sensors=self.sensors), list(self.config.settings))
            self.system = Slam(self.rig, config, known, live=True, anchors=anchors)

    def _save(self) -> str:
        if not self.config.map_file:
            raise ConfigError("map_file is not given; set that parameter to where the map shall go")
        map = self.system.map_in_world() if isinstance(self.system, Slam) else self.system.map
        save_map(map, self.config.map_file)
        return f"{len(self.system.map.alive_keyframes)} keyframes saved to {self.config.map_file}"

    def _load(self) -> str:
        if not self.config.map_file:
            raise ConfigError("map_file is not given; set that parameter to a saved map")
        known = load_map(self.config.map_file)
        self._end()
        self._begin(known)
        return f"{len(known.alive_keyframes)} keyframes loaded from {self.config.map_file}"

    def _reset(self) -> str:
        self._end()
        if self.config.mode == "localize":
            self._begin(self.system.map)
            return "the camera is looked for anew"
        self._begin(None)
        return "a new map is begun"

    def _hold(self, on: bool) -> str:
        if isinstance(self.system, Localizer):
            return "this node localizes only, always"
        self.system.localization_only = on
        return "the map is not written to any more" if on else "mapping goes on"

    def _end(self) -> None:
        """Stop what runs beside; a map that is left is not worth its last adjustment."""
        if isinstance(self.system, Localizer):
            self.system.close()
        else:
            self.system.mapping.close()
