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
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.messages import TagSighting
from lodelight.odometry.probation import Probation, extended
from lodelight.tags.gate import GateConfig
from lodelight.tags.pose import by_gravity, clear, tag_poses
from lodelight.tags.survey import MappedTag, map_tag
from lodelight.tags.survey import TagView as View

OLD_S = 10.0  # the odometry's frame drifts, and what was seen before this says no more


def tag_views(
    window: Window, sightings: Sequence[TagSighting], T_map_cam: SE3, surveyed: Callable[[str], Tag | None],
    placed: Callable[[TagSighting, SE3], SE3 | None], probation: Probation,
) -> tuple[list[TagView], list[str]]:  # fmt: skip
    """What a frame says of tags, and the names of those that the window has not had yet, which are declared to it.

    surveyed : a tag by name where its place is known; placed : T_map_tag of another one, as soon as that is clear, by
    its sighting and T_map_cam. Left out are sightings without a size, both copies of a tag that is seen twice, and what
    has no place yet. Held, without a say, are those of known tags on probation.
    """
    copies = Counter(s.name for s in sightings)
    views, new = [], []
    for s in sightings:
        if s.size_m is None or copies[s.name] > 1:
            continue
        T_cam_tag: SE3 | None = None
        if not window.knows(s.name):
            tag = surveyed(s.name)
            if tag is None:
                T_map_tag = placed(s, T_map_cam)
                if T_map_tag is None:
                    continue
                T_cam_tag = T_map_cam.inverse() @ T_map_tag
                tag = Tag(s.name, np.asarray(tag_corners(s.size_m), np.float64))
                probation.admit(s.name, s.t_ns)
            window.declare(tag)
            new.append(s.name)
        sigma_px = np.hypot(s.sigma_px, GateConfig.model_px)
        held = probation.holds(s.name, s.t_ns)
        views.append(TagView(s.name, s.camera, s.corners_px, sigma_px, T_cam_tag, held=held))
    return views, new


@dataclass(eq=False)
class NewTags:
    """Sightings of tags that have no place yet, by name, from where the window had the camera at the time."""

    camera: Camera
    seen: dict[str, list[View]] = field(default_factory=dict)

    def place(self, s: TagSighting, T_map_cam: SE3) -> SE3 | None:
        """T_map_tag by this sighting from T_map_cam, and those before it; None where two poses still fit."""
        if s.size_m is None:
            return None
        poses = tag_poses(s, s.size_m, self.camera)
        settled = clear(poses, s) or (by_gravity(poses, T_map_cam.R[2]) if len(poses) > 1 else None)
        if settled is not None:
            return T_map_cam @ settled.T_cam_tag
        views = [v for v in self.seen.get(s.name, ()) if (s.t_ns - v.sighting.t_ns) * 1e-9 < OLD_S]
        if not extended(views, s, T_map_cam):
            return None
        self.seen[s.name] = views
        found = map_tag(views, s.size_m, self.camera)
        return found.T_world_tag if isinstance(found, MappedTag) else None

    def move(self, T_new_old: SE3) -> None:
        """Into another frame."""
        self.seen = {
            name: [View(v.sighting, T_new_old @ v.T_world_cam) for v in views] for name, views in self.seen.items()
        }
