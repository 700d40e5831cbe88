"""Lenses: projection and unprojection against OpenCV and closed forms, Jacobians against central differences."""

import cv2
import numpy as np
import pytest

from lodelight.errors import CalibrationError
from lodelight.geometry.cameras import Camera, project_jacobian, project_point

PIXEL = 1e-9  # px: rounding of some twenty operations on numbers near 1000

PINHOLES = {
    "ideal": Camera.create("radtan", 640, 480, (525.0, 525.0, 319.5, 239.5)),
    "euroc": Camera.create(
        "radtan", 752, 480, (458.654, 457.296, 367.215, 248.375), (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)
    ),
    "kinect": Camera.create(
        "radtan",
        640,
        480,
        (517.306408, 516.469215, 318.643040, 255.313989),
        (0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
    ),
}
FISHEYES = {
    "tum_vi": Camera.create(
        "equidistant", 512, 512, (190.97847, 190.97330, 254.93170, 256.89744), (0.00348, 0.00071, -0.00205, 0.00020)
    ),
    "plain": Camera.create("equidistant", 800, 600, (300.0, 310.0, 399.5, 299.5)),
}
SPHERES = {
    "tum_vi_ds": Camera.create("double_sphere", 512, 512, (158.28, 158.27, 254.96, 256.88), (-0.172, 0.593)),
    "wide_ds": Camera.create("double_sphere", 1280, 960, (313.2, 313.2, 638.7, 514.4), (0.2, 0.6)),
}
LENSES = PINHOLES | FISHEYES | SPHERES


def points_in_view(camera, count=400, seed=0, widest_rad=1.5):
    """(N, 3) points at 0.3 to 20 m whose pixels fall into the image."""
    rng = np.random.default_rng(seed)
    theta = rng.uniform(0.0, widest_rad, 20 * count)
    phi = rng.uniform(0.0, 2 * np.pi, 20 * count)
    rays = np.column_stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
    X = rays * rng.uniform(0.3, 20.0, (20 * count, 1))
    return X[camera.project(X)[1]][:count]


def lenses(group):
    return pytest.mark.parametrize("camera", group.values(), ids=group.keys())


@lenses(PINHOLES)
def test_radtan_projects_as_opencv(camera):
    X = points_in_view(camera)
    expected, _ = cv2.projectPoints(X, np.zeros(3), np.zeros(3), camera.K, np.array(camera.distortion))
    assert np.allclose(camera.project(X)[0], expected[:, 0], atol=PIXEL)


@lenses(FISHEYES)
def test_equidistant_projects_as_opencv(camera):
    X = points_in_view(camera)
    expected, _ = cv2.fisheye.projectPoints(X[:, None], np.zeros(3), np.zeros(3), camera.K, np.array(camera.distortion))
    assert np.allclose(camera.project(X)[0], expected[:, 0], atol=PIXEL)


@lenses(PINHOLES)
def test_radtan_unprojects_as_opencv(camera):
    px = camera.project(points_in_view(camera))[0]
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-14)
    if hasattr(cv2, "undistortPointsIter"):  # OpenCV 4's name for the one that takes criteria
        expected = cv2.undistortPointsIter(px[:, None], camera.K, np.array(camera.distortion), None, None, criteria)
    else:
        expected = cv2.undistortPoints(px[:, None], camera.K, np.array(camera.distortion), criteria=criteria)
    rays, seen = camera.unproject(px)
    assert seen.all()
    assert np.allclose(rays[:, :2] / rays[:, 2:], expected[:, 0], atol=1e-9)


@lenses(FISHEYES)
def test_equidistant_unprojects_as_opencv(camera):
    px = camera.project(points_in_view(camera, widest_rad=1.4))[0]
    expected = cv2.fisheye.undistortPoints(px[:, None], camera.K, np.array(camera.distortion))[:, 0]
    rays, seen = camera.unproject(px)
    assert seen.all()
    # OpenCV stops its iteration at 1e-8 rad; towards 90 degrees the tangent magnifies that
    assert np.allclose(rays[:, :2] / rays[:, 2:], expected, rtol=1e-6, atol=1e-6)


@lenses(SPHERES)
def test_double_sphere_projects_by_the_formulas_of_its_paper(camera):
    X = points_in_view(camera)
    x, y, z = X.T
    (xi, alpha), (fx, fy, cx, cy) = camera.distortion, camera.params[:4]
    d1 = np.linalg.norm(X, axis=1)
    d2 = np.sqrt(x**2 + y**2 + (xi * d1 + z) ** 2)
    n = alpha * d2 + (1 - alpha) * (xi * d1 + z)
    assert np.allclose(camera.project(X)[0], np.column_stack([fx * x / n + cx, fy * y / n + cy]), atol=PIXEL)


def test_double_sphere_of_half_alpha_is_the_stereographic_projection():
    camera = Camera.create("double_sphere", 800, 800, (200.0, 200.0, 399.5, 399.5), (0.0, 0.5))
    theta = np.linspace(0.0, 1.5, 50)
    X = 3.0 * np.column_stack([np.sin(theta), np.zeros(50), np.cos(theta)])
    assert np.allclose(camera.project(X)[0][:, 0] - 399.5, 200.0 * 2.0 * np.tan(theta / 2.0), atol=PIXEL)


@lenses(LENSES)
def test_unprojection_undoes_projection_up_to_depth(camera):
    X = points_in_view(camera, widest_rad=1.6)
    rays, seen = camera.unproject(camera.project(X)[0])
    assert seen.all()
    assert np.allclose(np.linalg.norm(rays, axis=1), 1.0, atol=1e-12)
    assert np.allclose(rays, X / np.linalg.norm(X, axis=1, keepdims=True), atol=1e-8)


@lenses(LENSES)
def test_projection_undoes_unprojection_over_the_whole_image(camera):
    v, u = np.mgrid[0 : camera.height : 20, 0 : camera.width : 20]
    px = np.column_stack([u.ravel(), v.ravel()]).astype(float)
    rays, seen = camera.unproject(px)
    assert seen.mean() > 0.75  # a fisheye has none in the corners
    again, visible = camera.project(5.0 * rays[seen])
    # a ray at the very limit of the lens may fall on either side of it
    assert visible.mean() > 0.99
    assert np.allclose(again[visible], px[seen][visible], atol=1e-7)


@lenses(LENSES)
def test_projection_jacobians_match_central_differences(camera):
    step = 1e-6
    for X in points_in_view(camera, 60, seed=1):
        J = np.empty((2, 3))
        u, v, seen = project_jacobian(camera.model, camera.params, *X, J)
        assert seen
        assert (u, v) == pytest.approx(project_point(camera.model, camera.params, *X)[:2], abs=PIXEL)
        ends = [
            [project_point(camera.model, camera.params, *(X + s * d))[:2] for s in (1, -1)] for d in step * np.eye(3)
        ]
        numeric = np.array([(np.array(a) - np.array(b)) / (2 * step) for a, b in ends]).T
        # pixels of 1000 at 1e-16 over a step of 1e-6: 1e-7 absolute, growing where the point is near
        assert np.allclose(J, numeric, rtol=1e-5, atol=1e-5)


@lenses(LENSES)
def test_jacobian_is_finite_on_the_axis(camera):
    J = np.empty((2, 3))
    u, v, seen = project_jacobian(camera.model, camera.params, 0.0, 0.0, 2.0, J)
    assert seen
    assert (u, v) == pytest.approx(tuple(camera.params[2:4]))
    assert np.isfinite(J).all()


def test_what_is_behind_a_pinhole_is_not_seen():
    X = np.array([[0.0, 0.0, -1.0], [0.1, 0.1, 0.0], [0.0, 0.0, 0.0]])
    for camera in LENSES.values():
        assert not camera.project(X)[1][[0, 2]].any()


def test_a_point_beyond_the_fold_of_a_distortion_is_not_seen():
    """Past its turning point a negative k1 folds the outside back into the image."""
    camera = Camera.create("radtan", 640, 480, (400.0, 400.0, 320.0, 240.0), (-0.3,))
    fold = np.sqrt(1.0 / 0.9)  # d/dr r (1 - 0.3 r^2) = 0
    X = np.array([[0.99 * fold, 0.0, 1.0], [1.01 * fold, 0.0, 1.0], [1.8, 0.0, 1.0]])
    assert camera.project(X)[1].tolist() == [True, False, False]


def test_a_pixel_beyond_the_fold_of_a_distortion_has_no_ray():
    camera = Camera.create("radtan", 2000, 480, (400.0, 400.0, 1000.0, 240.0), (-0.3,))
    reach_px = 400.0 * np.sqrt(1.0 / 0.9) * 2.0 / 3.0
    _, seen = camera.unproject(np.array([[1000.0 + 0.99 * reach_px, 240.0], [1000.0 + 1.05 * reach_px, 240.0]]))
    assert seen.tolist() == [True, False]


def test_the_image_reaches_half_a_pixel_beyond_its_outer_centres():
    camera = PINHOLES["ideal"]
    px = np.array([[-0.5, 0.0], [-0.51, 0.0], [639.49, 479.49], [639.5, 0.0], [0.0, 479.5]])
    assert camera.inside(px).tolist() == [True, False, True, False, False]
    assert camera.inside(px, margin_px=1.0).tolist() == [False] * 5


@lenses(LENSES)
def test_a_resized_camera_sees_a_point_where_its_resized_image_shows_it(camera):
    larger = camera.resized(1.5)
    X = points_in_view(camera, 50)
    px, seen = camera.project(X)
    share = np.array([larger.width / camera.width, larger.height / camera.height])
    np.testing.assert_allclose(larger.project(X)[0][seen], (px[seen] + 0.5) * share - 0.5, atol=1e-9)
    assert larger.project(X)[1].tolist() == seen.tolist()


@pytest.mark.parametrize(
    ("model", "size", "intrinsics", "distortion", "says"),
    [
        ("radtan", (640, 480), (float("nan"), 1.0, 0.0, 0.0), (), "finite"),
        ("radtan", (640, 480), (-500.0, 500.0, 320.0, 240.0), (), "positive"),
        ("radtan", (0, 480), (500.0, 500.0, 320.0, 240.0), (), "size"),
        ("radtan", (640, 480), (500.0, 500.0, 320.0, 240.0), (0.1,) * 6, "at most 5"),
        ("fisheye9", (640, 480), (500.0, 500.0, 320.0, 240.0), (), "unknown"),
        ("double_sphere", (640, 480), (500.0, 500.0, 320.0, 240.0), (0.1, 1.5), "alpha"),
        ("equidistant", (640, 480), (500.0, 500.0, 320.0, 240.0), (float("inf"),), "finite"),
    ],
)
def test_a_lens_that_cannot_be_is_refused(model, size, intrinsics, distortion, says):
    with pytest.raises(CalibrationError, match=says):
        Camera.create(model, *size, intrinsics, distortion)
