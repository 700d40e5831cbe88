"""Whether an IMU reads in m/s^2 and rad/s, up as positive: what a wrong unit looks like, named."""

from __future__ import annotations

import numpy as np

from lodelight.types import Array

GRAVITY_M_S2 = 9.81
PLAUSIBLE = (0.6, 1.6)  # mean specific force over gravity: walking, driving and flying over half a second stay within
MIN_TURN_DEG = 3.0  # of images or of the gyroscope, below which their units cannot be compared
DEG_PER_RAD = 180.0 / np.pi


def accelerometer_fault(accel: Array) -> str:
    """What is wrong with samples (N, 3) of at least half a second; empty where nothing is."""
    reads = float(np.linalg.norm(accel, axis=1).mean())
    if PLAUSIBLE[0] < reads / GRAVITY_M_S2 < PLAUSIBLE[1]:
        return ""
    if PLAUSIBLE[0] < reads < PLAUSIBLE[1]:
        return f"the accelerometer reads {reads:.2f} on average: it is in g; multiply it by 9.80665 to have m/s^2"
    if PLAUSIBLE[0] < reads / (1000.0 * GRAVITY_M_S2) < PLAUSIBLE[1]:
        return f"the accelerometer reads {reads:.0f} on average: it is in mm/s^2; divide it by 1000 to have m/s^2"
    if PLAUSIBLE[0] < reads / 1000.0 < PLAUSIBLE[1]:
        return f"the accelerometer reads {reads:.0f} on average: it is in mg; multiply it by 0.00980665 to have m/s^2"
    return f"the accelerometer reads {reads:.3g} m/s^2 on average where gravity is 9.81: check its unit, and its offset"


def gyroscope_fault(turned: Array, seen: Array, duration_s: float) -> str:
    """What is wrong with turns (N, 3) rad, by the gyroscope, against those that images show; empty where nothing is.

    A bias of 0.3 rad/s is taken for one, not for a unit.
    """
    by_gyro, by_images = np.linalg.norm(turned, axis=1).sum(), np.linalg.norm(seen, axis=1).sum()
    excess = max(by_gyro - 0.3 * duration_s, 0.0)
    if np.degrees(max(excess, by_images)) < MIN_TURN_DEG:
        return ""
    differ = turned / DEG_PER_RAD - seen
    in_deg = np.linalg.norm(differ - differ.mean(axis=0), axis=1).sum()  # its bias is in deg/s as well
    if excess > 10.0 * max(by_images, 0.02) and in_deg < 0.7 * by_images + 0.01 * duration_s:
        return (
            f"the gyroscope turned by {by_gyro:.1f} rad while the images turned by {by_images:.3f}: it is in deg/s; "
            "multiply it by 0.0174533 to have rad/s"
        )
    left = np.linalg.norm(turned - turned.mean(axis=0) - (seen - seen.mean(axis=0)), axis=1).sum()
    moved = np.linalg.norm(seen - seen.mean(axis=0), axis=1).sum()
    other_way = np.linalg.norm(-turned + turned.mean(axis=0) - (seen - seen.mean(axis=0)), axis=1).sum()
    if np.degrees(moved) > MIN_TURN_DEG and left > moved:
        turned_back = other_way < 0.5 * moved
        how = "it turns the other way round" if turned_back else "check its axes, the camera's pose, and their clocks"
        return f"the gyroscope's turns differ from the images' by {left / moved:.0%} of them: {how}"
    return ""
