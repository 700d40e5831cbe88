"""`rig.toml`: this project's own file of what is known of the sensors.

```toml
[[camera]]
name = "cam0"
model = "radtan"                      # radtan: k1 k2 p1 p2 k3; equidistant: k1 k2 k3 k4; double_sphere: xi alpha
size = [752, 480]
intrinsics = [458.654, 457.296, 367.215, 248.375]
distortion = [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
T_body_cam = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
rate_hz = 20.0                        # optional, like all that follow
time_offset_s = 0.0                   # is added to its stamps
row_time_s = 0.0                      # 0: global shutter
stamped_row = 0.0                     # that is exposed at the stamp
exposure_s = 0.0

[depth]                               # optional
units_per_m = 1000.0
registered = true                     # to camera 0; false: with model, size, intrinsics, distortion, T_body_depth
min_m = 0.3
max_m = 8.0
noise = [0.0012, 0.0019, 0.4]         # sigma_z = a + b (z - c)^2 m

[imu]                                 # optional: the body
rate_hz = 200.0
gyro_noise = 1.6968e-4                # rad/s/sqrt(Hz)
gyro_walk = 1.9393e-5                 # rad/s^2/sqrt(Hz)
accel_noise = 2.0e-3                  # m/s^2/sqrt(Hz)
accel_walk = 3.0e-3                   # m/s^3/sqrt(Hz)
time_offset_s = 0.0

[lights]                              # optional: the camera that reads coded lights; keys of a camera
```
"""

from __future__ import annotations

import json
import sys
from dataclasses import fields
from pathlib import Path
from typing import Any

from lodelight.errors import CalibrationError
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.io.schema import Section
from lodelight.io.text import read_text, write_text
from lodelight.rig import CameraSpec, DepthSpec, ImuSpec, Rig

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


def read_rig(path: str | Path) -> Rig:
    """Raises CalibrationError naming file and key where something is missing, unknown, or not what it must be."""
    return parse_rig(read_text(Path(path)), str(path))


def parse_rig(text: str, where: str) -> Rig:
    """The rig of a text; `where` it stands, for errors, which are those of `read_rig`."""
    try:
        root = Section(tomllib.loads(text), f"{where}:")
    except tomllib.TOMLDecodeError as error:
        raise CalibrationError(f"{where} is not valid TOML: {error}") from None
    listed = root.value("camera")
    if not isinstance(listed, list) or not listed:
        raise CalibrationError(f"{where}: write each camera as a [[camera]] table; there is none")
    cameras = tuple(_camera(Section(entry, f"{where}: camera[{i}]"), f"cam{i}") for i, entry in enumerate(listed))
    rig = Rig(
        cameras,
        depth=_depth(root.table("depth"), cameras[0]) if "depth" in root else None,
        imu=_imu(root.table("imu")) if "imu" in root else None,
        lights=_camera(root.table("lights"), "light0") if "lights" in root else None,
    )
    root.only_known()
    return rig


def write_rig(path: str | Path, rig: Rig) -> None:
    """Write so that `read_rig` gives back the same numbers to the last bit."""
    write_text(Path(path), format_rig(rig))


def format_rig(rig: Rig) -> str:
    """The text of a rig file."""
    blocks = [_block("[[camera]]", _camera_keys(spec)) for spec in rig.cameras]
    if rig.depth is not None:
        blocks.append(_block("[depth]", _depth_keys(rig.depth)))
    if rig.imu is not None:
        blocks.append(_block("[imu]", {f.name: getattr(rig.imu, f.name) for f in fields(ImuSpec)}))
    if rig.lights is not None:
        blocks.append(_block("[lights]", _camera_keys(rig.lights)))
    return "\n".join(blocks)


def lens(section: Section) -> Camera:
    """The camera model, size, intrinsics and distortion of a table."""
    model, size = section.text("model"), section.size("size")
    fx, fy, cx, cy = section.numbers("intrinsics", 4)
    distortion = section.numbers("distortion") if "distortion" in section else ()
    try:
        return Camera.create(model, *size, (fx, fy, cx, cy), distortion)
    except CalibrationError as error:
        raise CalibrationError(f"{section.where}: {error}") from None


def _camera(section: Section, name: str) -> CameraSpec:
    spec = CameraSpec(
        name=section.text("name") if "name" in section else name,
        camera=lens(section),
        T_body_cam=section.motion("T_body_cam"),
        rate_hz=section.number("rate_hz", 0.0, minimum=0.0),
        time_offset_s=section.number("time_offset_s", 0.0),
        row_time_s=section.number("row_time_s", 0.0, minimum=0.0),
        stamped_row=section.number("stamped_row", 0.0, minimum=0.0),
        exposure_s=section.number("exposure_s", 0.0, minimum=0.0),
    )
    section.only_known()
    return spec


def _depth(section: Section, cam0: CameraSpec) -> DepthSpec:
    registered = section.flag("registered", True)
    camera, T_body_depth = cam0.camera, cam0.T_body_cam
    if not registered:
        camera, T_body_depth = lens(section), section.motion("T_body_depth")
    low, high = section.number("min_m", DepthSpec.min_m, minimum=0.0), section.number("max_m", DepthSpec.max_m)
    units_per_m = section.number("units_per_m", DepthSpec.units_per_m)
    if units_per_m <= 0:
        raise CalibrationError(f"{section.at('units_per_m')} must be positive, got {units_per_m:g}")
    if low >= high:
        raise CalibrationError(f"{section.at('min_m')} must be below max_m, got {low:g} and {high:g}")
    a, b, c = section.numbers("noise", 3) if "noise" in section else DepthSpec.noise
    section.only_known()
    return DepthSpec(camera, T_body_depth, units_per_m, registered, low, high, (a, b, c))


def _imu(section: Section) -> ImuSpec:
    offset_s = section.number("time_offset_s", 0.0)
    names = [f.name for f in fields(ImuSpec) if f.name != "time_offset_s"]
    values = {name: section.number(name, getattr(ImuSpec, name), minimum=0.0) for name in names}
    section.only_known()
    return ImuSpec(**values, time_offset_s=offset_s)


def _lens_keys(camera: Camera) -> dict[str, Any]:
    return {
        "model": camera.model_name,
        "size": [camera.width, camera.height],
        "intrinsics": camera.params[:4].tolist(),
        "distortion": list(camera.distortion),
    }


def _camera_keys(spec: CameraSpec) -> dict[str, Any]:
    timing = ("rate_hz", "time_offset_s", "row_time_s", "stamped_row", "exposure_s")
    return {
        "name": spec.name,
        **_lens_keys(spec.camera),
        "T_body_cam": spec.T_body_cam,
        **{key: getattr(spec, key) for key in timing},
    }


def _depth_keys(spec: DepthSpec) -> dict[str, Any]:
    own = {} if spec.registered else {**_lens_keys(spec.camera), "T_body_depth": spec.T_body_depth}
    return {
        "registered": spec.registered,
        **own,
        "units_per_m": spec.units_per_m,
        "min_m": spec.min_m,
        "max_m": spec.max_m,
        "noise": list(spec.noise),
    }


def _block(head: str, keys: dict[str, Any]) -> str:
    return "\n".join([head, *(f"{key} = {_toml(value)}" for key, value in keys.items())]) + "\n"


def _toml(value: Any) -> str:
    """A value as TOML: floats by their shortest exact digits, a motion as four rows."""
    if isinstance(value, SE3):
        return "[\n" + "".join(f"    {_toml(row)},\n" for row in value.matrix.tolist()) + "]"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    return str(value) if isinstance(value, int) else repr(float(value))
