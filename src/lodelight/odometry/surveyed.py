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
from lodelight.estimation.window import Tag, Window
from lodelight.geometry.se3 import SE3, level
from lodelight.messages import TagSighting
from lodelight.tags.gate import KnownTag


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
    ) -> SE3 | None:  # fmt: skip
        """T_map_old by which the window was moved among the tags; None where it lies there, or none is in it yet.

        sightings : in the frame to come; placed : where such a tag is in the old frame, if that is clear
        """
        if self.tied:
            return None
        T_map_old = self._by_estimates(window) or self._by_sighting(sightings, placed)
        if T_map_old is not None:
            window.align(T_map_old, release_gauge=True)
            self.tied = True
            self._declare(window, set(self.known))
        return T_map_old

    def _by_estimates(self, window: Window) -> SE3 | None:
        """By the tag that the window knows best."""
        if not any(window.knows(name) for name in self.known):
            return None
        found = {name: at for name, at in window.tags().items() if name in self.known}
        if not found:
            return None
        name = min(found, key=lambda name: float(np.trace(found[name][1])))
        T_old_tag = found[name][0]
        return level(_place(self.known[name]) @ T_old_tag.inverse(), T_old_tag.t)

    def _by_sighting(self, sightings: Sequence[TagSighting], placed: Callable[[TagSighting], SE3 | None]) -> SE3 | None:
        """By the largest tag of which it is clear how it hangs."""
        for s in sorted(sightings, key=lambda s: -s.side_px):
            T_old_tag = placed(s) if s.name in self.known else None
            if T_old_tag is not None:
                return level(_place(self.known[s.name]) @ T_old_tag.inverse(), T_old_tag.t)
        return None

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
