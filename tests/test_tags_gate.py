"""Tags that hang elsewhere, twice, or were misread: none may hold the pose, all are named within three frames."""

from dataclasses import replace

import numpy as np
import pytest

from lodelight.anchors import Tag, tag_corners
from lodelight.geometry.se3 import SE3
from lodelight.messages import TagSighting
from lodelight.rig import CameraSpec
from lodelight.tags.corners import corner_jacobians
from lodelight.tags.gate import TagGate, _covariance_of_pose
from lodelight.tags.pose import tag_poses
from lodelight.tags.survey import MappedTag, TagView, map_tag
from tag_scenes import EUROC, FISHEYE

SPEC = CameraSpec("cam0", EUROC, SE3.exp(np.array([0.3, -1.2, 0.4, 0.1, -0.05, 0.02])))
UPRIGHT = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # on a wall at the end of x, seen along x


def scene(rng, n=1, size_m=0.2):
    """A camera, and tags that face it, all in view: T_world_body and Tags."""
    T_world_cam = SE3(UPRIGHT @ SE3.exp(np.array([*rng.normal(0, 0.1, 3), 0, 0, 0])).R, rng.uniform(-5, 5, 3))
    tags = []
    while len(tags) < n:
        z = rng.uniform(0.9, 2.8)
        xyz = np.array([rng.uniform(-0.45, 0.45) * z, rng.uniform(-0.25, 0.25) * z, z])
        T_cam_tag = SE3.exp(np.array([*rng.normal(0, (0.1, 0.45, 0.1)), *xyz]))
        _, inside = EUROC.project(T_cam_tag @ tag_corners(size_m))
        if inside.all() and T_cam_tag.R[:, 2] @ xyz > 0.3 * z:
            tags.append(Tag("tag36h11", str(len(tags)), size_m, T_world_cam @ T_cam_tag))
    return T_world_cam @ SPEC.T_body_cam.inverse(), tags


def sight(T_world_body, tag, rng, t_ns=0, sigma_px=0.3):
    px, inside = EUROC.project((T_world_body @ SPEC.T_body_cam).inverse() @ tag.corners_world)
    noisy = px + sigma_px * rng.standard_normal((4, 2))
    return TagSighting(t_ns, tag.family, tag.id, noisy, np.full(4, sigma_px)) if inside.all() else None


PREDICTED = np.diag([0.006**2] * 3 + [0.03**2] * 3)


def predicted(T, rng):
    return T.perturbed(np.sqrt(np.diag(PREDICTED)) * rng.standard_normal(6))


@pytest.mark.parametrize("camera", [EUROC, FISHEYE], ids=["radtan", "equidistant"])
def test_jacobians_of_corners_match_central_differences(camera):
    rng = np.random.default_rng(0)
    T_body, (tag,) = scene(rng)
    args = camera, SPEC.T_body_cam
    _, J_body, J_tag = corner_jacobians(*args, T_body, tag.T_world_tag, tag_corners(0.2))
    eps = 1e-6
    for k in range(6):
        d = np.zeros(6)
        d[k] = eps
        up = corner_jacobians(*args, T_body.perturbed(d), tag.T_world_tag, tag_corners(0.2))[0]
        down = corner_jacobians(*args, T_body.perturbed(-d), tag.T_world_tag, tag_corners(0.2))[0]
        assert (up - down).ravel() / (2 * eps) == pytest.approx(J_body[:, k], rel=1e-5, abs=1e-3)
        up = corner_jacobians(*args, T_body, tag.T_world_tag.perturbed(d), tag_corners(0.2))[0]
        down = corner_jacobians(*args, T_body, tag.T_world_tag.perturbed(-d), tag_corners(0.2))[0]
        assert (up - down).ravel() / (2 * eps) == pytest.approx(J_tag[:, k], rel=1e-5, abs=1e-3)


def test_covariance_of_the_camera_by_a_tag_matches_samples():
    rng = np.random.default_rng(1)
    T_body, (tag,) = scene(rng)
    T_cam_tag = (T_body @ SPEC.T_body_cam).inverse() @ tag.T_world_tag
    of_tag, of_sight = np.diag([1e-4, 2e-4, 3e-4, 1e-4, 4e-4, 1e-4]), np.diag([2e-4, 1e-4, 1e-4, 1e-4, 1e-4, 9e-4])
    T = tag.T_world_tag @ T_cam_tag.inverse()
    samples = []
    for _ in range(4000):
        a = tag.T_world_tag.perturbed(np.sqrt(np.diag(of_tag)) * rng.standard_normal(6))
        b = T_cam_tag.perturbed(np.sqrt(np.diag(of_sight)) * rng.standard_normal(6))
        there = a @ b.inverse()
        samples.append(np.concatenate([(T.inverse() @ there).log()[:3], there.t - T.t]))
    expected = _covariance_of_pose(of_sight, of_tag, tag.T_world_tag, T_cam_tag)
    assert np.cov(np.array(samples).T) == pytest.approx(expected, abs=0.08 * np.diag(expected).max())


def test_true_tags_pass():
    rng = np.random.default_rng(2)
    kinds = []
    for _ in range(400):
        T, (tag,) = scene(rng)
        survey = replace(tag, T_world_tag=tag.T_world_tag.perturbed(np.r_[np.zeros(3), 0.005 * rng.standard_normal(3)]))
        (verdict,) = TagGate([survey]).judge([sight(T, tag, rng)], SPEC, predicted(T, rng), PREDICTED)
        kinds.append(verdict.kind)
    assert kinds.count("agrees") >= 0.99 * len(kinds)


@pytest.mark.parametrize("kind", ["moved", "duplicated", "misread"])
def test_no_wrong_tag_is_accepted_and_each_is_named_within_three_frames(kind):
    rng = np.random.default_rng(3)
    trials = 0
    while trials < 334:
        T, tags = scene(rng, 3)
        wrong = tags[0]
        if kind == "moved":
            way = rng.normal(0, 1, 3)
            survey = replace(
                wrong, T_world_tag=SE3(wrong.T_world_tag.R, wrong.T_world_tag.t + way / np.linalg.norm(way))
            )
        elif kind == "duplicated":  # the surveyed copy hangs somewhere else in the building
            turn = rng.uniform(-np.pi, np.pi)
            away = SE3.exp(np.array([0, 0, turn, *rng.uniform(-8, 8, 3)]))
            survey = replace(wrong, T_world_tag=away @ wrong.T_world_tag)
        else:
            if np.linalg.norm(tags[1].T_world_tag.t - wrong.T_world_tag.t) < 0.3:
                continue  # sheets of paper do not overlap
            survey = replace(tags[1], id=wrong.id)
        trials += 1
        told = []
        gate = TagGate([survey, *tags[2:]], on_event=lambda t_ns, what, **fields: told.append((t_ns, fields)))  # noqa: B023
        for frame in range(3):
            guess = predicted(T, rng)
            seen = [s for s in (sight(T, tag, rng, frame) for tag in (wrong, tags[2])) if s]
            verdicts = {v.sighting.id: v for v in gate.judge(seen, SPEC, guess, PREDICTED)}
            assert not verdicts[wrong.id].usable
        assert [fields["tag"] for _, fields in told].count("tag36h11 0") == 1
        assert "tag36h11 0" in gate.named


def test_two_copies_in_one_image_are_refused():
    rng = np.random.default_rng(4)
    T, tags = scene(rng, 2)
    seen = [sight(T, tags[0], rng), sight(T, replace(tags[1], id="0"), rng)]
    verdicts = TagGate(tags[:1]).judge(seen, SPEC, T, PREDICTED)
    assert [v.kind for v in verdicts] == ["contradicts", "contradicts"]
    assert "twice" in verdicts[0].why


def test_two_tags_that_agree_with_each_other_correct_the_prediction():
    rng = np.random.default_rng(5)
    right = 0
    for _ in range(60):
        T, tags = scene(rng, 2, size_m=0.3)
        drifted = T.perturbed(np.array([0.02, 0.05, 0.01, 0.5, -0.4, 0.1]))
        kinds = [v.kind for v in TagGate(tags).judge([sight(T, t, rng) for t in tags], SPEC, drifted, PREDICTED)]
        assert "agrees" not in kinds
        right += kinds[1] == "corrects"
    assert right > 40


def test_claims_of_a_payload_are_held_against_the_survey():
    rng = np.random.default_rng(6)
    T, (tag,) = scene(rng)
    s = sight(T, tag, rng)
    gate = TagGate([tag])
    assert gate.judge([replace(s, size_m=0.2)], SPEC, T, PREDICTED)[0].usable
    assert "large" in gate.judge([replace(s, size_m=0.3)], SPEC, T, PREDICTED)[0].why
    moved = replace(s, size_m=0.2, T_world_tag=SE3(tag.T_world_tag.R, tag.T_world_tag.t + np.array([1.0, 0, 0])))
    assert "1.00 m" in gate.judge([moved], SPEC, T, PREDICTED)[0].why
    stranger = TagGate().judge([s], SPEC, T, PREDICTED)[0]
    assert (stranger.kind, stranger.usable) == ("unsized", False)
    newcomer = TagGate().judge([replace(s, size_m=0.2)], SPEC, T, PREDICTED)[0]
    assert newcomer.kind == "new"


def walk_past(tag, rng, n=8, sigma_px=0.3, T_of=lambda T: T, ids=None):
    """Views of a tag from n places within a metre."""
    views = []
    while len(views) < n:
        at = tag.T_world_tag @ np.array([rng.uniform(-1, 1), rng.uniform(-0.2, 0.2), -rng.uniform(1.2, 3.0)])
        look = tag.T_world_tag.R @ SE3.exp(np.array([*rng.normal(0, 0.1, 3), 0, 0, 0])).R
        T_world_cam = SE3(look, at)
        px, inside = EUROC.project(T_world_cam.inverse() @ tag.corners_world)
        if inside.all():
            noisy = px + sigma_px * rng.standard_normal((4, 2))
            views.append(TagView(TagSighting(len(views), tag.family, tag.id, noisy, np.full(4, sigma_px)), T_world_cam))
    return views


def test_mapped_tags_are_where_they_hang_and_never_flipped():
    rng = np.random.default_rng(7)
    nees, mapped = [], 0
    for _ in range(50):
        _, (tag,) = scene(rng, size_m=0.16)
        found = map_tag(walk_past(tag, rng), 0.16, EUROC)
        if isinstance(found, MappedTag):
            mapped += 1
            d = np.concatenate(
                [(found.T_world_tag.inverse() @ tag.T_world_tag).log()[:3], tag.T_world_tag.t - found.T_world_tag.t]
            )
            assert np.linalg.norm(d[:3]) < np.radians(12.0)  # a flip is tens of degrees
            assert np.linalg.norm(d[3:]) < 0.05
            nees.append(d @ np.linalg.solve(found.covariance, d) / 6)
    assert mapped > 35
    assert 0.4 < np.mean(nees) < 1.2  # model_px makes it cautious


def test_a_single_far_and_square_view_is_not_mapped():
    rng = np.random.default_rng(8)
    _, (tag,) = scene(rng, size_m=0.1)
    same = walk_past(tag, rng, 1)[0]
    assert not isinstance(map_tag([same], 0.1, EUROC), MappedTag)


def test_a_tag_that_was_moved_between_its_views_is_not_mapped():
    rng = np.random.default_rng(9)
    for _ in range(8):
        _, (tag,) = scene(rng)
        other = replace(
            tag, T_world_tag=SE3(tag.T_world_tag.R, tag.T_world_tag.t + tag.T_world_tag.R @ [0.5, 0.0, 0.0])
        )
        refused = map_tag([*walk_past(tag, rng, 5), *walk_past(other, rng, 5)], 0.2, EUROC)
        assert not isinstance(refused, MappedTag)
        outvoted = map_tag([*walk_past(tag, rng, 8), *walk_past(other, rng, 2)], 0.2, EUROC)
        if isinstance(outvoted, MappedTag):
            assert np.linalg.norm(outvoted.T_world_tag.t - tag.T_world_tag.t) < 0.05
            assert not outvoted.agrees[8:].any()


def test_poses_of_noise_are_refused_when_nothing_is_seen():
    behind = TagSighting(0, "qr", "A", np.array([[1.0, 1], [1, 1], [1, 1], [1, 1]]), np.full(4, 0.3))
    assert len(tag_poses(behind, 0.2, EUROC)) <= 2
