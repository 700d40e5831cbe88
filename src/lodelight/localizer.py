"""The localization system: features in, pose in a finished map out; the map is never written. Read `step` first."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from lodelight.compiled import Stopwatch
from lodelight.errors import CalibrationError, MapError
from lodelight.features.frontend import FrontEnd
from lodelight.features.orb import OrbConfig
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3, carried_covariance
from lodelight.io.pacing import Paced
from lodelight.io.recording import Recording
from lodelight.localization.backwards import Backwards
from lodelight.localization.follower import n_temporary
from lodelight.localization.ladder import EventSink, Ladder, LadderConfig
from lodelight.localization.reckoning import DeadReckoning
from lodelight.localization.relocalize import Hint
from lodelight.localization.states import State
from lodelight.localization.tracker import Tracked
from lodelight.mapping.map import Map
from lodelight.messages import LOST_COVARIANCE, Estimate, Frame, Imu, LightFix, Message
from lodelight.rig import Rig
from lodelight.types import Array

# Of the way without the map, one standard deviation, by a camera of that focal length (science note B3): scale is lost
# by angles, and with fewer pixels a radian they are measured the worse.
DRIFT, DRIFT_FOCAL_PX = 0.02, 460.0
GUESSED = 0.5  # of the way without anything whose distance is known
# An image is enlarged to twice its size at most (as Lowe 2004 does: beyond, nothing more comes out of it), and to so
# many pixels, for the time they take; where less than one octave is wanting, it is not.
MOST_ENLARGED, MOST_PIXELS = 2.0, 700_000


@dataclass(frozen=True)
class LocalizerConfig:
    """Every default of the system, by stage.

    sensors : mono, stereo or rgbd, each also with -inertial
    temporary_points : whether they may carry the camera where the map is not enough
    backwards : whether frames before one that was found are followed back from there; never while live
    hint_reach_m : from how far away the place of a hinted pose may be seen
    """

    sensors: str = "mono"
    seed: int = 0
    temporary_points: bool = True
    backwards: bool = True
    hint_reach_m: float = 3.0
    orb: OrbConfig = field(default_factory=OrbConfig)
    ladder: LadderConfig = field(default_factory=LadderConfig)


class Localizer:
    """Finds and follows a camera in a map.

    `run` streams a recording; `feed` takes one message at a time, for live use; `close` ends.
    rig : of the camera, which need not be the one that made the map; its first camera is used
    on_event : told of what happens, as on_event(t_ns, kind, **fields)
    Poses are T_world_body in the map's frame, of the body of `rig`.
    Raises MapError where the map has nothing to localize in, CalibrationError on sensors that the rig lacks.
    """

    def __init__(
        self,
        rig: Rig,
        map: Map,
        config: LocalizerConfig | None = None,
        on_event: EventSink | None = None,
        live: bool = False,
    ) -> None:
        self.config = config or LocalizerConfig()
        _check(map)
        visual, _, inertial = self.config.sensors.partition("-")
        if inertial and rig.imu is None:
            raise CalibrationError(f"{self.config.sensors} was asked for, but the rig has no IMU; give it [imu]")
        self.map = map
        self.live = live
        self.on_event = on_event
        self._focal_px = rig.cameras[0].camera.focal_px
        self.front_end = FrontEnd(
            rig, visual, self.config.orb, _enlarged(rig.cameras[0].camera, map, self.config.orb.scale_factor)
        )
        rig = self.front_end.rig
        self.ladder = Ladder(
            rig, map, self.config.orb, self.config.ladder, self.config.seed, self.config.temporary_points, live,
            self._emit, DeadReckoning(rig.imu, self._emit) if inertial and rig.imu is not None else None,
        )  # fmt: skip
        self.backwards: Backwards | None = None
        if self.config.backwards and not live:
            self.backwards = Backwards(rig, self._another_ladder, self.config.ladder.states.good_inliers)
        self._earlier: dict[int, SE3] = {}
        self.relocalizations = 0
        self.dropped = 0

    def run(self, recording: Recording, start_s: float = 0.0, end_s: float = math.inf) -> Iterator[Estimate]:
        """Estimates of all frames of a recording, as a robot would have had them at the time."""
        messages: Iterator[Message] = recording.messages(self.config.sensors, start_s, end_s)
        if self.live:
            messages = iter(Paced(messages, self._dropped))
        for message in messages:
            estimate = self.feed(message)
            if estimate is not None:
                yield estimate
        self.close()

    def feed(self, message: Message | LightFix) -> Estimate | None:
        """One message; an estimate for every frame. A light fix restricts where a lost camera is looked for."""
        if isinstance(message, LightFix):
            if message.T_world_body is not None:
                self.hint(message.t_ns, message.T_world_body, message.covariance)
            return None
        if isinstance(message, Imu):
            if self.ladder.reckoning is not None:
                self.ladder.reckoning.add(message)
            return None
        return self.step(message)

    def hint(self, t_ns: int, T_world_body: SE3, covariance: Array) -> None:
        """Where the body was by something else, a light fix or a tag: a lost camera is looked for there for 2 s.

        covariance : (6, 6), chart of SE3.perturbed
        """
        self.ladder.second_look.hint = (t_ns, Hint(T_world_body, self.config.hint_reach_m, covariance))

    def step(self, frame: Frame) -> Estimate:
        """One frame: see it, locate it."""
        clock = Stopwatch()
        seen = self.front_end.process(frame)
        tracked = self.ladder.locate(frame.t_ns, seen)
        self.relocalizations += self.ladder.status == "relocalized"
        track_ms = clock.ms()
        if self.backwards is not None:
            self._keep_earlier(self.backwards.add(tracked, seen))
        details = {
            "temporary": float(n_temporary(tracked)),
            "mono": float(self.ladder.states.state is State.carried),
            "track_ms": track_ms,
        }
        return Estimate(
            frame.t_ns, self.ladder.status, tracked.T_world_body, self._covariance(tracked), self.ladder.why,
            tracked.n_inliers, details,
        )  # fmt: skip

    def close(self) -> None:
        """Wait for what runs beside, and clear what is temporary."""
        if self.backwards is not None:
            self._keep_earlier(self.backwards.follow())
        self.ladder.close()

    @property
    def earlier(self) -> list[tuple[int, SE3]]:
        """Poses (t_ns, T_world_body) of frames that had none at the time, as what came later tells, by their stamps:
        those believed only after others had agreed, and those followed back from where the camera was found."""
        return sorted({**self._earlier, **dict(self.ladder.confirmed)}.items())

    def _keep_earlier(self, poses: list[tuple[int, SE3]]) -> None:
        self._earlier.update(poses)
        if poses:
            self._emit(poses[0][0], "followed_back", frames=len(poses), first_t_ns=poses[-1][0])

    def _another_ladder(self, rig: Rig) -> Ladder:
        """A ladder at its beginning in the same map, of which nobody is told."""
        return Ladder(
            rig, self.map, self.config.orb, self.config.ladder, self.config.seed, self.config.temporary_points,
            live=False, emit=lambda *_, **__: None, places=self.ladder.relocalizer.places,
        )  # fmt: skip

    def stats(self) -> dict[str, object]:
        """Counts for `metrics.json`."""
        return {
            "keyframes": len(self.map.alive_keyframes),
            "map_points": len(self.map.alive_points),
            "loops": len(self.map.loops),
            "relocalizations": self.relocalizations,
            "temporary_points": {
                "created": self.ladder.temporary.created + (self.backwards.created if self.backwards else 0),
                "left": self.ladder.temporary_left + (self.backwards.left if self.backwards else 0),
            },
            "dropped": self.dropped,
        }

    def _emit(self, t_ns: int, kind: str, **fields: object) -> None:
        if self.on_event is not None:
            self.on_event(t_ns, kind, **fields)

    def _dropped(self, t_ns: int) -> None:
        self.dropped += 1
        self._emit(t_ns, "dropped", why="the frames before it took too long")

    def _covariance(self, tracked: Tracked) -> Array:
        """Of the pose in the map: its own against the map there, what the map there carries, and drift without it."""
        if tracked.why_lost:
            return LOST_COVARIANCE
        known: Array = self.map.keyframes.covariance[tracked.reference]
        total = tracked.covariance + carried_covariance(self.map.pose(tracked.reference), known, tracked.T_world_body)
        if self.ladder.states.state is State.carried:
            states = self.ladder.states
            drift_m = DRIFT * DRIFT_FOCAL_PX / self._focal_px * states.carried_m
            total[3:, 3:] += (drift_m**2 + (GUESSED * states.guessed_m) ** 2) * np.eye(3)
        return total


def _enlarged(camera: Camera, map: Map, octave: float) -> float:
    """By how much to enlarge the images of a camera for its pyramid to begin where the map's does.

    A shorter lens shows the map's points smaller than they were mapped: below its finest octave, most of them.
    """
    wanted = map.rig.cameras[0].camera.focal_px / camera.focal_px
    factor = min(wanted, MOST_ENLARGED, math.sqrt(MOST_PIXELS / (camera.width * camera.height)))
    return factor if factor >= octave else 1.0


def _check(map: Map) -> None:
    if len(map.alive_keyframes) == 0 or len(map.alive_points) == 0:
        raise MapError("the map is empty: it has no keyframe with points; map the building first, with lodelight run")
    if not map.features.desc.any() or not map.points.desc[map.alive_points].any():
        raise MapError("the map has no descriptors, so nothing can be recognised in it; map again with lodelight run")
