"""Where the body was by the lights at the time of an image: interpolated, and hardly ever extrapolated."""

from __future__ import annotations

from bisect import bisect_left, insort
from dataclasses import dataclass

from lodelight.geometry.se3 import SE3
from lodelight.messages import LightFix
from lodelight.types import Array

GAP_S = 0.2  # between two fixes that are interpolated
REACH_S = 0.05  # beyond the last fix
KEPT_S = 10.0
NS = 1e-9


@dataclass(frozen=True, eq=False)
class LightPose:
    """A fix brought to a time. lights : ids of those it came of; none for odometry that was made elsewhere."""

    t_ns: int
    T_world_body: SE3
    covariance: Array
    lights: tuple[str, ...]
    rms_px: float


class FixBuffer:
    """The fixes of the last seconds, in order of their stamps."""

    def __init__(self) -> None:
        self._fixes: list[LightFix] = []

    def add(self, fix: LightFix) -> None:
        """Keep a fix that has a pose; a second one of the same stamp is left out."""
        if fix.T_world_body is None:
            return
        at = bisect_left(self._fixes, fix.t_ns, key=_stamp)
        if at < len(self._fixes) and self._fixes[at].t_ns == fix.t_ns:
            return
        insort(self._fixes, fix, key=_stamp)
        while (self._fixes[-1].t_ns - self._fixes[0].t_ns) * NS > KEPT_S:
            self._fixes.pop(0)

    def at(self, t_ns: int) -> LightPose | None:
        """Lerp and slerp between two fixes that enclose a time and lie at most GAP_S apart.

        Within REACH_S of the nearest fix the motion of the two nearest is carried on; None where neither can be.
        """
        after = bisect_left(self._fixes, t_ns, key=_stamp)
        if after < len(self._fixes) and self._fixes[after].t_ns == t_ns:
            return _between(self._fixes[after], self._fixes[after], t_ns)
        if 0 < after < len(self._fixes):
            inside = _between(self._fixes[after - 1], self._fixes[after], t_ns)
            if inside is not None:
                return inside
        if after >= 2 and (t_ns - self._fixes[after - 1].t_ns) * NS <= REACH_S:
            return _between(self._fixes[after - 2], self._fixes[after - 1], t_ns)
        return None

    def before(self, t_ns: int, within_s: float) -> LightFix | None:
        """The last fix at or before a time, if it is no older than that."""
        after = bisect_left(self._fixes, t_ns + 1, key=_stamp)
        if after and (t_ns - self._fixes[after - 1].t_ns) * NS <= within_s:
            return self._fixes[after - 1]
        return None


def _stamp(fix: LightFix) -> int:
    return fix.t_ns


def _between(a: LightFix, b: LightFix, t_ns: int) -> LightPose | None:
    gap_ns = b.t_ns - a.t_ns
    if gap_ns * NS > GAP_S or a.T_world_body is None or b.T_world_body is None:
        return None
    u = (t_ns - a.t_ns) / gap_ns if gap_ns else 0.0
    # within, the errors of neighbours are much the same (tilt, survey); beyond, their difference is carried on
    share = 1.0 if 0.0 <= u <= 1.0 else u**2 + (1.0 - u) ** 2
    nearest = a if u < 0.5 else b
    T = a.T_world_body.interpolate(b.T_world_body, u)
    return LightPose(t_ns, T, share * nearest.covariance, nearest.lights, max(a.rms_px, b.rms_px))
