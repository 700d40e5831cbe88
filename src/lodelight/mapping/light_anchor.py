"""Lights in the loop of SLAM: fixes come in, and out come the place of the map in the world, the pose by the lights at
the time of a frame, the gate's verdicts, and what ties keyframes to the world.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lodelight.anchors import Light
from lodelight.geometry.se3 import SE3
from lodelight.lights.alignment import Pair, agreement, align
from lodelight.lights.buffer import REACH_S, FixBuffer, LightPose
from lodelight.lights.sighted import assigned, centre_px
from lodelight.lights.watch import LightWatch
from lodelight.mapping.anchoring import Anchoring, AnchorSighting
from lodelight.mapping.keyframes import Candidate, Verdict
from lodelight.mapping.light_gate import GateConfig, LightGate, difference
from lodelight.mapping.map import Map
from lodelight.messages import LightFix, LightSighting
from lodelight.types import Array

NS = 1e-9
NODES = 64  # frames that are remembered, to know where the body was when a light was seen
NODE_GAP_S = 0.25
PAIRS, PAIR_M = 400, 0.05  # pairs kept; how far the body moves between two of them
ALIGN_PAIRS, ALIGN_M, ALIGN_SHARE = 10, 0.5, 0.6  # pairs, the ground they cover, and the share of them that must agree
FLOOR_RAD, FLOOR_M = math.radians(0.05), 0.003  # of a pose by the lights: what its covariance does not know of
WAIT_S = 0.15  # that a map waits for the lights before it begins: one image of theirs
NOT_YET = "the map's place in the world rests on less than ten fixes"


@dataclass(frozen=True)
class LightsConfig:
    """use : off, or tight: sightings of lights are part of every adjustment
    sigma_px : of a light's centre; near_s : between a keyframe and a sighting that becomes part of it
    drift : error of the tracked motion between the two, as a share of its length
    """

    use: str = "off"
    sigma_px: float = 0.5
    near_s: float = 0.12
    drift: float = 0.02

    def __post_init__(self) -> None:
        if self.use not in ("off", "tight"):
            raise ValueError(f"{self.use!r} is no use of lights; choose off or tight")


@dataclass(frozen=True, eq=False)
class _Node:
    """Where the body was, held to a keyframe, so that it moves with the map."""

    t_ns: int
    reference: int
    T_reference_body: SE3


@dataclass(frozen=True, eq=False)
class _Met:
    """A fix, and where the body was in the map at its time."""

    fix: LightFix
    node: _Node


@dataclass(frozen=True, eq=False)
class _Seen:
    """A sighting whose light is known, and where the body was in the map at its time."""

    light: str
    node: _Node
    px: Array
    sigma_px: float


class LightAnchor:
    """One for a run. emit : told of what was decided, as emit(t_ns, kind, **fields)."""

    def __init__(
        self, map: Map, gate: GateConfig, lights: LightsConfig, surveyed: tuple[Light, ...], emit: Callable[..., None]
    ) -> None:
        self.map = map
        self.config = lights
        self.gate = LightGate(gate, map.rig.cameras[0].T_body_cam)
        self.emit = emit
        self.spec = map.rig.lights
        self._lights = {light.id: light for light in surveyed}
        map.anchoring = Anchoring(self.spec, self._lights)
        self._watch = LightWatch(self._lights)
        self._buffer = FixBuffer()
        self._waiting: deque[LightFix] = deque(maxlen=NODES)
        self._nodes: deque[_Node] = deque(maxlen=NODES)
        self._met: list[_Met] = []
        self._recent: deque[_Seen] = deque(maxlen=NODES)
        self._keyframe: tuple[int, int] | None = None  # the last one, and its stamp
        self._why_none = "no light seen yet"
        self._verdict: tuple[int, Verdict, LightPose] | None = None
        self._pending: SE3 | None = None
        self._asked_ns: int | None = None
        self._doubted_ns = -1
        self._no_fit = ""
        self.placed = False  # the map has a place in the world, if only by one fix
        self.aligned = False

    # -- what comes in ------------------------------------------------------------------------------------------

    def feed(self, fix: LightFix) -> None:
        """A fix, or the sightings alone of an image that gave none."""
        bad = [name for name in fix.lights if name in self._watch.misplaced]
        if fix.T_world_body is None:
            self._why_none = fix.why
        elif bad:
            self._why_none = f"light {bad[0]} is not where it was surveyed"
        else:
            self._buffer.add(fix)
        self._waiting.append(fix)

    def tracked(self, t_ns: int, reference: int, T_reference_body: SE3) -> None:
        """A frame was localized: what the lights said since the last one now has its place in the map."""
        self._nodes.append(_Node(t_ns, reference, T_reference_body))
        while self._waiting and self._waiting[0].t_ns <= t_ns:
            fix = self._waiting.popleft()
            node = self._node_at(fix.t_ns)
            usable = not any(name in self._watch.misplaced for name in fix.lights)
            if node is not None and fix.T_world_body is not None and usable:
                self._meet(_Met(fix, node))
            for sighting in fix.seen if self.aligned else ():
                self._sight(sighting)

    def take_move(self) -> SE3 | None:
        """T_world_map by which the map is to be moved now, once."""
        move, self._pending = self._pending, None
        return move

    # -- what is asked ------------------------------------------------------------------------------------------

    def pose_at(self, t_ns: int) -> tuple[LightPose | None, str]:
        """The body by the lights at a frame's stamp, or why not. An older fix is carried on by the tracked motion."""
        if not self.aligned:
            return None, self._no_fit or NOT_YET
        here = self._buffer.at(t_ns)
        if here is None:
            fix, now = self._buffer.before(t_ns, self.gate.config.stale_s), self._node_at(t_ns)
            then = self._node_at(fix.t_ns) if fix is not None else None
            if fix is None or fix.T_world_body is None or then is None or now is None:
                return None, f"no pose by the lights within {self.gate.config.stale_s:g} s: {self._why_none}"
            T = fix.T_world_body @ self._pose(then).inverse() @ self._pose(now)
            here = LightPose(t_ns, T, fix.covariance, fix.lights, fix.rms_px)
        if any(name in self._watch.misplaced for name in here.lights):
            return None, "one of its lights is not where it was surveyed"
        return here, ""

    def start(self, t_ns: int) -> tuple[SE3, str]:
        """T_world_body to begin a map with, and why it should not begin yet; the identity where no light is in view."""
        self._asked_ns = t_ns if self._asked_ns is None else self._asked_ns
        here, fix = self._buffer.at(t_ns), self._buffer.before(t_ns, REACH_S)
        T = here.T_world_body if here is not None else fix.T_world_body if fix is not None else None
        if T is not None:
            self.placed = True
            self.emit(t_ns, "world", why="the map begins where the lights say", pairs=1, moved_m=0.0, turned_deg=0.0)
            return T, ""
        waited_s = (t_ns - self._asked_ns) * NS
        return SE3.identity(), "waits for a first pose by the lights" if waited_s < WAIT_S else ""

    def doubt(self, t_ns: int, T_world_body: SE3 | None) -> SE3 | None:
        """Where to look for a frame that was lost, or tracked farther from the lights' pose than the gate allows."""
        light = self._buffer.at(t_ns) if self.aligned else None
        config = self.gate.config
        if light is None or t_ns < self.gate.trusted_from_ns or light.rms_px > config.max_rms_px:
            return None
        if any(name in self._watch.misplaced for name in light.lights):
            return None
        if T_world_body is None:
            return light.T_world_body
        d = difference(T_world_body, np.zeros((6, 6)), light, self.map.rig.cameras[0].T_body_cam)
        if d.angle_deg <= config.max_deg and d.centre_m <= config.max_m:
            return None
        if t_ns != self._doubted_ns:  # not what was found there, when that is shown as well
            self._doubted_ns = t_ns
            self.emit(t_ns, "light_doubt", angle_deg=d.angle_deg, centre_m=d.centre_m)
        return light.T_world_body

    def ask(self, candidate: Candidate) -> Verdict:
        """The gate among the keyframe conditions."""
        light, why_not = self.pose_at(candidate.t_ns)
        verdict = self.gate.ask(candidate, light, why_not)
        self._verdict = None if light is None else (candidate.t_ns, verdict, light)
        self.emit(candidate.t_ns, "gate", verdict=verdict.verdict, why=verdict.why, weight=verdict.weight)
        if self.gate.blamed:
            self.emit(candidate.t_ns, "gate_blame", blamed=self.gate.blamed, why=verdict.why)
        return verdict

    def inserted(self, keyframe: int, t_ns: int) -> None:
        """A keyframe entered the map: tie it to the world by what the lights say of its time."""
        self._keyframe = (keyframe, t_ns)
        if self._verdict is not None and self._verdict[0] == t_ns and self.gate.config.anchor:
            _, verdict, light = self._verdict
            if verdict.verdict == "PASS":
                floor = np.diag([FLOOR_RAD**2] * 3 + [FLOOR_M**2] * 3)
                information: Array = verdict.weight * np.asarray(np.linalg.inv(light.covariance + floor), np.float64)
                self.map.anchoring.add_pose(keyframe, light.T_world_body, information)
        for seen in self._recent:
            self._tie(seen)

    # -- parts --------------------------------------------------------------------------------------------------

    def _pose(self, node: _Node) -> SE3:
        return self.map.pose(node.reference) @ node.T_reference_body

    def _node_at(self, t_ns: int) -> _Node | None:
        """Between two localized frames."""
        nodes = self._nodes
        for i in range(len(nodes) - 1, -1, -1):
            if nodes[i].t_ns == t_ns:
                return nodes[i]
            if nodes[i].t_ns < t_ns:
                if i + 1 == len(nodes) or (nodes[i + 1].t_ns - nodes[i].t_ns) * NS > NODE_GAP_S:
                    return None
                a, b = nodes[i], nodes[i + 1]
                T = self._pose(a).interpolate(self._pose(b), (t_ns - a.t_ns) / (b.t_ns - a.t_ns))
                return _Node(t_ns, b.reference, self.map.pose(b.reference).inverse() @ T)
        return None

    def _meet(self, met: _Met) -> None:
        """Keep a pair, and see whether the map lies where the pairs say."""
        if self._met and np.linalg.norm(self._pose(met.node).t - self._pose(self._met[-1].node).t) < PAIR_M:
            return
        self._met.append(met)
        if len(self._met) > PAIRS:
            del self._met[1::2]  # the whole way, half as dense
        if not self.placed:
            self._place(
                self._pairs()[0].T_world_body @ self._pairs()[0].T_map_body.inverse(), "seeded by the first fix", 1
            )
        elif not self.aligned or len(self._met) % ALIGN_PAIRS == 0:
            self._review()

    def _pairs(self) -> list[Pair]:
        return [Pair(m.fix.T_world_body, self._pose(m.node)) for m in self._met if m.fix.T_world_body is not None]

    def _review(self) -> None:
        """Align with what most pairs say: once for good, and again only where they contradict what was believed."""
        pairs = self._pairs()
        ground_m = float(np.linalg.norm(np.ptp([pair.T_map_body.t for pair in pairs], axis=0)))
        if len(pairs) < ALIGN_PAIRS or ground_m < ALIGN_M:
            return
        now = int(np.count_nonzero(agreement(pairs, SE3.identity())))
        if self.aligned and now >= 0.5 * len(pairs):
            return
        found = align(pairs)
        if found.count < max(ALIGN_PAIRS, ALIGN_SHARE * len(pairs)) or (self.aligned and found.count < 2 * now):
            if not self.aligned and len(pairs) >= 2 * ALIGN_PAIRS:
                self._no_fit = f"only {found.count} of {len(pairs)} poses by the lights agree on a place of the map"
            return
        again, self.aligned, self._no_fit = self.aligned, True, ""
        if again:
            self.map.anchoring = Anchoring(self.spec, self._lights)
        self._place(found.T_world_map, f"{found.count} of {len(pairs)} pairs agree", len(pairs))

    def _place(self, T_world_map: SE3, why: str, pairs: int) -> None:
        self.placed = True
        self._pending = T_world_map
        self._watch.forget()
        self._recent.clear()
        moved = {"moved_m": float(np.linalg.norm(T_world_map.t)), "turned_deg": math.degrees(T_world_map.angle)}
        self.emit(self._met[-1].fix.t_ns, "world", why=why, pairs=pairs, **moved)

    def _sight(self, sighting: LightSighting) -> None:
        """Name a sighting's light by where the body is, watch whether it hangs there, and tie a keyframe by it."""
        node = self._node_at(sighting.t_ns)
        if node is None or self.spec is None or self._pending is not None:
            return
        T_world_cam = self._pose(node) @ self.spec.T_body_cam
        light = assigned(sighting, T_world_cam, self.spec.camera, self._lights)
        if light is None:
            return
        px = centre_px(sighting.centre_px, T_world_cam, self.spec.camera, light)
        ray, _ = self.spec.camera.unproject(px[None])
        misplaced = self._watch.see(sighting.t_ns, light.id, T_world_cam, ray[0])
        if misplaced is not None:
            self.emit(sighting.t_ns, "light_misplaced", light=light.id, off_m=misplaced.off_m, why=misplaced.why)
            self.map.anchoring.forget_light(light.id)
        if self.config.use == "tight" and light.id not in self._watch.misplaced:
            seen = _Seen(light.id, node, px, max(sighting.sigma_px, self.config.sigma_px))
            self._recent.append(seen)
            self._tie(seen)

    def _tie(self, seen: _Seen) -> None:
        """Let the last keyframe have a sighting that is near enough in time."""
        if self._keyframe is None or self.config.use != "tight" or self.spec is None or not self.aligned:
            return
        keyframe, t_ns = self._keyframe
        apart_s = abs(seen.node.t_ns - t_ns) * NS
        if apart_s > self.config.near_s or not self.map.keyframes.alive[keyframe]:
            return
        T_keyframe_body = self.map.pose(keyframe).inverse() @ self._pose(seen.node)
        far_m = float(np.linalg.norm(self._lights[seen.light].xyz - self._pose(seen.node).t))
        drift_px = self.spec.camera.focal_px * self.config.drift * float(np.linalg.norm(T_keyframe_body.t)) / far_m
        sigma_px = math.hypot(seen.sigma_px, drift_px)
        sighting = AnchorSighting(T_keyframe_body @ self.spec.T_body_cam, seen.px, sigma_px, apart_s)
        self.map.anchoring.add_sighting(keyframe, seen.light, sighting)
