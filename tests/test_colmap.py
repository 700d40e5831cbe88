"""COLMAP's text model, read back by a small reader and projected with OpenCV, and by pycolmap where there is one."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from lodelight.errors import CalibrationError
from lodelight.io.colmap import camera_line
from lodelight.mapping.export import export_colmap
from lodelight.mapping.map import Map
from maps import room_map, room_rig

LENSES = [
    ("radtan", (0.0, 0.0, 0.0, 0.0), "PINHOLE"),
    ("radtan", (-0.28, 0.07, 0.0002, 2e-5), "OPENCV"),
    ("radtan", (-0.28, 0.07, 0.0002, 2e-5, 0.01), "FULL_OPENCV"),
    ("equidistant", (0.003, -0.002, 0.001, -0.0002), "OPENCV_FISHEYE"),
]


def rows_of(path: Path) -> list[list[str]]:
    """Lines without comments, split; an empty line is an image without points."""
    return [line.split() for line in path.read_text().splitlines() if not line.startswith("#")]


def project(model: str, params: list[float], X_cam: np.ndarray) -> np.ndarray:
    fx, fy, cx, cy, *k = params
    K, zero = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), np.zeros(3)
    if model == "OPENCV_FISHEYE":
        return cv2.fisheye.projectPoints(X_cam[None], zero, zero, K, np.array(k))[0].reshape(-1, 2)
    return cv2.projectPoints(X_cam, zero, zero, K, np.array(k) if k else None)[0].reshape(-1, 2)


def rotation(q: list[float]) -> np.ndarray:
    w, x, y, z = q
    v = np.array([x, y, z])
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return (w * w - v @ v) * np.eye(3) + 2 * np.outer(v, v) + 2 * w * skew


@pytest.mark.parametrize(("lens", "distortion", "model"), LENSES)
def test_points_project_where_the_model_says_they_were_seen(
    tmp_path: Path, lens: str, distortion: tuple[float, ...], model: str
) -> None:
    map = room_map(rig=room_rig(lens, distortion))
    map.remove_points([3, 5, 50])
    map.remove_keyframe(4)
    export_colmap(map, tmp_path)
    (camera,) = rows_of(tmp_path / "cameras.txt")
    assert camera[:4] == ["1", model, "640", "480"]
    points = {int(r[0]): r for r in rows_of(tmp_path / "points3D.txt")}
    xyz = {m: np.array(r[1:4], float) for m, r in points.items()}
    lines = rows_of(tmp_path / "images.txt")
    seen = {}
    for head, corners in zip(lines[0::2], lines[1::2], strict=True):
        image, (q, t) = int(head[0]), (floats(head[1:5]), np.array(head[5:8], float))
        px, ids = np.array(corners, float).reshape(-1, 3)[:, :2], ints(corners[2::3])
        seen |= {(image, index): point for index, point in enumerate(ids)}
        X_cam = np.array([rotation(q) @ xyz[point] + t for point in ids])
        # COLMAP's pixels start at the image's corner, as the intrinsics beside them do: they agree with each other.
        # 0.002 px: pixels are written to 0.001, points to a micrometre, float32 pixels err by 3e-5
        np.testing.assert_allclose(project(model, floats(camera[4:]), X_cam), px, atol=0.002)
    assert len(lines) // 2 == len(map.alive_keyframes)
    tracked = {(i, k): m for m, r in points.items() for i, k in zip(ints(r[8::2]), ints(r[9::2]), strict=True)}
    assert tracked == seen
    assert len(seen) == map.points.n_obs.sum()


def floats(texts: list[str]) -> list[float]:
    return [float(t) for t in texts]


def ints(texts: list[str]) -> list[int]:
    return [int(t) for t in texts]


def test_pixels_are_counted_from_the_corner_of_the_image(tmp_path: Path) -> None:
    """Our (0, 0) is the middle of the first pixel, COLMAP's its corner: both principal point and corners move."""
    map = room_map()
    export_colmap(map, tmp_path)
    (camera,) = rows_of(tmp_path / "cameras.txt")
    assert floats(camera[6:8]) == [322.5, 241.5]
    first = np.array(rows_of(tmp_path / "images.txt")[1][:2], float)
    np.testing.assert_allclose(first, map.features.px[0] + 0.5, atol=0.001)


def test_error_is_the_mean_distance_from_projection_to_corner(tmp_path: Path) -> None:
    map = room_map(sigma_px=1.0, n_keyframes=20)
    export_colmap(map, tmp_path)
    error = np.array([float(r[7]) for r in rows_of(tmp_path / "points3D.txt")])
    weight = np.array([(len(r) - 8) / 2 for r in rows_of(tmp_path / "points3D.txt")])
    # a distance of two normal coordinates of 1 px has mean sqrt(pi / 2) = 1.2533 and deviation 0.655
    assert abs((error * weight).sum() / weight.sum() - 1.2533) < 4 * 0.655 / np.sqrt(weight.sum())


def test_double_sphere_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    map = room_map(rig=room_rig("double_sphere", (-0.2, 0.6)))
    with pytest.raises(CalibrationError, match="COLMAP has no double_sphere lens; export ply"):
        export_colmap(map, tmp_path / "model")
    assert not (tmp_path / "model").exists()


def test_empty_map_is_an_empty_model(tmp_path: Path) -> None:
    export_colmap(Map(room_rig()), tmp_path)
    assert rows_of(tmp_path / "images.txt") == []
    assert rows_of(tmp_path / "points3D.txt") == []


@pytest.mark.parametrize(("lens", "distortion", "model"), LENSES)
def test_pycolmap_reads_the_model_and_agrees_on_its_error(
    tmp_path: Path, lens: str, distortion: tuple[float, ...], model: str
) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    map = room_map(rig=room_rig(lens, distortion), sigma_px=0.5)
    export_colmap(map, tmp_path)
    model_read = pycolmap.Reconstruction(str(tmp_path))
    assert model_read.num_points3D() == len(map.points)
    assert model_read.compute_num_observations() == map.points.n_obs.sum()
    told = model_read.compute_mean_reprojection_error()
    model_read.update_point_3d_errors()
    assert abs(model_read.compute_mean_reprojection_error() - told) < 1e-3  # px, what the text is rounded to
    assert camera_line(map.rig.cameras[0].camera).startswith(model)


def test_two_keyframes_of_one_stamp_are_two_images(tmp_path):
    map = room_map()
    map.keyframes.t_ns[3] = map.keyframes.t_ns[0]
    export_colmap(map, tmp_path)
    lines = [line for line in (tmp_path / "images.txt").read_text().splitlines() if line.endswith(".png")]
    names = [line.split()[-1] for line in lines]
    assert len(set(names)) == len(map.alive_keyframes)
    assert f"{map.keyframes.t_ns[0]}_2.png" in names
