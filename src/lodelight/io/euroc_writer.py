"""Writing EuRoC/ASL folders: `sensor.yaml` in EuRoC's own schema, images and rows appended as they come.

A writer calls `write_sensors` once, then `append_image`, `append_imu` and `append_truth` on the folders it names:

    folders = write_sensors(root, rig, comment="office, seed 1")
    append_image(folders["cam0"], t_ns, image)
    append_image(folders["depth0"], t_ns, stored_depth(depth_m, rig.depth))

An image is on disk before its row is, so that after a kill every row is good; `written_stamps` tells where to go on.
`depth0` and `light0` stand beside EuRoC's folders with keys of their own; other people's tools do not look there.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from lodelight.errors import SourceError
from lodelight.geometry.cameras import DOUBLE_SPHERE, EQUIDISTANT, Camera
from lodelight.geometry.se3 import SE3
from lodelight.io.rig_toml import write_rig
from lodelight.io.text import write_text
from lodelight.rig import CameraSpec, DepthSpec, ImuSpec, Rig
from lodelight.types import AnyArray, Array, ArrayF32

IMAGE_HEADER = "#timestamp [ns],filename\n"
IMU_HEADER = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\n"
)
TRUTH_HEADER = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
    "v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], "
    "b_w_RS_S_x [rad s^-1], b_w_RS_S_y [rad s^-1], b_w_RS_S_z [rad s^-1], "
    "b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], b_a_RS_S_z [m s^-2]\n"
)
TRUTH = "state_groundtruth_estimate0"


def write_sensors(root: str | Path, rig: Rig, comment: str = "") -> dict[str, Path]:
    """Lay out `root/mav0` for the rig: every `sensor.yaml`, `body.yaml`, `root/rig.toml`, empty `data.csv`s.

    Rows already there are kept. Returns the folder of each sensor: cam0, cam1, ..., imu0, depth0, light0 as the rig
    has them, and state_groundtruth_estimate0.
    """
    root = Path(root)
    texts = {f"cam{i}": camera_yaml(spec, comment) for i, spec in enumerate(rig.cameras)}
    if rig.imu is not None:
        texts["imu0"] = imu_yaml(rig.imu, comment)
    if rig.depth is not None:
        texts["depth0"] = depth_yaml(rig.depth, comment)
    if rig.lights is not None:
        texts["light0"] = camera_yaml(rig.lights, comment)
    texts[TRUTH] = _yaml("visual-inertial", comment, SE3.identity(), {})
    folders = {name: root / "mav0" / name for name in texts}
    for name, text in texts.items():
        write_text(folders[name] / "sensor.yaml", text)
        data = folders[name] / "data.csv"
        if not data.exists():
            write_text(data, {"imu0": IMU_HEADER, TRUTH: TRUTH_HEADER}.get(name, IMAGE_HEADER))
    write_text(root / "mav0" / "body.yaml", f"%YAML:1.0\ncomment: {_text(comment)}\n")
    write_rig(root / "rig.toml", rig)
    return folders


def append_image(sensor: Path, t_ns: int, image: AnyArray) -> None:
    """Write `data/<t_ns>.png` (grey uint8, or uint16 for depth) and its row."""
    name = f"{t_ns}.png"
    ok, data = cv2.imencode(".png", image)
    if not ok:
        raise SourceError(f"cannot encode image {t_ns} of {sensor}: {image.dtype} {image.shape} is no PNG")
    target = sensor / "data" / name
    half = target.with_suffix(".part")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        half.write_bytes(data.tobytes())
        os.replace(half, target)
    except OSError as error:
        with suppress(OSError):
            half.unlink(missing_ok=True)
        raise SourceError(f"cannot write {target}: {error.strerror}; make room or choose another --out") from None
    _append(sensor, [f"{t_ns},{name}\n"])


def append_imu(sensor: Path, t_ns: NDArray[np.int64], gyro: Array, accel: Array) -> None:
    """Rows of t_ns (N,), gyro (N, 3) rad/s and accel (N, 3) m/s^2, body frame."""
    _append_rows(sensor, t_ns, np.hstack([gyro, accel]))


def append_truth(
    sensor: Path,
    t_ns: NDArray[np.int64],
    xyz: Array,
    quat_wxyz: Array,
    v_world: Array,
    bias_gyro: Array,
    bias_accel: Array,
) -> None:
    """Rows of t_ns (N,), T_world_body as xyz (N, 3) m and quat_wxyz (N, 4), v_world (N, 3) m/s and both biases."""
    _append_rows(sensor, t_ns, np.hstack([xyz, quat_wxyz, v_world, bias_gyro, bias_accel]))


def stored_depth(depth_m: ArrayF32, spec: DepthSpec) -> NDArray[np.uint16]:
    """(H, W) m as the file stores it: in the spec's units, 0 where there is no reading or it does not fit."""
    raw = np.rint(np.nan_to_num(depth_m, posinf=0.0) * spec.units_per_m)
    return np.where((raw > 0) & (raw < 65535), raw, 0).astype(np.uint16)


def written_stamps(sensor: Path) -> list[int]:
    """Stamps of the rows that are there; a row cut short by a kill is removed from the file first."""
    data = sensor / "data.csv"
    if not data.exists():
        return []
    text = data.read_text()
    whole = text[: text.rfind("\n") + 1]
    if whole != text:
        write_text(data, whole)
    return [int(line.partition(",")[0]) for line in whole.splitlines() if line and not line.startswith("#")]


def camera_yaml(spec: CameraSpec, comment: str = "") -> str:
    """A camera's `sensor.yaml`; time offset, shutter and exposure only where the spec has them."""
    timing = {key: getattr(spec, key) for key in ("time_offset_s", "row_time_s", "stamped_row", "exposure_s")}
    keys = {"rate_hz": spec.rate_hz, **_lens_keys(spec.camera), **{k: v for k, v in timing.items() if v}}
    return _yaml("camera", comment, spec.T_body_cam, keys)


def depth_yaml(spec: DepthSpec, comment: str = "") -> str:
    """As a camera's, with what the stored values mean."""
    keys = {
        **_lens_keys(spec.camera),
        "units_per_m": spec.units_per_m,
        "registered": spec.registered,
        "min_m": spec.min_m,
        "max_m": spec.max_m,
        "noise": list(spec.noise),
    }
    return _yaml("depth", comment, spec.T_body_depth, keys)


def imu_yaml(spec: ImuSpec, comment: str = "") -> str:
    keys = {
        "rate_hz": spec.rate_hz,
        "gyroscope_noise_density": spec.gyro_noise,
        "gyroscope_random_walk": spec.gyro_walk,
        "accelerometer_noise_density": spec.accel_noise,
        "accelerometer_random_walk": spec.accel_walk,
        **({"time_offset_s": spec.time_offset_s} if spec.time_offset_s else {}),
    }
    return _yaml("imu", comment, SE3.identity(), keys)


def _lens_keys(camera: Camera) -> dict[str, object]:
    """EuRoC's names for radial-tangential and equidistant lenses, Kalibr's for double sphere."""
    size: dict[str, object] = {"resolution": [camera.width, camera.height]}
    pinhole = camera.params[:4].tolist()
    distortion = list(camera.distortion)
    if camera.model == DOUBLE_SPHERE:
        return size | {"camera_model": "ds", "intrinsics": distortion + pinhole, "distortion_model": "none"}
    name = "equidistant" if camera.model == EQUIDISTANT else "radial-tangential"
    if name == "radial-tangential" and distortion[4] == 0.0:
        distortion = distortion[:4]  # EuRoC's own files have four
    return size | {
        "camera_model": "pinhole",
        "intrinsics": pinhole,
        "distortion_model": name,
        "distortion_coefficients": distortion,
    }


def _yaml(sensor_type: str, comment: str, T_body_sensor: SE3, keys: Mapping[str, object]) -> str:
    rows = ",\n         ".join(", ".join(map(_number, row)) for row in T_body_sensor.matrix.tolist())
    head = f"%YAML:1.0\nsensor_type: {sensor_type}\ncomment: {_text(comment)}\n\n"
    pose = f"# Sensor extrinsics wrt. the body-frame.\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{rows}]\n"
    return head + pose + "".join(f"{key}: {_value(value)}\n" for key, value in keys.items())


def _value(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list):
        return "[" + ", ".join(map(_value, value)) + "]"
    return _number(value) if isinstance(value, int | float) else str(value)


def _text(text: str) -> str:
    """Bare as in EuRoC's files where YAML cannot misread it, else quoted."""
    return text if re.fullmatch(r"[A-Za-z][\w ,.()/-]*", text) else json.dumps(text)


def _number(value: float) -> str:
    """Exact digits, in a form every YAML reader takes for a number (`1e-05` is a text to some)."""
    text = str(value)
    mantissa, e, exponent = text.partition("e")
    return text if not e else f"{mantissa if '.' in mantissa else mantissa + '.0'}e{exponent}"


def _append_rows(sensor: Path, t_ns: NDArray[np.int64], values: Array) -> None:
    _append(
        sensor, (f"{t},{','.join(map(repr, row))}\n" for t, row in zip(t_ns.tolist(), values.tolist(), strict=True))
    )


def _append(sensor: Path, rows: Iterable[str]) -> None:
    try:
        with (sensor / "data.csv").open("a", encoding="utf-8", newline="\n") as file:
            file.writelines(rows)
    except OSError as error:
        raise SourceError(f"cannot write {sensor / 'data.csv'}: {error.strerror}; make room") from None
