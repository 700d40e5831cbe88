"""`lodelight lights`."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from collections.abc import Iterator

    from lodelight.anchors import Anchors, Light
    from lodelight.io.recording import Recording
    from lodelight.lights.plan import Plan
    from lodelight.lights.stream import LightFrame
    from lodelight.messages import LightFix, LightSighting
    from lodelight.rig import CameraSpec
    from lodelight.types import Bytes

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    help="Visible light positioning: decode coded lights, plan their frequencies, calibrate the camera.",
)
JSON = typer.Option(False, "--json", help="Print the result as JSON.")
RIG = typer.Option(None, help="rig.toml with a [lights] camera; default: what the source says.")
STRIPES = typer.Option("rows", help="rows, or columns where images are stored a quarter turn from the sensor's rows.")


@app.command(epilog="Example: lodelight lights decode office --anchors office/anchors.toml --out out/lights")
def decode(
    source: Path = typer.Argument(..., help="Recording with a light camera (light0)."),
    anchors: Path = typer.Option(..., help="anchors.toml with the [[light]] entries of the building."),
    out: Path = typer.Option(..., help="Folder for trajectory, sightings, metrics and a picture; created."),
    rig: Path = RIG,
    level: str = typer.Option("imu", help="imu, or mounting: the body's z is up to within --tilt."),
    tilt: float = typer.Option(0.5, min=0.01, help="Sigma of up about either horizontal axis, degrees."),
    stripes: str = STRIPES,
    start: float = typer.Option(0.0, min=0.0, help="Seconds after the first frame."),
    end: float = typer.Option(float("inf"), help="Seconds after the first frame."),
    as_json: bool = JSON,
) -> None:
    """Decode coded lights and write the positioning odometry alone."""
    from lodelight.errors import ConfigError, RunError
    from lodelight.io.anchors_toml import read_anchors
    from lodelight.io.sources import open_source

    if level not in ("imu", "mounting"):
        raise ConfigError(f"--level {level!r} is unknown; choose imu or mounting")
    recording = open_source(source, rig)
    metrics = decode_to_folder(recording, read_anchors(anchors), out, level, tilt, stripes, start, end)
    print(json.dumps(metrics, indent=2) if as_json else _summary(metrics, out))
    if not metrics["fixes"]:
        raise RunError(f"{source}: no frame gave a position; {out / 'fixes.csv'} says why")


def decode_to_folder(
    recording: Recording, anchors: Anchors, out: Path, level: str = "imu", tilt_deg: float = 0.5,
    stripes: str = "rows", start_s: float = 0.0, end_s: float = float("inf"),
) -> dict[str, Any]:  # fmt: skip
    """Read every light frame and write `trajectory.tum`, `covariance.csv`, `odometry.mcap`, `odometry.bag`,
    `fixes.csv`, `sightings.csv`, `metrics.json` and `frame.png`; returns what `metrics.json` holds."""
    from lodelight.cli.progress import track
    from lodelight.io.covariances import write_covariances
    from lodelight.io.odometry_bag import write_odometry
    from lodelight.io.text import write_text
    from lodelight.io.trajectories import write_tum
    from lodelight.trajectory import Trajectory

    fixes: list[LightFix] = []
    rows: list[str] = []
    times_ms: list[tuple[float, float]] = []
    shown: tuple[int, Bytes | None, list[LightSighting]] = (-1, None, [])
    frames = light_frames(recording, anchors, level, tilt_deg, stripes, start_s, end_s)
    for frame in track(frames, "decoding lights"):
        times_ms.append(frame.times_ms)
        fixes.append(frame.fix)
        rows += [_row(frame.t_ns, s) for s in frame.sightings]
        if len(frame.fix.seen) > shown[0]:
            shown = (len(frame.fix.seen), frame.image, frame.sightings)
    placed = [fix for fix in fixes if fix.T_world_body is not None]
    trajectory = Trajectory.from_poses([f.t_ns for f in placed], [f.T_world_body for f in placed if f.T_world_body])
    out.mkdir(parents=True, exist_ok=True)
    write_tum(out / "trajectory.tum", trajectory)
    write_covariances(out / "covariance.csv", [f.t_ns for f in placed], [f.covariance for f in placed])
    for name in ("odometry.mcap", "odometry.bag"):
        write_odometry(out / name, placed)
    write_text(out / "sightings.csv", HEADER + "".join(rows))
    write_text(out / "fixes.csv", "# t_ns,lights,rms_px,why\n" + "".join(map(_fix_row, fixes)))
    if shown[1] is not None:
        _write_picture(out / "frame.png", shown[1], shown[2])
    metrics = _metrics(recording, fixes, trajectory, rows, times_ms)
    write_text(out / "metrics.json", json.dumps(metrics, indent=2) + "\n")
    return metrics


HEADER = "# t_ns,lights,u_px,v_px,sigma_px,diameter_rows,frequency_hz,sigma_hz,confidence,why\n"


def _row(t_ns: int, s: LightSighting) -> str:
    u, v = s.centre_px
    return (
        f"{t_ns},{' '.join(s.candidates)},{u:.3f},{v:.3f},{s.sigma_px:.3f},{s.diameter_rows:.2f},{s.frequency_hz:.2f},"
        f"{s.sigma_hz:.2f},{s.confidence:.4f},{s.why.replace(',', ';')}\n"
    )


def _fix_row(fix: LightFix) -> str:
    return f"{fix.t_ns},{' '.join(fix.lights)},{fix.rms_px:.3f},{fix.why.replace(',', ';')}\n"


def light_frames(
    recording: Recording, anchors: Anchors, level: str = "imu", tilt_deg: float = 0.5, stripes: str = "rows",
    start_s: float = 0.0, end_s: float = float("inf"),
) -> Iterator[LightFrame]:  # fmt: skip
    """Every image of a recording's light camera, read. level : "imu", or "mounting": the body's z is up.

    Raises CalibrationError, ConfigError or SourceError where that cannot be done.
    """
    from lodelight.errors import SourceError
    from lodelight.lights.odometry import LightOdometry
    from lodelight.lights.receiver import receiver
    from lodelight.lights.stream import read_lights

    reader = receiver(recording.rig.lights, anchors.lights, stripes)
    if level == "imu" and recording.rig.imu is None:
        raise SourceError(
            f"{recording.path} has no IMU to level its camera by; add --level mounting if it stands level"
        )
    inertial = recording.inertial(start_s, end_s) if level == "imu" else iter(())
    odometry = LightOdometry(reader.spec, anchors.lights, tilt_deg)
    return read_lights(recording.light_frames(start_s, end_s), inertial, reader, odometry)


def _write_picture(path: Path, image: Bytes, sightings: list[LightSighting]) -> None:
    import cv2

    from lodelight.io.text import write_bytes
    from lodelight.lights.picture import draw

    _, data = cv2.imencode(".png", draw(image, sightings))
    write_bytes(path, data.tobytes())


def _metrics(
    recording: Recording, fixes: list[LightFix], trajectory: Any, rows: list[str], times_ms: list[tuple[float, float]]
) -> dict[str, Any]:
    from collections import Counter

    import numpy as np

    from lodelight.evaluation.compare import compare

    placed = [f for f in fixes if f.T_world_body is not None]
    metrics: dict[str, Any] = {
        "frames": len(fixes),
        "fixes": len(placed),
        "sightings": len(rows),
        "named": sum(bool(row.split(",")[1]) for row in rows),
        "abstained": dict(Counter(f.why for f in fixes if f.why)),
        "ms_receiver": _spread([t[0] for t in times_ms]),
        "ms_position": _spread([t[1] for t in times_ms]),
    }
    truth = recording.ground_truth()
    if truth is not None and len(placed) > 1:
        covariances = np.array([f.t_ns for f in placed], dtype=np.int64), np.array([f.covariance for f in placed])
        result = compare(trajectory, truth, "none", covariances=covariances)
        metrics["ate"] = {
            "rmse_m": result.ate.rmse_m, "median_m": result.ate.median_m, "p95_m": result.ate.p95_m,
            "max_m": result.ate.max_m, "rotation_deg": result.ate.rotation_deg,
        }  # fmt: skip
        metrics["nees"] = None if result.nees is None else result.nees.pose
    return metrics


def _spread(values: list[float]) -> dict[str, float]:
    import numpy as np

    p50, p95 = np.percentile(values, (50, 95)) if values else (0.0, 0.0)
    return {"p50": round(float(p50), 3), "p95": round(float(p95), 3)}


def _summary(m: dict[str, Any], out: Path) -> str:
    lines = [
        f"{m['fixes']} of {m['frames']} frames placed, {m['named']} of {m['sightings']} spots named; "
        f"receiver {m['ms_receiver']['p50']:.1f} ms, position {m['ms_position']['p50']:.1f} ms"
    ]
    lines += [f"  {count} x {why}" for why, count in m["abstained"].items()]
    if "ate" in m:
        e = m["ate"]
        lines.append(
            f"ATE without alignment: rmse {e['rmse_m']:.3f} m, p95 {e['p95_m']:.3f}, {e['rotation_deg']:.2f} deg"
        )
    return "\n".join([*lines, f"written to {out}"])


@app.command(epilog="Example: lodelight lights plan building.toml --rig rig.toml --height 0.5 --out anchors.toml")
def plan(
    lights: Path = typer.Argument(..., help="anchors.toml, or text rows: id x y z [radius], m."),
    rig: Path = typer.Option(..., help="rig.toml whose [lights] camera will read them."),
    out: Path = typer.Option(..., help="anchors.toml to write; the drivers' table goes beside it, as .csv."),
    height: float = typer.Option(0.5, help="Of the camera over the floor, m."),
    spacing: float = typer.Option(200.0, help="Between two frequencies, Hz."),
    lowest: float = typer.Option(2000.0, help="Hz; below 1250 a light may be seen to flicker."),
    highest: float = typer.Option(8000.0, help="Hz."),
    duty: float = typer.Option(0.5, min=0.05, max=0.95, help="Part of a period that a light is on."),
    reach: float = typer.Option(
        None, min=0.0, help="Least distance of two lights of one frequency, m; default: an image's."
    ),
    as_json: bool = JSON,
) -> None:
    """Give each light of a building a frequency that a given camera can tell apart."""
    from lodelight.errors import CalibrationError
    from lodelight.io.anchors_toml import write_anchors
    from lodelight.io.calibrations import load_rig
    from lodelight.io.text import write_text
    from lodelight.lights.plan import plan_frequencies

    spec = load_rig(rig).lights
    if spec is None or not spec.row_time_s > 0.0:
        raise CalibrationError(f"{rig} has no [lights] camera with a row_time_s; add it, or calibrate it")
    anchors = _lights_of(lights)
    made = plan_frequencies(anchors.lights, spec, height, duty, spacing, reach, (lowest, highest))
    write_anchors(out, replace(anchors, lights=made.lights))
    write_text(out.with_suffix(".csv"), _driver_table(made, duty, spec))
    told = _plan_told(made)
    print(json.dumps(told, indent=2) if as_json else "\n".join(f"{key:<14} {value}" for key, value in told.items()))


def _lights_of(path: Path) -> Anchors:
    import numpy as np

    from lodelight.anchors import Anchors, Light
    from lodelight.errors import SourceError
    from lodelight.io.anchors_toml import read_anchors
    from lodelight.io.text import fields, lines

    if path.suffix == ".toml":
        return read_anchors(path)
    found: list[Light] = []
    for number, line in lines(path):
        name, *values = fields(line)
        try:
            x, y, z, radius = [float(v) for v in values] if len(values) == 4 else [*map(float, values), 0.09]
        except ValueError:
            raise SourceError(f"{path} line {number}: expected id x y z [radius] in m, got {line!r}") from None
        found.append(Light(name, 1.0, np.array([x, y, z]), radius_m=radius))
    return Anchors(lights=tuple(found))


def _driver_table(plan: Plan, duty: float, spec: CameraSpec) -> str:
    from lodelight.lights.modulation import contrast, flicker

    rows = []
    for light in plan.lights:
        f = light.frequency_hz
        values = (f, duty, 1e6 / f, 1e6 * duty / f, contrast(f, duty, spec.exposure_s))
        rows.append(f"{light.id},{','.join(f'{v:.6g}' for v in values)},{flicker(f, duty)}\n")
    return "# id,frequency_hz,duty,period_us,on_us,stripe_amplitude,flicker_ieee1789\n" + "".join(rows)


def _plan_told(plan: Plan) -> dict[str, Any]:
    import math

    used = {light.frequency_hz for light in plan.lights}
    return {
        "lights": len(plan.lights),
        "frequencies": f"{len(used)} of {len(plan.codes_hz)}, {plan.codes_hz[0]:g} to {plan.codes_hz[-1]:g} Hz",
        "smallest light": f"{plan.diameter_rows:.0f} rows",
        "image reaches": f"{plan.reach_m:.1f} m",
        "re-used after": "never" if math.isinf(plan.reuse_m) else f"{plan.reuse_m:.1f} m",
        "notes": "; ".join(plan.notes),
    }


@app.command(epilog="Example: lodelight lights calibrate images/ --frequency 3000")
def calibrate(
    source: Path = typer.Argument(..., help="Image, folder of images, or recording with a light camera."),
    frequency: float = typer.Option(..., min=1.0, help="Of the light in view, Hz, measured and not nominal."),
    rig: Path = RIG,
    stripes: str = STRIPES,
    as_json: bool = JSON,
) -> None:
    """Find a camera's row time from one light of known frequency."""
    from lodelight.lights.calibrate import calibrate_row_time

    found = calibrate_row_time(_images_of(source, rig), frequency, _any_spec(), stripes)
    told = {"row_time_s": found.row_time_s, "sigma_s": found.sigma_s, "images": found.images}
    text = f"row_time_s = {found.row_time_s:.5e}  # +- {found.sigma_s:.1e} s, from {found.images} images"
    print(json.dumps(told) if as_json else text)


def _any_spec() -> CameraSpec:
    """A camera of which only the stripes are read."""
    from lodelight.geometry.cameras import Camera
    from lodelight.geometry.se3 import SE3
    from lodelight.rig import CameraSpec

    return CameraSpec("light0", Camera.create("radtan", 1, 1, (1.0, 1.0, 0.0, 0.0)), SE3.identity(), row_time_s=1.0)


def _images_of(source: Path, rig: Path | None) -> Iterator[Bytes]:
    from lodelight.errors import SourceError
    from lodelight.io.pictures import SUFFIXES
    from lodelight.io.sources import open_source

    if not source.exists():
        raise SourceError(f"{source} does not exist")
    files = sorted(source.iterdir()) if source.is_dir() else [source]
    files = [file for file in files if file.suffix.lower() in SUFFIXES]
    if not files:
        yield from (frame.images[0] for frame in open_source(source, rig).light_frames())
        return
    yield from map(_grey, files)


def _grey(file: Path) -> Bytes:
    from lodelight.errors import SourceError
    from lodelight.io.pictures import BadFrame, read_grey

    try:
        return read_grey(file)
    except BadFrame as bad:
        raise SourceError(f"{file}: {bad}") from None
