"""The simulator: what it builds, moves, senses and writes, against closed forms and other people's readers."""

import hashlib
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.spatial.transform import Rotation

from lodelight.errors import ConfigError, SourceError
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.io import open_source
from lodelight.rig import CameraSpec, DepthSpec, ImuSpec
from lodelight.sim.builder import Builder
from lodelight.sim.bvh import STACK, cast_ray
from lodelight.sim.depth import sense_depth
from lodelight.sim.faults import Faults
from lodelight.sim.furniture import rack
from lodelight.sim.gaits import GAITS, generate
from lodelight.sim.imager import Imager
from lodelight.sim.imu import SPECS, read_out
from lodelight.sim.lightmap import bake
from lodelight.sim.lights import brightness, pwm_mean
from lodelight.sim.motion import GRAVITY, Motion
from lodelight.sim.paths import another_way
from lodelight.sim.recorder import Simulation, record
from lodelight.sim.render import Eye, render
from lodelight.sim.rigs import standard
from lodelight.sim.scenarios import SCENARIOS, unlit
from lodelight.sim.sensor import DARK_DN, FULL_WELL_E, READ_NOISE_E, Exposure, develop, level_for
from lodelight.sim.space import Space
from lodelight.trajectory import Trajectory

ROUTE = np.array([[1.5, 1.5], [4.5, 1.5], [4.5, 3.5], [1.5, 3.5]])
CAMERA = Camera.create("radtan", 320, 240, (220.0, 220.0, 161.0, 118.0), (-0.28, 0.07, 1e-4, 2e-5))
AT_WALL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # a camera that looks along x


def room(faults=None):
    """6 x 5 x 3 m with two codes on the wall x = 6, a lamp and three coded lights."""
    b = Builder("room", 3, ROUTE, 3.0, faults=faults or Faults())
    b.floor(0, 0, 6, 5, "planks")
    b.ceiling(0, 0, 6, 5, "ceiling")
    for p, q in (((0, 0), (6, 0)), ((6, 0), (6, 5)), ((6, 5), (0, 5)), ((0, 5), (0, 0))):
        b.wall(p, q, "brick", "brick", thickness=0.02)
    b.tag("qr", 1, 5.99, 2.1, 1.5, 180, 0.3, surveyed=True)
    b.tag("tag36h11", 17, 5.99, 2.8, 1.5, 180)
    b.panel(3.0, 2.5, 3.0, (1.2, 0.6))
    for k in range(3):
        b.coded(1.5 + 1.5 * k, 2.0, 3.0, 2000.0 + 1000.0 * k)
    return b.finish()


@pytest.fixture(scope="module")
def lit_room():
    out = room()
    bake(out.scene)
    return out


def motion(kind="hand", seconds=12.0, seed=0, standstill_s=0.0):
    return generate(GAITS[kind], ROUTE, seconds, 10**18, np.random.default_rng(seed), standstill_s)


def tiny(building, faults=None, seconds=0.5, **rig):
    rig = standard((96, 64), 10.0, light_size=(160, 120), **rig)
    faults = faults or Faults()
    way = motion(seconds=seconds)
    series = read_out(way, rig.imu, np.random.default_rng(1))
    true = faults.true_rig(rig, np.random.default_rng(2))
    return Simulation(building, way, true, series, 4, faults, rig, {"scenario": "room", "faults": str(faults)})


def digest(folder):
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


# Buildings


@pytest.mark.parametrize("name", SCENARIOS)
def test_every_building_has_what_its_anchors_say_where_they_say_it(name):
    place = unlit(name, 5)
    scene, anchors = place.scene, place.anchors
    assert {"qr", "tag36h11"} <= {tag.family for tag in anchors.tags}
    for ids in ([tag.id for tag in anchors.tags], [light.id for light in anchors.lights]):
        assert len(set(ids)) == len(ids) >= 4
    stack = np.empty(STACK, np.int32)

    def first_hit(origin, direction):
        tree = scene.tree
        return cast_ray(tree.boxes, tree.links, tree.order, scene.geometry, stack, origin, direction, 10.0, False)

    for tag in anchors.tags:  # half a metre before its middle one looks at it, and reads it with x to the right
        T = tag.T_world_tag
        reach, hit = first_hit(T.t - 0.3 * T.R[:, 2], T.R[:, 2])
        assert scene.names[hit] == f"code {tag.id}", tag.id
        assert reach == pytest.approx(0.3, abs=1e-6)
        u, v = scene.geometry[hit, 12:15], scene.geometry[hit, 15:18]
        assert np.allclose(u / np.linalg.norm(u), T.R[:, 0])
        assert np.allclose(v / np.linalg.norm(v), T.R[:, 1])
        assert np.linalg.norm(u) > tag.size_m
    for light in anchors.lights:
        _, hit = first_hit(light.xyz + 0.3 * light.normal, -light.normal)
        assert scene.names[hit] == "lamp_face", light.id
    Space(place).check(generate(GAITS["walk"], place.route, 150.0, 0, np.random.default_rng(0)))


def test_racks_are_bolted_to_the_floor_and_only_their_goods_change():
    def built(changed):
        builder = Builder("shed", 1, np.array([[0.0, 9.0], [9.0, 9.0]]), 5.0, changed)
        for y in range(8):
            rack(builder, 0.0, 2.0 * y, 0, 4.8, 3, 1.75, 1.2)
        quads = builder.mesh.quads
        return [np.array([q.origin for q in quads if (q.surface == "metal") == frame]) for frame in (True, False)]

    (frames, goods), (frames_later, goods_later) = built(False), built(True)
    assert np.array_equal(frames, frames_later)
    assert goods.shape != goods_later.shape or not np.allclose(goods, goods_later)


def test_a_changed_building_keeps_walls_and_tags_and_moves_things():
    before, after = unlit("tunnel", 1), unlit("tunnel", 1, changed=True)
    a, b = before.scene, after.scene
    assert [t.id for t in before.anchors.tags] == [t.id for t in after.anchors.tags]
    assert all(
        np.array_equal(s.T_world_tag.matrix, t.T_world_tag.matrix)
        for s, t in zip(before.anchors.tags, after.anchors.tags, strict=True)
    )
    on = [lamp.on for lamp in b.lamps]
    assert all(lamp.on for lamp in a.lamps)
    assert 0 < on.count(False) < 0.4 * len(on)
    walls = [
        np.array(
            [n != "lamp_face" and np.linalg.norm(g[12:15]) > 4.0 for n, g in zip(s.names, s.geometry, strict=True)]
        )
        for s in (a, b)
    ]
    assert np.allclose(a.geometry[walls[0]], b.geometry[walls[1]])
    same = unlit("tunnel", 1)
    assert np.array_equal(same.scene.geometry, a.geometry)
    assert not np.array_equal(unlit("tunnel", 2).scene.textures.texels, a.textures.texels)


def test_codes_are_read_from_pictures_and_lie_where_anchors_say(lit_room):
    import zxingcpp

    from lodelight.tags.apriltags import detect_apriltags

    camera = Camera.create("radtan", 752, 480, (458.0, 457.0, 367.0, 248.0), (-0.28, 0.07, 2e-4, 2e-5))
    qr, april = lit_room.anchors.tags
    views = []
    for tag in (qr, april):
        T = tag.T_world_tag @ SE3(Rotation.from_euler("y", 12, degrees=True).as_matrix(), np.zeros(3))
        T = T @ SE3(np.eye(3), np.array([0.0, 0.0, -1.5]))
        view = render(lit_room.scene, Eye.of(camera), [T])
        exposure = Exposure.for_level(level_for(view.image, 110.0), 0.006)
        views.append((T, develop(view.image, np.ones_like(view.image), exposure, 3)))
    texts = [found.text for found in zxingcpp.read_barcodes(views[0][1])]
    assert any(text.startswith("LODE1;id=Q01;size=0.30;xyz=") for text in texts)
    (found,) = [q for q in detect_apriltags(views[1][1], "tag36h11", 1.0) if q.number == 17]
    truth, _ = camera.project(views[1][0].inverse() @ april.corners_world)
    assert np.linalg.norm(found.corners_px - truth, axis=1).max() < 0.3


# Motion and IMU


def test_derivatives_of_a_motion_are_those_of_its_poses():
    way, t, h = motion(), np.linspace(1.0, 11.0, 41), 1e-4
    s, before, after = way.at(t), way.at(t - h), way.at(t + h)
    assert np.allclose((after.xyz - before.xyz) / (2 * h), s.v_world, atol=1e-6)
    assert np.allclose((after.v_world - before.v_world) / (2 * h), s.a_world, atol=1e-5)
    turn = Rotation.from_matrix(np.swapaxes(before.R_world_body, 1, 2) @ after.R_world_body).as_rotvec()
    assert np.allclose(turn / (2 * h), s.omega, atol=1e-5)


def test_jerk_does_not_jump():
    t = np.arange(1.0, 11.0, 1e-3)
    jerk = np.gradient(motion("walk").at(t).a_world, 1e-3, axis=0)
    assert np.abs(np.diff(jerk[2:-2], axis=0)).max() < 0.05 * np.abs(jerk).max()


def test_it_rests_first_where_asked():
    state = motion(standstill_s=3.0).at(np.linspace(0, 2.8, 20))
    assert np.abs(state.v_world).max() < 1e-9
    assert np.abs(state.omega).max() < 1e-9


@pytest.mark.parametrize("kind", GAITS)
def test_a_perfect_imu_integrates_to_the_truth(kind):
    way = motion(kind, seconds=11.0, seed=7)
    series = read_out(way, SPECS["perfect"], np.random.default_rng(0))
    g, a, dt = series.gyro, series.accel, 0.005
    k = np.arange(1, 2001)
    turns = dt * (13 * (g[k] + g[k + 1]) - g[k - 1] - g[k + 2]) / 24 + dt * dt / 12 * np.cross(g[k], g[k + 1])
    first, last = way.at(np.array([0.005, 10.005])), None
    R, p, v = Rotation.from_matrix(first.R_world_body[0]), first.xyz[0], first.v_world[0]
    for i, turn in zip(k, turns, strict=True):
        R1 = R * Rotation.from_rotvec(turn)
        world = 0.5 * (R.apply(a[i]) + R1.apply(a[i + 1])) + GRAVITY
        p, v, R = p + dt * v + 0.5 * dt * dt * world, v + dt * world, R1
    last = Rotation.from_matrix(first.R_world_body[1])
    assert np.degrees((last.inv() * R).magnitude()) < 1e-4
    assert np.linalg.norm(p - first.xyz[1]) < 1e-3


def test_imu_noise_has_the_densities_of_its_sheet():
    way = Motion.from_controls(np.tile([0, 0, 1, 1, 0, 0, 0.0], (2100, 1)), 0, 100.0)
    spec = ImuSpec(200.0, 2e-3, 3e-3, 4e-3, 5e-3)
    draws = [read_out(way, spec, np.random.default_rng(i), (0.1, 0.2)) for i in range(20)]
    white = (
        np.concatenate([s.gyro - s.bias_gyro for s in draws]),
        np.concatenate([s.accel - s.bias_accel for s in draws]),
    )
    assert white[0].std() == pytest.approx(2e-3 * 200**0.5, rel=0.02)
    assert (white[1] - [0, 0, 9.81]).std() == pytest.approx(4e-3 * 200**0.5, rel=0.02)
    walk = np.array([s.bias_gyro[-1] - s.bias_gyro[0] for s in draws])
    assert walk.std() == pytest.approx(3e-3 * 100**0.5, rel=0.25)
    assert np.array([s.bias_accel[0] for s in draws]).std() == pytest.approx(0.2, rel=0.35)


def test_a_given_trajectory_is_met_as_closely_as_it_says():
    way = motion(seconds=10.0)
    given = way.trajectory(20.0)
    fitted = Motion.fit(given)
    state = fitted.at_ns(given.t_ns)
    off = np.linalg.norm(state.xyz - given.xyz, axis=1).max()
    assert off <= fitted.deviation_m + 1e-12 < 1e-6
    between = given.t_ns[:-1] + 25_000_000  # where nothing was given
    assert np.linalg.norm(fitted.at_ns(between).xyz - way.at_ns(between).xyz, axis=1).max() < 1e-3
    with pytest.raises(SourceError, match="at least 8"):
        Motion.fit(Trajectory(given.t_ns[:5], given.xyz[:5], given.quat_xyzw[:5]))


# Sensors


def test_a_row_sees_the_mean_of_a_lights_square_wave():
    starts = np.array([0.1, 0.10003, 0.123456])
    means = pwm_mean(3210.0, 0.5, 0.3, starts, 60e-6)
    for start, mean in zip(starts, means, strict=True):
        fine = start + (np.arange(200_000) + 0.5) / 200_000 * 60e-6
        assert mean == pytest.approx(np.mean((fine * 3210.0 + 0.3) % 1.0 < 0.5), abs=1e-4)


def test_lamps_without_a_code_hum_at_a_hundred_hertz(lit_room):
    panel = next(lamp for lamp in lit_room.scene.lamps if not lamp.id)
    t = np.array([0.0, 0.0021, 0.0063])
    seen = brightness((panel,), t, 0.002)[:, 0]
    for start, value in zip(t, seen, strict=True):
        assert value == pytest.approx(
            quad(lambda x: 1 + 0.3 * np.sin(200 * np.pi * x), start, start + 0.002)[0] / 0.002
        )


def test_grey_levels_have_shot_and_read_noise():
    grey = np.repeat(np.linspace(5.0, 200.0, 8, dtype=np.float32), 100)[:, None] * np.ones((1, 400), np.float32)
    exposure = Exposure.for_level(1.0, 0.006)
    image = develop(grey, np.ones_like(grey), exposure, 1, psf_px=0.0).reshape(8, -1).astype(float)
    level = grey.reshape(8, -1)[:, 0] * exposure.level
    assert np.allclose(image.mean(axis=1), level + DARK_DN, atol=0.05)
    per_dn = FULL_WELL_E / 255.0 / exposure.gain
    assert np.allclose(image.var(axis=1), level / per_dn + (READ_NOISE_E / per_dn) ** 2 + 1 / 12, rtol=0.05)


def test_a_view_has_the_depth_of_the_walls_it_shows(lit_room):
    T = SE3(AT_WALL, np.array([2.0, 2.5, 1.5]))
    view = render(lit_room.scene, Eye.of(CAMERA), [T])
    u, v = np.meshgrid(np.arange(320.0), np.arange(240.0))
    rays, _ok = CAMERA.unproject(np.stack([u.ravel(), v.ravel()], axis=1))
    d = rays @ T.R.T
    with np.errstate(divide="ignore"):
        sides = np.stack(
            [
                np.where(np.abs(d[:, k]) < 1e-12, np.inf, (np.where(d[:, k] > 0, hi, lo) - T.t[k]) / d[:, k])
                for k, (lo, hi) in enumerate(((0.01, 5.99), (0.01, 4.99), (0.0, 3.0)))
            ]
        )
    expected = (sides.min(axis=0) * rays[:, 2]).reshape(240, 320)
    off = np.abs(view.depth - expected)
    assert np.quantile(off, 0.95) < 1e-3
    assert off.max() < 0.03
    assert (view.image > 0).all()


def test_depth_has_its_noise_range_and_holes():
    spec = DepthSpec(CAMERA, SE3.identity(), min_m=0.4, max_m=6.0)
    exact = np.full((240, 320), 3.0, np.float32)
    exact[:, 200:], exact[:20], exact[220:] = 4.0, 0.3, 7.0
    seen = sense_depth(exact, spec, 5)
    flat = seen[30:210, 20:190]
    assert 0.001 < (flat == 0).mean() < 0.006
    assert flat[flat > 0].std() == pytest.approx(0.0012 + 0.0019 * 2.6**2, rel=0.03)
    assert (seen[:20] == 0).all()
    assert (seen[220:] == 0).all()
    assert (seen[30:210, 200:204] == 0).all()


def test_a_moving_camera_blurs_along_its_way(lit_room):
    T = SE3(AT_WALL, np.array([3.0, 2.5, 1.5]))
    quat = Rotation.from_matrix(T.R).as_quat()[[3, 0, 1, 2]]
    controls = np.array([[3.0, 2.5 + 0.1 * k, 1.5, *quat] for k in range(-3, 40)])  # 2 m/s to the left
    spec = CameraSpec("cam0", CAMERA, SE3.identity(), 20.0)
    moving = Imager(lit_room, spec, Motion.from_controls(controls, 0, 1.0))
    still = Imager(
        lit_room, spec, Motion.from_controls(controls * [1, 0, 1, 1, 1, 1, 1] + [0, 2.5, 0, 0, 0, 0, 0], 0, 1.0)
    )
    sharp, blurred = (imager.take(0, Exposure(0.04, 0.15), 1)[0].astype(float) for imager in (still, moving))
    across = [np.abs(np.diff(image[60:180, 60:260], axis=1)).mean() for image in (sharp, blurred)]
    down = [np.abs(np.diff(image[60:180, 60:260], axis=0)).mean() for image in (sharp, blurred)]
    assert across[1] < 0.7 * across[0]
    assert down[1] / down[0] > 1.2 * across[1] / across[0]


# Faults


def test_lights_go_wrong_where_asked_and_the_survey_does_not_know():
    clean, lamps = room(), {}
    for name, texts in (("light", ["light=L02"]), ("swap", ["swapped-lights=L01:L03"]), ("moved", ["moved-light=L03"])):
        wrong = room(Faults.parse(texts, 10.0))
        lamps[name] = {lamp.id: lamp for lamp in wrong.scene.lamps if lamp.id}
        if name != "moved":
            assert [x.frequency_hz for x in wrong.anchors.lights] == [2000.0, 3000.0, 4000.0]
            continue
        shifts = [np.linalg.norm(x.xyz - lamps[name][x.id].center) for x in wrong.anchors.lights]
        assert shifts == pytest.approx([0.0, 0.0, 1.0])
    assert lamps["light"]["L02"].frequency_hz == 3600.0
    assert [lamps["swap"][k].frequency_hz for k in ("L01", "L02", "L03")] == [4000.0, 3000.0, 2000.0]
    assert [lamp.frequency_hz for lamp in clean.scene.lamps if lamp.id] == [2000.0, 3000.0, 4000.0]


def test_tags_go_wrong_where_asked():
    moved, double = (room(Faults.parse([f"{name}=Q01"], 10.0)) for name in ("moved-tag", "duplicated-tag"))
    where = [k for k, n in enumerate(moved.scene.names) if n == "code Q01"]
    assert moved.scene.geometry[where[0], 2] - room().scene.geometry[where[0], 2] == pytest.approx(-0.5)
    assert double.scene.names.count("code Q01") == 2
    assert moved.scene.names.count("code Q01") == 1


@pytest.mark.parametrize(
    "text",
    ["fog", "dropped=2", "dropped=x", "blackout=3", "people=two", "swapped-lights=L01", "light=L99", "moved-tag=Q77"],
)
def test_a_fault_that_cannot_be_is_refused(text):
    with pytest.raises(ConfigError, match=text.partition("=")[2] or "choose one of"):
        room(Faults.parse([text], 10.0))


def test_offsets_and_extrinsics_are_wrong_by_what_was_asked(lit_room):
    simulation = tiny(lit_room, Faults.parse(["time-offset=0.03", "extrinsics=2:0.05"], 1.0))
    for true, stated in zip(simulation.rig.cameras, simulation.stated.cameras, strict=True):
        off = stated.T_body_cam.inverse() @ true.T_body_cam
        assert np.degrees(off.angle) == pytest.approx(2.0)
        assert np.linalg.norm(true.T_body_cam.t - stated.T_body_cam.t) == pytest.approx(0.05)
        assert true.time_offset_s == pytest.approx(0.03)
        assert stated.time_offset_s == 0.0


def test_a_kidnapped_body_jumps(lit_room):
    way = replace(motion(), duration_s=6.0, jump=(3.0, 4.0))
    before, after = way.at(np.array([2.999, 3.001])).xyz
    assert np.linalg.norm(after - before) > 0.5
    assert np.allclose(way.at(4.0).xyz, motion().at(8.0).xyz)


# Recordings


@pytest.fixture(scope="module")
def recording(lit_room, tmp_path_factory):
    return record(tiny(lit_room), tmp_path_factory.mktemp("sim") / "out", threads=2)


def test_a_recording_is_one_that_the_readers_know(recording):
    source = open_source(recording)
    assert [c.camera.width for c in source.rig.cameras] == [96, 96]
    assert source.rig.depth is not None
    assert source.rig.lights is not None
    assert source.rig.imu is not None
    assert (recording / "contact_sheet.png").exists()
    assert (recording / "plan.html").exists()
    rows = np.loadtxt(recording / "mav0/state_groundtruth_estimate0/data.csv", delimiter=",")
    assert rows.shape[1] == 17
    assert np.allclose(np.linalg.norm(rows[:, 4:8], axis=1), 1.0)
    for camera, count in (("cam0", 6), ("cam1", 6), ("depth0", 6), ("light0", 6)):
        assert len(list((recording / "mav0" / camera / "data").glob("*.png"))) == count
    depth = cv2.imread(str(next((recording / "mav0/depth0/data").glob("*.png"))), cv2.IMREAD_UNCHANGED)
    assert depth.dtype == np.uint16
    assert 500 < np.median(depth[depth > 0]) < 6000


def test_one_thread_and_a_kill_in_between_give_the_same_bytes(recording, lit_room, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(recording, out)
    for camera in ("cam0", "cam1", "depth0", "light0"):  # as if killed: images gone, a row cut short, a half image
        data = out / "mav0" / camera / "data.csv"
        rows = data.read_text().splitlines(keepends=True)
        data.write_text("".join(rows[:3]) + rows[3][:7])
        for row in rows[3:]:
            (out / "mav0" / camera / "data" / row.strip().split(",")[1]).unlink()
        (out / "mav0" / camera / "data" / (rows[3].split(",")[0] + ".part")).write_bytes(b"half")
    (out / "contact_sheet.png").unlink()
    record(tiny(lit_room), out, threads=1)
    assert digest(out) == digest(recording)


def test_faults_in_images(lit_room, tmp_path):
    faults = Faults.parse(["dropped=0.5", "blackout=0.0:0.25", "time-offset=0.05"], 1.5)
    out = record(tiny(lit_room, faults, seconds=1.5), tmp_path / "out")
    folders = [out / "mav0" / name / "data" for name in ("cam0", "cam1", "depth0")]
    names = [sorted((p.name for p in folder.glob("*.png")), key=lambda n: int(n[:-4])) for folder in folders]
    assert names[0] == names[1] == names[2]
    assert 2 < len(names[0]) < 14
    first, *_, last = (cv2.imread(str(out / "mav0/cam0/data" / n), 0) for n in names[0])
    assert first.max() < 12
    assert last.mean() > 40
    assert int(names[0][0].split(".")[0]) == 10**18 - 50_000_000


def test_depth_from_a_lens_of_its_own(lit_room, tmp_path):
    simulation = tiny(lit_room, seconds=0.2)
    lens = Camera.create("radtan", 80, 60, (60.0, 60.0, 39.5, 29.5))
    own = DepthSpec(
        lens, simulation.rig.cameras[0].T_body_cam @ SE3(np.eye(3), np.array([0.03, 0, 0])), registered=False
    )
    rig = replace(simulation.rig, depth=own)
    out = record(replace(simulation, rig=rig, stated=rig), tmp_path / "out")
    images = sorted((out / "mav0/depth0/data").glob("*.png"))
    assert len(images) == 3
    assert cv2.imread(str(images[0]), cv2.IMREAD_UNCHANGED).shape == (60, 80)


def test_a_folder_with_something_else_in_it_is_left_alone(lit_room, recording, tmp_path):
    (tmp_path / "letter.txt").write_text("dear")
    with pytest.raises(SourceError, match=r"not empty \(letter.txt"):
        record(tiny(lit_room), tmp_path)
    with pytest.raises(SourceError, match="other settings"):
        record(replace(tiny(lit_room), settings={"scenario": "hall"}), recording)


def test_a_way_through_a_wall_is_refused(lit_room):
    space = Space(lit_room)
    space.check(motion())
    with pytest.raises(ConfigError, match=r"outside|through|passes"):
        space.check(motion().moved(SE3(np.eye(3), np.array([3.0, 0.0, 0.0]))))
    T = space.place(motion().moved(SE3(np.eye(3), np.array([300.0, 40.0, 0.0]))))
    space.check(motion().moved(SE3(np.eye(3), np.array([300.0, 40.0, 0.0]))).moved(T))
    way = motion().trajectory(20.0)
    wide = Motion.fit(Trajectory(way.t_ns, way.xyz * 10.0, way.quat_xyzw))
    with pytest.raises(ConfigError, match="fits nowhere"):
        space.place(wide)


def test_another_way_is_another_and_free(lit_room):
    space = Space(lit_room)
    ways = [another_way(ROUTE, space, GAITS["hand"], np.random.default_rng(k)) for k in (1, 1, 2)]
    assert np.array_equal(ways[0], ways[1])
    for way in ways[1:]:
        aside = np.linalg.norm(way[:, None] - ROUTE[None], axis=2).min(axis=1)
        assert 0.05 < aside.max() < 0.9
        space.check(generate(GAITS["hand"], way, 30.0, 0, np.random.default_rng(0)))
