"""Checks of one sensor by itself: stamps, the units of the IMU, exposure, blur."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from lodelight.doctor.findings import Finding, Level
from lodelight.io.recording import Skipped
from lodelight.io.stamps import NS_PER_S
from lodelight.messages import Imu

GRAVITY = 9.81
LOST_SHARE, GAP_S, IMU_GAP_S = 0.2, 0.5, 0.1
OUT_OF_ORDER = "out of order"


def stamps(t_ns: NDArray[np.int64], rate_hz: float, skipped: Iterable[Skipped]) -> list[Finding]:
    """Of frames: their rate, gaps and jitter, and those that were out of order."""
    disorder = sum(OUT_OF_ORDER in item.reason for item in skipped) + int(np.count_nonzero(np.diff(t_ns) <= 0))
    t_ns = np.unique(t_ns)
    if len(t_ns) < 3:
        return [Finding("frames", "fault", f"{len(t_ns)} frames with stamps are too few for a run")]
    gaps_s = np.diff(t_ns) / NS_PER_S
    period_s = float(np.median(gaps_s))
    lost = float(np.sum(np.maximum(np.rint(gaps_s / period_s) - 1, 0)))
    share, longest = lost / (lost + len(t_ns)), float(gaps_s.max())
    near = gaps_s[gaps_s < 1.5 * period_s]
    jitter_ms = 1e3 * float(np.std(near)) if len(near) > 1 else 0.0
    out = [
        Finding(
            "frame rate",
            "note" if rate_hz > 0 and abs(period_s * rate_hz - 1) > 0.05 else "ok",
            f"{1 / period_s:.2f} Hz with a jitter of {jitter_ms:.2f} ms; the rig says {rate_hz:g} Hz",
            1 / period_s,
            "Hz",
        ),
        Finding(
            "frame gaps",
            "fault" if share > LOST_SHARE or longest > GAP_S + period_s else "note" if share > 0.02 else "ok",
            f"{100 * share:.1f} % of the frames are missing, the longest gap is {longest:.3f} s",
            100 * share,
            "%",
        ),
        Finding(
            "frame order",
            "fault" if disorder > 0.02 * len(t_ns) else "note" if disorder else "ok",
            f"{disorder} frames bear a stamp that repeats or steps back" if disorder else "stamps increase",
            float(disorder),
        ),
    ]
    return out


def inertial(samples: list[Imu], frames_ns: NDArray[np.int64], rate_hz: float) -> list[Finding]:
    """Of the IMU: its stamps against the frames', its units, and gravity in its samples."""
    if len(samples) < 10:
        return [Finding("IMU", "fault", f"the rig has an IMU, the recording {len(samples)} samples of it")]
    t_ns = np.array([s.t_ns for s in samples])
    accel = np.linalg.norm([s.accel for s in samples], axis=1)
    gyro = np.linalg.norm([s.gyro for s in samples], axis=1)
    gaps_s = np.diff(t_ns) / NS_PER_S
    rate = 1.0 / max(float(np.median(gaps_s)), 1e-9)
    longest = float(gaps_s.max())
    late_s = max((int(t_ns[0]) - int(frames_ns[0])) / NS_PER_S, (int(frames_ns[-1]) - int(t_ns[-1])) / NS_PER_S)
    wrong = longest > IMU_GAP_S or late_s > 1.0
    out = [
        Finding(
            "IMU stamps",
            "fault" if wrong else "note" if rate_hz > 0 and abs(rate / rate_hz - 1) > 0.1 else "ok",
            f"{rate:.1f} Hz, the rig says {rate_hz:g}; the longest gap is {1e3 * longest:.0f} ms"
            + (f"; {late_s:.1f} s of the frames have none" if late_s > 1.0 else ""),
            rate,
            "Hz",
        )
    ]
    middle = float(np.median(accel))
    if 0.8 < middle < 1.25:
        text = f"the accelerometer is in g: {middle:.3f} at rest, where m/s^2 say 9.81; multiply it by 9.80665"
        out.append(Finding("accelerometer", "fault", text, middle, "m/s^2"))
    elif middle < 5.0 or middle > 15.0:
        text = f"{middle:.2f} m/s^2 in the median, not 9.81: gravity was removed, or the unit is wrong"
        out.append(Finding("accelerometer", "fault", text, middle, "m/s^2"))
    else:
        off = middle / GRAVITY - 1
        level: Level = "note" if abs(off) > 0.03 else "ok"
        out.append(
            Finding("accelerometer", level, f"{middle:.2f} m/s^2 in the median, gravity is 9.81", middle, "m/s^2")
        )
    fastest = float(np.percentile(gyro, 99))
    if fastest > 35.0:  # the range of the fastest sensors in use, 2000 degrees a second
        text = (
            f"the gyro shows {fastest:.0f} rad/s, more than one can measure: it is in degrees; multiply it by 0.0174533"
        )
        out.append(Finding("gyro unit", "fault", text, fastest, "rad/s"))
    return out


def exposure(brightness: list[tuple[float, float, float]]) -> Finding:
    """Of images: whether they are black or white where they should show something."""
    mean, black, white = (float(np.median(column)) for column in np.array(brightness).T)
    dark = float(np.mean([b[1] > 0.9 for b in brightness]))
    text = f"mean {mean:.0f} of 255, {100 * black:.0f} % black, {100 * white:.0f} % white"
    if dark > 0.2:
        return Finding(
            "exposure", "fault", f"{100 * dark:.0f} % of the images show nothing: they are black; {text}", mean
        )
    if mean < 15 or black > 0.6 or white > 0.4:
        return Finding("exposure", "fault", f"the images are too {'dark' if mean < 128 else 'bright'}: {text}", mean)
    return Finding("exposure", "note" if white > 0.15 or mean < 30 else "ok", text, mean)


def blur(values: list[float]) -> Finding:
    """Of images, by how little more blur takes from them."""
    middle, high = float(np.median(values)), float(np.percentile(values, 90))
    text = f"{middle:.2f} in the median, {high:.2f} for the worst tenth (0 sharp, 1 without any edge)"
    if middle > 0.75:
        return Finding("blur", "fault", f"the images are out of focus or moved while they were exposed: {text}", middle)
    return Finding("blur", "note" if high > 0.75 else "ok", text, middle)
