"""A walk along the walls of a hall with tags on them: simulated tracks, samples and sightings, no images."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass, field

import numpy as np

from lodelight.anchors import tag_corners
from lodelight.geometry.se3 import SE3
from lodelight.messages import Frame, Imu, TagSighting
from lodelight.odometry.inertial import InertialOdometry, OdometryStep
from lodelight.rig import Rig
from lodelight.sim.gaits import GAITS, generate
from lodelight.sim.motion import Motion
from lodelight.tags.gate import KnownTag
from lodelight.tags.pose import angle_between, faces, tag_poses
from odometry_scenes import START_NS, Points, messages, rig

HALL = np.array([15.0, 10.0, 3.0])  # half of its sides, m
ROUTE = np.array([[-12.0, -7.0], [12.0, -7.0], [12.0, 7.0], [-12.0, 7.0]])
SIZE_M, SIGMA_PX, FAR_M = 0.3, 0.3, 5.0
SURVEY_M = 0.005


@dataclass(eq=False)
class TaggedWalk:
    """count : tags, evenly along the walls, facing into the hall; hung : where each hangs, by id"""

    seed: int
    duration_s: float
    cameras: int = 2
    count: int = 12
    rate_hz: float = 10.0
    rig: Rig = field(init=False)
    motion: Motion = field(init=False)
    hung: dict[str, SE3] = field(init=False)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)
        self.rig = rig(self.cameras)
        self.motion = generate(GAITS["walk"], ROUTE, self.duration_s, START_NS, self.rng, 1.0)
        self.hung = dict(wall_tags(self.count))

    def known(self) -> dict[str, KnownTag]:
        """The survey, exact, with the covariance of one that is good to 5 mm."""
        covariance = np.diag([(np.sqrt(2.0) * SURVEY_M / SIZE_M) ** 2] * 3 + [SURVEY_M**2] * 3)
        return {
            f"tag36h11 {id}": KnownTag("tag36h11", id, SIZE_M, T, covariance, surveyed=True)
            for id, T in self.hung.items()
        }

    def truth(self, t_ns: int) -> SE3:
        return self.motion.at_ns(np.array([t_ns])).poses()[0]

    def sight(self, t_ns: int, id: str, T_world_tag: SE3) -> TagSighting | None:
        """What camera 0 sees of a tag that hangs there; None where it cannot be read."""
        spec = self.rig.cameras[0]
        T_cam_tag = (self.truth(t_ns) @ spec.T_body_cam).inverse() @ T_world_tag
        xyz = T_cam_tag @ tag_corners(SIZE_M)
        if np.linalg.norm(T_cam_tag.t) > FAR_M or not faces(T_cam_tag) or xyz[:, 2].min() < 0.3:
            return None
        px, seen = spec.camera.project(xyz)
        px = px + SIGMA_PX * self.rng.standard_normal((4, 2))
        found = TagSighting(t_ns, "tag36h11", id, px, np.full(4, 0.15), size_m=SIZE_M)
        return found if seen.all() and found.side_px >= 14.0 else None

    def look(self, frame: Frame, hidden: Callable[[str], bool] = lambda id: False) -> list[TagSighting]:
        found = [self.sight(frame.t_ns, id, T) for id, T in self.hung.items() if not hidden(id)]
        return [s for s in found if s is not None]

    def odometry(self, on_event: Callable[..., None] | None = None) -> InertialOdometry:
        sensors = "stereo" if self.cameras > 1 else "mono"
        odometry = InertialOdometry(self.rig, sensors, on_event=on_event, seed=self.seed)
        odometry.tracker = Points(self.motion, self.rig, self.seed, 0.06, room=tuple(HALL))  # type: ignore[assignment]
        return odometry

    def messages(self) -> Iterator[Imu | Frame]:
        assert self.rig.imu is not None
        return messages(self.motion, self.rig.imu, self.seed, self.rate_hz)

    def steps(self, odometry: InertialOdometry) -> Iterator[OdometryStep]:
        for message in self.messages():
            if isinstance(message, Frame):
                step = odometry.feed_frame(message, self.look(message))
            else:
                step = odometry.feed_imu(message)
            if step is not None:
                yield step

    def error(self, step: OdometryStep) -> np.ndarray:
        """(6,) with truth = estimate perturbed by it; both in the hall's frame."""
        estimate, truth = step.state.T_world_body, self.truth(step.frame.t_ns)
        turn = SE3(estimate.R.T @ truth.R, np.zeros(3)).log()[:3]
        return np.concatenate([turn, truth.t - estimate.t])


def wall_tags(count: int) -> Iterator[tuple[str, SE3]]:
    """Upright, 1.6 m high, z into the wall as printed tags have it."""
    a, b = HALL[0], HALL[1]
    corners = np.array([[-a, -b], [a, -b], [a, b], [-a, b], [-a, -b]])
    length = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    for i, along in enumerate(length.sum() * (np.arange(count) + 0.35) / max(count, 1)):
        wall = int(np.searchsorted(np.cumsum(length), along))
        x, y = (corners[wall + 1] - corners[wall]) / length[wall]
        at = corners[wall] + (along - length[:wall].sum()) * np.array([x, y])
        down, into = np.array([0.0, 0.0, -1.0]), np.array([y, -x, 0.0])
        yield str(i), SE3(np.column_stack([np.cross(down, into), down, into]), np.array([*at, 1.6]))


SIGHTS = 10  # of a wrong tag, at most
WRONG = ("moved", "duplicated", "misread", "flipped")


def apart(id: str) -> bool:
    """Every other tag is kept for the trials: a wrong one is wrong from its first sight on."""
    return int(id) % 2 == 1


def wrongly_hung(walk: TaggedWalk, t_ns: int, kind: str, rng: np.random.Generator) -> tuple[str, SE3] | None:
    """An id and where the tag that is read so really hangs, in view at t_ns; None where none of the kind is in view.

    right : where it should; moved : a metre from its survey; duplicated : another print somewhere ahead
    misread : another tag, taken for it
    flipped : turned into the other of the two poses that its corners allow
    """
    in_view = [id for id, T in walk.hung.items() if walk.sight(t_ns, id, T) is not None]
    away = [id for id in walk.hung if id not in in_view]
    in_view = [id for id in in_view if apart(id)]
    if kind == "duplicated":
        T_world_cam = walk.truth(t_ns) @ walk.rig.cameras[0].T_body_cam
        ahead = rng.uniform([-0.5, -0.3, 1.5], [0.5, 0.3, 4.0])
        turn = SE3.exp(np.array([0.0, rng.uniform(-0.9, 0.9), 0.0, 0.0, 0.0, 0.0])).R
        return str(rng.choice(away)), T_world_cam @ SE3(turn, ahead)
    if not in_view:
        return None
    id = str(rng.choice(in_view))
    T = walk.hung[id]
    if kind == "misread":
        return str(rng.choice(away)), T
    if kind == "right":
        return id, T
    if kind == "moved":
        ways = rng.standard_normal((16, 3))
        moved = [SE3(T.R, T.t + way / np.linalg.norm(way)) for way in ways]
        return next(((id, T) for T in moved if walk.sight(t_ns, id, T) is not None), None)
    s = walk.sight(t_ns, id, T)
    assert s is not None
    T_world_cam = walk.truth(t_ns) @ walk.rig.cameras[0].T_body_cam
    poses = [T_world_cam @ pose.T_cam_tag for pose in tag_poses(s, SIZE_M, walk.rig.cameras[0].camera)]
    other = max(poses, key=lambda pose: angle_between(pose, T), default=T)
    return (id, SE3(other.R, T.t)) if angle_between(other, T) > np.radians(15.0) else None


@dataclass(frozen=True)
class Trial:
    """kind; sights : of the wrong tag; used : the first of them in the window's solution, named : the one at which it
    was named; 0 = none
    lost : the window ended in the trial
    """

    kind: str
    sights: int
    used: int
    named: int
    lost: bool = False


def trials(walk: TaggedWalk, kinds: Sequence[str], every: int, rng: np.random.Generator) -> Iterator[Trial]:
    """From every so many frames of a walk among surveyed tags on: three frames with a wrong one, on a copy; or up to
    SIGHTS, as long as it has neither been named nor had a say."""
    odometry = walk.odometry()
    odometry.tie(walk.known())
    held = list(walk.messages())
    frames = 0
    for i, message in enumerate(held):
        if not isinstance(message, Frame):
            odometry.feed_imu(message)
            continue
        frames += 1
        if frames % every == 0 and odometry.window is not None and odometry._surveyed.tied:
            for kind in kinds:
                trial = _trial(walk, odometry, held[i : i + (SIGHTS + 1) * 200 // int(walk.rate_hz)], kind, rng)
                if trial is not None:
                    yield trial
        odometry.feed_frame(message, walk.look(message, apart))


def _trial(
    walk: TaggedWalk, odometry: InertialOdometry, ahead: Sequence[Imu | Frame], kind: str, rng: np.random.Generator
) -> Trial | None:
    wrong = wrongly_hung(walk, ahead[0].t_ns, kind, rng)
    if wrong is None:
        return None
    id, T_world_tag = wrong
    name, named, seen, used = f"tag36h11 {id}", 0, 0, 0
    copied = deepcopy(odometry)
    told: list[str] = []
    copied.emit = lambda t_ns, kind, **fields: told.append(str(fields.get("tag", "")))
    copied._contradicted.pop(name, None)
    copied._probation.tried.pop(name, None)
    for message in ahead:
        if not isinstance(message, Frame):
            copied.feed_imu(message)
            continue
        true = [s for s in walk.look(message, apart) if s.id != id]
        sighting = walk.sight(message.t_ns, id, T_world_tag)
        if sighting is None or seen == SIGHTS or (seen >= 3 and (named or used)):
            break
        copied.feed_frame(message, [*true, sighting])
        copied.flush()
        seen += 1
        if copied.window is None:
            return Trial(kind, seen, used, named, lost=True)
        used = used or seen * any(v.view.id == name and v.use for v in copied.window.frames[-1].tags)
        named = named or (seen if name in told else 0)
    return Trial(kind, seen, used, named) if seen >= 3 else None
