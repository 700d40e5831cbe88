"""Surveyed tags for the inertial window: it is laid down among them, and from then on they hold it there.

Yaw and position of a window's start are a choice, no knowledge. Once a surveyed tag is seen the window is turned about
the vertical and shifted to where that tag puts it, and forgets what it knew of absolute yaw and position. Then every
surveyed tag is believed where its survey has it, with the survey's covariance; the window tests each sighting before it
counts. Tags are given in the frame of the map, which is the world's but for a constant T_world_map.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from lodelight.anchors import tag_corners
from lodelight.estimation.window import Tag, Window, WindowConfig
from lodelight.geometry.se3 import SE3, level
from lodelight.messages import TagSighting
from lodelight.tags.gate import KnownTag
from lodelight.types import Array

AGREE_CHI2 = 22.46  # 99.9 % of six degrees of freedom


@dataclass(eq=False)
class SurveyedTags:
    """known : by name, all with a place, in the map's frame. tied : the window lies among them"""

    known: dict[str, KnownTag] = field(default_factory=dict)
    tied: bool = False

    def learn(self, known: Mapping[str, KnownTag], window: Window | None) -> None:
        """What is surveyed now. Where a tag's place has changed, so has the map's frame, and the window is not tied."""
        old = self.known
        self.tied &= all(_same(old[name], tag) for name, tag in known.items() if name in old)
        self.known = dict(known)
        if self.tied and window is not None:
            self._declare(window, {name for name in known if name not in old})

    def declaration(self, name: str) -> Tag | None:
        """A tag for the window; None where nothing but its size may be believed."""
        return _declaration(name, self.known[name]) if self.tied and name in self.known else None

    def lay_down(
        self, window: Window, sightings: Sequence[TagSighting] = (),
        placed: Callable[[TagSighting], SE3 | None] = lambda sighting: None,
    ) -> tuple[SE3, str] | None:  # fmt: skip
        """T_map_old by which the window was moved among the tags, and by which of them; None where it lies there, or
        none is in it yet.

        sightings : in the frame to come; placed : where such a tag is in the old frame, if that is clear
        """
        if self.tied:
            return None
        found = {name: at for name, at in window.tags().items() if name in self.known} if self._any(window) else {}
        by = self._best(found) or self._by_sighting(sightings, placed)
        if by is None:
            return None
        name, T_old_tag = by
        T_map_old = level(_place(self.known[name]) @ T_old_tag.inverse(), T_old_tag.t)
        agreeing = {
            other for other in self.known if other not in found or self._agree(name, other, found, window.config)
        }
        window.align(T_map_old, release_gauge=True)
        self.tied = True
        self._declare(window, agreeing)
        return T_map_old, name

    def _any(self, window: Window) -> bool:
        return any(window.knows(name) for name in self.known)

    @staticmethod
    def _best(found: Mapping[str, tuple[SE3, Array]]) -> tuple[str, SE3] | None:
        """The tag that the window knows best."""
        name = min(found, key=lambda name: float(np.trace(found[name][1])), default=None)
        return None if name is None else (name, found[name][0])

    def _by_sighting(
        self, sightings: Sequence[TagSighting], placed: Callable[[TagSighting], SE3 | None]
    ) -> tuple[str, SE3] | None:
        """The largest tag of which it is clear how it hangs."""
        for s in sorted(sightings, key=lambda s: -s.side_px):
            T_old_tag = placed(s) if s.name in self.known else None
            if T_old_tag is not None:
                return s.name, T_old_tag
        return None

    def _agree(self, a: str, b: str, found: Mapping[str, tuple[SE3, Array]], config: WindowConfig) -> bool:
        """Whether two tags hang to each other in the window as their surveys say: else only `a` is believed."""
        if a == b or a not in found:
            return True
        (T_a, P_a), (T_b, P_b) = found[a], found[b]
        there = T_a.inverse() @ T_b
        surveyed = _place(self.known[a]).inverse() @ _place(self.known[b])
        d = np.concatenate([(surveyed.inverse() @ there).log()[:3], there.t - surveyed.t])
        S = P_a + P_b + self.known[a].covariance + self.known[b].covariance
        swing = float(np.trace(P_a[:3, :3] + self.known[a].covariance[:3, :3])) * float(there.t @ there.t)
        S = np.diag(np.diag(S)) + np.diag([config.tag_gate_rad**2] * 3 + [config.tag_gate_m**2 + swing] * 3)
        return float(d @ np.linalg.solve(S, d)) <= AGREE_CHI2

    def _declare(self, window: Window, names: set[str]) -> None:
        """Tell of surveys to a window that has these tags already; of others it is told at their first sight."""
        for name in sorted(names):
            if window.knows(name):
                window.declare(_declaration(name, self.known[name]))


def _declaration(name: str, tag: KnownTag) -> Tag:
    return Tag(name, np.asarray(tag_corners(tag.size_m), np.float64), _place(tag), tag.covariance)


def _place(tag: KnownTag) -> SE3:
    assert tag.T_world_tag is not None
    return tag.T_world_tag


def _same(a: KnownTag, b: KnownTag) -> bool:
    return bool(np.allclose(_place(a).t, _place(b).t, atol=1e-6) and np.allclose(_place(a).R, _place(b).R, atol=1e-6))
