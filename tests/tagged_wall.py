"""A textured wall with three tags on it, seen through an exact warp by an RGB-D camera that passes it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from lodelight.anchors import Tag
from lodelight.fiducials import fiducial_modules
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.io.euroc_writer import append_image, append_truth, stored_depth, write_sensors
from lodelight.messages import Frame
from lodelight.rig import CameraSpec, DepthSpec, Rig

LENS = Camera.create("radtan", 480, 360, (360.0, 360.0, 239.5, 179.5))
RIG = Rig((CameraSpec("cam0", LENS, SE3.identity(), 20.0),), depth=DepthSpec(LENS, SE3.identity()))
PX_PER_M = 400.0  # of the wall's picture
WALL_M = (4.0, 2.4)
TAGS = (  # on the wall: x to the right, y down, z into it
    Tag("tag36h11", "1", 0.2, SE3(np.eye(3), np.array([0.9, 1.0, 0.0]))),
    Tag("tag36h11", "2", 0.16, SE3(np.eye(3), np.array([2.0, 1.45, 0.0]))),
    Tag("tag36h11", "3", 0.2, SE3(np.eye(3), np.array([2.9, 0.9, 0.0]))),
)
# The wall in the world: upright, seen along y; the world's z is up.
T_WORLD_WALL = SE3(np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]), np.array([5.0, 7.0, 3.0]))
STEP_NS = 50_000_000
N_POSES = 40  # of the walk that recordings are parts of


def surveyed(tag: Tag, moved=(0.0, 0.0, 0.0)) -> Tag:
    assert tag.T_world_tag is not None
    T = T_WORLD_WALL @ tag.T_world_tag
    return replace(tag, T_world_tag=SE3(T.R, T.t + np.array(moved)))


def wall_picture() -> np.ndarray:
    """Grey, PX_PER_M, with the tags on it."""
    rng = np.random.default_rng(0)
    w, h = (round(PX_PER_M * side) for side in WALL_M)
    image = np.full((h, w), 128.0)
    for scale in (40, 16, 7):
        image += cv2.resize(rng.normal(0, 28, (h // scale + 2, w // scale + 2)), (w, h), interpolation=cv2.INTER_CUBIC)
    image = np.clip(image, 10, 245)
    for tag in TAGS:
        modules = np.pad(fiducial_modules(tag.family, int(tag.id)), 1, constant_values=1)
        side = round(PX_PER_M * tag.size_m * len(modules) / (len(modules) - 2))
        print_ = cv2.resize(modules * 200 + 25, (side, side), interpolation=cv2.INTER_NEAREST)
        x, y = (np.array(tag.T_world_tag.t[:2]) * PX_PER_M - 0.5 * side).round().astype(int)
        image[y : y + side, x : x + side] = print_
    return image.astype(np.uint8)


def poses(n: int = 26):
    """T_wall_cam: past the wall, swaying and turning a little."""
    for k in range(n):
        u = k / (n - 1)
        at = np.array([0.9 + 2.0 * u, 1.15 + 0.12 * np.sin(7 * u), -1.25 + 0.15 * np.sin(5 * u)])
        yield SE3.exp(np.array([0.05 * np.sin(6 * u), 0.25 * np.sin(9 * u), 0.03 * np.cos(8 * u), *at]))


def frame(wall: np.ndarray, T_wall_cam: SE3, t_ns: int) -> Frame:
    u, v = np.meshgrid(np.arange(LENS.width), np.arange(LENS.height))
    rays = np.stack([(u - 239.5) / 360.0, (v - 179.5) / 360.0, np.ones(u.shape)], axis=-1) @ T_wall_cam.R.T
    along = -T_wall_cam.t[2] / rays[..., 2]  # which is depth along the camera's z
    xy = (T_wall_cam.t[:2] + along[..., None] * rays[..., :2]) * PX_PER_M - 0.5
    image = cv2.remap(wall, xy.astype(np.float32), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    image = image + np.random.default_rng(t_ns).normal(0, 2, image.shape)
    return Frame(t_ns, (np.clip(image, 0, 255).astype(np.uint8),), along.astype(np.float32))


def write_walk(folder: Path, wall: np.ndarray, first: int, last: int, step_ns: int = STEP_NS) -> Path:
    """A part of the walk past the wall, with its truth."""
    folders = write_sensors(folder, RIG)
    truth = folders["state_groundtruth_estimate0"]
    for k, T_wall_cam in list(enumerate(poses(N_POSES)))[first:last]:
        seen = frame(wall, T_wall_cam, (k + 1) * step_ns)
        append_image(folders["cam0"], seen.t_ns, seen.images[0])
        append_image(folders["depth0"], seen.t_ns, stored_depth(seen.depth, RIG.depth))
        still = np.zeros((1, 3))
        quat_wxyz = np.roll(T_wall_cam.quat_xyzw, 1)[None]
        append_truth(truth, np.array([seen.t_ns]), T_wall_cam.t[None], quat_wxyz, still, still, still)
    return folder
