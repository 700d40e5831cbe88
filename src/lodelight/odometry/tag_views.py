"""Tags for the inertial window: their corners in its frames, and where a new one begins.

The size of a tag is known, and so one camera sees how long a metre is. Where a tag of unknown place first is must not
be the wrong one of the two poses that a square has: it enters once one view is clear, gravity tells, or several views
agree on one of them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from lodelight.anchors import tag_corners
from lodelight.estimation.window import Tag, TagView, Window
from lodelight.geometry.se3 import SE3
from lodelight.messages import TagSighting
from lodelight.odometry.probation import Probation, in_window, scale_of, views_apart
from lodelight.rig import CameraSpec
from lodelight.tags.gate import GateConfig
from lodelight.tags.pose import by_gravity, clear, tag_poses
from lodelight.tags.size import measured_size
from lodelight.tags.survey import MappedTag, map_tag


def tag_views(
    window: Window, sightings: Sequence[TagSighting], T_map_cam: SE3, surveyed: Callable[[str], Tag | None],
    placed: Callable[[TagSighting, SE3], SE3 | None], probation: Probation,
) -> tuple[list[TagView], list[str]]:  # fmt: skip
    """What a frame says of tags, and the names of those that the window has not had yet, which are declared to it.

    surveyed : a tag by name where its place is known; placed : T_map_tag of another one, as soon as that is clear, by
    its sighting and T_map_cam. Left out are sightings without a size, both copies of a tag that is seen twice, and what
    has no place yet. Held, without a say, are those of known tags on probation.
    """
    views, new = [], []
    for s in of_known_size(sightings):
        T_cam_tag: SE3 | None = None
        if not window.knows(s.name):
            tag = surveyed(s.name)
            if tag is None:
                T_map_tag = placed(s, T_map_cam)
                if T_map_tag is None:
                    continue
                T_cam_tag = T_map_cam.inverse() @ T_map_tag
                tag = as_tag(s)
                probation.admit(s.name, s.t_ns)
            window.declare(tag)
            new.append(s.name)
        views.append(as_view(s, T_cam_tag, probation.holds(s.name, s.t_ns)))
    return views, new


def of_known_size(sightings: Sequence[TagSighting]) -> list[TagSighting]:
    """Those of tags that say their size, but for both copies of one that is seen twice."""
    copies = Counter(s.name for s in sightings)
    return [s for s in sightings if s.size_m is not None and copies[s.name] == 1]


def as_tag(s: TagSighting) -> Tag:
    """The tag of a sighting, its place unknown, for `Window.declare`."""
    assert s.size_m is not None
    return Tag(s.name, np.asarray(tag_corners(s.size_m), np.float64))


def as_view(s: TagSighting, T_cam_tag: SE3 | None, held: bool = False) -> TagView:
    """A sighting for the window, with the noise of its corners and of the lens."""
    sigma_px = np.hypot(s.sigma_px, GateConfig.model_px)
    return TagView(s.name, s.camera, s.corners_px, sigma_px, T_cam_tag, held=held)


@dataclass(eq=False)
class NewTags:
    """Sightings of tags that have no place yet, by name, as far as their frames are in the window."""

    spec: CameraSpec
    seen: dict[str, list[TagSighting]] = field(default_factory=dict)
    _wrong: dict[str, tuple[int, str]] = field(default_factory=dict)  # when, and why
    _told: set[str] = field(default_factory=set)

    def place(self, s: TagSighting, T_map_cam: SE3, window: Window) -> SE3 | None:
        """T_map_tag by this sighting from T_map_cam, later than the window, and those before it.

        None where two poses still fit, where a single place does not tell how large it is, or where it is not as large
        as it says.
        """
        if s.size_m is None:
            return None
        before = self.seen.setdefault(s.name, [])
        views = views_apart([*in_window(window, before, self.spec.T_body_cam), (s, T_map_cam)])
        before.append(s)
        if views[-1].sighting is not s:
            return None
        measured = measured_size(views, s.size_m, self.spec.camera)
        if measured is None:
            return None
        why = measured.contradicts(scale_of(window))
        if why:
            self._wrong[s.name] = s.t_ns, why
            return None
        poses = tag_poses(s, s.size_m, self.spec.camera)
        settled = clear(poses, s) or (by_gravity(poses, T_map_cam.R[2]) if len(poses) > 1 else None)
        if settled is not None:
            return T_map_cam @ settled.T_cam_tag
        found = map_tag(views, s.size_m, self.spec.camera)
        return found.T_world_tag if isinstance(found, MappedTag) else None

    def wrong(self) -> list[tuple[str, int, str]]:
        """Tags that were found to be of another size, when, and what is wrong; each once."""
        out = [(name, *said) for name, said in self._wrong.items() if name not in self._told]
        self._told |= {name for name, _, _ in out}
        return out
