"""Tracks of corners: to a fraction of a pixel, spread, the same bytes twice; depth from a second camera."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from lodelight.errors import SourceError
from lodelight.features.klt import KltConfig, KltTracker
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.geometry.so3 import so3_exp
from lodelight.messages import Frame
from lodelight.rig import CameraSpec, Rig

CAMERA = Camera.create("radtan", 376, 240, (230.0, 230.0, 187.5, 119.5))
BASELINE_M = 0.1


def plane(shift_m: np.ndarray, R: np.ndarray | None = None, gain: float = 1.0) -> np.ndarray:
    """A textured wall 2 m ahead, seen by a camera at shift_m (3,) turned by R."""
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.uniform(0, 255, (900, 1200)).astype(np.float32), (0, 0), 3.0)
    texture = 128 + 6.0 * (texture - texture.mean())
    T_cam_wall = np.eye(3) if R is None else R.T
    K = CAMERA.K
    per_m = 200.0  # texture px
    to_wall = np.array([[1 / per_m, 0, -3.0], [0, 1 / per_m, -2.25], [0, 0, 1.0]])  # texture px -> (x, y, 1) m
    place = np.eye(3)
    place[:, 2] = np.array([0, 0, 2.0]) - shift_m
    H = K @ T_cam_wall @ place @ to_wall
    image = cv2.warpPerspective(texture, H, (376, 240), flags=cv2.INTER_LINEAR)
    return np.clip(gain * image, 0, 255).astype(np.uint8)


def rig(cameras: int = 1) -> Rig:
    right = SE3(np.eye(3), np.array([BASELINE_M, 0.0, 0.0]))
    return Rig((CameraSpec("cam0", CAMERA, SE3.identity()), CameraSpec("cam1", CAMERA, right))[:cameras])


CONFIG = KltConfig(tracks=100, spacing_px=12.0)


def test_tracks_follow_a_wall_and_its_change_of_brightness():
    tracker = KltTracker(rig(), "mono", CONFIG)
    steps = [np.array([0.02 * i, 0.01 * i, 0.0]) for i in range(6)]
    seen = [tracker.process(Frame(i, (plane(s, gain=1.0 - 0.05 * i),)), np.eye(3)) for i, s in enumerate(steps)]
    first, last = seen[0], seen[-1]
    _, a, b = np.intersect1d(first.id, last.id, return_indices=True)
    assert len(a) > 60
    moved = last.px[b] - first.px[a]
    expected = -steps[-1][:2] / 2.0 * 230.0
    assert np.median(np.linalg.norm(moved - expected, axis=1)) < 0.15
    assert last.age[b].min() == 5


def test_a_lens_that_darkens_its_rim_does_not_hold_back_tracks_of_a_pale_wall():
    """The darkening stays where it is in the image; the wall, of 3 grey values, moves by 4.6 px a frame beneath it."""
    v, u = np.mgrid[:240, :376]
    rim = 1.0 - 0.45 * ((u - 187.5) ** 2 + (v - 119.5) ** 2) / (187.5**2 + 119.5**2)
    rng = np.random.default_rng(1)

    def pale(x_m: float) -> np.ndarray:
        wall = plane(np.array([x_m, 0.0, 0.0])).astype(np.float64)
        image = rim * (128.0 + 3.0 / wall.std() * (wall - 128.0)) + 0.3 * rng.standard_normal(wall.shape)
        return np.clip(image + 0.5, 0, 255).astype(np.uint8)

    tracker = KltTracker(rig(), "mono", CONFIG)
    seen = [tracker.process(Frame(i, (pale(0.04 * i),)), np.eye(3)) for i in range(5)]
    _, a, b = np.intersect1d(seen[1].id, seen[-1].id, return_indices=True)
    assert len(a) > 40
    way = (seen[-1].px[b] - seen[1].px[a])[:, 0] / (-3 * 0.04 / 2.0 * 230.0)
    assert abs(np.median(way) - 1.0) < 0.003


def test_a_fast_turn_is_followed_where_the_gyroscope_tells_of_it():
    R = so3_exp(np.array([0.0, 0.25, 0.0]))  # 58 px
    tracker = KltTracker(rig(), "mono", CONFIG)
    first = tracker.process(Frame(0, (plane(np.zeros(3)),)))
    second = tracker.process(Frame(1, (plane(np.zeros(3), R),)), np.ascontiguousarray(R.T), 1e-3)
    assert np.isin(second.id, first.id).sum() > 40
    assert np.allclose(tracker.flow.R_now_last, R.T, atol=2e-3)


def test_corners_are_spread_and_apart():
    tracks = KltTracker(rig(), "mono", CONFIG).process(Frame(0, (plane(np.zeros(3)),)))
    apart = np.linalg.norm(tracks.px[:, None] - tracks.px[None], axis=2) + 1e3 * np.eye(len(tracks))
    assert apart.min() > 10.0
    quarters = (tracks.px[:, 0] > 188).astype(int) + 2 * (tracks.px[:, 1] > 120)
    assert np.bincount(quarters, minlength=4).min() > 10


def test_two_cameras_give_depth():
    tracker = KltTracker(rig(2), "stereo", CONFIG)
    images = (plane(np.zeros(3)), plane(np.array([BASELINE_M, 0.0, 0.0])))
    tracks = tracker.process(Frame(0, images))
    known = tracks.inv_depth > 0
    assert known.sum() > 60
    assert np.array_equal(known, tracks.stereo)
    error = (tracks.inv_depth[known] - 0.5) / tracks.sigma_inv_depth[known]
    assert np.median(np.abs(error)) < 1.0


def test_tracks_on_the_edge_of_something_nearer_are_noisier():
    """Grey posts before the wall: patches with a part of one show two disparities."""
    images = [plane(np.zeros(3)), plane(np.array([BASELINE_M, 0.0, 0.0]))]
    for image, shift in zip(images, (0, 14), strict=True):  # the wall's: 11.5
        for left in (80, 180, 280):
            image[:, left - shift : left - shift + 5] = 128
    rows = np.arange(30.0, 210.0, 12.0)
    edge = np.array([(at, row) for at in (84, 184, 284) for row in rows], np.float32)
    px = np.vstack([edge, edge + np.float32([40.0, 0.0])])
    _, found, noise = KltTracker(rig(2), "stereo", CONFIG)._flow(*images, px, px - np.float32([11.5, 0.0]))
    assert found[: len(edge)].sum() > 10
    assert np.median(noise[: len(edge)][found[: len(edge)]]) > 2.0 * np.median(noise[len(edge) :])


def test_same_frames_give_same_bytes():
    runs = []
    for _ in range(2):
        tracker = KltTracker(rig(), "mono", CONFIG)
        runs.append([tracker.process(Frame(i, (plane(np.array([0.03 * i, 0, 0.02 * i])),))) for i in range(3)][-1])
    assert runs[0].px.tobytes() == runs[1].px.tobytes()
    assert runs[0].id.tobytes() == runs[1].id.tobytes()


def test_an_image_without_texture_has_no_corners_and_one_of_another_size_is_refused():
    tracker = KltTracker(rig(), "mono", CONFIG)
    assert len(tracker.process(Frame(0, (np.full((240, 376), 90, np.uint8),)))) == 0
    with pytest.raises(SourceError, match="376x200"):
        tracker.process(Frame(1, (np.zeros((200, 376), np.uint8),)))
