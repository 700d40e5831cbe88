"""Rig files: `rig.toml` to the last bit, and what EuRoC, Kalibr, ROS and OpenCV write, read as they mean it."""

from contextlib import suppress

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import example, given
from hypothesis import strategies as st

from conftest import shared_data
from lodelight.errors import CalibrationError, LodelightError
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.io.calibrations import load_rig
from lodelight.io.rig_toml import read_rig, write_rig
from lodelight.rig import CameraSpec, DepthSpec, ImuSpec, Rig
from recordings import SENSOR_YAML


def pose(seed):
    return SE3.exp(np.random.default_rng(seed).normal(size=6))


def full_rig():
    radtan = Camera.create("radtan", 752, 480, (458.654, 457.296, 367.215, 248.375), (-0.28, 0.07, 1e-4, 2e-5, 1e-7))
    fisheye = Camera.create("equidistant", 512, 512, (190.9, 190.8, 254.9, 256.9), (0.0034, 0.0007, -0.002, 0.0002))
    sphere = Camera.create("double_sphere", 512, 512, (158.28, 158.27, 254.96, 256.88), (-0.172, 0.593))
    return Rig(
        (CameraSpec("cam0", radtan, pose(1), 20.0, -0.00123456789), CameraSpec('left "é"', fisheye, pose(2), 20.0)),
        depth=DepthSpec(sphere, pose(3), 5000.0, False, 0.1, 10.0, (0.001, 0.002, 0.3)),
        imu=ImuSpec(400.0, 1 / 3, 1e-300, 0.1 + 0.2, 3e-3, 0.001),
        lights=CameraSpec("light0", radtan, pose(4), 30.0, row_time_s=18.9e-6, exposure_s=60e-6),
    )


def same_lens(a, b):
    return (a.model, a.width, a.height, a.params.tolist()) == (b.model, b.width, b.height, b.params.tolist())


def same_camera(a, b):
    timing = ("name", "rate_hz", "time_offset_s", "row_time_s", "exposure_s")
    return (
        all(getattr(a, key) == getattr(b, key) for key in timing)
        and same_lens(a.camera, b.camera)
        and np.array_equal(a.T_body_cam.matrix, b.T_body_cam.matrix)
    )


def test_rig_toml_gives_back_every_bit(tmp_path):
    rig = full_rig()
    write_rig(tmp_path / "rig.toml", rig)
    again = read_rig(tmp_path / "rig.toml")
    assert all(same_camera(a, b) for a, b in zip(rig.cameras, again.cameras, strict=True))
    assert same_camera(rig.lights, again.lights)
    assert again.imu == rig.imu
    assert same_lens(rig.depth.camera, again.depth.camera)
    assert np.array_equal(rig.depth.T_body_depth.matrix, again.depth.T_body_depth.matrix)
    keys = ("units_per_m", "registered", "min_m", "max_m", "noise")
    assert all(getattr(rig.depth, key) == getattr(again.depth, key) for key in keys)
    write_rig(tmp_path / "again.toml", again)
    assert (tmp_path / "again.toml").read_bytes() == (tmp_path / "rig.toml").read_bytes()


def test_registered_depth_takes_the_lens_and_pose_of_camera_0(tmp_path):
    text = minimal() + "[depth]\nunits_per_m = 5000\n"
    (tmp_path / "rig.toml").write_text(text)
    rig = read_rig(tmp_path / "rig.toml")
    assert rig.depth.registered
    assert same_lens(rig.depth.camera, rig.cameras[0].camera)
    assert rig.depth.max_m == DepthSpec.max_m


def minimal():
    return (
        '[[camera]]\nmodel = "radtan"\nsize = [640, 480]\nintrinsics = [525, 525.0, 319.5, 239.5]\n'
        "T_body_cam = [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]\n"
    )


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("T_body_cam", "T_body_cm", r"camera\[0\]\.T_body_cam is missing"),
        ("size", "extra = 1\nsize", r"camera\[0\]\.extra is unknown.*T_body_cam"),
        ("[[camera]]", "[[cameras]]", "camera is missing"),
        ("[[camera]]", "[camera]", r"\[\[camera\]\]"),
        ("525,", "nan,", r"camera\[0\]\.intrinsics.*finite.*nan"),
        ("525,", "-525,", r"camera\[0\].*positive"),
        ("525,", '"525",', r"camera\[0\]\.intrinsics"),
        ("[525,", "[", r"camera\[0\]\.intrinsics must be a list of 4"),
        ("radtan", "pinhole", r"camera\[0\].*pinhole.*radtan"),
        ("[640, 480]", "[640.5, 480]", r"camera\[0\]\.size"),
        ("[640, 480]", "640", r"camera\[0\]\.size"),
        ("[1,0,0,0]", "[2,0,0,0]", r"camera\[0\]\.T_body_cam is no rigid motion"),
        ("[1,0,0,0]", "[-1,0,0,0]", r"camera\[0\]\.T_body_cam is no rigid motion"),
        ("[1,0,0,0]", "[1,0,0]", r"camera\[0\]\.T_body_cam must be a matrix"),
        ("[1,0,0,0]", "[1,0,0,inf]", r"camera\[0\]\.T_body_cam"),
        ("size", "rate_hz = -1\nsize", r"camera\[0\]\.rate_hz.*at least 0"),
        ("size", "rate_hz = true\nsize", r"camera\[0\]\.rate_hz"),
        ("model", "model = \n", "not valid TOML"),
    ],
)
def test_a_wrong_rig_toml_is_told_with_file_and_key(tmp_path, old, new, says):
    (tmp_path / "rig.toml").write_text(minimal().replace(old, new, 1))
    with pytest.raises(CalibrationError, match=rf"rig\.toml.*{says}"):
        read_rig(tmp_path / "rig.toml")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[imu]\ngyro_noise = -1\n", r"imu\.gyro_noise"),
        ("[imu]\ngyro = 1\n", r"imu\.gyro is unknown"),
        ("[depth]\nunits_per_m = 0\n", r"depth\.units_per_m must be positive"),
        ("[depth]\nmin_m = 9\n", r"depth\.min_m must be below max_m"),
        ("[depth]\nregistered = 1\n", r"depth\.registered must be true or false"),
        ("[depth]\nregistered = false\n", r"depth\.model is missing"),
        ("[depth]\nT_body_depth = 1\n", r"depth\.T_body_depth is unknown"),
        ("[camera0]\n", "camera0 is unknown"),
        ("imu = 3\n", "not valid TOML|imu"),
    ],
)
def test_a_wrong_part_of_a_rig_toml_is_told_with_file_and_key(tmp_path, text, says):
    (tmp_path / "rig.toml").write_text(minimal() + text)
    with pytest.raises(CalibrationError, match=says):
        read_rig(tmp_path / "rig.toml")


def test_a_rotation_written_with_few_digits_becomes_a_rotation(tmp_path):
    (tmp_path / "rig.toml").write_text(minimal().replace("[1,0,0,0],[0,1,0,0]", "[0.866,0.5,0,0],[-0.5,0.866,0,0]"))
    R = read_rig(tmp_path / "rig.toml").cameras[0].T_body_cam.R
    assert np.allclose(R @ R.T, np.eye(3), atol=1e-15)


def test_a_euroc_sensor_yaml_is_one_camera(tmp_path):
    (tmp_path / "sensor.yaml").write_text(SENSOR_YAML.format(x=0.25))
    (spec,) = load_rig(tmp_path / "sensor.yaml").cameras
    assert spec.camera.params[:4].tolist() == [50.0, 50.5, 31.5, 23.5]
    assert spec.camera.distortion == (-0.28340811, 0.07395907, 1e-4, 1.76187114e-05, 0.0)
    assert spec.T_body_cam.t.tolist() == [0.25, 0.0, 0.0]
    assert spec.rate_hz == 20.0


def test_the_real_euroc_calibration_puts_the_cameras_11_cm_apart():
    left, right = (
        load_rig(shared_data("euroc_loop_pairs") / f"sensor{side}.yaml").cameras[0] for side in ("Left", "Right")
    )
    baseline = left.T_body_cam.inverse() @ right.T_body_cam
    assert np.linalg.norm(baseline.t) == pytest.approx(0.110, abs=5e-4)
    assert baseline.t[0] > 0.1  # the right one is to the right


CAMCHAIN = """cam0:
  T_cam_imu:
  - [0.0, 1.0, 0.0, 0.1]
  - [-1.0, 0.0, 0.0, 0.2]
  - [0.0, 0.0, 1.0, 0.3]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.27, 0.067, 8.75e-4, 1e-4]
  distortion_model: radtan
  intrinsics: [461.6, 460.2, 362.7, 246.0]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
  timeshift_cam_imu: -8.121e-05
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.11]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: ds
  distortion_coeffs: []
  distortion_model: none
  intrinsics: [-0.172, 0.593, 158.28, 158.27, 254.96, 256.88]
  resolution: [512, 512]
"""


def test_a_kalibr_chain_places_each_camera_by_the_one_before(tmp_path):
    (tmp_path / "camchain.yaml").write_text(CAMCHAIN)
    (tmp_path / "imu.yaml").write_text(KALIBR_IMU)
    rig = load_rig(tmp_path / "camchain.yaml")
    T_cam0_imu = np.array(yaml.safe_load(CAMCHAIN)["cam0"]["T_cam_imu"])
    assert np.allclose(rig.cameras[0].T_body_cam.matrix @ T_cam0_imu, np.eye(4), atol=1e-12)
    T_cam1_cam0 = rig.cameras[1].T_body_cam.inverse() @ rig.cameras[0].T_body_cam
    assert T_cam1_cam0.t == pytest.approx([-0.11, 0.0, 0.0])
    assert rig.cameras[0].time_offset_s == -8.121e-05
    assert rig.cameras[1].camera.model_name == "double_sphere"
    assert rig.cameras[1].camera.distortion == (-0.172, 0.593)
    assert rig.imu == ImuSpec(200.0, 0.005, 4e-6, 0.06, 2e-4)


KALIBR_IMU = """accelerometer_noise_density: 0.06
accelerometer_random_walk: 2e-4
gyroscope_noise_density: 0.005
gyroscope_random_walk: 4e-6
rostopic: /imu0
update_rate: 200.0
"""


def test_a_kalibr_chain_without_an_imu_has_camera_0_as_its_body(tmp_path):
    data = yaml.safe_load(CAMCHAIN)
    del data["cam0"]["T_cam_imu"]
    (tmp_path / "camchain.yaml").write_text(yaml.safe_dump(data))
    rig = load_rig(tmp_path / "camchain.yaml")
    assert rig.imu is None
    assert np.array_equal(rig.cameras[0].T_body_cam.matrix, np.eye(4))
    assert rig.cameras[1].T_body_cam.t == pytest.approx([0.11, 0.0, 0.0])


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("T_cn_cnm1", "T_x", r"cam1\.T_cn_cnm1 is missing"),
        ("camera_model: pinhole", "camera_model: omni", r"cam0\.camera_model 'omni'"),
        ("distortion_model: radtan", "distortion_model: fov", r"cam0\.distortion_model 'fov'"),
        ("[461.6,", "[.nan,", r"cam0\.intrinsics"),
        ("[461.6,", "[-461.6,", r"cam0.*positive"),
        ("resolution: [752, 480]", "size: 1", r"cam0\.resolution is missing"),
        ("  T_cam_imu:", "  T_cam_imu: {", "not valid YAML"),
    ],
)
def test_a_wrong_kalibr_chain_is_told_with_file_and_key(tmp_path, old, new, says):
    (tmp_path / "chain.yaml").write_text(CAMCHAIN.replace(old, new, 1))
    with pytest.raises(CalibrationError, match=rf"chain\.yaml.*{says}"):
        load_rig(tmp_path / "chain.yaml")


K = np.array([[526.7, 0, 312.3], [0, 525.75, 246.2], [0, 0, 1]])
D = np.array([0.0186, -0.0808, 0.00067, -0.0018, 0.01])


def test_what_opencv_writes_is_read_back(tmp_path):
    file = cv2.FileStorage(str(tmp_path / "camera.yml"), cv2.FILE_STORAGE_WRITE)
    file.write("image_width", 640)
    file.write("image_height", 480)
    file.write("camera_matrix", K)
    file.write("distortion_coefficients", D.reshape(1, 5))
    file.release()
    (spec,) = load_rig(tmp_path / "camera.yml").cameras
    assert np.allclose(spec.camera.K, K, atol=0)
    assert spec.camera.distortion == tuple(D)
    assert (spec.camera.width, spec.camera.height) == (640, 480)


def ros_info(model="plumb_bob", coefficients=tuple(D)):
    return {
        "image_width": 640,
        "image_height": 480,
        "camera_name": "rgb",
        "camera_matrix": {"rows": 3, "cols": 3, "data": K.ravel().tolist()},
        "distortion_model": model,
        "distortion_coefficients": {"rows": 1, "cols": len(coefficients), "data": list(map(float, coefficients))},
        "rectification_matrix": {"rows": 3, "cols": 3, "data": np.eye(3).ravel().tolist()},
        "projection_matrix": {"rows": 3, "cols": 4, "data": [0.0] * 12},
    }


def test_a_ros_camera_info_file_is_read(tmp_path):
    (tmp_path / "info.yaml").write_text(yaml.safe_dump(ros_info()))
    camera = load_rig(tmp_path / "info.yaml").cameras[0].camera
    assert np.allclose(camera.K, K, atol=0)
    assert camera.distortion == tuple(D)


def test_a_printed_ros_camera_info_message_is_read(tmp_path):
    message = {
        "height": 480,
        "width": 640,
        "distortion_model": "equidistant",
        "d": [0.1, 0.2, 0.3, 0.4],
        "k": K.ravel().tolist(),
        "r": [0.0] * 9,
        "p": [0.0] * 12,
    }
    (tmp_path / "info.yaml").write_text(yaml.safe_dump(message))
    camera = load_rig(tmp_path / "info.yaml").cameras[0].camera
    assert camera.model_name == "equidistant"
    assert camera.distortion == (0.1, 0.2, 0.3, 0.4)


def test_a_rational_distortion_is_read_where_its_denominator_is_one_and_refused_elsewhere(tmp_path):
    (tmp_path / "a.yaml").write_text(yaml.safe_dump(ros_info("rational_polynomial", (*D, 0, 0, 0))))
    assert load_rig(tmp_path / "a.yaml").cameras[0].camera.distortion == tuple(D)
    (tmp_path / "b.yaml").write_text(yaml.safe_dump(ros_info("rational_polynomial", (*D, 0.1, 0, 0))))
    with pytest.raises(CalibrationError, match="at most 5"):
        load_rig(tmp_path / "b.yaml")


def test_an_uncalibrated_camera_info_is_refused(tmp_path):
    info = ros_info() | {"camera_matrix": {"rows": 3, "cols": 3, "data": [0.0] * 9}}
    (tmp_path / "info.yaml").write_text(yaml.safe_dump(info))
    with pytest.raises(CalibrationError, match=r"info\.yaml.*positive"):
        load_rig(tmp_path / "info.yaml")


@pytest.mark.parametrize("text", ["", "a: 1\n", "- 1\n", "just text", "cam0: 3\n", "\t:", "T_BS: 1\ncamera_model: x"])
def test_what_is_no_calibration_is_told(tmp_path, text):
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(CalibrationError, match=r"a\.yaml"):
        load_rig(tmp_path / "a.yaml")


@example(at=368, junk=";")  # leaves 8.121e-0; which YAML takes for a number and cannot read
@given(st.integers(0, len(CAMCHAIN)), st.text(max_size=5))
def test_a_damaged_file_is_a_rig_or_one_clear_error(tmp_path_factory, at, junk):
    path = tmp_path_factory.mktemp("rig") / "chain.yaml"
    path.write_text(CAMCHAIN[:at] + junk, encoding="utf-8")
    with suppress(LodelightError):
        load_rig(path)
