"""EuRoC folders we write: other tools read them, a kill leaves only good rows, and we read back what we wrote."""

import os
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml

from lodelight.cli.main import main
from lodelight.errors import SourceError
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.io import open_source
from lodelight.io.convert import convert
from lodelight.io.euroc_writer import (
    TRUTH,
    append_image,
    append_imu,
    append_truth,
    stored_depth,
    write_sensors,
    written_stamps,
)
from lodelight.io.rig_toml import write_rig
from lodelight.messages import Frame, Imu
from lodelight.rig import CameraSpec, DepthSpec, ImuSpec, Rig
from recordings import write_euroc, write_sevenscenes, write_tum

T0 = 1_000_000_000_123_456_789


def full_rig():
    lens = Camera.create("radtan", 64, 48, (50.0, 50.5, 31.5, 23.5), (-0.28, 0.07, 1e-4, 2e-5))
    fisheye = Camera.create("equidistant", 64, 48, (20.0, 20.0, 31.5, 23.5), (0.003, 7e-4, -0.002, 2e-4))
    poses = [SE3.exp(np.random.default_rng(i).normal(size=6)) for i in range(3)]
    cameras = (CameraSpec("cam0", lens, poses[0], 20.0), CameraSpec("cam1", fisheye, poses[1], 20.0))
    return Rig(
        cameras,
        depth=DepthSpec(lens, poses[0], units_per_m=5000.0),
        imu=ImuSpec(200.0, 1e-5, 2e-6, 3e-3, 4e-4),
        lights=CameraSpec("light0", lens, poses[2], 30.0, row_time_s=18.9e-6, exposure_s=60e-6),
    )


def write_full(root, n=4):
    rig = full_rig()
    folders = write_sensors(root, rig, comment="office: seed 1")
    rng = np.random.default_rng(0)
    for i in range(n):
        t = T0 + i * 50_000_000
        for camera in ("cam0", "cam1", "light0"):
            append_image(folders[camera], t, np.full((48, 64), 10 * i + 5, np.uint8))
        append_image(folders["depth0"], t, stored_depth(np.full((48, 64), 1.5, np.float32), rig.depth))
    t_ns = T0 + np.arange(0, n * 50_000_000, 5_000_000)
    append_imu(folders["imu0"], t_ns, rng.normal(size=(len(t_ns), 3)), rng.normal(size=(len(t_ns), 3)))
    zeros = np.zeros((len(t_ns), 3))
    quat_wxyz = np.tile([0.0, 1.0, 0.0, 0.0], (len(t_ns), 1))
    append_truth(folders[TRUTH], t_ns, rng.normal(size=(len(t_ns), 3)), quat_wxyz, zeros, zeros, zeros)
    return rig, folders


def test_what_is_written_is_read_back_exactly(tmp_path):
    rig, _ = write_full(tmp_path / "sim")
    (tmp_path / "sim/rig.toml").unlink()  # so that the yaml files speak
    recording = open_source(tmp_path / "sim")
    assert recording.rig.sensors == "rgbd-inertial"
    pairs = zip((*rig.cameras, rig.lights), (*recording.rig.cameras, recording.rig.lights), strict=True)
    for ours, theirs in pairs:
        assert theirs.camera.params.tolist() == ours.camera.params.tolist()
        assert np.array_equal(theirs.T_body_cam.matrix, ours.T_body_cam.matrix)
        assert (theirs.rate_hz, theirs.row_time_s, theirs.exposure_s) == (
            ours.rate_hz,
            ours.row_time_s,
            ours.exposure_s,
        )
    assert recording.rig.imu == rig.imu
    assert recording.rig.depth.units_per_m == 5000.0
    messages = list(recording.messages("rgbd-inertial"))
    assert [m.t_ns for m in messages if isinstance(m, Frame)] == [T0 + i * 50_000_000 for i in range(4)]
    assert all(np.all(m.depth == np.float32(1.5)) for m in messages if isinstance(m, Frame))
    rng = np.random.default_rng(0)
    gyro, accel = rng.normal(size=(40, 3)), rng.normal(size=(40, 3))
    imu = [m for m in messages if isinstance(m, Imu)]
    assert np.array_equal([m.gyro for m in imu], gyro[: len(imu)])
    assert np.array_equal([m.accel for m in imu], accel[: len(imu)])
    assert np.array_equal(recording.ground_truth().xyz, rng.normal(size=(40, 3)))
    assert recording.ground_truth().quat_xyzw[0].tolist() == [1, 0, 0, 0]


def test_sensor_yaml_has_the_keys_of_euroc_and_is_read_by_plain_yaml_and_by_opencv(tmp_path):
    rig, folders = write_full(tmp_path)
    text = (folders["cam0"] / "sensor.yaml").read_text()
    assert text.startswith("%YAML:1.0\n")
    data = yaml.safe_load(re.sub(r"^%YAML:1.0\n", "", text))  # as every EuRoC reader has to
    assert {"sensor_type", "comment", "T_BS", "rate_hz", "resolution", "camera_model", "intrinsics"} <= data.keys()
    assert data["comment"] == "office: seed 1"
    assert data["camera_model"] == "pinhole"
    assert data["distortion_model"] == "radial-tangential"
    assert data["distortion_coefficients"] == [-0.28, 0.07, 1e-4, 2e-5]
    assert np.array_equal(np.array(data["T_BS"]["data"]).reshape(4, 4), rig.cameras[0].T_body_cam.matrix)
    imu = yaml.safe_load(re.sub(r"^%YAML:1.0\n", "", (folders["imu0"] / "sensor.yaml").read_text()))
    assert imu["gyroscope_noise_density"] == 1e-5
    assert imu["accelerometer_random_walk"] == 4e-4
    storage = cv2.FileStorage(str(folders["cam1"] / "sensor.yaml"), cv2.FILE_STORAGE_READ)
    assert storage.getNode("distortion_model").string() == "equidistant"
    assert storage.getNode("T_BS").getNode("data").size() == 16
    assert storage.getNode("intrinsics").at(0).real() == 20.0
    storage.release()


def test_csv_headers_are_those_of_euroc(tmp_path):
    _, folders = write_full(tmp_path)
    assert (folders["cam0"] / "data.csv").read_text().startswith("#timestamp [ns],filename\n")
    assert (folders["imu0"] / "data.csv").read_text().startswith("#timestamp [ns],w_RS_S_x [rad s^-1],")
    assert len((folders[TRUTH] / "data.csv").read_text().splitlines()[1].split(",")) == 17


def test_a_row_cut_by_a_kill_is_removed_and_writing_goes_on(tmp_path):
    rig, folders = write_full(tmp_path)
    data = folders["cam0"] / "data.csv"
    data.write_text(data.read_text() + "10000000")
    folders = write_sensors(tmp_path, rig)  # a second start keeps what is there
    assert written_stamps(folders["cam0"]) == [T0 + i * 50_000_000 for i in range(4)]
    append_image(folders["cam0"], T0 + 200_000_000, np.zeros((48, 64), np.uint8))
    assert len(written_stamps(folders["cam0"])) == 5
    assert len(open_source(tmp_path).ground_truth()) == 40
    assert written_stamps(tmp_path / "mav0" / "cam7") == []


def test_an_image_has_no_row_before_it_is_whole_on_disk(tmp_path, monkeypatch):
    _, folders = write_full(tmp_path)

    def killed(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("lodelight.io.euroc_writer.os.replace", killed)
    with pytest.raises(SourceError, match="No space left"):
        append_image(folders["cam0"], T0 + 200_000_000, np.zeros((48, 64), np.uint8))
    assert len(written_stamps(folders["cam0"])) == 4
    assert not any(name.startswith(str(T0 + 200_000_000)) for name in os.listdir(folders["cam0"] / "data"))


def test_depth_that_does_not_fit_is_stored_as_none():
    spec = full_rig().depth
    depth = np.array([[0.0, np.nan, np.inf, -1.0, 1e-5, 1.23456, 13.1, 14.0]], np.float32)
    assert stored_depth(depth, spec)[0].tolist() == [0, 0, 0, 0, 0, 6173, 65500, 0]


@pytest.mark.parametrize("make", [write_tum, write_sevenscenes, write_euroc])
def test_any_recording_survives_its_conversion_to_a_euroc_folder(tmp_path, make):
    source = open_source(make(tmp_path / "freiburg1"))
    convert(source.path, tmp_path / "out")
    copy = open_source(tmp_path / "out")
    assert copy.rig.sensors == source.rig.sensors
    ours, theirs = list(source.messages(source.rig.sensors)), list(copy.messages(source.rig.sensors))
    assert [(type(m), m.t_ns) for m in theirs] == [(type(m), m.t_ns) for m in ours]
    for a, b in zip(ours, theirs, strict=True):
        if isinstance(a, Frame):
            assert all(np.array_equal(x, y) for x, y in zip(a.images, b.images, strict=True))
            assert a.depth is None or np.array_equal(a.depth, b.depth)
        else:
            assert np.array_equal(a.gyro, b.gyro)
            assert np.array_equal(a.accel, b.accel)
    assert np.allclose(copy.ground_truth().xyz, source.ground_truth().xyz, atol=1e-9)  # nine decimals


def test_the_light_camera_comes_along_on_the_bodys_clock(tmp_path):
    rig, _ = write_full(tmp_path / "full")
    write_rig(tmp_path / "late.toml", replace(rig, lights=replace(rig.lights, time_offset_s=0.002)))
    source = open_source(tmp_path / "full", tmp_path / "late.toml")
    convert(source.path, tmp_path / "out", tmp_path / "late.toml", end_s=0.12)
    copy = open_source(tmp_path / "out")
    assert (copy.rig.lights.time_offset_s, copy.rig.lights.row_time_s) == (0.0, 18.9e-6)
    for a, b in zip(source.light_frames(end_s=0.12), copy.light_frames(), strict=True):
        assert a.t_ns == b.t_ns
        assert np.array_equal(a.images[0], b.images[0])


def test_the_command_converts_recordings_trajectories_and_rigs(tmp_path, capsys):
    source = write_euroc(tmp_path / "flight")
    for i, dest in enumerate(("cut", "truth.tum", "truth.kitti", "rig.toml")):
        window = ["--start", "0.05", "--end", "0.15"] if i == 0 else []
        assert main(["convert", str(source), str(tmp_path / dest), *window]) == 0
    assert open_source(tmp_path / "cut").n_frames == 3
    assert main(["convert", str(tmp_path / "truth.tum"), str(tmp_path / "again.csv")]) == 0
    assert len((tmp_path / "again.csv").read_text().splitlines()) == 7
    capsys.readouterr()
    assert main(["convert", str(source), str(tmp_path / "cut")]) == 2
    assert "exists already" in capsys.readouterr().err
    (source / "mav0/cam0/data").rename(source / "mav0/cam0/gone")
    assert main(["convert", str(source), str(tmp_path / "none")]) == 2
    assert "6x image file is missing" in capsys.readouterr().err
