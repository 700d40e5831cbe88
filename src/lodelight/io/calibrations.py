"""Calibration files of other tools to a rig: EuRoC, Kalibr, ROS CameraInfo, OpenCV; and `rig.toml`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lodelight.errors import CalibrationError
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.io.rig_toml import read_rig
from lodelight.io.schema import Section
from lodelight.io.yaml_file import read_yaml
from lodelight.rig import CameraSpec, DepthSpec, ImuSpec, Rig

DISTORTIONS = {
    "radial-tangential": "radtan",
    "radtan": "radtan",
    "plumb_bob": "radtan",
    "rational_polynomial": "radtan",
    "equidistant": "equidistant",
    "fisheye": "equidistant",
    "none": "radtan",
}


def load_rig(path: str | Path) -> Rig:
    """The rig of a file, whichever of the known kinds it is.

    `rig.toml`; an EuRoC `sensor.yaml` of one camera; a Kalibr camchain (the IMU's noise from an `imu*.yaml` beside
    it, else ImuSpec's defaults); a ROS CameraInfo or OpenCV calibration of one camera, which is then the body.
    Raises CalibrationError naming file and key.
    """
    path = Path(path)
    if path.suffix.lower() == ".toml":
        return read_rig(path)
    root = read_yaml(path)
    if "T_BS" in root or "sensor_type" in root:
        return Rig((euroc_camera(root, "cam0"),))
    if "cam0" in root:
        return kalibr_rig(path)
    if any(key in root for key in ("camera_matrix", "K", "k")):
        return Rig((CameraSpec("cam0", matrix_camera(root), SE3.identity()),))
    raise CalibrationError(
        f"{path} is no calibration known here; expected rig.toml, an EuRoC sensor.yaml (T_BS), a Kalibr camchain "
        "(cam0), a ROS CameraInfo or an OpenCV calibration (camera_matrix)"
    )


def euroc_camera(root: Section, name: str) -> CameraSpec:
    """A camera's `sensor.yaml`, with this project's additions: time_offset_s, row_time_s, stamped_row, exposure_s."""
    return CameraSpec(
        name,
        _named_lens(root, "distortion_coefficients"),
        root.motion("T_BS"),
        rate_hz=root.number("rate_hz", 0.0, minimum=0.0),
        time_offset_s=root.number("time_offset_s", 0.0),
        row_time_s=root.number("row_time_s", 0.0, minimum=0.0),
        stamped_row=root.number("stamped_row", 0.0, minimum=0.0),
        exposure_s=root.number("exposure_s", 0.0, minimum=0.0),
    )


def euroc_depth(root: Section, cam0: CameraSpec) -> DepthSpec:
    """A `depth0/sensor.yaml` as this project writes it."""
    registered = root.flag("registered", True)
    a, b, c = root.numbers("noise", 3) if "noise" in root else DepthSpec.noise
    return DepthSpec(
        cam0.camera if registered else _named_lens(root, "distortion_coefficients"),
        cam0.T_body_cam if registered else root.motion("T_BS"),
        root.number("units_per_m", DepthSpec.units_per_m, minimum=1e-9),
        registered,
        root.number("min_m", DepthSpec.min_m, minimum=0.0),
        root.number("max_m", DepthSpec.max_m, minimum=0.0),
        (a, b, c),
    )


def imu_spec(root: Section) -> ImuSpec:
    """Noise densities as EuRoC and Kalibr name them."""
    rate = "update_rate" if "update_rate" in root else "rate_hz"
    return ImuSpec(
        rate_hz=root.number(rate, ImuSpec.rate_hz, minimum=0.0),
        gyro_noise=root.number("gyroscope_noise_density", minimum=0.0),
        gyro_walk=root.number("gyroscope_random_walk", minimum=0.0),
        accel_noise=root.number("accelerometer_noise_density", minimum=0.0),
        accel_walk=root.number("accelerometer_random_walk", minimum=0.0),
        time_offset_s=root.number("time_offset_s", 0.0),
    )


def kalibr_rig(path: Path) -> Rig:
    """A Kalibr camchain. The body is the IMU where the chain has `T_cam_imu`, else camera 0."""
    root = read_yaml(path)
    cameras: list[CameraSpec] = []
    while (name := f"cam{len(cameras)}") in root:
        section = root.table(name)
        cameras.append(
            CameraSpec(
                name,
                _named_lens(section, "distortion_coeffs"),
                _kalibr_pose(section, cameras),
                time_offset_s=section.number("timeshift_cam_imu", 0.0),
            )
        )
    has_imu = "T_cam_imu" in root.table("cam0") or "T_imu_cam" in root.table("cam0")
    return Rig(tuple(cameras), imu=_kalibr_imu(path.parent) if has_imu else None)


def _kalibr_pose(section: Section, before: list[CameraSpec]) -> SE3:
    """T_body_cam of the next camera of a chain."""
    if "T_cam_imu" in section:
        return section.motion("T_cam_imu").inverse()
    if "T_imu_cam" in section:
        return section.motion("T_imu_cam")
    if "T_cn_cnm1" in section and before:
        return before[-1].T_body_cam @ section.motion("T_cn_cnm1").inverse()
    if before:
        raise CalibrationError(f"{section.at('T_cn_cnm1')} is missing, and so is T_cam_imu: add where the camera sits")
    return SE3.identity()


def _kalibr_imu(folder: Path) -> ImuSpec:
    found = sorted(folder.glob("imu*.yaml"))
    if not found:
        return ImuSpec()
    root = read_yaml(found[0])
    return imu_spec(root.table("imu0") if "imu0" in root else root)


def _named_lens(section: Section, coefficients: str) -> Camera:
    """A lens by the names of EuRoC and Kalibr: camera_model, intrinsics, distortion_model, resolution."""
    model = section.text("camera_model")
    size = section.size("resolution")
    if model == "ds":
        xi, alpha, fx, fy, cx, cy = section.numbers("intrinsics", 6)
        return _create(section, "double_sphere", size, (fx, fy, cx, cy), (xi, alpha))
    if model != "pinhole":
        raise CalibrationError(f"{section.at('camera_model')} {model!r} is not supported; choose pinhole or ds")
    fx, fy, cx, cy = section.numbers("intrinsics", 4)
    distortion = section.numbers(coefficients) if coefficients in section else ()
    return _create(section, _distortion_model(section), size, (fx, fy, cx, cy), distortion)


def matrix_camera(root: Section) -> Camera:
    """A lens by its 3x3 matrix: files of ROS (CameraInfo, also printed as a message) and OpenCV."""
    width = "image_width" if "image_width" in root else "width"
    height = "image_height" if "image_height" in root else "height"
    size = int(root.number(width, minimum=1)), int(root.number(height, minimum=1))
    key = next(key for key in ("camera_matrix", "K", "k") if key in root)
    flat = isinstance(root.value(key), list) and len(root.value(key)) == 9
    K = np.array(root.numbers(key)).reshape(3, 3) if flat else root.matrix(key)
    if K.shape != (3, 3):
        raise CalibrationError(f"{root.at(key)} must be a 3x3 matrix, not {K.shape[0]}x{K.shape[1]}")
    names = ("distortion_coefficients", "dist_coeffs", "D", "d")
    found = next((name for name in names if name in root), None)
    distortion: tuple[float, ...] = ()
    if found:
        stored = root.value(found)
        distortion = tuple(root.matrix(found).ravel().tolist()) if isinstance(stored, dict) else root.numbers(found)
    model = "equidistant" if "fisheye_model" in root and root.value("fisheye_model") else _distortion_model(root)
    return _create(root, model, size, (K[0, 0], K[1, 1], K[0, 2], K[1, 2]), distortion)


def _distortion_model(section: Section) -> str:
    name = section.text("distortion_model") if "distortion_model" in section else "none"
    if name not in DISTORTIONS:
        known = ", ".join(DISTORTIONS)
        raise CalibrationError(f"{section.at('distortion_model')} {name!r} is not supported; choose one of {known}")
    return DISTORTIONS[name]


def _create(
    section: Section,
    model: str,
    size: tuple[int, int],
    intrinsics: tuple[float, float, float, float],
    distortion: tuple[float, ...],
) -> Camera:
    while len(distortion) > 4 and distortion[-1] == 0.0:  # ROS and OpenCV pad with zeros
        distortion = distortion[:-1]
    try:
        return Camera.create(model, *size, intrinsics, distortion)
    except CalibrationError as error:
        raise CalibrationError(f"{section.where} {error}") from None
