"""The SLAM system: features in, pose out, keyframes into the map. Read `step` first."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import numpy as np

from lodelight.anchors import Anchors
from lodelight.compiled import Stopwatch
from lodelight.errors import ConfigError
from lodelight.features.features import Features
from lodelight.features.frontend import FrontEnd
from lodelight.features.orb import OrbConfig
from lodelight.geometry.se3 import SE3, carried_covariance
from lodelight.inertial import InertialFront, Located, NewKeyframe
from lodelight.io.pacing import Paced
from lodelight.io.recording import Recording, woven
from lodelight.localization.machine import Finder, LocalizationMachine
from lodelight.localization.relocalize import Relocalizer
from lodelight.localization.tracker import Tracked, Tracker, TrackerConfig
from lodelight.mapping.compact import compacted
from lodelight.mapping.first_views import Begun, FirstViews, FirstViewsConfig
from lodelight.mapping.inertial_adjust import adjust_with_imu
from lodelight.mapping.keyframes import Candidate, Decision, Gate, KeyframeConfig, decide
from lodelight.mapping.light_anchor import LightAnchor
from lodelight.mapping.light_gate import GateConfig
from lodelight.mapping.light_ties import LightsConfig
from lodelight.mapping.local import LocalMapper, LocalMappingConfig, adjust
from lodelight.mapping.loops import LoopCloser, LoopConfig
from lodelight.mapping.map import Map
from lodelight.mapping.path import Path, PathNode, laid_down
from lodelight.mapping.places import Places
from lodelight.mapping.tags import MapTags, MapTagsConfig
from lodelight.mapping.worker import InlineMapping, ThreadedMapping
from lodelight.memory import give_back_large
from lodelight.messages import LOST_COVARIANCE, Estimate, Frame, LightFix, Message, TagSighting
from lodelight.odometry.inertial import InertialOdometry, OdometryConfig
from lodelight.rig import Rig
from lodelight.tags.gate import KnownTag
from lodelight.trajectory import Trajectory
from lodelight.types import Array

EventSink = Callable[..., None]  # called as sink(t_ns, kind, **fields)
FOREVER_NS = 10**18
GIVEN_UP_NS = 10**9  # sooner than this no map is given up


@dataclass(frozen=True)
class SlamConfig:
    """Every default of the system, by stage.

    min_start_points : close points below which no map is begun
    final_iterations : of the adjustment of the whole map at the end of a run
    """

    sensors: str = "rgbd"
    seed: int = 0
    min_start_points: int = 50
    final_iterations: int = 10
    orb: OrbConfig = field(default_factory=OrbConfig)
    tracking: TrackerConfig = field(default_factory=TrackerConfig)
    first_views: FirstViewsConfig = field(default_factory=FirstViewsConfig)
    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    mapping: LocalMappingConfig = field(default_factory=LocalMappingConfig)
    loops: LoopConfig = field(default_factory=LoopConfig)
    gate: GateConfig = field(default_factory=GateConfig)
    lights: LightsConfig = field(default_factory=LightsConfig)
    tags: MapTagsConfig = field(default_factory=MapTagsConfig)
    inertial: OdometryConfig = field(default_factory=OdometryConfig)


@dataclass(frozen=True, eq=False)
class FlownKeyframe:
    """A frame of the inertial window that is to become a keyframe; at : its node of the path."""

    located: Located
    new: NewKeyframe
    at: int


MappingJob: TypeAlias = int | FlownKeyframe  # a keyframe of the map, or one that has yet to come into it


class Slam:
    """Simultaneous localization and mapping with RGB-D or stereo, with any camera and an IMU, or with one camera alone.

    `run` streams a recording; `feed` takes one message at a time, for live use; `close` waits for mapping to end.
    map : the map so far; a given one is continued
    live : mapping on its own thread; else everything is done in order, the same bytes every time
    anchors : what is surveyed of the building; fixes by its lights come as messages
    on_event : told of every decision, as on_event(t_ns, kind, **fields), from either thread
    metric : lengths are in m; not so of one camera alone, unless a tag of known size was in view when the map began
    mapping_ms : wall time of every keyframe's mapping so far
    localization_only : set it, and the map is no longer written to
    """

    def __init__(
        self,
        rig: Rig,
        config: SlamConfig | None = None,
        map: Map | None = None,
        gates: tuple[Gate, ...] = (),
        on_event: EventSink | None = None,
        live: bool = False,
        anchors: Anchors | None = None,
    ) -> None:
        give_back_large()
        self.config = config or SlamConfig()
        visual, _, inertial = self.config.sensors.partition("-")
        self.front_end = FrontEnd(rig, visual, self.config.orb)
        self.emit: EventSink = on_event or (lambda t_ns, kind, **fields: None)
        self.anchors, self.more_gates = anchors or Anchors(), gates
        find = self._assemble(map if map is not None else Map(rig))
        scaleless = visual == "mono" and not inertial and map is None
        self.first_views = self._first_views() if scaleless else None
        self.metric = not scaleless
        self.inertial: InertialFront | None = None
        if inertial:
            odometry = InertialOdometry(rig, visual, self.config.inertial, self.emit, self.config.seed)
            self.inertial = InertialFront(
                odometry, self.map, self.front_end, self.tracker, self.mapper, find, self.emit, self.tags.see,
                self.gates, self.lights,
            )  # fmt: skip
        self.live = live
        self.localization_only = False
        work: Callable[[MappingJob], None] = self._map
        self.mapping = ThreadedMapping(work) if live else InlineMapping(work)
        self.mapping_ms: list[float] = []
        self._tie: tuple[dict[str, KnownTag], bool] | None = None  # surveyed tags, and whether they move the window
        self.relocalizations = 0
        self.dropped = 0
        self._last_keyframe_ns = -FOREVER_NS
        self._relocalized_ns = -FOREVER_NS
        self._peak_inliers = 0  # of the frames since the last keyframe

    def run(
        self, recording: Recording, start_s: float = 0.0, end_s: float = math.inf, beside: Iterable[Message] = ()
    ) -> Iterator[Estimate]:
        """Estimates of all frames of a recording, as a robot would have had them at the time.

        beside : further messages by rising stamp, such as fixes by lights
        """
        messages = woven(recording.messages(self.config.sensors, start_s, end_s), beside)
        if self.live:
            messages = iter(Paced(messages, self._dropped))
        for message in messages:
            estimate = self.feed(message)
            if estimate is not None:
                yield estimate
        last = self.inertial.flush() if self.inertial is not None else None
        if last is not None:
            yield self._take(last)
        self.close()

    def close(self) -> None:
        """Wait until the last keyframe is mapped, then adjust the whole map once more."""
        self.mapping.close()
        self.tags.prepare()
        if self.config.final_iterations and len(self.map.keyframes):
            orb, sigma_px = self.config.orb, self.config.mapping.sigma_px
            iterations = self.config.final_iterations
            with_imu = self.inertial is not None and adjust_with_imu(
                self.map, orb, sigma_px, iterations, self.inertial.chain, not self.config.sensors.startswith("mono")
            )
            if not with_imu:
                adjust(self.map, self.map.alive_keyframes, orb, sigma_px, iterations, None)
        move = self.lights.settled() if self.lights else None
        if move is not None:
            self.map.move(move)
        self.tags.finish()

    def feed(self, message: Message) -> Estimate | None:
        """One message; an estimate for every frame. With an IMU a frame waits for the sample behind it."""
        if isinstance(message, LightFix):
            if self.lights:
                with self.map.lock:  # with an IMU the gate asks from the thread that maps
                    self.lights.feed(message)
            return None
        if self.inertial is not None:
            self.inertial.localization_only = self.localization_only
            if self.lights and isinstance(message, Frame):
                with self.map.lock:
                    self._move_map()
            if self._tie is not None:  # found where maps are made, and the window is not to be moved from there
                tie, self._tie = self._tie, None
                self.inertial.tie(*tie)
            located = self.inertial.feed(message)
            return None if located is None else self._take(located)
        return self.step(message) if isinstance(message, Frame) else None

    def step(self, frame: Frame) -> Estimate:
        """One frame: see it, locate it, decide whether it becomes a keyframe, map."""
        clock = Stopwatch()
        seen = self.front_end.process(frame)
        tags = self.tags.see(frame) if self.metric or len(self.map.keyframes) == 0 else []  # they say lengths
        if len(self.map.keyframes) == 0:
            return self._begin(frame.t_ns, seen, clock, tags)
        with self.map.lock:
            self._move_map()
            tracked = self.machine.locate(frame.t_ns, seen, self.lights.doubt if self.lights else None)
            estimate = self._estimate(tracked, clock)
        if estimate.status == "relocalized":
            self._relocalized_ns = frame.t_ns
            self.relocalizations += 1
        if estimate.localized:
            self.path.append(PathNode(tracked.t_ns, tracked.reference, tracked.T_reference_body))
            with self.map.lock:
                candidate = self._candidate(tracked)
                if self.lights:
                    self.lights.tracked(frame.t_ns, tracked.reference, tracked.T_reference_body)
                decision = decide(candidate, self.config.keyframes, self.gates)
            self.emit(frame.t_ns, "keyframe", inserted=decision.insert, why=decision.why, weight=decision.weight)
            if decision.insert:
                self._insert(tracked, decision, tags)
            elif tags and not self.localization_only:
                with self.map.lock:
                    covariance = self._covariance(tracked)
                    self.tags.note(tags, tracked.reference, tracked.T_reference_body, covariance, own=False)
        elif self.first_views is not None and self._hopeless(frame.t_ns):
            self.emit(frame.t_ns, "begun_anew", why="lost for longer than the map had been followed")
            self._assemble(Map(self.map.rig))
            self.first_views, self.metric = self._first_views(), False
        return estimate

    def trajectory(self) -> Trajectory:
        """T_world_body of all localized frames, as the map stands now."""
        return Trajectory.from_poses(
            [node.t_ns for node in self.path],
            [self.tags.world(T) for T in laid_down(self.path, self.map.pose)],
        )

    def map_in_world(self) -> Map:
        """A copy of the map as it stands, without dead rows, in the world where it is aligned: what to save of a run
        that goes on."""
        with self.map.lock:
            map, T_world_map = compacted(self.map), self.tags.T_world_map
        if T_world_map is not None:
            map.move(T_world_map)
        return map

    def cloud(self) -> Array:
        """(N, 3) m, world: the map's points."""
        return self.map.points.xyz[self.map.alive_points]

    def stats(self) -> dict[str, Any]:
        """Counts for `metrics.json`."""
        return {
            "keyframes": len(self.map.alive_keyframes),
            "map_points": len(self.map.alive_points),
            "loops": len(self.map.loops),
            "tags": int(np.count_nonzero(self.map.tags.placed)),
            "aligned": self.tags.aligned,
            "metric": self.metric,
            "relocalizations": self.relocalizations + (self.inertial.relocalizations if self.inertial else 0),
            "dropped": self.dropped,
            **({"gate": self.lights.gate.counts} if self.lights else {}),
        }

    def _dropped(self, t_ns: int) -> None:
        self.dropped += 1
        self.emit(t_ns, "dropped", why="the frames before it took too long")

    # -- parts --------------------------------------------------------------------------------------------------

    def _assemble(self, map: Map) -> Finder:
        """Everything that works on a map, around this one; returns what finds a camera in it."""
        orb, config = self.config.orb, self.config
        self.map = map
        self.tracker = Tracker(map.rig, map, orb, config.tracking, config.seed)
        upright = config.sensors.endswith("-inertial")
        self.lights = _light_anchor(map, config, self.anchors, self.emit, upright)
        asks = self.lights if config.gate.use == "lights" else None
        self.gates = (*self.more_gates, asks.ask) if asks else self.more_gates
        places = Places(map)
        find = Relocalizer(map, orb, places).find
        self.machine = LocalizationMachine(self.tracker, find)
        self.mapper = LocalMapper(map, orb, config.mapping)
        self.loops = LoopCloser(map, orb, places, config.loops, self.emit)
        self.tags = MapTags(map, orb, config.mapping.sigma_px, self.anchors.tags, config.tags, self.emit, upright)
        self.path = Path()
        return find

    def _first_views(self) -> FirstViews:
        config, spec = self.config, self.map.rig.cameras[0]
        self.mapper.min_parallax = math.radians(config.mapping.min_parallax_mono_deg)
        return FirstViews(spec, config.orb, config.mapping.sigma_px, config.first_views, config.seed)

    def _move_map(self) -> None:
        """Lay the map down where the lights say it is, while no adjustment is under way that would move it back."""
        move = self.lights.take_move() if self.lights and self.mapping.idle else None
        if move is not None:
            self.map.move(move)
            self.tags.moved()
            self.loops.forget()

    def _hopeless(self, t_ns: int) -> bool:
        """Whether a map without scale is given up for a new one: it was followed for less time than it is lost now."""
        if not self.path or not self.mapping.idle:
            return False
        followed_ns, lost_ns = self.path[-1].t_ns - self.path[0].t_ns, t_ns - self.path[-1].t_ns
        return lost_ns > max(followed_ns, GIVEN_UP_NS)

    def _begin(self, t_ns: int, seen: Features, clock: Stopwatch, tags: Sequence[TagSighting]) -> Estimate:
        """The first keyframe of a new map, at the origin, if enough of what it sees has a depth."""
        if self.first_views is not None:
            begun = self.first_views.feed(t_ns, seen, tags)
            if not isinstance(begun, str):
                return self._begin_with(begun, clock)
            return Estimate(t_ns, "initializing", SE3.identity(), LOST_COVARIANCE, begun, 0, {"track_ms": clock.ms()})
        close = int(np.count_nonzero(self.mapper.close(seen)))
        if close < self.config.min_start_points:
            why = f"{close} of {len(seen)} corners have depth, {self.config.min_start_points} are needed to begin a map"
            return Estimate(t_ns, "initializing", SE3.identity(), LOST_COVARIANCE, why, 0, {"track_ms": clock.ms()})
        T_world_body = self.lights.start(t_ns) if self.lights else SE3.identity()
        nothing = np.full(len(seen), -1, np.int32)
        first = Tracked(t_ns, seen, T_world_body, np.zeros((6, 6)), nothing, reference=0)
        self.emit(t_ns, "keyframe", inserted=True, why="the first", weight=1.0)
        self._insert(first, Decision(True, "the first"), tags)
        self.machine.start(first)
        self.path.append(PathNode(t_ns, 0, SE3.identity()))
        if self.lights:
            self.lights.tracked(t_ns, 0, SE3.identity())
        return self._estimate(first, clock)

    def _begin_with(self, begun: Begun, clock: Stopwatch) -> Estimate:
        """Several keyframes and the points that they see; without a tag the map is as large as was supposed."""
        self.metric = begun.metric
        with self.map.lock:
            keyframes: list[int] = []
            for view in begun.views:
                nothing, parent = np.full(len(view.seen), -1, np.int32), len(keyframes) - 1
                keyframes.append(self.mapper.insert(view.t_ns, view.T_world_body, view.seen, nothing, 1.0, parent))
                self.emit(view.t_ns, "keyframe", inserted=True, why="of the first views", weight=1.0)
                self.path.append(PathNode(view.t_ns, keyframes[-1], SE3.identity()))
            self.mapper.add_seen(begun.xyz, keyframes, [view.row for view in begun.views])
            point = self.map.points_of(keyframes[-1]).copy()
        last = begun.views[-1]
        tracked = Tracked(last.t_ns, last.seen, last.T_world_body, np.zeros((6, 6)), point, reference=keyframes[-1])
        self._last_keyframe_ns = last.t_ns
        self.machine.start(tracked)
        self.mapping.submit(keyframes[-1])
        return self._estimate(tracked, clock)

    def _take(self, located: Located) -> Estimate:
        """What the inertial half made of a frame: into the path, and its keyframe to mapping."""
        estimate = located.estimate
        if not estimate.localized:
            return estimate
        self.path.append(PathNode(estimate.t_ns, located.reference, located.T_reference_body))
        if located.keyframe is not None:
            flown = FlownKeyframe(located, located.keyframe, len(self.path) - 1)
            # the first of all must be there before another frame can hang on it
            self.mapping.submit(self._put(flown) if located.reference < 0 else flown)
        elif not self.localization_only:
            with self.map.lock:
                self._note(located, located.reference, located.T_reference_body, own=False)
        T_world_body, covariance = self.tags.world(estimate.T_world_body), estimate.covariance
        details = {**estimate.details, "aligned": float(self.tags.aligned)}
        if self.tags.T_world_map is not None:
            velocity = self.tags.T_world_map.R @ [details[f"velocity_{axis}"] for axis in "xyz"]
            details |= {f"velocity_{axis}": float(v) for axis, v in zip("xyz", velocity, strict=True)}
        return replace(
            estimate, T_world_body=T_world_body, covariance=self.tags.world_covariance(covariance), details=details
        )

    def _insert(self, tracked: Tracked, decision: Decision, tags: Sequence[TagSighting] = ()) -> None:
        """The quick half of mapping, which the next frame needs; the rest is the worker's."""
        with self.map.lock:
            parent = tracked.reference if len(self.map.keyframes) else -1
            keyframe = self.mapper.insert(
                tracked.t_ns, tracked.T_world_body, tracked.seen, tracked.point, decision.weight, parent, tracked.noise
            )
            tracked.point[:] = self.map.points_of(keyframe)
            if self.lights:
                self.lights.inserted(keyframe, tracked.t_ns)
            self.tags.note(tags, keyframe, SE3.identity(), self._covariance(tracked), own=True)
        self._last_keyframe_ns = tracked.t_ns
        self._peak_inliers = 0
        self.mapping.submit(keyframe)

    def _put(self, flown: FlownKeyframe) -> int:
        """A keyframe of the inertial window into the map: there its frame hangs on itself; -1 where it may not."""
        assert self.inertial is not None
        located, node = flown.located, self.path[flown.at]
        keyframe, decision = self.inertial.insert(flown.new)
        why = "; ".join(filter(None, [flown.new.step.keyframe, decision.why]))
        self.emit(node.t_ns, "keyframe", inserted=keyframe >= 0, why=why, weight=decision.weight)
        if keyframe < 0:
            return keyframe
        alone = node.reference < 0 or flown.new.step.restarted
        before = None if alone else (node.reference, node.T_reference_body)
        self.path[flown.at] = PathNode(node.t_ns, keyframe, SE3.identity(), before)
        with self.map.lock:
            self._note(located, keyframe, SE3.identity(), own=True)
        return keyframe

    def _note(self, located: Located, reference: int, T_reference_body: SE3, own: bool) -> None:
        """What a frame of the inertial half saw of tags; the window is told of surveyed ones."""
        if not located.tags:
            return
        window = self.config.inertial.window
        beyond = np.diag(np.repeat([window.tag_gate_rad, window.tag_gate_m], 3) ** 2)  # as in the window's test
        covariance = located.estimate.covariance + beyond
        elsewhere = self.tags.note(located.tags, reference, T_reference_body, covariance, own)
        if self.tags.aligned:
            self._tie = self.tags.surveys(), elsewhere

    def _map(self, job: MappingJob) -> None:
        clock = Stopwatch()
        keyframe = job if isinstance(job, int) else self._put(job)
        if keyframe < 0:
            return
        self.mapper.process(keyframe, self.mapping.interrupted)
        if self.map.keyframes.alive[keyframe]:
            self.loops.process(keyframe, self.mapping.interrupted)
            self.tags.process(keyframe, self.mapping.interrupted)
        if self.inertial is not None:
            self.inertial.squeeze(self.loops.places)
        self.mapping_ms.append(clock.ms())

    def _candidate(self, tracked: Tracked) -> Candidate:
        n_keyframes = int(np.count_nonzero(self.map.keyframes.alive))
        expected = self.map.points_of(tracked.reference)
        expected = expected[expected >= 0]
        min_sightings = 2 if n_keyframes > 2 else 1
        confirmed = int(np.count_nonzero(self.map.points.n_obs[expected] >= min_sightings))
        self._peak_inliers = max(self._peak_inliers, tracked.n_inliers)
        close = self.mapper.close(tracked.seen)
        return Candidate(
            t_ns=tracked.t_ns,
            inliers=tracked.n_inliers,
            reference_points=max(confirmed, self._peak_inliers),
            close_tracked=int(np.count_nonzero(close & (tracked.point >= 0))),
            close_untracked=int(np.count_nonzero(close & (tracked.point < 0))),
            n_keyframes=n_keyframes,
            noise=tracked.noise,
            since_keyframe_s=(tracked.t_ns - self._last_keyframe_ns) * 1e-9,
            since_relocalization_s=(tracked.t_ns - self._relocalized_ns) * 1e-9,
            mapping_idle=self.mapping.idle,
            mapping_stopped=self.loops.correcting,
            localization_only=self.localization_only,
            measures_depth=self.config.sensors != "mono",
            queue=self.mapping.queued,
            T_world_body=tracked.T_world_body,
            covariance=self._covariance(tracked),
        )

    def _covariance(self, tracked: Tracked) -> Array:
        """Of the pose against the map's root: its own against the map there, and what the map there carries."""
        reference = tracked.reference
        known: Array = self.map.keyframes.covariance[reference]
        return tracked.covariance + carried_covariance(self.map.pose(reference), known, tracked.T_world_body)

    def _estimate(self, tracked: Tracked, clock: Stopwatch) -> Estimate:
        covariance = LOST_COVARIANCE if tracked.why_lost else self.tags.world_covariance(self._covariance(tracked))
        return Estimate(
            tracked.t_ns, self.machine.status, self.tags.world(tracked.T_world_body), covariance, self.machine.why,
            tracked.n_inliers, {"track_ms": clock.ms(), "aligned": float(self.tags.aligned)},
        )  # fmt: skip


def _light_anchor(
    map: Map, config: SlamConfig, anchors: Anchors, emit: EventSink, upright: bool
) -> LightAnchor | None:  # fmt: skip
    """None where lights are not asked for. Raises ConfigError where they would be used twice."""
    gated, tight = config.gate.use == "lights", config.lights.use == "tight"
    if gated and tight:
        raise ConfigError("the gate and tight lights would count the same light twice; choose --gate or --lights tight")
    if (gated or tight) and config.sensors == "mono" and len(map.keyframes) == 0:
        raise ConfigError("lights say metres, and one camera alone does not; choose rgbd, stereo, or one with an IMU")
    if tight and (map.rig.lights is None or not anchors.lights):
        raise ConfigError("tight lights need a light camera in the rig and [[light]] entries in the anchors")
    if not gated and not tight:
        return None
    return LightAnchor(map, config.gate, config.lights, anchors.lights, emit, upright)
