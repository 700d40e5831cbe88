"""Depth registered to another camera: against a plain twin, against closed forms, without holes, nearest first."""

import numpy as np
import pytest

from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.io.depth import DepthReader
from lodelight.io.registration import FOOTPRINT, Registration
from lodelight.rig import CameraSpec, DepthSpec

DEPTH = Camera.create("radtan", 160, 120, (146.0, 146.0, 79.5, 59.5))
SIDEWAYS = SE3(np.eye(3), np.array([-0.025, 0.0, 0.0]))
TILTED = SE3.exp(np.array([0.02, -0.03, 0.01, -0.025, 0.004, 0.01]))


def target(scale=1.0, model="radtan", distortion=()):
    size = round(160 * scale), round(120 * scale)
    return Camera.create(model, *size, (131 * scale, 131 * scale, size[0] / 2 - 0.5, size[1] / 2 - 0.5), distortion)


def plane(camera, normal, distance_m):
    """(H, W) depth along z of the plane normal . X = distance, seen by a camera at the origin; 0 behind it."""
    v, u = np.mgrid[: camera.height, : camera.width]
    rays, seen = camera.unproject(np.column_stack([u.ravel(), v.ravel()]).astype(float))
    z = distance_m / (rays @ normal) * rays[:, 2]
    return np.where(seen & (z > 0), z, 0.0).reshape(camera.height, camera.width).astype(np.float32)


def twin(depth, lens, cam, T):
    """The same drawing with numpy and plain loops."""
    out = np.zeros((cam.height, cam.width), np.float32)
    v, u = np.nonzero(depth)
    rays, _ = lens.unproject(np.column_stack([u, v]).astype(float))
    z = depth[v, u].astype(float)
    X = T @ (rays / rays[:, 2:] * z[:, None])
    px, _ = cam.project(X)
    for (x, y), Z, d in zip(px, X[:, 2], z, strict=True):
        half = 0.5 * FOOTPRINT * d / Z * cam.params[:2] / lens.params[:2]
        for i in range(int(np.ceil(y - half[1])), int(np.floor(y + half[1])) + 1):
            for j in range(int(np.ceil(x - half[0])), int(np.floor(x + half[0])) + 1):
                if 0 <= i < cam.height and 0 <= j < cam.width and (out[i, j] == 0 or np.float32(Z) < out[i, j]):
                    out[i, j] = Z
    return out


@pytest.mark.parametrize("T", [SIDEWAYS, TILTED], ids=["sideways", "tilted"])
@pytest.mark.parametrize("cam", [target(), target(2.3), target(distortion=(-0.28, 0.07, 2e-4, 1e-5))])
def test_the_kernel_draws_as_its_numpy_twin(T, cam):
    rng = np.random.default_rng(0)
    depth = np.where(rng.random((120, 160)) < 0.7, rng.uniform(0.4, 4.0, (120, 160)), 0.0).astype(np.float32)
    ours, theirs = Registration(DEPTH, cam, T)(depth), twin(depth, DEPTH, cam, T)
    # the kernel keeps its rays in single precision: a footprint may end on the other side of a pixel's centre
    assert (~np.isclose(ours, theirs, rtol=1e-5)).mean() < 1e-3
    assert (theirs > 0).mean() > 0.3


@pytest.mark.parametrize("scale", [0.5, 1.0, 1.7, 4.0])
@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.7, 0.0, 0.7), (0.0, -0.8, 0.6), (-0.5, 0.6, 0.62)])
def test_a_plane_stays_a_plane_without_holes(scale, normal):
    normal = np.array(normal) / np.linalg.norm(normal)
    cam = target(scale)
    seen = Registration(DEPTH, cam, TILTED)(plane(DEPTH, normal, 2.0))
    normal_cam = TILTED.R @ normal
    expected = plane(cam, normal_cam, 2.0 + normal_cam @ TILTED.t)
    drawn = seen > 0
    # within one depth pixel of a reading its value is off by no more than the plane's slope over that pixel
    step = np.maximum(*(np.abs(g) for g in np.gradient(expected))) * max(scale, 1.0)
    assert np.all(np.abs(seen - expected)[drawn] <= 1.3 * step[drawn] + 1e-4)
    # no hole: what is drawn fills its rows from end to end
    for row in drawn:
        columns = np.flatnonzero(row)
        assert len(columns) == 0 or len(columns) == columns[-1] - columns[0] + 1


def test_the_nearer_surface_hides_the_farther():
    depth = np.full((120, 160), 3.0, np.float32)
    depth[40:80, 60:100] = 1.0
    seen = Registration(DEPTH, target(), SE3(np.eye(3), np.array([-0.2, 0.0, 0.0])))(depth)
    near = seen == 1.0
    columns = np.flatnonzero(near[60])
    # the box, moved left by 131 * 0.2 / 1 px, over a wall moved by a third of that
    left, right = (131 * ((u - 79.5) / 146 - 0.2) + 79.5 for u in (60, 99))
    assert (columns[0], columns[-1]) == pytest.approx((left, right), abs=1.0)
    assert near[60, columns[0] : columns[-1] + 1].all()
    assert not (seen[45:75] == 0)[:, columns[0] : columns[-1] + 1].any()
    # to its right the wall is in the depth camera's shadow: nothing was measured there
    assert (seen[60, columns[-1] + 2 : columns[-1] + 12] == 0).all()


def test_depth_of_one_camera_in_itself_is_unchanged():
    rng = np.random.default_rng(1)
    depth = rng.uniform(0.5, 4.0, (120, 160)).astype(np.float32)
    seen = Registration(DEPTH, DEPTH, SE3.identity())(np.where(rng.random((120, 160)) < 0.2, 0, depth))
    # each reading covers a little more than its pixel: it may spill into a neighbour's only where that is farther
    assert np.all((seen <= depth * (1 + 1e-6)) | (seen == 0))


def test_a_wide_target_and_rays_without_depth_are_no_trouble():
    lens = Camera.create("equidistant", 160, 120, (60.0, 60.0, 79.5, 59.5), (0.01, 0.0, 0.0, 0.0))
    turned = SE3.exp(np.array([0.0, 0.1, 0.0, 0.02, 0.0, 0.0]))
    seen = Registration(lens, lens, turned)(np.full((120, 160), 2, np.float32))
    assert np.isfinite(seen).all()
    assert (seen > 0).mean() > 0.5


def test_readings_out_of_range_and_the_marks_of_none_become_zero():
    spec = DepthSpec(DEPTH, SE3.identity(), units_per_m=1000.0, min_m=0.3, max_m=8.0)
    reader = DepthReader(spec, CameraSpec("cam0", DEPTH, SE3.identity()))
    raw = np.array([[0, 299, 300, 1234, 8000, 8001, 65535]], np.uint16)
    metres = reader.metres(raw)
    assert metres.dtype == np.float32
    assert metres[0].tolist() == [0.0, 0.0, np.float32(0.3), np.float32(1.234), 8.0, 0.0, 0.0]
