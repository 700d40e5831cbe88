"""Every format is recognised by its content and streamed in order, with its rig, its stamps and its truth."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from conftest import shared_data
from lodelight.errors import CalibrationError, ConfigError, SourceError
from lodelight.geometry.se3 import SE3
from lodelight.io import open_source
from lodelight.io.rig_toml import write_rig
from lodelight.messages import Frame, Imu
from lodelight.rig import Rig
from recordings import (
    PERIOD_NS,
    START_NS,
    number,
    picture,
    tiny_rig,
    write,
    write_euroc,
    write_kitti,
    write_sevenscenes,
    write_tum,
)


def frames(recording, sensors, *window):
    return [m for m in recording.messages(sensors, *window) if isinstance(m, Frame)]


def test_a_tum_folder_gives_colour_and_depth_with_exact_stamps(tmp_path):
    recording = open_source(write_tum(tmp_path / "room", depth_m=2.0))
    got = frames(recording, "rgbd")
    assert (recording.format, recording.n_frames, recording.rig.sensors) == ("tum_rgbd", 6, "rgbd")
    assert [f.t_ns for f in got] == [START_NS + i * PERIOD_NS for i in range(6)]
    assert [number(f) for f in got] == list(range(6))
    assert got[0].images[0].dtype == np.uint8
    assert got[0].depth.dtype == np.float32
    assert np.all(got[0].depth == np.float32(2.0))
    assert recording.duration_s == pytest.approx(0.25, abs=1e-12)
    assert recording.rig.cameras[0].camera.params[0] == 517.306408  # the freiburg1 of the comment
    assert recording.ground_truth().xyz[:, 0].tolist() == [0, 1, 2, 3, 4, 5]
    assert recording.skipped == []


def test_tum_colour_without_depth_within_20_ms_is_skipped_and_told(tmp_path):
    recording = open_source(write_tum(tmp_path, lag_ns=21_000_000))
    with pytest.raises(SourceError, match=r"6x no depth image near enough in time"):
        frames(recording, "rgbd")
    assert len(frames(recording, "mono")) == 6


def test_a_tum_folder_that_names_no_camera_asks_for_a_rig(tmp_path):
    write_tum(tmp_path / "room")
    (tmp_path / "room/rgb.txt").write_text((tmp_path / "room/rgb.txt").read_text().replace("freiburg1", "office"))
    with pytest.raises(CalibrationError, match="--rig"):
        open_source(tmp_path / "room")


def test_a_euroc_folder_gives_stereo_and_imu_in_one_order(tmp_path):
    recording = open_source(write_euroc(tmp_path / "flight"))
    messages = list(recording.messages("stereo-inertial"))
    stamps = [m.t_ns for m in messages]
    assert stamps == sorted(stamps)
    got = [m for m in messages if isinstance(m, Frame)]
    assert [len(f.images) for f in got] == [2] * 6
    assert all(np.all(f.images[1] == f.images[0] + 1) for f in got)
    for i, message in enumerate(messages):
        if isinstance(message, Frame):  # a sample of the same stamp comes first
            assert isinstance(messages[i - 1], Imu)
            assert messages[i - 1].t_ns == message.t_ns
    # 20 ms of IMU before the first frame, then ten samples a frame
    assert sum(isinstance(m, Imu) for m in messages) == 4 + 1 + 5 * 10
    assert recording.rig.sensors == "stereo-inertial"
    assert recording.rig.imu.gyro_noise == 1.6968e-4
    assert recording.rig.cameras[1].T_body_cam.t.tolist() == [0.1, 0.0, 0.0]
    assert recording.rig.cameras[0].camera.distortion[2] == 1e-4
    assert recording.ground_truth().t_ns[3] == START_NS + 3 * PERIOD_NS


def test_mav0_itself_opens_the_folder_around_it(tmp_path):
    write_euroc(tmp_path / "flight")
    assert open_source(tmp_path / "flight" / "mav0").name == "flight"


def test_a_euroc_right_image_counts_only_within_5_ms(tmp_path):
    write_euroc(tmp_path)
    rows = [f"{START_NS + i * PERIOD_NS + 1_000_000 * 2 * i},{START_NS + i * PERIOD_NS}.png" for i in range(6)]
    (tmp_path / "mav0/cam1/data.csv").write_text("\n".join(rows))
    recording = open_source(tmp_path)
    assert [number(f) for f in frames(recording, "stereo")] == [0, 1, 2]
    assert {skip.reason for skip in recording.skipped} == {"cam1 has no image near enough in time"}
    assert len(frames(recording, "mono")) == 6


def test_the_body_of_a_euroc_folder_is_the_imu_even_where_the_files_have_another(tmp_path):
    write_euroc(tmp_path)
    yaml = (tmp_path / "mav0/imu0/sensor.yaml").read_text().replace("[1, 0, 0, 0,", "[1, 0, 0, 0.5,")
    (tmp_path / "mav0/imu0/sensor.yaml").write_text(yaml)
    recording = open_source(tmp_path)
    assert recording.rig.cameras[0].T_body_cam.t.tolist() == [-0.5, 0.0, 0.0]
    assert recording.ground_truth().xyz[0].tolist() == [0.5, 0.0, 0.0]


def test_time_offsets_put_all_stamps_on_the_body_clock(tmp_path):
    write_euroc(tmp_path)
    for c in (0, 1):
        with (tmp_path / f"mav0/cam{c}/sensor.yaml").open("a") as file:
            file.write("time_offset_s: 0.0025\n")
    recording = open_source(tmp_path)
    messages = list(recording.messages("stereo-inertial"))
    first = next(m for m in messages if isinstance(m, Frame))
    assert first.t_ns == START_NS + 2_500_000
    assert [m.t_ns for m in messages] == sorted(m.t_ns for m in messages)


def test_tum_vi_folders_take_their_lenses_from_kalibr_files(tmp_path):
    write_euroc(tmp_path)
    for file in tmp_path.glob("mav0/*/sensor.yaml"):
        file.unlink()
    (tmp_path / "mav0/state_groundtruth_estimate0").rename(tmp_path / "mav0/mocap0")
    camera = (
        "  camera_model: pinhole\n  distortion_model: equidistant\n  resolution: [64, 48]\n"
        "  intrinsics: [19.0, 19.0, 31.5, 23.5]\n  distortion_coeffs: [0.003, 0.0007, -0.002, 0.0002]\n"
    )
    pose = "[[1,0,0,0.02],[0,1,0,0],[0,0,1,0],[0,0,0,1]]"
    (tmp_path / "dso").mkdir()
    (tmp_path / "dso/camchain.yaml").write_text(
        f"cam0:\n{camera}  T_cam_imu: {pose}\ncam1:\n{camera}  T_cn_cnm1: {pose}\n"
    )
    (tmp_path / "dso/imu_config.yaml").write_text(
        "accelerometer_noise_density: 0.0028\naccelerometer_random_walk: 0.00086\n"
        "gyroscope_noise_density: 0.00016\ngyroscope_random_walk: 0.000022\nupdate_rate: 200.0\n"
    )
    recording = open_source(tmp_path)
    assert recording.rig.cameras[0].camera.model_name == "equidistant"
    assert recording.rig.cameras[1].T_body_cam.t == pytest.approx([-0.04, 0.0, 0.0])
    assert recording.rig.imu.accel_noise == 0.0028
    assert len(recording.ground_truth()) == 6
    assert len(frames(recording, "stereo-inertial")) == 6


def test_a_sevenscenes_folder_numbers_its_frames_in_thirtieths_of_a_second(tmp_path):
    write_sevenscenes(tmp_path, first=3)
    (tmp_path / "frame-000005.color.png").unlink()
    recording = open_source(tmp_path)
    assert [f.t_ns for f in frames(recording, "rgbd")] == [
        100_000_000,
        133_333_333,
        200_000_000,
        233_333_333,
        266_666_667,
    ]


def test_sevenscenes_truth_is_brought_from_the_depth_camera_to_the_colour_camera(tmp_path):
    recording = open_source(write_sevenscenes(tmp_path))
    # the colour camera looks the same way from 25 mm to the right
    assert recording.ground_truth().xyz == pytest.approx(np.array([[i + 0.025, 0, 0] for i in range(6)]))


def test_sevenscenes_depth_is_seen_from_the_colour_camera(tmp_path):
    depth = frames(open_source(write_sevenscenes(tmp_path)), "rgbd")[0].depth
    seen = depth > 0
    assert np.all(depth[seen] == np.float32(1.5))
    # The depth camera's 640 px at f 585 are 574 px at f 525, shifted 525 * 0.025 / 1.5 = 8.75 px to the left
    columns = np.nonzero(seen[240])[0]
    assert columns[0] == pytest.approx(319.5 - 525 * (320.5 / 585) - 8.75, abs=1)
    assert columns[-1] == pytest.approx(319.5 + 525 * (319.5 / 585) - 8.75, abs=1)
    assert seen[240, columns[0] : columns[-1]].all()


def test_a_kitti_folder_has_its_baseline_its_times_and_its_truth(tmp_path):
    recording = open_source(write_kitti(tmp_path))
    assert (recording.format, recording.rig.sensors) == ("kitti", "stereo")
    assert recording.rig.cameras[1].T_body_cam.t == pytest.approx([0.54, 0.0, 0.0])
    assert recording.rig.cameras[0].rate_hz == pytest.approx(10.0)
    got = frames(recording, "stereo")
    assert [f.t_ns for f in got] == [i * 100_000_000 for i in range(6)]
    assert recording.ground_truth().xyz[:, 2].tolist() == [0, 1, 2, 3, 4, 5]


@pytest.mark.parametrize(
    ("names", "stamps"),
    [
        (["f2.png", "f10.png", "f1.png"], [50_000_000, 100_000_000, 500_000_000]),
        (["1000000000.png", "1050000000.png", "1200000000.png"], [1_000_000_000, 1_050_000_000, 1_200_000_000]),
        (["1.5.png", "1.55.png", "1.700000001.png"], [1_500_000_000, 1_550_000_000, 1_700_000_001]),
    ],
    ids=["counted", "nanoseconds", "seconds"],
)
def test_image_folders_are_sorted_by_number_and_stamped_by_name(tmp_path, names, stamps):
    for i, name in enumerate(sorted(names, key=lambda n: float("".join(c for c in n[:-4] if c in "0123456789.")))):
        write(tmp_path / name, picture(i))
    got = frames(open_source(tmp_path, tiny_rig()), "mono")
    assert [f.t_ns for f in got] == stamps
    assert [number(f) for f in got] == [0, 1, 2]


@pytest.mark.parametrize(
    "rows", ["10.5\n10.6\n10.7\n", "b.png 10.6\na.png 10.5\nc.png 10.7\n", "10.5 a\n10.6 b\n10.7 c\n"]
)
def test_a_list_of_times_stamps_an_image_folder(tmp_path, rows):
    for i, name in enumerate("abc"):
        write(tmp_path / f"{name}.png", picture(i))
    (tmp_path / "times.txt").write_text(rows)
    assert [f.t_ns for f in frames(open_source(tmp_path, tiny_rig()), "mono")] == [
        10_500_000_000,
        10_600_000_000,
        10_700_000_000,
    ]


def test_deep_and_coloured_images_become_grey_bytes(tmp_path):
    """TUM-VI stores 16 bit; a Kinect's colour is weighed as OpenCV weighs it."""
    rng = np.random.default_rng(0)
    colour = rng.integers(0, 255, (48, 64, 3)).astype(np.uint8)
    write(tmp_path / "0.png", picture(3).astype(np.uint16) * 257)
    write(tmp_path / "1.png", colour)
    deep, grey = (f.images[0] for f in frames(open_source(tmp_path, tiny_rig()), "mono"))
    assert np.array_equal(deep, picture(3))
    assert np.abs(grey.astype(int) - cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY)).max() <= 1  # rounding


def test_a_rig_file_in_the_folder_speaks_for_it(tmp_path):
    for i in range(3):
        write(tmp_path / f"{i}.png", picture(i))
    with pytest.raises(CalibrationError, match="--rig"):
        open_source(tmp_path)
    write_rig(tmp_path / "rig.toml", tiny_rig())
    assert len(frames(open_source(tmp_path), "mono")) == 3
    with pytest.raises(CalibrationError, match="rate_hz"):
        open_source(tmp_path, tiny_rig(rate_hz=0.0))


def test_a_video_is_read_in_order_from_any_start(tmp_path):
    video = cv2.VideoWriter(str(tmp_path / "walk.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 25, (64, 48))
    if not video.isOpened():
        pytest.skip("this OpenCV cannot write a video")
    for i in range(12):
        video.write(cv2.cvtColor(picture(i), cv2.COLOR_GRAY2BGR))
    video.release()
    recording = open_source(tmp_path / "walk.avi", tiny_rig())
    assert recording.n_frames == 12
    assert [number(f) for f in frames(recording, "mono")] == list(range(12))
    got = frames(recording, "mono", 0.1, 0.3)
    assert [(f.t_ns, number(f)) for f in got] == [(i * 40_000_000, i) for i in range(3, 8)]


def test_a_stretch_takes_one_imu_sample_beyond_either_end(tmp_path):
    recording = open_source(write_euroc(tmp_path))
    messages = list(recording.messages("mono-inertial", 0.051, 0.149))
    imu = [(m.t_ns - START_NS) / 1e6 for m in messages if isinstance(m, Imu)]
    assert (imu[0], imu[-1]) == (50.0, 150.0)
    assert [number(m) for m in messages if isinstance(m, Frame)] == [2]


def test_a_stretch_without_frames_is_an_error_that_says_how_long_there_is(tmp_path):
    with pytest.raises(SourceError, match=r"lasts 0\.250 s"):
        frames(open_source(write_euroc(tmp_path)), "mono", 5.0)


@pytest.mark.parametrize("sensors", ["rgbd", "stereo-visual", "mono-", "", "Mono"])
def test_sensors_a_recording_cannot_serve_are_refused(tmp_path, sensors):
    recording = open_source(write_euroc(tmp_path, cameras=1))
    with pytest.raises((SourceError, ConfigError), match="mono"):
        recording.messages(sensors)


def test_reading_twice_gives_the_same_bytes(tmp_path):
    recording = open_source(write_tum(tmp_path))
    first, second = frames(recording, "rgbd"), frames(recording, "rgbd")
    assert [f.images[0].tobytes() + f.depth.tobytes() for f in first] == [
        f.images[0].tobytes() + f.depth.tobytes() for f in second
    ]


def test_what_is_no_recording_is_told_what_would_be(tmp_path):
    with pytest.raises(SourceError, match="does not exist"):
        open_source(tmp_path / "nothing")
    with pytest.raises(SourceError, match="TUM RGB-D"):
        open_source(tmp_path)
    (tmp_path / "note.txt").write_text("hello")
    with pytest.raises(SourceError, match="known here"):
        open_source(tmp_path / "note.txt")
    write_tum(tmp_path / "inner")
    with pytest.raises(SourceError, match="inner is: give that"):
        open_source(tmp_path)


def test_freiburg1_rpy_is_read_whole():
    recording = open_source(shared_data("tum_fr1_rpy"))
    got = frames(recording, "rgbd", 0.0, 1.0)
    assert (recording.n_frames, recording.rig.sensors) == (300, "rgbd")
    assert got[0].t_ns == 1305031229528748000
    assert got[0].images[0].shape == (480, 640)
    assert 0.3 < np.median(got[0].depth[got[0].depth > 0]) < 3.0
    assert recording.skipped == []
    assert recording.ground_truth().t_ns[0] == 1305031225933400000


def test_red_kitchen_depth_edges_lie_on_image_edges():
    """Registration by the built-in rig puts depth discontinuities on stronger gradients than none, or a wrong one."""
    recording = open_source(shared_data("redkitchen"))
    spec = recording.rig.depth
    assert spec.camera.params[0] == 585.0

    def mean_gradient(T_body_depth):
        rig = Rig(recording.rig.cameras, depth=replace(spec, T_body_depth=T_body_depth))
        total = []
        for frame in list(frames(open_source(recording.path, rig), "rgbd", 0.0, 2.0))[::10]:
            z = frame.depth
            nearer = (z[:, :-1] > 0) & (z[:, 1:] > 1.1 * z[:, :-1])  # the near side of a step in depth
            gradient = np.abs(cv2.Sobel(cv2.GaussianBlur(frame.images[0], (0, 0), 2.0), cv2.CV_32F, 1, 0))
            total.append(gradient[:, :-1][nearer].mean())
        return np.mean(total)

    right = mean_gradient(spec.T_body_depth)
    for x_m in (0.0, 0.025, -0.05):
        assert right > 1.02 * mean_gradient(SE3(np.eye(3), np.array([x_m, 0.0, 0.0])))


def test_euroc_folders_are_read_whole():
    recording = open_source(shared_data("euroc_mh05"))
    assert (recording.n_frames, recording.rig.sensors) == (260, "mono-inertial")
    messages = list(recording.messages("mono-inertial", 0.0, 0.5))
    assert messages[0].t_ns == 1403638533577829376  # the IMU starts 5 s before the first frame
    assert sum(isinstance(m, Frame) for m in messages) == 11
    assert 9.0 < np.linalg.norm(np.mean([m.accel for m in messages[:200]], axis=0)) < 11.0
    pair = open_source(shared_data("euroc_v1_01"))
    assert len(frames(pair, "stereo")) == 12
    assert np.linalg.norm(pair.rig.cameras[1].T_body_cam.t - pair.rig.cameras[0].T_body_cam.t) == pytest.approx(
        0.110, abs=1e-3
    )
    assert len(pair.ground_truth()) == 2895
