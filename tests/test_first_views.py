"""A map begun by one camera: what makes one, what cannot, and how large it is."""

import numpy as np
import pytest

from conftest import shared_data
from lodelight.errors import ConfigError
from lodelight.evaluation.associate import matched
from lodelight.evaluation.ate import ate
from lodelight.features.features import Features
from lodelight.features.orb import OrbConfig
from lodelight.geometry.se3 import SE3
from lodelight.io import open_source
from lodelight.mapping.first_views import SUPPOSED_M, Begun, FirstView, FirstViews, FirstViewsConfig
from lodelight.messages import Frame, TagSighting
from lodelight.slam import Slam, SlamConfig
from maps import room_points, room_rig

TAG_M = 0.3
# On a wall that faces the camera; from the lower left as one reads it, and y points to the left.
TAG = np.array([[4.9, y, z] for y, z in [(1 + TAG_M, 1.0), (1.0, 1.0), (1.0, 1 + TAG_M), (1 + TAG_M, 1 + TAG_M)]])


class Scene:
    """Points before a camera that looks along x, each with a descriptor of its own; half a pixel of noise."""

    def __init__(self, xyz, seed, wrong=0.1):
        self.rig, self.xyz, self.wrong = room_rig(), xyz, wrong
        self.rng = np.random.default_rng(seed)
        self.desc = self.rng.integers(0, 2**64, (len(xyz), 4), dtype=np.uint64)
        self.angle = self.rng.uniform(-np.pi, np.pi, len(xyz)).astype(np.float32)

    def view(self, T_world_body):
        spec = self.rig.cameras[0]
        px, inside = spec.camera.project((T_world_body @ spec.T_body_cam).inverse() @ self.xyz)
        seen = np.flatnonzero(inside & spec.camera.inside(px))
        px = px[seen] + self.rng.normal(0, 0.5, (len(seen), 2))
        lost = self.rng.random(len(seen)) < self.wrong  # these are some other corner's neighbour
        px[lost] += self.rng.uniform(-30, 30, (np.count_nonzero(lost), 2))
        none = np.zeros(len(seen), np.float32)
        ray, _ = spec.camera.unproject(px)
        octave = np.zeros(len(seen), np.int32)
        return Features(px.astype(np.float32), octave, self.angle[seen], self.desc[seen], ray, none, none)

    def tag(self, T_world_body):
        spec = self.rig.cameras[0]
        px, _ = spec.camera.project((T_world_body @ spec.T_body_cam).inverse() @ TAG)
        return TagSighting(0, "qr", "A1", px + self.rng.normal(0, 0.2, px.shape), np.full(4, 0.2), size_m=TAG_M)


def room(seed, n=800):
    return room_points(np.random.default_rng(seed), n)


def wall(seed, n=500):
    rng = np.random.default_rng(seed)
    return np.column_stack([np.full(n, 5.0), rng.uniform(0, 4, n), rng.uniform(0, 2.5, n)])


def at(x=1.0, y=2.0, yaw=0.0):
    return SE3.exp(np.array([0.0, 0.0, yaw, x, y, 1.2]))


def feed(scene, poses, with_tag=False):
    """What the views say, up to the one that makes a map; and how many there were."""
    first = FirstViews(scene.rig.cameras[0], OrbConfig(), 1.0, FirstViewsConfig())
    said = []
    for k, T in enumerate(poses):
        said.append(first.feed(k, scene.view(T), [scene.tag(T)] if with_tag else []))
        if isinstance(said[-1], Begun):
            break
    return said


SIDEWAYS = [at(y=2.0 + 0.03 * k, yaw=0.005 * k) for k in range(30)]


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("way", ["sideways", "ahead"])
def test_a_camera_that_moves_begins_a_map_of_the_right_shape(seed, way):
    poses = SIDEWAYS if way == "sideways" else [at(x=1.0 + 0.04 * k, yaw=0.004 * k) for k in range(40)]
    begun = feed(Scene(room(seed), seed), poses)[-1]
    assert isinstance(begun, Begun)
    assert not begun.metric
    spec = room_rig().cameras[0]
    distance = np.linalg.norm(begun.xyz - spec.T_body_cam.t, axis=1)
    assert np.median(distance) == pytest.approx(SUPPOSED_M)
    last = begun.views[-1]
    true = poses[0].inverse() @ poses[last.t_ns]
    assert (true.inverse() @ last.T_world_body).angle < np.radians(0.5)
    # Cameras, not bodies: only their way scales.
    way_true = (true @ spec.T_body_cam).t - spec.T_body_cam.t
    way_here = (last.T_world_body @ spec.T_body_cam).t - spec.T_body_cam.t
    cosine = way_true @ way_here / np.linalg.norm(way_true) / np.linalg.norm(way_here)
    assert cosine > np.cos(np.radians(6.0))


@pytest.mark.parametrize(("misfit", "waits"), [(400.0, True), (990.0, True), (1100.0, False)])
def test_a_motion_that_lacks_parallax_yet_contests_one_that_fits_no_better(monkeypatch, misfit, waits):
    scene = Scene(room(0), 0)
    first = FirstViews(scene.rig.cameras[0], OrbConfig(), 1.0, FirstViewsConfig())
    made = []
    for way, fit, lacks in (((0.0, 1.0, 0.0), 1000.0, ""), ((1.0, 0.0, 0.0), misfit, "12 points have parallax enough")):
        there = SE3.identity(), SE3(np.eye(3), np.array(way))
        views = [FirstView(k, scene.view(at()), (), T, np.zeros(0, int)) for k, T in enumerate(there)]
        made.append(Begun(views, np.zeros((0, 3)), False, fit, lacks))
    monkeypatch.setattr(first, "_motions", lambda there, here: ([SE3.identity()] * 2, 0.0))
    monkeypatch.setattr(first, "_made_by", lambda *args: made.pop(0))
    first.feed(0, scene.view(at()))
    assert isinstance(first.feed(1, scene.view(at(y=2.1))), str) == waits


@pytest.mark.parametrize("seed", range(5))
def test_a_camera_that_only_turns_begins_none(seed):
    said = feed(Scene(room(seed), seed), [at(yaw=0.01 * k) for k in range(40)])
    assert all(isinstance(s, str) for s in said)
    assert "move sideways" in said[-1]


@pytest.mark.parametrize("seed", range(3))
def test_what_is_flat_begins_none(seed):
    said = feed(Scene(wall(seed), seed), SIDEWAYS)
    assert all(isinstance(s, str) for s in said)


def test_too_few_corners_begin_anew_and_say_so():
    said = feed(Scene(room(0, n=60), 0), SIDEWAYS[:4])
    assert "100 are needed; begun anew" in said[-1]


@pytest.mark.parametrize("seed", range(3))
def test_a_tag_of_known_size_gives_the_scale(seed):
    begun = feed(Scene(room(seed), seed), SIDEWAYS, with_tag=True)[-1]
    assert begun.metric
    last = begun.views[-1]
    true = SIDEWAYS[0].inverse() @ SIDEWAYS[last.t_ns]
    assert np.linalg.norm(last.T_world_body.t) == pytest.approx(np.linalg.norm(true.t), rel=0.06)


def test_lights_and_one_camera_without_scale_are_refused():
    with pytest.raises(ConfigError, match="metres"):
        Slam(room_rig(), SlamConfig(sensors="mono", gate=SlamConfig().gate.__class__(use="lights")))


@pytest.fixture(scope="module")
def kitchen():
    recording = open_source(shared_data("redkitchen"))
    return recording, list(recording.messages("mono", 0.0, 3.0))


def test_a_real_recording_of_one_camera_makes_a_map_up_to_scale(kitchen):
    recording, frames = kitchen
    slam = Slam(recording.rig, SlamConfig(sensors="mono"))
    estimates = [slam.feed(frame) for frame in frames]
    slam.close()
    assert estimates[-1].localized
    assert not slam.metric
    assert ate(*matched(slam.trajectory(), recording.ground_truth()), "sim3").rmse_m < 0.02


def test_a_young_map_that_is_lost_is_given_up_for_a_new_one(kitchen):
    recording, frames = kitchen
    events = []
    slam = Slam(recording.rig, SlamConfig(sensors="mono"), on_event=lambda t, kind, **fields: events.append(kind))
    begun = next(k for k, frame in enumerate(frames) if slam.feed(frame).localized)
    nothing = tuple(np.zeros_like(image) for image in frames[0].images)
    dark = [Frame(frames[begun].t_ns + k * 100_000_000, nothing) for k in range(1, 20)]
    statuses = [slam.feed(frame).status for frame in dark]
    assert "begun_anew" in events
    assert statuses[0] == "lost"
    assert statuses[-1] == "initializing"
    assert len(slam.map.keyframes) == 0
