"""A tag whose place is known has no say in the window before its own views have shown that it hangs there.

One view hardly tells. Where the window is not sure of itself, another print may be seen where the right one is
expected; and a square that is turned over its line of sight has nearly the same corners. So the first sightings are
tested against the window that was solved without them, and no more. From where that had the camera, the views then say
for themselves how the tag hangs (`tags/survey.py`): both poses that the corners allow are adjusted over all of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from lodelight.estimation.window import Window
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.geometry.so3 import so3_log
from lodelight.messages import TagSighting
from lodelight.tags.survey import MappedTag, SurveyConfig, TagView, map_tag

FRAMES = 3  # in a row in which a sighting must agree
APART_M, APART_DEG = 0.05, 3.0  # views nearer to each other say the same twice
MOST_VIEWS = 8
AWAY_S = 2.0  # out of sight for longer, and it may have been moved
ATTITUDE_CHI2 = 16.27  # 99.9 % of three degrees of freedom
OFF_RAD = 0.01  # by which the window may be turned beyond its covariance, as in the test of one view
# The wrong one of two attitudes, whose chi-square is larger by E on average, seems better by 16 in 3e-5 of all cases at
# most, whatever E is: the difference has the mean E and the deviation 2 sqrt(E).
SURVEY = SurveyConfig(min_views=1, rival_chi2=16.0, hypotheses=2)


def extended(views: list[TagView], s: TagSighting, T_map_cam: SE3) -> bool:
    """Add a view unless it is from where the last one was; whether it was added. The oldest goes."""
    if views and not (views[-1].T_world_cam.inverse() @ T_map_cam).exceeds(APART_M, APART_DEG):
        return False
    views.append(TagView(s, T_map_cam))
    del views[:-MOST_VIEWS]
    return True


@dataclass(eq=False)
class _Tried:
    """agreed : frames in a row; admitted : it has a say; why : it was found to hang otherwise"""

    seen_ns: int
    agreed: int = 0
    admitted: bool = False
    why: str = ""
    views: list[TagView] = field(default_factory=list)


@dataclass(eq=False)
class Probation:
    """tried : by name, tags in sight"""

    camera: Camera
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

    def contradicted(self, name: str) -> None:
        """It has failed the window's test."""
        one = self.tried.get(name)
        if one is not None:
            one.agreed, one.admitted, one.views = 0, False, []

    def agreed(self, s: TagSighting, window: Window, T_body_cam: SE3) -> str:
        """A sighting in the newest frame passed the window's test: admit its tag, if the views settle that; how else
        it hangs, the first time that they say so, otherwise nothing."""
        one = self.tried[s.name]
        if one.admitted or one.why or s.size_m is None:
            return ""
        one.agreed += 1
        new = extended(one.views, s, window.newest.T_world_body @ T_body_cam)
        if one.agreed < FRAMES or not (new or one.agreed == FRAMES):
            return ""
        found = map_tag(one.views, s.size_m, self.camera, SURVEY)
        if not isinstance(found, MappedTag):
            return ""
        believed, covariance = window.tag(s.name)
        d = so3_log(np.ascontiguousarray(believed.R.T @ found.T_world_tag.R))
        turn = believed.R.T @ window.newest.T_world_body.R
        of_window = turn @ window.covariance()[:3, :3] @ turn.T
        S = found.covariance[:3, :3] + covariance[:3, :3] + of_window + OFF_RAD**2 * np.eye(3)
        if float(d @ np.linalg.solve(S, d)) > ATTITUDE_CHI2:
            turned = math.degrees(float(np.linalg.norm(d)))
            one.why = f"its views say that it is turned by {turned:.0f} deg from where it should hang; it is not used"
            return one.why
        one.admitted = True
        window.admit(s.name)
        return ""

    def move(self, T_new_old: SE3) -> None:
        """Into another frame."""
        for one in self.tried.values():
            one.views = [TagView(v.sighting, T_new_old @ v.T_world_cam) for v in one.views]
