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
from lodelight.geometry.so3 import so3_exp, so3_log
from lodelight.messages import TagSighting
from lodelight.odometry.gap import Continuation
from lodelight.tags.gate import GateConfig, KnownTag
from lodelight.types import Array

AGREE_CHI2, TOGETHER_CHI2 = 22.46, 26.12  # 99.9 % of six degrees of freedom, and of eight


@dataclass(eq=False)
class SurveyedTags:
    """known : by name, all with a place, in the map's frame. tied : the window lies among them

    goes_on : where the window does, where another was left before it; None once it is tied. That may be far off, and so
    may a tag: it is laid down by one that is where it is expected, if that is known well enough to tell, or by two that
    agree with each other
    """

    known: dict[str, KnownTag] = field(default_factory=dict)
    tied: bool = False
    goes_on: Continuation | None = None
    _met: dict[str, tuple[SE3, Array]] = field(default_factory=dict)  # by a window that lies among none yet

    def begin_anew(self, goes_on: Continuation | None) -> None:
        """A new window lies among no tags."""
        self.tied, self.goes_on = False, goes_on
        self._met.clear()

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
        self._met = {name: at for name, at in (self._met | found).items() if name in self.known}
        by = self._best(window.config) if self._met or self.goes_on else self._by_sighting(sightings, placed)
        if by is None:
            return None
        name, T_old_tag = by
        agreeing = {other for other in self.known if other not in found or self._agree(name, other, window.config)}
        if self.goes_on is not None and self._expected(name, window.config):  # it knows better than by one tag
            T_map_old = SE3.identity()
            window.align(T_map_old, adrift=self.goes_on.adrift)
        else:
            T_map_old = level(_place(self.known[name]) @ T_old_tag.inverse(), T_old_tag.t)
            window.align(T_map_old)
        self.tied, self.goes_on = True, None
        self._met.clear()
        self._declare(window, agreeing)
        return T_map_old, name

    def _any(self, window: Window) -> bool:
        return any(window.knows(name) for name in self.known)

    def _best(self, config: WindowConfig) -> tuple[str, SE3] | None:
        """The tag with which most others agree, and of several the one that the window knows best."""
        votes = {a: sum(self._agree(a, b, config) for b in self._met) for a in self._met}
        if self.goes_on is not None:
            votes = {name: n for name, n in votes.items() if n > 1 or self._expected(name, config)}
        name = min(votes, key=lambda name: (-votes[name], float(np.trace(self._met[name][1]))), default=None)
        return None if name is None else (name, self._met[name][0])

    def _expected(self, name: str, config: WindowConfig) -> bool:
        """Whether a tag is where a window that goes on expects it, and that is known well enough to tell."""
        assert self.goes_on is not None
        (T, P), spread = self._met[name], self.goes_on.spread(self._met[name][0])
        if float(np.linalg.eigvalsh(spread[3:, 3:])[-1]) > GateConfig.vague_m**2:
            return False
        surveyed = _place(self.known[name])
        d = np.concatenate([(surveyed.inverse() @ T).log()[:3], T.t - surveyed.t])
        gate = np.diag([config.tag_gate_rad**2] * 3 + [config.tag_gate_m**2] * 3)
        return float(d @ np.linalg.solve(P + spread + self.known[name].covariance + gate, d)) <= AGREE_CHI2

    def _by_sighting(
        self, sightings: Sequence[TagSighting], placed: Callable[[TagSighting], SE3 | None]
    ) -> tuple[str, SE3] | None:
        """The largest tag of which it is clear how it hangs."""
        for s in sorted(sightings, key=lambda s: -s.side_px):
            T_old_tag = placed(s) if s.name in self.known else None
            if T_old_tag is not None:
                return s.name, T_old_tag
        return None

    def _agree(self, a: str, b: str, config: WindowConfig) -> bool:
        """Whether two tags hang to each other in the window as their surveys say, once it is turned about the vertical;
        else only `a` is believed."""
        if a == b or a not in self._met:
            return True
        (T_a, P_a), (T_b, P_b) = self._met[a], self._met[b]
        hung = [_place(self.known[name]) for name in (a, b)]
        P = [P_a + self.known[a].covariance, P_b + self.known[b].covariance]
        W = np.zeros((9, 9))
        W[:3, :3], W[3:6, 3:6] = (np.linalg.inv(Q[:3, :3] + config.tag_gate_rad**2 * np.eye(3)) for Q in P)
        W[6:, 6:] = np.linalg.inv(P[0][3:, 3:] + P[1][3:, 3:] + config.tag_gate_m**2 * np.eye(3))
        R = level(hung[0] @ T_a.inverse(), T_a.t).R
        for _ in range(4):
            there, away = [R @ T_a.R, R @ T_b.R], R @ (T_b.t - T_a.t)
            turned = [so3_log(np.ascontiguousarray(T.R.T @ now)) for T, now in zip(hung, there, strict=True)]
            e = np.concatenate([*turned, away - (hung[1].t - hung[0].t)])
            J = np.concatenate([there[0][2], there[1][2], [-away[1], away[0], 0.0]])
            R = so3_exp(np.array([0.0, 0.0, -float(J @ W @ e) / float(J @ W @ J)])) @ R
        return float(e @ W @ e) <= TOGETHER_CHI2

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
