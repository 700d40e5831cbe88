"""Tags for the inertial window: their corners in its frames, and where a new one begins.

A tag's place in the odometry's own frame is unknown however well it was surveyed in the world's, and is estimated along
with the window; its size is known, and so one camera sees how long a metre is. Where it first is must not be the wrong
one of the two poses that a square has: it enters once one view is clear, or gravity tells.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lodelight.anchors import tag_corners
from lodelight.estimation.window import Tag, TagView, Window
from lodelight.geometry.se3 import SE3
from lodelight.messages import TagSighting
from lodelight.rig import CameraSpec
from lodelight.tags.pose import TagPose, by_gravity, clear, tag_poses


def tag_views(
    window: Window, sightings: Sequence[TagSighting], spec: CameraSpec, T_map_body: SE3
) -> tuple[list[TagView], list[str]]:
    """What a frame at about T_map_body says of tags, and the names of those that the window has not had yet.

    Declares new ones to the window. Sightings without a size, and new ones of which it is not clear how they hang, are
    left out.
    """
    up_cam = (T_map_body @ spec.T_body_cam).R[2]
    views, new = [], []
    for s in sightings:
        if s.size_m is None:
            continue
        pose: TagPose | None = None
        if not window.knows(s.name):
            poses = tag_poses(s, s.size_m, spec.camera)
            pose = clear(poses, s) or (by_gravity(poses, up_cam) if len(poses) > 1 else None)
            if pose is None:
                continue
            window.declare(Tag(s.name, np.asarray(tag_corners(s.size_m), np.float64)))
            new.append(s.name)
        T_cam_tag = None if pose is None else pose.T_cam_tag
        views.append(TagView(s.name, s.camera, s.corners_px, s.sigma_px, T_cam_tag))
    return views, new
