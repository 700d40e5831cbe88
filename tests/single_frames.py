"""Maps of frames that know nothing of each other: every frame a keyframe, with points from its own depths alone."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from lodelight.features.features import Features
from lodelight.features.frontend import FrontEnd
from lodelight.features.orb import OrbConfig
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.io.calibrations import load_rig
from lodelight.io.recording import Recording
from lodelight.mapping.map import Map
from lodelight.messages import Frame
from lodelight.rig import CameraSpec, Rig

ORB = OrbConfig()
IDEAL = Camera.create("radtan", 640, 480, (460.0, 460.0, 319.5, 239.5))


@dataclass(frozen=True, eq=False)
class Shot:
    """What camera 0 saw, and where it was; the camera is the body."""

    seen: Features
    T_world_cam: SE3
    frame: Frame

    @property
    def idealized(self) -> Shot:
        """The same through the ideal camera, so that shots of several cameras can stand in one map."""
        return replace(self, seen=idealized(self.seen))


def idealized(seen: Features) -> Features:
    """The features that the ideal camera would see."""
    fx, fy, cx, cy = IDEAL.params[:4]
    px = np.stack([fx * seen.ray[:, 0] / seen.ray[:, 2] + cx, fy * seen.ray[:, 1] / seen.ray[:, 2] + cy], axis=1)
    return replace(seen, px=px.astype(np.float32)).take(IDEAL.inside(px))


def shots(recording: Recording, sensors: str, every: int) -> list[Shot]:
    """Every so manyeth frame of a recording with truth, at the truth nearest in time."""
    spec, front_end = recording.rig.cameras[0], FrontEnd(recording.rig, sensors, ORB)
    truth = recording.ground_truth()
    taken = []
    for i, frame in enumerate(recording.messages(sensors)):
        if i % every == 0:
            T_world_body = truth.pose(int(np.abs(truth.t_ns - frame.t_ns).argmin()))
            taken.append(Shot(front_end.process(frame), T_world_body @ spec.T_body_cam, frame))
    return taken


def stereo_pairs(folder: Path) -> list[Shot]:
    """The stereo pairs of `euroc_loop_pairs` with the poses of `body_poses.csv`."""
    cameras = [load_rig(folder / f"sensor{side}.yaml").cameras[0] for side in ("Left", "Right")]
    rig = Rig((cameras[0], replace(cameras[1], name="cam1")))
    front_end = FrontEnd(rig, "stereo", ORB)
    taken = []
    for i, x, y, z, *quat_wxyz in np.loadtxt(folder / "body_poses.csv", delimiter=",", comments="#"):
        images = [
            cv2.imread(str(folder / f"{side}_img_{int(i)}.png"), cv2.IMREAD_GRAYSCALE) for side in ("left", "right")
        ]
        T_world_body = SE3.from_quat_xyzw(np.array([x, y, z]), np.roll(quat_wxyz, -1))
        frame = Frame(int(i), tuple(images))
        taken.append(Shot(front_end.process(frame), T_world_body @ rig.cameras[0].T_body_cam, frame))
    return taken


def map_of(taken: list[Shot], camera: Camera = IDEAL) -> Map:
    """A keyframe for each, at its true pose, with a point for every feature whose depth is known to a fifth."""
    map = Map(Rig((CameraSpec("cam0", camera, SE3.identity()),)))
    for i, shot in enumerate(taken):
        seen = shot.seen
        keyframe = map.add_keyframe(i, shot.T_world_cam, seen)
        known = np.flatnonzero((seen.inv_depth > 0) & (seen.sigma_inv_depth < 0.2 * seen.inv_depth))
        xyz = shot.T_world_cam @ (seen.ray[known] / (seen.ray[known, 2] * seen.inv_depth[known])[:, None])
        points = map.add_points(xyz, (map.feature_range(keyframe).start + known).astype(np.int32), keyframe)
        map.refresh_points(points, ORB.scale_factor, ORB.n_levels)
    return map
