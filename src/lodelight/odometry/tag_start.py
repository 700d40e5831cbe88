"""A tag of known size in view when the window starts: it says how long a metre is.

To the starter's images it adds the place of its centre, a point whose distance is known. It is in the window from the
first image on. With one camera nothing else tells whether it is as large as it says: once IMU and images alone can
tell lengths, they are asked.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from lodelight.estimation.window import TagView, Window
from lodelight.geometry.se3 import SE3
from lodelight.imu.initialization import Starter, StartView
from lodelight.imu.preintegration import NavState
from lodelight.imu.samples import ImuSamples
from lodelight.messages import TagSighting
from lodelight.odometry.probation import SURVEY, views_apart
from lodelight.odometry.tag_views import as_tag, as_view, of_known_size
from lodelight.rig import CameraSpec
from lodelight.tags.pose import tag_poses
from lodelight.tags.size import MeasuredSize, measured_size
from lodelight.tags.survey import MappedTag, map_tag
from lodelight.types import Array

RANGE_SHARE = 0.01  # of a distance by a tag's size, at least: what prints and lenses do is alike in all images
START_SCALE = 0.05  # deviation of lengths in a start that needs no tag
CHECK_S, CHECK_EVERY_S = 10.0, 0.5  # after the start, for so long, so often


@dataclass(eq=False)
class TagStart:
    """refused : tags that were found to be of another size"""

    spec: CameraSpec
    refused: set[str] = field(default_factory=set)
    _row: dict[str, int] = field(default_factory=dict)

    def usable(self, sightings: Sequence[TagSighting]) -> list[TagSighting]:
        """Those of a size that may be believed, of tags that are seen once."""
        return [s for s in of_known_size(sightings) if s.name not in self.refused]

    def with_tags(self, view: StartView, sightings: Sequence[TagSighting]) -> StartView:
        """The view and a row of camera 0 for the centre of each tag, whose tracks are negative."""
        track, ray, inv_depth, sigma, names = [], [], [], [], []
        for s in self.usable(sightings):
            assert s.size_m is not None
            poses = tag_poses(s, s.size_m, self.spec.camera)
            if not poses:
                continue
            at = poses[0].T_cam_tag.t
            spread = 0.5 * max(abs(float(pose.T_cam_tag.t[2] - at[2])) for pose in poses)
            sigma_z = math.hypot(math.sqrt(float(poses[0].covariance[5, 5])), spread, RANGE_SHARE * float(at[2]))
            track.append(-1 - self._row.setdefault(s.name, len(self._row)))
            ray.append(at / np.linalg.norm(at))
            inv_depth.append(1.0 / at[2])
            sigma.append(sigma_z / at[2] ** 2)
            names.append(s.name)
        if not names:
            return view
        return StartView(
            view.t_ns, np.concatenate([view.track, np.array(track, view.track.dtype)]),
            np.concatenate([view.camera, np.zeros(len(track), view.camera.dtype)]), np.vstack([view.ray, ray]),
            np.concatenate([view.inv_depth, inv_depth]), np.concatenate([view.sigma_inv_depth, sigma]),
            view.R_now_last, tuple(names),
        )  # fmt: skip

    def placed(
        self, states: Sequence[NavState], seen: Sequence[Sequence[TagSighting]]
    ) -> tuple[dict[str, SE3], dict[str, str]]:
        """T_map_tag by name of the tags seen from a start's states, where it is clear how they hang; and what is wrong
        with the size of others, which are refused from then on."""
        at: dict[str, list[tuple[TagSighting, SE3]]] = {}
        for state, sightings in zip(states, seen, strict=True):
            for s in self.usable(sightings):
                at.setdefault(s.name, []).append((s, state.T_world_body @ self.spec.T_body_cam))
        out: dict[str, SE3] = {}
        wrong: dict[str, str] = {}
        for name, sights in at.items():
            mine = views_apart(sights)
            size_m = mine[0].sighting.size_m
            assert size_m is not None
            measured = measured_size(mine, size_m, self.spec.camera)
            why = measured.contradicts(START_SCALE) if measured is not None else ""
            if why:
                wrong[name] = why
                self.refused.add(name)
                continue
            found = map_tag(mine, size_m, self.spec.camera, SURVEY)
            if isinstance(found, MappedTag):
                out[name] = found.T_world_tag
        return out, wrong

    def views(
        self, window: Window, state: NavState, sightings: Sequence[TagSighting], placed: dict[str, SE3]
    ) -> list[TagView]:
        """For the window, from one of the start's states; tags are declared to it."""
        out = []
        T_cam_map = (state.T_world_body @ self.spec.T_body_cam).inverse()
        for s in self.usable(sightings):
            if s.name in placed:
                if not window.knows(s.name):
                    window.declare(as_tag(s))
                out.append(as_view(s, T_cam_map @ placed[s.name]))
        return out


@dataclass(eq=False)
class ScaleCheck:
    """Whether a window of one camera that began by tags is as large as images and IMU say without them; and, as of one
    that began at rest, whether the accelerometer's sign is turned, of which both know nothing before they move.

    starter : one that has no images yet; sizes : m, of those tags by name; started_ns : or rested last
    """

    starter: Starter
    sizes: dict[str, float]
    started_ns: int
    _at: dict[int, Array] = field(default_factory=dict)
    _tried_ns: int = 0

    def add(
        self, view: StartView, imu: ImuSamples, T_map_body: SE3, still: bool = False
    ) -> dict[str, MeasuredSize] | None:
        """The next image, without rows of tags; how large the tags are, as soon as that is known. Raises SourceError
        where the accelerometer's sign is turned."""
        self.started_ns = view.t_ns if still else self.started_ns
        self.starter.add(view, imu if self._at else None)
        self._at[view.t_ns] = T_map_body.t
        if (view.t_ns - max(self._tried_ns, self.started_ns)) * 1e-9 < CHECK_EVERY_S:
            return None
        self._tried_ns = view.t_ns
        found = self.starter.in_motion()
        if isinstance(found, str):
            return None
        theirs = np.array([state.T_world_body.t for state in found.states])
        far = int(np.argmax(np.linalg.norm(theirs - theirs[0], axis=1)))
        ours = self._at[found.states[far].t_ns] - self._at[found.states[0].t_ns]
        ratio = float(np.linalg.norm(theirs[far] - theirs[0])) / max(float(np.linalg.norm(ours)), 1e-3)
        return {name: MeasuredSize(said, said * ratio, found.sigma_scale) for name, said in self.sizes.items()}

    def move(self, T_new_old: SE3) -> None:
        """Into another frame."""
        self._at = {t_ns: T_new_old @ p for t_ns, p in self._at.items()}

    def over(self, t_ns: int) -> bool:
        """Nothing will be known of it any more."""
        return (t_ns - self.started_ns) * 1e-9 > CHECK_S
