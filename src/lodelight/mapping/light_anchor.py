"""Lights in the loop of SLAM: fixes come in, and out come the place of the map in the world, the pose by the lights at
the time of a frame, the gate's verdicts, and what ties keyframes to the world.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from lodelight.anchors import Light
from lodelight.geometry.se3 import SE3
from lodelight.lights.buffer import REACH_S, FixBuffer, LightPose
from lodelight.lights.clock import ClockCheck
from lodelight.lights.continuity import Continuity
from lodelight.mapping.anchoring import Anchoring
from lodelight.mapping.body_path import BodyPath, Node
from lodelight.mapping.keyframes import Candidate, Verdict
from lodelight.mapping.light_gate import Difference, GateConfig, LightGate, difference
from lodelight.mapping.light_placement import CORRELATED_S, Move, Placement
from lodelight.mapping.light_ties import LightsConfig, LightTies
from lodelight.mapping.map import Map
from lodelight.messages import Doubt, LightFix
from lodelight.types import Array

NS = 1e-9
WAITING = 64  # fixes that wait for the frame behind them, or for the map to be laid down
CLOCK_EVERY = 10  # fixes
FLOOR_RAD, FLOOR_M = math.radians(0.05), 0.003  # of a pose by the lights: what its covariance does not know of
HELD_S = 0.2
MOTION_SHARE = 0.5  # of the gate's thresholds: fixes' motion within a second is better known than their place
NOT_YET = "the map's place in the world rests on less than ten fixes, and on less than three lights passed"


class LightAnchor:
    """One for a run. emit : told of what was decided, as emit(t_ns, kind, **fields)

    upright : the map is level by an IMU, which lights do not tilt
    """

    def __init__(
        self, map: Map, gate: GateConfig, lights: LightsConfig, surveyed: tuple[Light, ...], emit: Callable[..., None],
        upright: bool = False,
    ) -> None:  # fmt: skip
        self.map = map
        self.config = lights
        self.gate = LightGate(gate, map.rig.cameras[0].T_body_cam)
        self.emit = emit
        self.spec = map.rig.lights
        self._lights = {light.id: light for light in surveyed}
        map.anchoring = Anchoring(self.spec, self._lights)
        self._buffer = FixBuffer()
        self._waiting: deque[LightFix] = deque(maxlen=WAITING)
        self._unread: deque[LightFix] = deque(maxlen=WAITING)
        self._path = BodyPath(map)
        self._placement = Placement(self._path, self._lights, self.spec, upright)
        self._ties = LightTies(map, self._path, lights, self._lights, emit)
        self._clock = ClockCheck()
        self._continuity = Continuity()
        self._fixes = 0
        self._off_clock = ""
        self._why_none = "no light seen yet"
        self._verdict: tuple[int, Verdict, LightPose] | None = None
        self._pending: SE3 | None = None
        self._tied_ns: int | None = None  # the last keyframe that a pose by the lights holds
        self._doubted_ns = self._held_ns = -(10**18)

    @property
    def aligned(self) -> bool:
        """Whether the map has been laid down in the world for good."""
        return self._placement.aligned

    # -- what comes in ------------------------------------------------------------------------------------------

    def feed(self, fix: LightFix) -> None:
        """A fix, or the sightings alone of an image that gave none."""
        late_ns = round(self.config.late_s * 1e9)
        if late_ns:
            seen = tuple(replace(sighting, t_ns=sighting.t_ns - late_ns) for sighting in fix.seen)
            fix = replace(fix, t_ns=fix.t_ns - late_ns, seen=seen)
        bad = [name for name in fix.lights if name in self._ties.watch.misplaced]
        if fix.T_world_body is None:
            self._why_none = fix.why
        elif bad:
            self._why_none = f"light {bad[0]} is not where it was surveyed"
        else:
            self._why_none = ""
            self._buffer.add(fix)
            self._continuity.fixed(fix.t_ns, fix.T_world_body)
            self._clock.fixed(fix.t_ns, fix.T_world_body.R, fix.covariance)
            self._fixes += 1
            if self._fixes % CLOCK_EVERY == 0:
                self._check_clock(fix.t_ns)
        self._waiting.append(fix)

    def tracked(self, t_ns: int, reference: int, T_reference_body: SE3) -> None:
        """A frame was localized: what the lights said since the last one now has its place in the map."""
        here = Node(t_ns, reference, T_reference_body)
        self._path.add(here)
        self._clock.tracked(t_ns, self._path.pose(here).R)
        while self._waiting and self._waiting[0].t_ns <= t_ns:
            fix = self._waiting.popleft()
            node = self._path.at(fix.t_ns)
            usable = not any(name in self._ties.watch.misplaced for name in fix.lights)
            if node is not None and fix.T_world_body is not None and usable and not self._held_at(fix.t_ns):
                self._meet(fix, fix.T_world_body, node)
            move = self._placement.see(fix, node) if not self._off_clock and not self._held_at(fix.t_ns) else None
            if move is not None:
                self._place(fix.t_ns, move)
            self._unread.append(fix)
        if self.aligned and not self._off_clock and self._pending is None:
            while self._unread:  # also those from before the map was laid down
                for sighting in self._unread.popleft().seen:
                    self._ties.see(sighting)

    def take_move(self) -> SE3 | None:
        """T_world_map by which the map is to be moved now, once."""
        move, self._pending = self._pending, None
        return move

    def settled(self) -> SE3 | None:
        """T_world_map by which the finished map is to be moved: every light that was passed has its say."""
        if self.config.use == "tight" or self._off_clock:
            return None  # they had it in every adjustment, or must not have it
        move = self._placement.settle(self._ties.watch.misplaced)
        if move is not None and self._path.last_ns is not None:
            self._say(self._path.last_ns, move)
        return None if move is None else move.T_world_map

    # -- what is asked ------------------------------------------------------------------------------------------

    def pose_at(self, t_ns: int) -> tuple[LightPose | None, str]:
        """The body by the lights at a frame's stamp, or why not. An older fix is carried on by the tracked motion."""
        if self._off_clock:
            return None, self._off_clock
        if not self.aligned:
            return None, self._placement.no_fit or _because(NOT_YET, self._why_none)
        here = self._buffer.at(t_ns)
        if here is None:
            fix, now = self._buffer.before(t_ns, self.gate.config.stale_s), self._path.at(t_ns)
            then = self._path.at(fix.t_ns) if fix is not None else None
            if fix is None or fix.T_world_body is None or then is None or now is None:
                return None, _because(f"no pose by the lights within {self.gate.config.stale_s:g} s", self._why_none)
            T = fix.T_world_body @ self._path.pose(then).inverse() @ self._path.pose(now)
            here = LightPose(t_ns, T, fix.covariance, fix.lights, fix.rms_px)
        if any(name in self._ties.watch.misplaced for name in here.lights):
            return None, "one of its lights is not where it was surveyed"
        return here, ""

    def start(self, t_ns: int) -> SE3:
        """T_world_body to begin a map with: where the lights say, or the identity until they do."""
        here, fix = self._buffer.at(t_ns), self._buffer.before(t_ns, REACH_S)
        T = here.T_world_body if here is not None else fix.T_world_body if fix is not None else None
        if T is None:
            return SE3.identity()
        self._placement.placed = True
        self.emit(t_ns, "world", why="the map begins where the lights say", pairs=1, moved_m=0.0, turned_deg=0.0)
        return T

    def doubt(self, t_ns: int, T_world_body: SE3 | None) -> Doubt | None:
        """Where to look for a frame that was lost, or tracked farther from the lights' pose than the gate allows."""
        light = self._buffer.at(t_ns) if self.aligned and not self._off_clock else None
        config = self.gate.config
        if light is None or t_ns < self.gate.trusted_from_ns or light.rms_px > config.max_rms_px:
            return None
        if any(name in self._ties.watch.misplaced for name in light.lights):
            return None
        expected = self._continuity.expected(t_ns, light.T_world_body)
        if expected is not None and T_world_body is None:
            self._held_ns = t_ns
        said = Doubt(expected or light.T_world_body, light.covariance, expected is not None)
        if T_world_body is None:
            return said
        d = self._difference(t_ns, T_world_body, light)
        if expected is not None:
            off = expected.inverse() @ T_world_body
            content = config.near(math.degrees(off.angle), float(np.linalg.norm(off.t)), MOTION_SHARE)
        else:
            content = config.near(d.angle_deg, d.centre_m) or d.chi2 <= config.chi2
        if content:
            return None
        if expected is not None:
            self._held_ns = t_ns
        if t_ns != self._doubted_ns:  # not what was found there, when that is shown as well
            self._doubted_ns = t_ns
            self.emit(t_ns, "light_doubt", angle_deg=d.angle_deg, centre_m=d.centre_m)
        return said

    def ask(self, candidate: Candidate) -> Verdict:
        """The gate among the keyframe conditions."""
        light, why_not = self.pose_at(candidate.t_ns)
        laid = self._placement.covariance(candidate.t_ns, candidate.T_world_body)
        verdict = self.gate.ask(replace(candidate, covariance=candidate.covariance + laid), light, why_not)
        self._verdict = None if light is None else (candidate.t_ns, verdict, light)
        self.emit(candidate.t_ns, "gate", verdict=verdict.verdict, why=verdict.why, weight=verdict.weight)
        if self.gate.blamed:
            self.emit(candidate.t_ns, "gate_blame", blamed=self.gate.blamed, why=verdict.why)
        return verdict

    def inserted(self, keyframe: int, t_ns: int) -> None:
        """A keyframe entered the map: tie it to the world by what the lights say of its time."""
        if self._verdict is not None and self._verdict[0] == t_ns and self.gate.config.anchor:
            _, verdict, light = self._verdict
            if verdict.verdict == "PASS":
                floor = np.diag([FLOOR_RAD**2] * 3 + [FLOOR_M**2] * 3)
                since_s = CORRELATED_S if self._tied_ns is None else (t_ns - self._tied_ns) * NS
                weight = verdict.weight * min(1.0, since_s / CORRELATED_S)
                information: Array = weight * np.asarray(np.linalg.inv(light.covariance + floor), np.float64)
                self._tied_ns = t_ns
                self.map.anchoring.add_pose(keyframe, light.T_world_body, information)
        self._ties.inserted(keyframe, t_ns)

    # -- parts --------------------------------------------------------------------------------------------------

    def _held_at(self, t_ns: int) -> bool:
        """Whether frames about a time may have their pose from the lights: they cannot say whether these are right."""
        return abs(t_ns - self._held_ns) * NS < HELD_S

    def _meet(self, fix: LightFix, T_world_body: SE3, node: Node) -> None:
        move = self._placement.meet(fix, T_world_body, node)
        if move is not None:
            self._place(fix.t_ns, move)
        elif self.aligned and self._pending is None:
            light = LightPose(fix.t_ns, T_world_body, fix.covariance, fix.lights, fix.rms_px)
            here = self._path.pose(node)
            d = self._difference(fix.t_ns, here, light)
            if self.gate.config.near(d.angle_deg, d.centre_m):
                self._continuity.agreed(fix.t_ns, T_world_body, here)

    def _difference(self, t_ns: int, T_world_body: SE3, light: LightPose) -> Difference:
        laid = self._placement.covariance(t_ns, T_world_body)
        return difference(T_world_body, laid, light, self.map.rig.cameras[0].T_body_cam)

    def _place(self, t_ns: int, move: Move) -> None:
        if move.again:
            self.map.anchoring = Anchoring(self.spec, self._lights)
        self._pending = move.T_world_map
        self._ties.watch.forget()
        self._continuity.forget()
        self._ties.forget()
        self._say(t_ns, move)

    def _say(self, t_ns: int, move: Move) -> None:
        moved = {
            "moved_m": float(np.linalg.norm(move.T_world_map.t)),
            "turned_deg": math.degrees(move.T_world_map.angle),
        }
        self.emit(t_ns, "world", why=move.why, pairs=move.pairs, **moved)

    def _check_clock(self, t_ns: int) -> None:
        """Lights of another clock hold nothing any more, from when that shows on."""
        offset = self._clock.offset()
        if offset is not None and not self._off_clock:
            self.emit(t_ns, "light_clock", late_s=offset.late_s, sigma_s=offset.sigma_s, why=offset.why)
            self.map.anchoring = Anchoring(self.spec, self._lights)
            self._ties.forget()
        self._off_clock = offset.why if offset is not None else ""


def _because(what: str, why: str) -> str:
    return f"{what}: {why}" if why else what
