"""All checks of a recording, in an order in which what one finds spares the next a wrong conclusion."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lodelight.doctor import pair_of_eyes, signals
from lodelight.doctor.findings import Finding, measured
from lodelight.doctor.gather import BUDGET_FRAMES, STRETCH_S, Seen, gather
from lodelight.doctor.lever import lever_of
from lodelight.doctor.metric import Move, field_of, move_of
from lodelight.doctor.rims import beside
from lodelight.doctor.squares import squares_of
from lodelight.doctor.turning import Gyro, align, turn_of
from lodelight.io.recording import Recording
from lodelight.io.stamps import NS_PER_S
from lodelight.messages import Imu
from lodelight.rig import CameraSpec, Rig
from lodelight.types import Array

# Limits: half of what spoils a run, and above what good recordings of known rigs show (docs/doctor.md).
OFFSET_MS, TURN_DEG, FOCAL, EPIPOLAR_PX, AIM_CM, REGION_PX = 3.5, 1.3, 0.018, 1.0, 1.0, 1.0
SHIFT_CM, AXES_CM, SQUARE_PX, ASPECT = 2.0, 1.2, 1.0, 0.015
DEPTH_PX, DEPTH_DEG = 2.5, 0.5
SURE = 2.5  # sigmas that know how alike errors are (`findings.jackknifed`, `rims.beside`); others need four
DEGREES = (40.0, 80.0)  # what a gyro in degrees shows over what vision does


def look(recording: Recording) -> Iterator[tuple[Seen, int]]:
    """Gather what the checks need, frame by frame: all stamps and IMU samples, and stretches where the body turns."""
    imu = list(recording.inertial())
    t_ns = np.array([shot.t_ns for shot in recording.shots(1, False)], dtype=np.int64)
    t_ns = t_ns + round(recording.rig.cameras[0].time_offset_s * NS_PER_S)
    for seen, count in gather(recording, stretches_of(recording, imu)):
        seen.imu, seen.t_ns = imu, t_ns
        yield seen, count


def stretches_of(recording: Recording, imu: list[Imu]) -> list[tuple[float, float]]:
    """Up to BUDGET_FRAMES of frames in stretches of STRETCH_S: those in which the gyro changes most, else spread."""
    rate_hz = recording.rig.cameras[0].rate_hz or 20.0
    count = max(1, int(BUDGET_FRAMES / (rate_hz * STRETCH_S)))
    total = int(max(1.0, recording.duration_s // STRETCH_S))
    if total <= count:
        return [(0.0, recording.duration_s)]
    if len(imu) < 10:
        chosen = np.linspace(0, total - 1, count).astype(int).tolist()
    else:
        first_ns = recording.span_ns[0] + round(recording.rig.cameras[0].time_offset_s * NS_PER_S)
        at = ((np.array([s.t_ns for s in imu]) - first_ns) / NS_PER_S // STRETCH_S).astype(int)
        gyro = np.array([s.gyro for s in imu])
        life = [float(gyro[at == k].std(axis=0).sum()) if np.any(at == k) else 0.0 for k in range(total)]
        chosen = sorted(np.argsort(life, kind="stable")[-count:].tolist())
    return [(k * STRETCH_S, (k + 1) * STRETCH_S) for k in chosen]


def judge(seen: Seen, rig: Rig, recording: Recording | None = None) -> list[Finding]:
    """Every finding, faults and what is in order."""
    out = signals.stamps(seen.t_ns, rig.cameras[0].rate_hz, recording.skipped if recording else ())
    if seen.brightness:
        out += [signals.exposure(seen.brightness), signals.blur(seen.blur)]
    if rig.imu is not None:
        out += signals.inertial(seen.imu, seen.t_ns, rig.imu.rate_hz)
    eyes, swapped = _eyes(seen, rig)
    out += eyes
    if swapped:
        return out  # the images are those of the other camera: nothing further would be about this rig
    out += _squares(seen, rig) + _rims(seen, rig)
    cam0, cam1 = rig.cameras[0], rig.cameras[1] if len(rig.cameras) > 1 else None
    wrong = any(f.level == "fault" for f in eyes)  # points of a wrong pair would miss everywhere
    moves = [] if wrong else [m for pair in seen.pairs if (m := move_of(pair, cam0, cam1)) is not None]
    return out + _regions(moves, cam0) + _turning(seen, rig, moves)


def _eyes(seen: Seen, rig: Rig) -> tuple[list[Finding], bool]:
    if len(rig.cameras) < 2 or not seen.stereo:
        return [], False
    cam0, cam1 = rig.cameras[:2]
    found = pair_of_eyes.examine(seen.stereo, cam0, cam1)
    if found is None:
        return [Finding("stereo", "note", "too few corners are in both images to check the pair")], False
    other = pair_of_eyes.examine([(b, a) for a, b in seen.stereo], cam0, cam1)
    if other is not None and _cost(other) < 0.5 * _cost(found) and _cost(found) > 0.5:
        text = (
            f"the cameras are swapped: as they are, {100 * found.behind:.0f} % of what both see lies behind them and "
            f"epipolar curves are missed by {found.miss_px:.2f} px, swapped {100 * other.behind:.0f} % and "
            f"{other.miss_px:.2f} px; exchange cam0 and cam1"
        )
        return [Finding("swapped cameras", "fault", text, found.behind)], True
    turn, aim = np.degrees(found.turn_rad), found.aim_rad
    shift_cm = 100.0 * found.baseline_m * float(np.linalg.norm(aim))
    sigma_cm = 100.0 * found.baseline_m * float(np.linalg.norm(found.sigma[3:5]))
    miss = found.miss_px > EPIPOLAR_PX
    text = (
        f"{found.miss_px:.2f} px in the median of {found.matches} matches, {found.best_px:.2f} with the pair corrected"
    )
    out = [Finding("epipolar error", "fault" if miss else "ok", text, found.miss_px, "px")]
    out.append(
        measured(
            "stereo turn", float(np.linalg.norm(turn)), float(np.degrees(np.linalg.norm(found.sigma[:3]))), 0.5, "deg",
            "cam1 stands to cam0 as the rig says, to {value:.2f} deg",
            "extrinsics: cam1 is turned by {value:.2f} deg (+- {sigma:.2f}) against the rig; calibrate the pair anew",
        )
    )  # fmt: skip
    out.append(
        measured(
            "stereo shift", shift_cm, sigma_cm, AIM_CM, "cm",
            "cam1 sits where the rig says, to {value:.2f} cm across the base line",
            "extrinsics: cam1 sits {value:.1f} cm (+- {sigma:.1f}) beside where the rig says; calibrate the pair anew",
        )
    )  # fmt: skip
    out.append(
        measured(
            "stereo focal", 100 * (found.focal - 1), 100 * float(found.sigma[5]), 100 * FOCAL, "%",
            "focal lengths of the pair agree to {value:.2f} %",
            "focal length: that of cam1 is wrong by {value:.1f} % (+- {sigma:.1f}) against cam0's; calibrate it anew",
        )
    )  # fmt: skip
    return out, False


def _cost(found: pair_of_eyes.Eyes) -> float:
    return found.miss_px + 3.0 * found.behind


def _squares(seen: Seen, rig: Rig) -> list[Finding]:
    found = squares_of(seen.tags, rig.cameras[0].camera)
    if found is None:
        return []
    text = f"corners of {found.sightings} tags leave {found.left_px:.2f} px of a square in the median"
    bad = found.left_px > SQUARE_PX
    if bad:
        text = f"lens: {text}; calibrate it anew, or print the tags on something flat"
    out = [Finding("tag squareness", "fault" if bad else "ok", text, found.left_px, "px")]
    for name, value, sigma, limit in (
        ("tag focal", found.focal, found.sigma_focal, FOCAL), ("tag aspect", found.aspect, found.sigma_aspect, ASPECT),
    ):  # fmt: skip
        what = "focal length" if name == "tag focal" else "fx over fy"
        out.append(
            measured(
                name, 100 * value, 100 * sigma, 100 * limit, "%",
                f"tags are square with the rig's {what}, to {{value:.2f}} % (+- {{sigma:.2f}})",
                f"{what}: by the tags the true one is {{value:+.1f}} % (+- {{sigma:.1f}}) off; calibrate anew",
            )
        )  # fmt: skip
    return out


def _rims(seen: Seen, rig: Rig) -> list[Finding]:
    if rig.depth is None:
        return []
    found = beside(seen.rims)
    if found is None:
        return [Finding("depth on image", "note", "too few things stand out to hold depth against the image")]
    of = "; ".join(f"{x:+.0f}, {y:+.0f} px at {distance_m:.1f} m" for distance_m, x, y in found.bands)
    limit_px = max(DEPTH_PX, np.radians(DEPTH_DEG) * rig.cameras[0].camera.focal_px)
    return [
        measured(
            "depth on image", float(np.hypot(*found.px)), found.sigma_px, limit_px, "px",
            "rims of things are at the same place in depth and image, to {value:.1f} px (+- {sigma:.1f})",
            "extrinsics: depth lies {value:.1f} px (+- {sigma:.1f}) beside cam0's image (" + of + "); "
            "calibrate T_body_depth anew", times=SURE,
        )
    ]  # fmt: skip


def _regions(moves: list[Move], cam0: CameraSpec) -> list[Finding]:
    if not moves:
        return []
    worst, _ = field_of(moves, cam0.camera)
    text = f"{worst:.2f} px is the largest mean miss of a ninth of the image"
    return [Finding("lens by region", "fault" if worst > REGION_PX else "ok", text, worst, "px")]


def _turning(seen: Seen, rig: Rig, moves: list[Move]) -> list[Finding]:
    """Vision against the IMU: unit, time offset, extrinsics, focal length."""
    if rig.imu is None or len(seen.imu) < 10:
        return []
    lens, R_body_cam = rig.cameras[0].camera, rig.cameras[0].T_body_cam.R
    turns = [turn for pair in seen.pairs if (turn := turn_of(pair, lens)) is not None]
    t_ns, rate = np.array([s.t_ns for s in seen.imu]), np.array([s.gyro for s in seen.imu])
    out: list[Finding] = []
    found = align(turns, Gyro(t_ns, rate), R_body_cam)
    if found is not None and found.correlation > 0.8 and DEGREES[0] < 1.0 / found.rate_ratio < DEGREES[1]:
        text = (
            f"the gyro is in degrees: it shows {1 / found.rate_ratio:.1f} times the turning that the images do; "
            "multiply it by 0.0174533"
        )
        out.append(Finding("gyro unit", "fault", text, 1.0 / found.rate_ratio))
        rate = np.radians(rate)
        found = align(turns, Gyro(t_ns, rate), R_body_cam)
    if found is None:
        return [*out, Finding("camera and IMU", "note", "the body turned too little to hold vision against the gyro")]
    if found.correlation < 0.7 or found.residual_rad > 0.02:
        text = (
            f"images and gyro do not turn together (correlation {found.correlation:.2f}): wrong axes, units or clocks"
        )
        return [
            *out,
            Finding("camera and IMU", "fault" if found.correlation < 0.5 else "note", text, found.correlation),
        ]
    out.append(
        measured(
            "time offset", 1e3 * found.offset_s, 1e3 * found.sigma_offset_s, OFFSET_MS, "ms",
            "images and IMU agree to {value:.1f} ms (+- {sigma:.1f})",
            "time offset: images are stamped {value:+.1f} ms (+- {sigma:.1f}) wrong against the IMU; "
            "add it to the cameras' time_offset_s", times=SURE,
        )
    )  # fmt: skip
    turn_deg, sigma_deg = _sure(np.degrees(found.turn_rad), np.degrees(found.sigma_turn_rad))
    out.append(
        measured(
            "IMU turn", turn_deg, sigma_deg, TURN_DEG, "deg",
            "cam0 stands to the IMU as the rig says, to {value:.2f} deg (+- {sigma:.2f})",
            "extrinsics: cam0 is turned by {value:.2f} deg (+- {sigma:.2f}) against the IMU; calibrate T_body_cam anew",
        )
    )  # fmt: skip
    out.append(
        measured(
            "focal length", 100 * (found.scale - 1), 100 * found.sigma_scale, 100 * FOCAL, "%",
            "images turn as the gyro does, to {value:.2f} % (+- {sigma:.2f})",
            "focal length: the true one is {value:+.1f} % (+- {sigma:.1f}) off the rig's, by the gyro; calibrate anew",
        )
    )  # fmt: skip
    if any(f.level == "fault" for f in out):
        return out  # a lever would be found by what is wrong otherwise
    lever = lever_of(moves, seen.imu, rig.imu, rig.cameras[0], found)
    if lever is None:
        text = "too few moves are known in metres, by depth or a pair, to tell where cam0 sits on the IMU"
        return [*out, Finding("IMU shift", "note", text)]
    shift_m, sigma_m = lever.told(0.01 * AXES_CM)
    out.append(
        measured(
            "IMU shift", 100 * shift_m, 100 * sigma_m, SHIFT_CM, "cm",
            "cam0 sits on the IMU where the rig says, to {value:.1f} cm (+- {sigma:.1f})",
            "extrinsics: cam0 sits {value:.1f} cm (+- {sigma:.1f}) beside where the rig says; "
            "measure T_body_cam anew", times=SURE,
        )
    )  # fmt: skip
    return out


def _sure(turn: Array, sigma: Array) -> tuple[float, float]:
    """The part of a turn about the axes that the motion tells of, and its sigma."""
    told = sigma < 1.0
    if not told.any():
        return 0.0, float(sigma.min())
    return float(np.linalg.norm(turn[told])), float(np.linalg.norm(sigma[told]))
