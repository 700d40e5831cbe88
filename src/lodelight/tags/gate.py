"""Which sightings of tags may be believed: every one is held against where its tag is known to hang.

A tag is known from `anchors.toml`, from its own payload, or because it was mapped. From the predicted pose and both
covariances follows where its corners should be seen; a chi-square test says whether they are. A tag that was moved,
hangs twice, or was misread fails it, and after a few frames is named. Two different tags that fail in the same way say
that not they are wrong but the prediction.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

import numpy as np

from lodelight.anchors import Tag, tag_corners
from lodelight.geometry.dense import spd_inverse
from lodelight.geometry.se3 import SE3
from lodelight.geometry.so3 import skew
from lodelight.messages import TagSighting
from lodelight.rig import CameraSpec
from lodelight.tags.corners import corner_jacobians
from lodelight.tags.pose import TagPose, angle_between, by_prediction, tag_poses
from lodelight.types import Array

Kind: TypeAlias = Literal["agrees", "vague", "corrects", "new", "contradicts", "unsized"]
EventSink = Callable[..., None]  # called as sink(t_ns, kind, **fields)


@dataclass(frozen=True)
class GateConfig:
    """chi2 : of the eight coordinates of a tag's corners, above which it is not where it should be (99.9 %)
    apart2 : of the place where it is seen against the known one, likewise; corners of a tag that should be right
        before the lens are expected anywhere
    model_px : error of the lens model and of a printed sheet, added to every corner's sigma
    vague_m : a camera whose position is less certain cannot tell that a tag was moved
    name_after : frames after which a tag that contradicts is named; forgive_after : frames in a row in which it must
        then agree before it is believed again
    correct_s : two tags that contradict in the same way within so much time correct the pose
    size_ratio : the payload's size and the survey's may differ by this factor
    claim_m, claim_deg : so may the place the payload claims and the survey's
    """

    chi2: float = 26.12
    apart2: float = 16.27
    model_px: float = 0.3
    vague_m: float = 0.25
    name_after: int = 2
    forgive_after: int = 5
    correct_s: float = 20.0
    size_ratio: float = 1.05
    claim_m: float = 0.1
    claim_deg: float = 10.0


@dataclass(frozen=True, eq=False)
class KnownTag:
    """What is believed of a tag: covariance (6, 6) of T_world_tag in the chart of SE3.perturbed.

    T_world_tag None : its size is known, its place is not. surveyed : from a survey, not from this map
    """

    family: str
    id: str
    size_m: float
    T_world_tag: SE3 | None = None
    covariance: Array = field(default_factory=lambda: np.zeros((6, 6)))
    surveyed: bool = False

    @staticmethod
    def of(tag: Tag) -> KnownTag:
        return KnownTag(
            tag.family, tag.id, tag.size_m, tag.T_world_tag, survey_covariance(tag), tag.T_world_tag is not None
        )  # fmt: skip


def survey_covariance(tag: Tag) -> Array:
    """(6, 6) of a surveyed tag: sigma_m along each axis, and turned by as much at the ends of its side."""
    sigma_rad = math.sqrt(2.0) * tag.sigma_m / tag.size_m
    return np.diag([min(sigma_rad, math.radians(3.0)) ** 2] * 3 + [tag.sigma_m**2] * 3)


@dataclass(frozen=True, eq=False)
class Verdict:
    """agrees : the tag is where it should be. vague : so it is, but the prediction is too uncertain to tell
    corrects : it is not, and another tag says the same of the camera's pose: believe the tags
    new : of known size, its place is not known. contradicts : not to be used. unsized : of unknown size, of no use

    chi2 of the corners, 0 where there was nothing to compare; T_world_cam : the camera's pose by this tag alone, of
    the two that fit the one nearer in attitude to the prediction; None for a tag without a place
    """

    sighting: TagSighting
    kind: Kind
    tag: KnownTag | None = None
    why: str = ""
    chi2: float = 0.0
    T_world_cam: SE3 | None = None

    @property
    def usable(self) -> bool:
        """Whether its corners may hold the pose to the map."""
        return self.kind in ("agrees", "corrects")


@dataclass(frozen=True, eq=False)
class _Complaint:
    t_ns: int
    name: str
    T_new_old: SE3  # how the tag would move the camera, world axes
    covariance: Array


class TagGate:
    """All tags known so far, and the judge of their sightings.

    tags : by family and id; on_event : told once of each tag that is found wrong, as on_event(t_ns, "tag", ...)
    """

    def __init__(
        self, tags: Iterable[Tag] = (), config: GateConfig | None = None, on_event: EventSink | None = None
    ) -> None:
        self.config = config or GateConfig()
        self.tags = {(tag.family, tag.id): KnownTag.of(tag) for tag in tags}
        self.emit: EventSink = on_event or (lambda t_ns, kind, **fields: None)
        self.named: dict[str, str] = {}  # tags found wrong, and how
        self._against: dict[str, int] = {}  # frames in a row that contradict
        self._pro: dict[str, int] = {}  # that do not
        self._complaints: list[_Complaint] = []

    def place(self, family: str, id: str, size_m: float, T_world_tag: SE3, covariance: Array) -> None:
        """A tag was mapped, or mapped better. A surveyed one keeps its survey."""
        known = self.tags.get((family, id))
        if known is None or not known.surveyed:
            self.tags[family, id] = KnownTag(family, id, size_m, T_world_tag, covariance)

    def judge(
        self, sightings: Sequence[TagSighting], spec: CameraSpec, T_world_body: SE3, covariance: Array
    ) -> list[Verdict]:
        """Verdicts on the sightings of one image, in their order.

        spec : the camera that saw them; T_world_body, covariance (6, 6) : predicted without them, in the frame of
        the survey
        """
        verdicts = []
        for s in sightings:
            twice = sum(o.name == s.name and o.camera == s.camera for o in sightings) > 1
            verdicts.append(self._remembered(self._of(s, spec, T_world_body, covariance, twice)))
        return verdicts

    def known(self, s: TagSighting) -> tuple[KnownTag | None, str]:
        """What is known of the tag of a sighting, its own payload included; None, or what is wrong with its claims."""
        known = self.tags.get((s.family, s.id))
        if s.size_m is None:
            return known, ""
        claim = KnownTag.of(Tag(s.family, s.id, s.size_m, s.T_world_tag))
        if known is None:
            if claim.surveyed:
                self.tags[s.family, s.id] = claim
            return claim, ""
        if not 1.0 / self.config.size_ratio < s.size_m / known.size_m < self.config.size_ratio:
            return known, f"it says it is {s.size_m:g} m large, known are {known.size_m:g} m"
        if known.surveyed and known.T_world_tag is not None and s.T_world_tag is not None:
            apart_m = float(np.linalg.norm(known.T_world_tag.t - s.T_world_tag.t))
            turned = math.degrees(angle_between(known.T_world_tag, s.T_world_tag))
            if apart_m > self.config.claim_m or turned > self.config.claim_deg:
                return known, f"it says it hangs {apart_m:.2f} m and {turned:.0f} deg from where it was surveyed"
        if claim.surveyed and not known.surveyed:  # a survey is worth more than what was mapped
            self.tags[s.family, s.id] = known = claim
        return known, ""

    # -- one sighting -------------------------------------------------------------------------------------------

    def _of(self, s: TagSighting, spec: CameraSpec, T_world_body: SE3, covariance: Array, twice: bool) -> Verdict:
        tag, lie = self.known(s)
        if twice:
            return Verdict(s, "contradicts", tag, "it is seen twice in one image")
        if lie:
            return Verdict(s, "contradicts", tag, lie)
        if tag is None:
            return Verdict(s, "unsized", why="its size is not known; add it to the anchors")
        if tag.T_world_tag is None:
            return Verdict(s, "new", tag)
        T_world_cam = T_world_body @ spec.T_body_cam
        expected = T_world_cam.inverse() @ tag.T_world_tag
        chi2, spread_m = self._misfit(s, tag, spec, T_world_body, covariance, expected)
        found = by_prediction(tag_poses(s, tag.size_m, spec.camera), expected)
        if found is None:
            return Verdict(s, "contradicts", tag, "no pose fits its corners", chi2)
        by_tag = tag.T_world_tag @ found.T_cam_tag.inverse()
        apart2 = _apart2(tag, found, T_world_body, spec.T_body_cam, covariance)
        if chi2 <= self.config.chi2 and apart2 <= self.config.apart2:
            return Verdict(s, "agrees" if spread_m <= self.config.vague_m else "vague", tag, "", chi2, by_tag)
        moved_m = float(np.linalg.norm((T_world_cam @ found.T_cam_tag).t - tag.T_world_tag.t))
        turned = math.degrees(angle_between(found.T_cam_tag, expected))
        why = f"it is {moved_m:.2f} m and {turned:.0f} deg from where it should be: moved, hung twice, or misread"
        correction = by_tag @ T_world_cam.inverse()
        noise = _covariance_of_pose(found.covariance, tag.covariance, tag.T_world_tag, found.T_cam_tag)
        complaint = _Complaint(s.t_ns, s.name, correction, noise)
        self._complaints = [c for c in self._complaints if abs(s.t_ns - c.t_ns) < self.config.correct_s * 1e9]
        seconded = any(self._same(complaint, other, T_world_cam) for other in self._complaints)
        self._complaints.append(complaint)
        return Verdict(s, "corrects" if seconded else "contradicts", tag, why, chi2, by_tag)

    def _misfit(
        self, s: TagSighting, tag: KnownTag, spec: CameraSpec, T_world_body: SE3, covariance: Array, expected: SE3
    ) -> tuple[float, float]:
        """chi2 of the corners against the prediction, inf out of view; and the sigma of the camera's position, m."""
        assert tag.T_world_tag is not None
        spread_m = math.sqrt(float(np.linalg.eigvalsh(covariance[3:, 3:])[-1]))
        found = corner_jacobians(spec.camera, spec.T_body_cam, T_world_body, tag.T_world_tag, tag_corners(tag.size_m))
        if found is None or expected.R[:, 2] @ expected.t <= 0.0:
            return math.inf, spread_m
        px, J_body, J_tag = found
        if not spec.camera.inside(px, -0.5 * spec.camera.width).all():  # far outside, no linear model holds
            return math.inf, spread_m
        sigma2 = np.repeat(np.square(s.sigma_px) + self.config.model_px**2, 2)
        S = J_body @ covariance @ J_body.T + J_tag @ tag.covariance @ J_tag.T + np.diag(sigma2)
        r = (s.corners_px - px).ravel()
        inverse, ok = spd_inverse(S)
        return float(r @ inverse @ r) if ok else math.inf, spread_m

    def _same(self, a: _Complaint, b: _Complaint, T_world_cam: SE3) -> bool:
        """Whether two tags would move the camera alike, as far as their own errors let them tell."""
        if a.name == b.name:
            return False
        there_a, there_b = a.T_new_old @ T_world_cam, b.T_new_old @ T_world_cam
        d = np.concatenate([(there_a.inverse() @ there_b).log()[:3], there_b.t - there_a.t])
        S = a.covariance + b.covariance + np.diag([math.radians(1.0) ** 2] * 3 + [0.03**2] * 3)
        near = float(np.linalg.norm(d[3:])) < 0.5 * max(float(np.linalg.norm(there_a.t - T_world_cam.t)), 0.1)
        inverse, ok = spd_inverse(S)
        return near and ok and float(d @ inverse @ d) < 16.81

    def _remembered(self, verdict: Verdict) -> Verdict:
        """The verdict in the light of those before on the same tag."""
        name = verdict.sighting.name
        if verdict.kind == "contradicts":
            self._against[name] = self._against.get(name, 0) + 1
            self._pro[name] = 0
            if self._against[name] >= self.config.name_after and name not in self.named:
                self.named[name] = verdict.why
                self.emit(verdict.sighting.t_ns, "tag", tag=name, verdict="contradicts", why=verdict.why)
            return verdict
        self._against[name] = 0
        self._pro[name] = self._pro.get(name, 0) + 1
        if name in self.named and verdict.kind == "agrees" and self._pro[name] <= self.config.forgive_after:
            return replace(verdict, kind="vague", why="it was found wrong before")
        return verdict


def _apart2(tag: KnownTag, seen: TagPose, T_world_body: SE3, T_body_cam: SE3, covariance: Array) -> float:
    """chi2, 3 degrees of freedom, of where the tag is seen against where it is known to hang."""
    assert tag.T_world_tag is not None
    at_body = T_body_cam @ seen.T_cam_tag.t
    J = np.hstack([-T_world_body.R @ skew(at_body), np.eye(3)])
    R_world_cam = T_world_body.R @ T_body_cam.R
    S = J @ covariance @ J.T + R_world_cam @ seen.covariance[3:, 3:] @ R_world_cam.T + tag.covariance[3:, 3:]
    apart = T_world_body @ at_body - tag.T_world_tag.t
    inverse, ok = spd_inverse(S + 1e-4**2 * np.eye(3))
    return float(apart @ inverse @ apart) if ok else math.inf


def _covariance_of_pose(of_sight: Array, of_tag: Array, T_world_tag: SE3, T_cam_tag: SE3) -> Array:
    """(6, 6) of T_world_cam = T_world_tag T_cam_tag^-1, rotations about the camera's axes, position in the world's."""
    T_world_cam = T_world_tag @ T_cam_tag.inverse()
    R_cw = T_world_cam.R.T
    arm = T_world_cam.t - T_world_tag.t
    cross = skew(arm)
    J = np.zeros((6, 6))  # by T_world_tag: a turn about the tag's axes turns the camera and swings it around the tag
    J[:3, :3], J[3:, :3], J[3:, 3:] = R_cw @ T_world_tag.R, -cross @ T_world_tag.R, np.eye(3)
    K = np.zeros((6, 6))  # by T_cam_tag: the same turns the other way, and the tag's shift in the camera
    K[:3, :3], K[3:, :3], K[3:, 3:] = -T_cam_tag.R, cross @ T_world_tag.R, -T_world_cam.R
    total: Array = J @ of_tag @ J.T + K @ of_sight @ K.T
    return total
