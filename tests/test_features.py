"""Corners, descriptors, matches and depths against plain numpy, OpenCV and exact geometry."""

import cv2
import numpy as np
import pytest

from conftest import shared_data
from lodelight.features.corners import find_corners, strengths
from lodelight.features.depth import depth_at
from lodelight.features.epipolar import match_epipolar
from lodelight.features.features import Features
from lodelight.features.frontend import FrontEnd
from lodelight.features.hamming import hamming
from lodelight.features.matching import FeatureIndex, consistent_turn, match_descriptors
from lodelight.features.orb import OrbConfig, OrbExtractor, refine_corners
from lodelight.features.stereo import StereoMatcher
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.messages import Frame
from lodelight.rig import CameraSpec, DepthSpec, Rig


def textured(seed, height=480, width=640):
    """Random blobs at several scales: corners everywhere."""
    rng = np.random.default_rng(seed)
    image = np.zeros((height, width), np.float32)
    for scale in (4, 8, 16, 32):
        noise = rng.normal(size=(height // scale + 2, width // scale + 2)).astype(np.float32)
        image += cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)
    return cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def camera(width=640, height=480, focal=500.0):
    return Camera.create("radtan", width, height, (focal, focal, (width - 1) / 2, (height - 1) / 2))


def random_features(rng, n, camera=None):
    px = rng.uniform(0, [640, 480], (n, 2)).astype(np.float32)
    ray = camera.unproject(px)[0] if camera else np.zeros((n, 3))
    return Features(
        px, rng.integers(0, 8, n).astype(np.int32), rng.uniform(-3, 3, n).astype(np.float32),
        rng.integers(0, 2**64, (n, 4), dtype=np.uint64), ray, np.zeros(n, np.float32), np.zeros(n, np.float32),
    )  # fmt: skip


def popcount(a, b):
    return (
        np.bitwise_count(a ^ b).sum(axis=-1).astype(int)
        if hasattr(np, "bitwise_count")
        else np.array([sum(bin(int(w)).count("1") for w in row) for row in np.atleast_2d(a ^ b)])
    )


def test_hamming_counts_differing_bits():
    rng = np.random.default_rng(0)
    for _ in range(20):
        a, b = rng.integers(0, 2**64, (2, 4), dtype=np.uint64)
        assert hamming(a, b) == int(popcount(a, b).sum())
    assert hamming(a, a) == 0
    assert hamming(a, ~a) == 256


@pytest.mark.parametrize("size", [(640, 480), (752, 480), (320, 240), (1280, 960)])
def test_corners_are_spread_over_image_and_scales(size):
    extractor = OrbExtractor(camera(*size))
    seen = extractor.extract(extractor.pyramid(textured(1, size[1], size[0])))
    cells = np.zeros((6, 8), bool)
    cells[(seen.px[:, 1] * 6 / size[1]).astype(int), (seen.px[:, 0] * 8 / size[0]).astype(int)] = True
    assert 900 <= len(seen) <= 1010
    assert cells.all()
    assert len(np.unique(seen.octave)) == min(8, len(extractor.pyramid(textured(1, size[1], size[0]))))


@pytest.mark.parametrize("threshold", [5, 7, 40])
def test_corners_are_those_of_fast_the_best_of_every_cell_first(threshold):
    quota, border = 150, 17
    image = cv2.GaussianBlur(textured(4, 240, 376), (0, 0), 1.0)
    image[:, 200:] //= 6  # faint, where cells have few or none
    inside = image[border:-border, border:-border]
    found = cv2.FastFeatureDetector.create(threshold, True).detect(inside)
    strength = strengths(image, border + 3)
    cell_px, ranked, taken = np.sqrt(inside.size / quota), [], {}
    for corner in sorted(found, key=lambda c: -c.response):  # stable: row by row where alike
        x, y = (int(v) for v in corner.pt)
        assert strength[y + border, x + border] == corner.response + 1
        cell = (int(x / cell_px), int(y / cell_px))
        taken[cell] = taken.get(cell, -1) + 1
        ranked.append((taken[cell], x + border, y + border))
    wanted = [corner[1:] for corner in sorted(ranked, key=lambda r: r[0])][:quota]
    np.testing.assert_array_equal(find_corners(image, quota, threshold, border), wanted)
    assert len(wanted) == (quota if threshold < 40 else len(found))


def test_blank_image_has_no_corner_and_breaks_nothing():
    extractor = OrbExtractor(camera())
    assert len(extractor.extract(extractor.pyramid(np.full((480, 640), 90, np.uint8)))) == 0


def test_corner_refinement_removes_most_of_what_rounding_to_pixels_costs():
    errors = []
    for dx, dy in np.random.default_rng(0).uniform(-0.45, 0.45, (30, 2)):
        big = np.kron([[0, 1], [1, 0]], np.ones((320, 320))).astype(np.float32) * 200 + 20
        shift = np.float32([[1 / 16, 0, 20 + dx - 319.5 / 16], [0, 1 / 16, 20 + dy - 319.5 / 16]])
        image = cv2.warpAffine(cv2.GaussianBlur(big, (0, 0), 12), shift, (41, 41), borderMode=cv2.BORDER_REPLICATE)
        errors.append(refine_corners(image.astype(np.uint8), np.array([[20, 20]], np.int32))[0] - [20 + dx, 20 + dy])
    assert np.abs(errors).max() < 0.15  # of up to 0.45; one step, with a window that is not centred anew


def test_descriptors_survive_a_turn_of_the_camera():
    image = textured(2, 640, 640)
    turned = cv2.warpAffine(image, cv2.getRotationMatrix2D((319.5, 319.5), 37.0, 1.0), (640, 640))
    extractor = OrbExtractor(camera(640, 640))
    a, b = (extractor.extract(extractor.pyramid(i)) for i in (image, turned))
    match = match_descriptors(a.desc, b.desc)
    hit = np.flatnonzero(match >= 0)
    M = cv2.getRotationMatrix2D((319.5, 319.5), 37.0, 1.0)
    error = np.linalg.norm(a.px[hit] @ M[:, :2].T + M[:, 2] - b.px[match[hit]], axis=1)
    assert len(hit) > 150
    assert np.mean(error < 3.0 * 1.2 ** a.octave[hit]) > 0.95
    assert consistent_turn(a.angle[hit], b.angle[match[hit]]).mean() > 0.9


def test_search_near_a_pixel_equals_its_numpy_twin():
    rng = np.random.default_rng(3)
    features, query = random_features(rng, 400), random_features(rng, 60)
    radius = rng.uniform(20, 80, 60)
    low, high = query.octave - 1, query.octave + 1
    got = FeatureIndex(features, 640, 480).search(
        query.px.astype(float), radius, (low, high), query.desc, max_hamming=140
    )
    wanted = np.full(60, -1)
    owner = {}
    for i in range(60):
        near = np.linalg.norm(features.px - query.px[i], axis=1) <= radius[i]
        near &= (features.octave >= low[i]) & (features.octave <= high[i])
        if near.any():
            distance = np.where(near, popcount(features.desc, query.desc[i]), 999)
            j = int(distance.argmin())
            if distance[j] <= 140 and (j not in owner or distance[j] < owner[j][1]):
                if j in owner:
                    wanted[owner[j][0]] = -1
                owner[j], wanted[i] = (i, distance[j]), j
    # random descriptors tie now and then: the feature may differ, the distance may not
    both = (got >= 0) & (wanted >= 0)
    assert np.mean((got >= 0) == (wanted >= 0)) > 0.95
    assert np.mean(got[both] == wanted[both]) > 0.9


def test_match_descriptors_is_mutual_and_passes_the_ratio_test():
    rng = np.random.default_rng(4)
    train = rng.integers(0, 2**64, (300, 4), dtype=np.uint64)
    order = rng.permutation(300)[:100]
    query = train[order] ^ np.uint64(5)  # 8 bits off
    assert np.array_equal(match_descriptors(query, train), order)
    assert (match_descriptors(rng.integers(0, 2**64, (50, 4), dtype=np.uint64), train) == -1).all()
    assert len(match_descriptors(train[:0], train)) == 0


def test_epipolar_matches_lie_on_the_plane_and_are_the_true_ones():
    rng = np.random.default_rng(5)
    cam, T_b_a = camera(), SE3.exp(np.array([0.02, -0.1, 0.03, 0.4, 0.05, -0.02]))
    X = rng.uniform([-2, -1.5, 3], [2, 1.5, 8], (300, 3))
    pa, ok_a = cam.project(X)
    pb, ok_b = cam.project(T_b_a @ X)
    both = ok_a & ok_b
    a = random_features(rng, int(both.sum()))
    a = Features(
        pa[both].astype(np.float32), a.octave * 0, a.angle, a.desc, cam.unproject(pa[both])[0], *[a.inv_depth] * 2
    )
    shuffled = rng.permutation(len(a))
    pb = (pb[both] + rng.normal(0, 0.5, (len(a), 2)))[shuffled]
    b = Features(
        pb.astype(np.float32),
        a.octave,
        a.angle,
        a.desc[shuffled] ^ np.uint64(3),
        cam.unproject(pb)[0],
        *[a.inv_depth] * 2,
    )
    match = match_epipolar(a, b, T_b_a, np.full(len(b), 1 / 500))
    hit = match >= 0
    assert hit.mean() > 0.85
    assert np.array_equal(shuffled[match[hit]], np.flatnonzero(hit))


def test_depth_is_read_at_the_corner_and_doubted_at_a_rim():
    depth = np.full((480, 640), 2.0, np.float32)
    depth[:, 320:] = 4.0
    depth[100:110, 100:110] = 0.0
    rng = np.random.default_rng(6)
    seen = random_features(rng, 3, camera())
    seen.px[:] = [[50, 200], [319, 200], [105, 105]]
    spec = DepthSpec(camera(), SE3.identity())
    got = seen.with_depth(*depth_at(seen.px, depth, spec))
    assert got.inv_depth[:2] == pytest.approx([0.5, 0.5])
    assert got.inv_depth[2] == 0
    assert got.sigma_inv_depth[0] * 4 == pytest.approx(np.hypot(0.0012 + 0.0019 * 1.6**2, 0.005 * 2), rel=1e-3)
    assert got.sigma_inv_depth[1] * 4 > 0.9


@pytest.mark.parametrize("none", [np.nan, np.inf, -1.0])
def test_what_is_no_depth_is_no_reading_and_makes_no_rim(none):
    cam = camera()
    seen = random_features(np.random.default_rng(0), 2, cam)
    seen.px[:] = [[100.0, 100.0], [300.0, 200.0]]
    depth = np.full((480, 640), 2.0, np.float32)
    flat = seen.with_depth(*depth_at(seen.px, depth, DepthSpec(cam, SE3.identity())))
    depth[100, 100] = depth[200, 301] = none
    got = seen.with_depth(*depth_at(seen.px, depth, DepthSpec(cam, SE3.identity())))
    assert got.inv_depth.tolist() == [0.0, 0.5]
    assert got.sigma_inv_depth.tolist() == [0.0, flat.sigma_inv_depth[1]]


def plane_pair(right, T_right_left, z):
    """A textured wall at z m seen by a pinhole left camera and any right camera."""
    left = camera()
    wall = textured(7, 1200, 1600)
    to_wall = lambda X: np.stack([X[..., 0] * 180 + 800, X[..., 1] * 180 + 600], axis=-1).astype(np.float32)  # noqa: E731

    def render(cam, T_left_cam):
        v, u = np.mgrid[0 : cam.height, 0 : cam.width]
        ray, _ = cam.unproject(np.stack([u, v], -1).reshape(-1, 2).astype(float))
        ray, origin = ray @ T_left_cam.R.T, T_left_cam.t
        X = origin + ray * ((z - origin[2]) / ray[:, 2:])
        at = to_wall(X).reshape(cam.height, cam.width, 2)
        return cv2.remap(wall, at[..., 0], at[..., 1], cv2.INTER_LINEAR)

    return left, render(left, SE3.identity()), render(right, T_right_left.inverse())


@pytest.mark.parametrize(
    ("model", "distortion", "turn"),
    [("radtan", (), (0, 0, 0)), ("radtan", (-0.28, 0.07, 2e-4, 1e-5), (0.01, -0.02, 0.015)),
     ("equidistant", (-0.01, 0.02, -0.01, 0.002), (0.0, 0.03, -0.02))],
)  # fmt: skip
def test_stereo_depth_is_exact_to_a_fifth_of_a_pixel_for_any_lens_and_turn(model, distortion, turn):
    right = Camera.create(model, 640, 480, (480.0, 482.0, 322.0, 236.0), distortion)
    T_right_left = SE3.exp(np.array([*turn, -0.12, 0.002, 0.001]))
    z = 3.0
    left, image, other = plane_pair(right, T_right_left, z)
    matcher = StereoMatcher(
        CameraSpec("cam0", left, SE3.identity()), CameraSpec("cam1", right, T_right_left.inverse()), OrbConfig()
    )
    extractor = OrbExtractor(left)
    pyramid = extractor.pyramid(image)
    got = matcher.measure(extractor.extract(pyramid), pyramid, other)
    measured = got.inv_depth > 0
    disparity_error = (got.inv_depth[measured] - 1 / z) * 500 * 0.12 / 1.2 ** got.octave[measured]
    assert measured.sum() > len(got) / 3
    assert np.median(np.abs(disparity_error)) < 0.2
    assert np.mean(np.abs(disparity_error) < 1.0) > 0.95
    pulls = (got.inv_depth[measured] - 1 / z) / got.sigma_inv_depth[measured]
    assert np.median(np.abs(pulls)) < 1.0


def test_stereo_of_a_real_drone_agrees_with_semi_global_matching():
    from lodelight.io import open_source

    recording = open_source(shared_data("euroc_v1_01"))
    frame = next(iter(recording.messages("stereo")))
    got = FrontEnd(recording.rig, "stereo", OrbConfig()).process(frame)
    a, b = recording.rig.cameras[:2]
    T = b.T_body_cam.inverse() @ a.T_body_cam
    da, db = np.array(a.camera.distortion), np.array(b.camera.distortion)
    size = (a.camera.width, a.camera.height)
    R1, R2, P1, P2, *_ = cv2.stereoRectify(a.camera.K, da, b.camera.K, db, size, T.R, T.t.reshape(3, 1), alpha=0)
    maps = [cv2.initUndistortRectifyMap(c.K, d, R, P, size, cv2.CV_32F)
            for c, d, R, P in ((a.camera, da, R1, P1), (b.camera, db, R2, P2))]  # fmt: skip
    left, right = (cv2.remap(i, *m, cv2.INTER_LINEAR) for i, m in zip(frame.images, maps, strict=True))
    dense = cv2.StereoSGBM.create(0, 96, 7, 200, 800).compute(left, right) / 16.0
    known = got.inv_depth > 0
    px = cv2.undistortPoints(got.px[known].reshape(-1, 1, 2).astype(float), a.camera.K, da, R=R1, P=P1).reshape(-1, 2)
    X = (got.ray[known] / (got.ray[known][:, 2:] * got.inv_depth[known][:, None])) @ R1.T
    u, v = np.rint(px).astype(int).T
    inside = (u >= 0) & (u < size[0]) & (v >= 0) & (v < size[1])
    other = dense[v[inside], u[inside]]
    error = (-P2[0, 3] / X[inside, 2] - other)[other > 0]
    assert len(error) > 200
    assert np.median(np.abs(error)) < 0.6  # SGBM itself is good to about half a pixel
    assert np.mean(np.abs(error) > 2.0) < 0.15


def test_corners_of_an_enlarged_image_lie_in_the_same_directions_at_the_same_depths():
    lens, image = Camera.create("radtan", 320, 240, (200.0, 200.0, 159.5, 119.5)), textured(3, 240, 320)
    depth = np.where(np.arange(320) < 160, 2.0, 4.0).astype(np.float32) * np.ones((240, 1), np.float32)
    rig = Rig((CameraSpec("cam0", lens, SE3.identity(), row_time_s=1e-4),), DepthSpec(lens, SE3.identity()))
    as_taken, enlarged = (FrontEnd(rig, "rgbd", OrbConfig(), factor) for factor in (1.0, 2.0))
    seen, more = (front.process(Frame(0, (image,), depth)) for front in (as_taken, enlarged))
    np.testing.assert_allclose(enlarged.rig.cameras[0].camera.project(more.ray)[0], more.px, atol=1e-3)
    off_px = lens.project(more.ray)[0][:, None] - seen.px[seen.octave == 0][None]
    nearest = np.take_along_axis(off_px, np.linalg.norm(off_px, axis=2).argmin(axis=0)[None, :, None], axis=0)[0]
    nearest = nearest[np.linalg.norm(nearest, axis=1) < 1.0]  # of the others, no corner was taken there
    assert len(nearest) > 0.6 * np.count_nonzero(seen.octave == 0)
    assert np.abs(np.median(nearest, axis=0)).max() < 0.1  # half a pixel of the enlarged image would be 0.25
    side = lens.project(more.ray)[0][:, 0]
    clear = np.abs(side - 159.5) > 3.0
    np.testing.assert_allclose(more.inv_depth[clear], np.where(side[clear] < 159.5, 0.5, 0.25), rtol=1e-6)
    rows = enlarged.rig.cameras[0]
    assert rows.row_time_s * rows.camera.height == pytest.approx(1e-4 * 240)


def test_an_image_of_another_size_than_the_rig_says_is_named():
    from lodelight.errors import SourceError

    rig = Rig((CameraSpec("cam0", camera(), SE3.identity()),))
    with pytest.raises(SourceError, match="320x240"):
        FrontEnd(rig, "mono", OrbConfig()).process(Frame(0, (np.zeros((240, 320), np.uint8),)))
