"""Bags are read whoever wrote them, and what is written to one comes back exactly."""

import contextlib
import re
import shutil

import cv2
import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin

from bags import OPTICAL, Robot, drive
from conftest import shared_data
from lodelight.cli.main import main
from lodelight.errors import CalibrationError, ConfigError, SourceError
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.io import open_source
from lodelight.io.convert import convert
from lodelight.io.covariances import covariance_from_ros, covariance_to_ros
from lodelight.io.euroc_writer import append_image, write_sensors
from lodelight.io.rig_toml import format_rig, write_rig
from lodelight.io.rosbag import Bag
from lodelight.io.rosbag_images import BAYER, grey
from lodelight.io.rosbag_recording import _paired, _Partner
from lodelight.io.rosbag_writer import BagWriter
from lodelight.io.trajectories import read_trajectory, write_trajectory
from lodelight.messages import Frame, Imu
from lodelight.rig import CameraSpec, DepthSpec, ImuSpec, Rig
from lodelight.trajectory import Trajectory
from recordings import PERIOD_NS, START_NS, number, picture, tiny_rig, write_euroc, write_sevenscenes, write_tum

KINDS = [".bag", ".mcap", ".db3"]


def same_messages(a, b):
    a, b = list(a), list(b)
    assert len(a) == len(b) > 0
    for one, two in zip(a, b, strict=True):
        assert (type(one), one.t_ns) == (type(two), two.t_ns)
        if isinstance(one, Imu):
            assert np.array_equal(one.gyro, two.gyro)
            assert np.array_equal(one.accel, two.accel)
        else:
            assert all(np.array_equal(p, q) for p, q in zip(one.images, two.images, strict=True))
            assert (one.depth is None) == (two.depth is None)
            if one.depth is not None:
                assert np.array_equal(one.depth, two.depth)


def frames(recording, sensors, *window):
    return [m for m in recording.messages(sensors, *window) if isinstance(m, Frame)]


# -- a recording, its bag and its MCAP ------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("source", ["stereo-inertial", "tum", "sevenscenes"])
def test_a_recording_and_its_bag_give_the_same_messages_and_the_same_rig(tmp_path, kind, source):
    write = {"stereo-inertial": write_euroc, "tum": write_tum, "sevenscenes": write_sevenscenes}[source]
    recording = open_source(write(tmp_path / "a_freiburg1"))
    sensors = "stereo-inertial" if source == "stereo-inertial" else "rgbd"
    convert(recording.path, tmp_path / f"out{kind}")
    bag = open_source(tmp_path / f"out{kind}")
    assert (bag.format, bag.n_frames, bag.span_ns) == ("rosbag", recording.n_frames, recording.span_ns)
    same_messages(recording.messages(sensors), bag.messages(sensors))
    assert format_rig(Rig(bag.rig.cameras, imu=bag.rig.imu)) == format_rig(
        Rig(recording.rig.cameras, imu=recording.rig.imu)
    )
    assert np.allclose(bag.ground_truth().xyz, recording.ground_truth().xyz, atol=1e-12)
    assert bag.skipped == []
    second = open_source(convert(tmp_path / f"out{kind}", tmp_path / "again") and tmp_path / "again")
    assert len(frames(second, sensors.removesuffix("-inertial"))) == recording.n_frames


def full_rig():
    """Everything a CameraInfo cannot hold: double sphere, time offsets, row time, IMU noise, a light camera."""
    lens = Camera.create("double_sphere", 64, 48, (30.1, 30.2, 31.3, 23.4), (-0.2, 0.6))
    place = SE3.exp(np.array([0.1, -0.2, 0.3, 0.4, 0.5, 0.6]))
    cameras = tuple(
        CameraSpec(f"cam{i}", lens, place.perturbed(np.array([0, 0, 0, 0.1 * i, 0, 0])), 20.0, 0.0125 * i, 2e-5, 0.004)
        for i in range(2)
    )
    lights = CameraSpec("light0", Camera.create("radtan", 64, 48, (50, 50, 31, 23)), place, 20.0, 0.002, 3e-5, 1e-4)
    imu = ImuSpec(100.0, 1e-3, 2e-4, 3e-2, 4e-3, time_offset_s=-0.003)
    return Rig(cameras, depth=DepthSpec(lens, place, 1000.0, noise=(0.01, 0.02, 0.3)), imu=imu, lights=lights)


def test_what_camera_info_cannot_hold_is_carried_and_time_offsets_are_applied_once(tmp_path):
    rig, root = full_rig(), tmp_path / "full"
    folders = write_sensors(root, rig)
    for i in range(5):
        t = START_NS + i * PERIOD_NS
        for c in range(2):  # each camera by its own clock
            append_image(folders[f"cam{c}"], t - round(rig.cameras[c].time_offset_s * 1e9), picture(i) + c)
        append_image(folders["depth0"], t, np.full((48, 64), 1000 + i, np.uint16))
        append_image(folders["light0"], t, picture(i))
    recording = open_source(root)
    convert(root, tmp_path / "full.mcap")
    bag = open_source(tmp_path / "full.mcap")
    assert bag.rig.sensors == "rgbd"  # no inertial sample was ever recorded
    for name in ("rate_hz", "row_time_s", "exposure_s"):
        assert [getattr(s, name) for s in bag.rig.cameras] == [getattr(s, name) for s in rig.cameras]
    assert bag.rig.cameras[1].camera.params.tolist() == rig.cameras[1].camera.params.tolist()
    assert np.array_equal(bag.rig.cameras[1].T_body_cam.matrix, recording.rig.cameras[1].T_body_cam.matrix)
    assert bag.rig.depth.noise == (0.01, 0.02, 0.3)
    same_messages(recording.frames(2, True), bag.frames(2, True))
    same_messages(recording.light_frames(), bag.light_frames())


@pytest.mark.parametrize("kind", [".bag", ".mcap"])
def test_a_run_on_a_recording_and_on_its_bag_has_the_same_bytes(tmp_path, kind):
    recording = shared_data("tum_fr1_rpy")
    convert(recording, tmp_path / f"rec{kind}", end_s=0.5)
    written = []
    for source in (recording, tmp_path / f"rec{kind}"):
        assert main(["run", str(source), "--out", str(tmp_path / "out"), "--end", "0.4"]) == 0
        written.append([(tmp_path / "out" / n).read_bytes() for n in ("trajectory.tum", "covariance.csv", "cloud.ply")])
    assert written[0] == written[1]


# -- bags of other robots --------------------------------------------------------------------------------------------

LAYOUTS = [(True, None, ".bag"), (False, StoragePlugin.MCAP, ""), (False, StoragePlugin.SQLITE3, "")]


@pytest.mark.parametrize(("ros1", "plugin", "suffix"), LAYOUTS)
@pytest.mark.parametrize("jpeg", [False, True])
def test_a_foreign_bag_gives_its_rig_from_camera_info_and_tf_static(tmp_path, ros1, plugin, suffix, jpeg):
    recording = open_source(drive(tmp_path / f"robot{suffix}", ros1, plugin, jpeg=jpeg))
    assert recording.rig.sensors == "stereo-inertial"
    # the body is the IMU, 0.1 m above base_link; the cameras look along its x
    T = recording.rig.cameras[0].T_body_cam
    assert np.allclose(T.t, [0.2, 0.05, 0.2], atol=1e-12)
    assert np.allclose(T @ np.array([[0.0, 0.0, 1.0]]), [[1.2, 0.05, 0.2]], atol=1e-12)
    assert np.allclose(recording.rig.cameras[1].T_body_cam.t, [0.2, -0.05, 0.2], atol=1e-12)
    assert recording.rig.cameras[0].camera.distortion == (0.1, -0.2, 0.001, 0.002, 0.03)
    assert (recording.rig.cameras[0].rate_hz, round(recording.rig.imu.rate_hz)) == (20.0, 256)  # 64 samples in 0.25 s
    got = frames(recording, "stereo-inertial")
    assert [f.t_ns for f in got] == [START_NS + i * PERIOD_NS for i in range(6)]
    assert [number(f) for f in got] == list(range(6))
    assert all(np.array_equal(f.images[1], f.images[0] + 1) for f in got)
    samples = [m for m in recording.messages("stereo-inertial") if isinstance(m, Imu)]
    assert samples[0].t_ns == START_NS - 20_000_000
    assert samples[0].gyro.tolist() == [0.1, 0.2, 0.3]


def test_partners_pair_by_their_own_stamps_within_half_a_frame_and_5_ms(tmp_path):
    assert len(frames(open_source(drive(tmp_path / "a.bag", right_lag_ns=4_900_000)), "stereo")) == 6
    assert len(frames(open_source(drive(tmp_path / "b.bag", right_lag_ns=-4_900_000)), "stereo")) == 6
    late = open_source(drive(tmp_path / "c.bag", right_lag_ns=6_000_000))
    with pytest.raises(SourceError, match="6x cam1 has no image near enough in time"):
        frames(late, "stereo")
    assert len(frames(late, "mono")) == 6


def test_depth_in_the_frame_of_a_camera_is_registered_to_it(tmp_path):
    recording = open_source(drive(tmp_path / "d.bag", depth=True))
    assert (recording.rig.sensors, recording.rig.depth.registered) == ("rgbd-inertial", True)
    assert [float(f.depth[0, 0]) for f in frames(recording, "rgbd")] == [np.float32(1.5 + i / 1000) for i in range(6)]


def test_an_imu_that_nothing_joins_to_the_camera_is_left_out_and_told(tmp_path):
    recording = open_source(drive(tmp_path / "e.bag", imu_joined=False))
    assert recording.rig.sensors == "stereo"
    assert "no static transform joins imu_link to left_optical" in recording.skipped[0].reason
    assert np.allclose(recording.rig.cameras[1].T_body_cam.t, [0.1, 0, 0], atol=1e-12)  # the body is camera 0


def test_a_rectified_pair_of_one_frame_has_its_baseline_from_the_projection(tmp_path):
    with Robot(tmp_path / "kitti.bag") as robot:
        for i in range(4):
            t = START_NS + i * PERIOD_NS
            for side, baseline_px in (("left", 0.0), ("right", -50.0 * 0.12)):
                robot.put(f"/{side}/camera_info", t, robot.info(t, "optical", baseline_px=baseline_px))
                robot.put(f"/{side}/image_rect", t, robot.image(t, "optical", picture(i), "mono8"))
    rig = open_source(tmp_path / "kitti.bag").rig
    assert rig.sensors == "stereo"
    assert np.allclose(rig.cameras[1].T_body_cam.t, [0.12, 0, 0], atol=1e-12)
    assert not any(rig.cameras[0].camera.distortion)  # rectified images have none left


def test_transforms_that_move_hold_no_sensors_together_and_old_ones_on_tf_do(tmp_path):
    def bag(name, moving):
        with Robot(tmp_path / name) as robot:
            for i in range(4):
                t = START_NS + i * PERIOD_NS
                x = 0.1 * i if moving else 0.0
                robot.put("/tf", t, robot.tf(t, ("/imu_link", "/cam", (x, 0, 0), OPTICAL)))
                robot.put("/cam/camera_info", t, robot.info(t, "cam"))
                robot.put("/cam/image_raw", t, robot.image(t, "cam", picture(i), "mono8"))
                robot.put("/imu", t, robot.imu(t))
        return open_source(tmp_path / name).rig.sensors

    assert bag("still.bag", moving=False) == "mono-inertial"
    assert bag("turret.bag", moving=True) == "mono"


def test_topics_may_be_named_and_mistakes_in_naming_are_one_line(tmp_path, capsys):
    path = drive(tmp_path / "robot.bag", depth=True)
    named = open_source(path, topics={"cam0": "/stereo/right/image_raw"})
    assert named.topics.cameras == ("/stereo/right/image_raw",)
    assert [number(f) for f in frames(named, "mono")] == list(range(6))
    assert frames(named, "mono")[0].images[0][0, 0] == 6
    for topics, says in (
        (["cam0=/front"], "has no topic /front (cam0)"),
        (["cam0=/imu/data"], "is sensor_msgs/Imu; cam0 must be sensor_msgs/Image"),
        (["imu=/stereo/left/image_raw"], "imu must be sensor_msgs/Imu"),
        (["nose=/x"], "write role=/topic"),
    ):
        options = [part for topic in topics for part in ("--topic", topic)]
        assert main(["run", str(path), "--out", str(tmp_path / "out"), *options]) == 2
        err = capsys.readouterr().err
        assert err.count("\n") == 1
        assert says in err
    with pytest.raises(ConfigError, match="no ROS bag"):
        open_source(write_euroc(tmp_path / "euroc"), topics={"cam0": "/x"})


def test_a_rig_file_comes_before_what_the_bag_says_and_is_asked_for_where_it_says_nothing(tmp_path):
    with Robot(tmp_path / "bare.bag") as robot:
        for i in range(3):
            t = START_NS + i * PERIOD_NS
            robot.put("/usb_cam/image_raw", t, robot.image(t, "cam", picture(i), "mono8"))
    with pytest.raises(CalibrationError, match=r"no CameraInfo for /usb_cam/image_raw; give --rig"):
        open_source(tmp_path / "bare.bag")
    assert [number(f) for f in frames(open_source(tmp_path / "bare.bag", tiny_rig()), "mono")] == [0, 1, 2]
    write_rig(tmp_path / "rig.toml", tiny_rig(rate_hz=7.0))
    assert open_source(tmp_path / "bare.bag").rig.cameras[0].rate_hz == 7.0


@pytest.mark.parametrize("encoding", ["mono8", "bgr8", "rgb8", "bgra8", "mono16", "yuv422", "yuyv", *BAYER])
def test_every_encoding_gives_the_grey_it_means(encoding):
    robot = Robot.__new__(Robot)
    Robot.__init__(robot, "/nonexistent/x.bag")
    value = np.full((48, 64), 77, np.uint8)
    pixels = {
        "bgr8": np.dstack([value] * 3), "rgb8": np.dstack([value] * 3), "bgra8": np.dstack([value] * 4),
        "mono16": value.astype(np.uint16) * 256 + 13, "yuv422": np.dstack([value * 0 + 128, value]),
        "yuyv": np.dstack([value, value * 0 + 128]),
    }.get(encoding, value)  # fmt: skip
    assert np.all(grey(robot.image(1, "c", pixels, encoding, padding=4), (64, 48)) == 77)


def test_colours_weigh_as_in_opencv_in_both_orders_and_bayer_patterns_start_where_ros_says():
    robot = Robot("/nonexistent/x.bag")
    red = np.zeros((48, 64, 3), np.uint8)
    red[:, :, 0] = 200
    expected = cv2.cvtColor(red, cv2.COLOR_RGB2GRAY)
    assert np.array_equal(grey(robot.image(1, "c", red, "rgb8"), (64, 48)), expected)
    assert np.array_equal(grey(robot.image(1, "c", red[:, :, ::-1], "bgr8"), (64, 48)), expected)
    mosaic = np.zeros((48, 64), np.uint8)  # of the same red: rggb has it in the even rows and columns
    mosaic[::2, ::2] = 200
    seen = grey(robot.image(1, "c", mosaic, "bayer_rggb8"), (64, 48))
    assert abs(int(np.median(seen[8:-8, 8:-8])) - int(expected[0, 0])) <= 2


def test_compressed_depth_comes_back_in_metres(tmp_path):
    raw = np.full((48, 64), 1234, np.uint16)
    a, b = 1000.0, -50.0
    inverse = np.full((48, 64), round(a / 2.5 + b), np.uint16)
    for name, format, stored, expected in (
        ("mm", "16UC1; compressedDepth png", raw, 1.234),
        ("m", "32FC1; compressedDepth png", inverse, 2.5),
    ):
        with Robot(tmp_path / f"{name}.bag") as robot:
            for i in range(3):
                t = START_NS + i * PERIOD_NS
                head = np.array([0], "<i4").tobytes() + np.array([a, b], "<f4").tobytes()
                robot.put("/cam/camera_info", t, robot.info(t, "cam"))
                robot.put("/cam/image_raw", t, robot.image(t, "cam", picture(i), "mono8"))
                robot.put("/cam/depth/compressedDepth", t, robot.compressed(t, "cam", stored, format=format, head=head))
        (frame, *_) = frames(open_source(tmp_path / f"{name}.bag"), "rgbd")
        assert np.allclose(frame.depth, expected, atol=0.005)


def test_stamps_that_jump_or_step_back_are_skipped_and_told(tmp_path):
    order = [0, 1, 2, 50, 3, 4, 4, 2, 5, 6]
    with Robot(tmp_path / "jumpy.bag") as robot:
        for k, i in enumerate(order):
            t = START_NS + i * PERIOD_NS
            robot.put("/cam/camera_info", START_NS + k * PERIOD_NS, robot.info(t, "cam"))
            robot.put("/cam/image_raw", START_NS + k * PERIOD_NS, robot.image(t, "cam", picture(min(i, 20)), "mono8"))
    recording = open_source(tmp_path / "jumpy.bag")
    assert [number(f) for f in frames(recording, "mono")] == [0, 1, 2, 3, 4, 5, 6]
    assert [s.reason for s in recording.skipped] == ["stamp is a duplicate or out of order"] * 3


def test_a_camera_that_stops_holds_up_the_other_for_a_second_only(tmp_path):
    with Robot(tmp_path / "half.bag") as robot:
        for i in range(60):
            t = START_NS + i * PERIOD_NS
            for side in ("left", "right"):
                robot.put(f"/{side}/camera_info", t, robot.info(t, side, baseline_px=-5.0 * (side == "right")))
                if side == "left" or i < 10:
                    robot.put(f"/{side}/image_raw", t, robot.image(t, side, picture(i % 20), "mono8"))
        robot.put("/tf_static", t, robot.tf(t, ("left", "right", (0.1, 0, 0), (0.0, 0.0, 0.0, 1.0))))
    recording = open_source(tmp_path / "half.bag")
    with Bag(recording.path) as bag:
        taken = []

        def told():
            for item in bag.messages(recording.topics.cameras):
                taken.append(item[1])
                yield item

        for k, (t_ns, _, _) in enumerate(
            _paired(told(), recording.topics.cameras[0], [_Partner("/right/image_raw", 5_000_000, 0)])
        ):
            assert taken[-1] - t_ns <= 1_050_000_000
            if k == 55:
                break
    assert len(frames(recording, "stereo")) == 10
    assert len(recording.skipped) == 50


# -- what is no good --------------------------------------------------------------------------------------------------


def one_line(capsys, path, tmp_path, *options):
    assert main(["run", str(path), "--out", str(tmp_path / "out"), *options]) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert "Traceback" not in err
    return err


@pytest.mark.parametrize("keep", [0.0, 0.001, 0.02, 0.3, 0.7, 0.99])
@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_cut_short_anywhere_is_one_line(tmp_path, capsys, kind, keep):
    convert(write_euroc(tmp_path / "rec", n=12), tmp_path / f"whole{kind}")
    whole = (tmp_path / f"whole{kind}").read_bytes()
    (tmp_path / f"cut{kind}").write_bytes(whole[: int(len(whole) * keep)])
    err = one_line(capsys, tmp_path / f"cut{kind}", tmp_path)
    assert re.search("cut short|damaged|no recording known|no index|depth|camera", err)


@pytest.mark.parametrize("kind", KINDS)
def test_bytes_overwritten_in_the_middle_end_in_an_error_of_ours_or_in_frames_left_out(tmp_path, kind):
    convert(write_euroc(tmp_path / "rec", n=12), tmp_path / f"whole{kind}")
    whole = bytearray((tmp_path / f"whole{kind}").read_bytes())
    rng = np.random.default_rng(0)
    for _ in range(6):
        broken = bytearray(whole)
        at = int(rng.integers(64, len(whole) - 4096))
        broken[at : at + 600] = rng.integers(0, 256, 600, dtype=np.uint8).tobytes()
        (tmp_path / f"broken{kind}").write_bytes(broken)
        with contextlib.suppress(SourceError, CalibrationError):  # and nothing else
            for _ in open_source(tmp_path / f"broken{kind}").messages("stereo-inertial"):
                pass


def test_an_unindexed_bag_says_how_to_index_it(tmp_path, capsys):
    path = drive(tmp_path / "robot.bag")
    data = bytearray(path.read_bytes())
    at = data.index(b"index_pos=") + len(b"index_pos=")
    data[at : at + 8] = bytes(8)
    path.write_bytes(data)
    assert "rosbag reindex" in one_line(capsys, path, tmp_path)


def test_a_bag_without_a_camera_lists_what_it_has(tmp_path, capsys):
    with Robot(tmp_path / "blind.bag") as robot:
        for i in range(5):
            robot.put("/imu", START_NS + i, robot.imu(START_NS + i))
    assert "has no camera: it has /imu (sensor_msgs/Imu)" in one_line(capsys, tmp_path / "blind.bag", tmp_path)


def test_an_uncalibrated_camera_is_told(tmp_path, capsys):
    with Robot(tmp_path / "raw.bag") as robot:
        for i in range(3):
            robot.put("/cam/camera_info", START_NS + i, robot.info(START_NS + i, "cam", fx=0.0))
            robot.put("/cam/image_raw", START_NS + i, robot.image(START_NS + i, "cam", picture(i), "mono8"))
    with Bag(tmp_path / "raw.bag") as bag:
        assert bag.types["/cam/image_raw"] == "sensor_msgs/Image"
    assert "fx" in (err := one_line(capsys, tmp_path / "raw.bag", tmp_path)) or "not calibrated" in err


def test_a_bag_under_another_name_is_recognised_by_its_content(tmp_path):
    shutil.copy(drive(tmp_path / "robot.bag"), tmp_path / "recording 100%.dat")
    assert len(frames(open_source(tmp_path / "recording 100%.dat"), "stereo")) == 6
    folder = drive(tmp_path / "ros2", ros1=False)
    (folder / "metadata.yaml").unlink()  # as a crash leaves it
    assert len(frames(open_source(folder), "stereo")) == 6


def test_a_database_that_is_no_bag_is_none(tmp_path, capsys):
    import sqlite3

    with sqlite3.connect(tmp_path / "other.sqlite") as db:
        db.execute("CREATE TABLE cooking (recipe TEXT)")
    assert "no recording known" in one_line(capsys, tmp_path / "other.sqlite", tmp_path)


# -- trajectories and clouds -------------------------------------------------------------------------------------------


def path_of(n=20):
    rng = np.random.default_rng(1)
    poses = [SE3.exp(rng.normal(size=6)) for _ in range(n)]
    return Trajectory.from_poses([START_NS + i * PERIOD_NS for i in range(n)], poses)


@pytest.mark.parametrize("kind", KINDS)
def test_a_trajectory_goes_to_odometry_path_and_tf_and_comes_back(tmp_path, kind):
    write_trajectory(tmp_path / "path.tum", path_of())
    known = read_trajectory(tmp_path / "path.tum")
    assert main(["convert", str(tmp_path / "path.tum"), str(tmp_path / f"path{kind}")]) == 0
    with Bag(tmp_path / f"path{kind}") as bag:
        assert {t: (bag.types[t], bag.counts[t]) for t in bag.types} == {
            "/odom": ("nav_msgs/Odometry", 20),
            "/path": ("nav_msgs/Path", 1),
            "/tf": ("tf2_msgs/TFMessage", 20),
        }
        transforms = [m.transforms[0] for _, _, m in bag.messages(("/tf",))]
    assert [(t.header.frame_id, t.child_frame_id) for t in transforms] == [("map", "body")] * 20
    for topic in ("/odom", "/path"):
        options = ["--topic", f"truth={topic}"]
        assert main(["convert", str(tmp_path / f"path{kind}"), str(tmp_path / "back.tum"), *options]) == 0
        back = read_trajectory(tmp_path / "back.tum")
        assert np.array_equal(back.t_ns, known.t_ns)
        assert np.allclose(back.xyz, known.xyz, atol=2e-9)
    assert main(["eval", str(tmp_path / f"path{kind}"), str(tmp_path / "path.tum"), "--align", "none"]) == 0


def test_a_covariance_is_that_of_ros_position_first_and_in_the_parents_axes():
    rng = np.random.default_rng(2)
    T, root = SE3.exp(rng.normal(size=6)), rng.normal(size=(6, 6))
    ours = root @ root.T
    draws = rng.multivariate_normal(np.zeros(6), 1e-6 * ours, 20_000)
    moved = [T.perturbed(d) for d in draws]
    # what ROS means: T' = T with a small rotation of the parent's axes on the left, and a shift in the parent's axes
    spread = np.array([[*(m.t - T.t), *SE3(m.R @ T.R.T, np.zeros(3)).log()[:3]] for m in moved])
    expected = 1e-6 * covariance_to_ros(T.R, ours)
    assert np.allclose(np.cov(spread.T), expected, atol=0.05 * np.abs(expected).max())
    assert np.allclose(covariance_from_ros(T.R, covariance_to_ros(T.R, ours)), ours, atol=1e-12)


def test_a_cloud_and_an_out_folder_go_to_point_cloud2(tmp_path):
    from out_folder import make_run

    out = tmp_path / "run"
    make_run(out)
    assert main(["convert", str(out), str(tmp_path / "run.mcap")]) == 0
    assert main(["convert", str(out / "cloud.ply"), str(tmp_path / "cloud.bag")]) == 0
    for name in ("run.mcap", "cloud.bag"):
        with Bag(tmp_path / name) as bag:
            cloud = bag.first("/cloud")
            assert bag.types["/cloud"] == "sensor_msgs/PointCloud2"
        xyz = cloud.data.view("<f4").reshape(-1, 3)
        assert (len(xyz), [f.name for f in cloud.fields]) == (cloud.width, ["x", "y", "z"])
        assert len(xyz) > 0
        assert np.isfinite(xyz).all()
    with Bag(tmp_path / "run.mcap") as bag:
        covariances = [m.pose.covariance for _, _, m in bag.messages(("/odom",))]
    assert np.count_nonzero([np.any(c) for c in covariances]) > len(covariances) / 2


def test_a_bag_that_exists_or_cannot_hold_a_stamp_is_refused_and_nothing_is_left(tmp_path):
    (tmp_path / "there.bag").write_text("precious")
    with pytest.raises(SourceError, match="exists already"), BagWriter(tmp_path / "there.bag"):
        pass
    assert (tmp_path / "there.bag").read_text() == "precious"
    with pytest.raises(SourceError, match="cannot hold the stamp"), BagWriter(tmp_path / "new.bag") as bag:
        bag.write("/x", -5, bag.text("x"))
    assert [p.name for p in tmp_path.iterdir()] == ["there.bag"]
