"""A tag whose place is known has no say in the window before its own views have shown that it hangs there.

One view hardly tells. Where the window is not sure of itself, another print may be seen where the right one is
expected; and a square that is turned over its line of sight has nearly the same corners. So the first sightings are
tested against the window that was solved without them, and no more. From where that had the camera, the views then say
for themselves how the tag hangs (`tags/survey.py`): both poses that the corners allow are adjusted over all of them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from lodelight.estimation.window import Window
from lodelight.geometry.se3 import SE3
from lodelight.messages import TagSighting
from lodelight.rig import CameraSpec
from lodelight.tags.size import measured_size
from lodelight.tags.survey import MappedTag, SurveyConfig, TagView, against, map_tag
from lodelight.types import Array

FRAMES = 3  # in a row in which a sighting must agree
AGAINST = 2  # frames in a row that contradict, after which a tag is named: one that hangs right may do it once
APART_M, APART_DEG = 0.05, 3.0  # views nearer to each other say the same twice
MOST_VIEWS = 8
AWAY_S = 2.0  # out of sight for longer, and it may have been moved
ATTITUDE_CHI2 = 16.27  # 99.9 % of three degrees of freedom
SHARP_RAD = math.radians(4.0)  # deviation of an attitude at most, of which it is said that it is the right one
SLOW_M_S = 0.1
# The wrong one of two attitudes, whose chi-square is larger by E on average, seems better by 16 in 3e-5 of all cases at
# most, whatever E is: the difference has the mean E and the deviation 2 sqrt(E).
SURVEY = SurveyConfig(min_views=1, rival_chi2=ATTITUDE_CHI2, hypotheses=2)


def scale_of(window: Window) -> float:
    """Deviation of the window's lengths, as a share, by that of its velocity; 1 where it hardly moves."""
    v = window.newest.v_world
    speed2 = float(v @ v)
    if speed2 < SLOW_M_S**2:
        return 1.0
    return min(math.sqrt(float(v @ window.covariance()[6:9, 6:9] @ v)) / speed2, 1.0)


def views_apart(states: Iterable[tuple[TagSighting, SE3]]) -> list[TagView]:
    """Of sightings and T_map_cam in the order of their stamps, those that say something new; the latest of many."""
    out: list[TagView] = []
    for s, T_map_cam in states:
        if not out or (out[-1].T_world_cam.inverse() @ T_map_cam).exceeds(APART_M, APART_DEG):
            out.append(TagView(s, T_map_cam))
    return out[-MOST_VIEWS:]


def in_window(window: Window, sightings: list[TagSighting], T_body_cam: SE3) -> list[tuple[TagSighting, SE3]]:
    """Those whose frames are still there, which stay in the list, with T_map_cam as the window has it.

    All from one solution: what the window believed before of absolute yaw and position was another guess.
    """
    at = {frame.t_ns: frame for frame in window.frames}
    sightings[:] = [s for s in sightings if s.t_ns in at]
    return [(s, at[s.t_ns].state.T_world_body @ T_body_cam) for s in sightings]


@dataclass(eq=False)
class _Tried:
    """agreed, against : frames in a row; admitted : it has a say; why : it was found to hang otherwise, or of another
    size; named : so that it is told once while it is in sight
    """

    seen_ns: int
    agreed: int = 0
    against: int = 0
    admitted: bool = False
    named: bool = False
    why: str = ""
    seen: list[TagSighting] = field(default_factory=list)


@dataclass(eq=False)
class Probation:
    """tried : by name, tags in sight"""

    spec: CameraSpec
    tried: dict[str, _Tried] = field(default_factory=dict)

    def holds(self, name: str, t_ns: int) -> bool:
        """Whether a tag that is seen has no say yet."""
        one = self.tried.get(name)
        if one is None or (t_ns - one.seen_ns) * 1e-9 > AWAY_S:
            one = self.tried[name] = _Tried(t_ns)
        one.seen_ns = t_ns
        return not one.admitted

    def admit(self, name: str, t_ns: int) -> None:
        """Its views have shown where it hangs already."""
        self.tried[name] = _Tried(t_ns, admitted=True)

    def named(self, name: str) -> bool:
        """Whether a tag in sight was named before this was asked."""
        one = self.tried[name]
        before, one.named = one.named or bool(one.why), True
        return before

    def judge(self, s: TagSighting, window: Window, rejected: bool) -> str:
        """After a solve with a sighting in the newest frame, which failed the window's test or not: admit its tag, if
        the views settle that; what else they say, the first time, otherwise nothing."""
        one = self.tried[s.name]
        if rejected and one.admitted:
            one.admitted, one.seen = False, []
        if one.admitted or one.why or s.size_m is None:
            return ""
        one.seen.append(s)
        views = views_apart(in_window(window, one.seen, self.spec.T_body_cam))
        new = views[-1].sighting is s  # from elsewhere than the last one
        if not new:
            views[-1] = TagView(s, window.newest.T_world_body @ self.spec.T_body_cam)
        one.why = self._turned(one, views, s, window, rejected)
        if not one.why and (rejected or one.agreed >= FRAMES) and (new or one.agreed == FRAMES):
            measured = measured_size(views, s.size_m, self.spec.camera)
            one.why = measured.contradicts(scale_of(window)) if measured is not None else ""
            if not one.why and one.agreed >= FRAMES and self._settled(views, s, window):
                one.admitted = True
                window.admit(s.name)
        return one.why

    def _turned(self, one: _Tried, views: list[TagView], s: TagSighting, window: Window, rejected: bool) -> str:
        """Count the frames that agree or contradict; by how much a tag is turned, once two in a row contradict."""
        assert s.size_m is not None
        believed, _ = window.tag(s.name)
        chi2, turn = against(views, believed, self._attitude(s, window), s.size_m, self.spec.camera, SURVEY)
        turned = chi2 > ATTITUDE_CHI2
        one.agreed, one.against = (0, one.against + 1) if rejected or turned else (one.agreed + 1, 0)
        if not turned or one.against < AGAINST:
            return ""
        return f"its views say that it is turned by {math.degrees(turn):.0f} deg from where it should hang; not used"

    def _settled(self, views: list[TagView], s: TagSighting, window: Window) -> bool:
        """Whether it is clear how a tag hangs, and well enough known that it cannot hang otherwise than it should."""
        assert s.size_m is not None
        found = map_tag(views, s.size_m, self.spec.camera, SURVEY)
        if not isinstance(found, MappedTag):
            return False
        S = found.covariance[:3, :3] + self._attitude(s, window)
        return math.sqrt(float(np.linalg.eigvalsh(S)[-1])) <= SHARP_RAD

    def _attitude(self, s: TagSighting, window: Window) -> Array:
        """(3, 3) covariance of how a tag should hang as the window sees it, rad^2, about its axes."""
        believed, covariance = window.tag(s.name)
        turn = believed.R.T @ window.newest.T_world_body.R
        of_window = turn @ window.covariance()[:3, :3] @ turn.T
        total: Array = covariance[:3, :3] + of_window + window.config.tag_gate_rad**2 * np.eye(3)
        return total
