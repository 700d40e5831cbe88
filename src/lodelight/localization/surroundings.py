"""Where a carried camera is by the map around it, looked for beside following it: two answers in a row must agree.

One answer may be a place that looks alike, and carrying is exact to a few centimetres where it does not go far.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lodelight.features.features import Features
from lodelight.geometry.se3 import SE3
from lodelight.localization.beside import InlineSearch, ThreadedSearch
from lodelight.localization.machine import Found
from lodelight.localization.relocalize import Hint, Relocalizer
from lodelight.localization.second_look import SecondLookConfig
from lodelight.localization.tracker import Tracked

DRIFT = 0.03  # of the way without the map, by which a place is farther away than it seems (science note B2)


@dataclass(frozen=True, eq=False)
class Question:
    """A carried frame, to be found in the map around it. near_m : how far off it may be"""

    seen: Features
    T_world_body: SE3
    in_map: int
    hint: Hint
    near_m: float


class Surroundings:
    """live : the search on a thread of its own, else at once"""

    def __init__(self, relocalizer: Relocalizer, config: SecondLookConfig, live: bool) -> None:
        self.config = config
        self._relocalizer = relocalizer
        self._search = (ThreadedSearch if live else InlineSearch)(self._answer)
        self._agreed: SE3 | None = None  # the correction that the last answer asked for
        self._since_asked = 0

    def look(self, tracked: Tracked, carried_m: float) -> tuple[SE3, str] | None:
        """T_world_body of a carried frame as two answers in a row have it, and how it was found; else None.

        carried_m : its way without the map
        """
        self._since_asked += 1
        if self._since_asked >= self.config.every and self._search.idle:
            self._since_asked = 0
            self._search.ask(self._question(tracked, carried_m))
        answer = self._search.answer()
        if answer is None:
            return None
        before, self._agreed = self._agreed, self._correction(*answer)
        if before is None or self._agreed is None or not self._alike(before, self._agreed, tracked):
            return None
        found = answer[1]
        assert isinstance(found, Found)
        return self._agreed @ tracked.T_world_body, f"{found.why} beside, twice alike"

    def forget(self) -> None:
        """The camera is not carried any more."""
        self._agreed = None

    def close(self) -> None:
        """Wait for the search."""
        self._search.close()

    def _question(self, tracked: Tracked, carried_m: float) -> Question:
        look = self.config
        hint = Hint(tracked.T_world_body, look.reach_m + DRIFT * carried_m)
        near_m = max(look.near_m, look.drift * carried_m)
        return Question(tracked.seen, tracked.T_world_body, tracked.right_in_map, hint, near_m)

    def _answer(self, question: Question) -> tuple[Question, Found | str]:
        return question, self._relocalizer.find(question.seen, question.hint)

    def _correction(self, question: Question, found: Found | str) -> SE3 | None:
        """T_world_carried: from where the camera was carried to where it is, if an answer is to be believed."""
        look = self.config
        if isinstance(found, str):
            return None
        if np.count_nonzero(found.point >= 0) < max(look.inliers, look.gain * question.in_map):
            return None
        off = question.T_world_body.inverse() @ found.T_world_body
        if np.linalg.norm(off.t) > question.near_m or np.degrees(off.angle) > look.near_deg:
            return None
        return found.T_world_body @ question.T_world_body.inverse()

    def _alike(self, a: SE3, b: SE3, tracked: Tracked) -> bool:
        """Whether two corrections put the present frame at one place."""
        look = self.config
        off = (a @ tracked.T_world_body).inverse() @ (b @ tracked.T_world_body)
        return bool(np.linalg.norm(off.t) <= 0.5 * look.near_m and np.degrees(off.angle) <= 0.5 * look.near_deg)
