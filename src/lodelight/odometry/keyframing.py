"""Which frames become keyframes of the inertial window (science note C7)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lodelight.features.klt import Tracks
from lodelight.geometry.se3 import SE3
from lodelight.types import Array


@dataclass(frozen=True)
class KeyframeRule:
    """A frame is a keyframe if it is distance_m or angle_deg from the last one, if its tracks moved by parallax_px on
    the median beyond what turning explains, or if less than min_shared of the last one's tracks, or less than
    min_tracks in all, are left; and not if the last one is less than min_interval_s ago. A new tag makes one always."""

    distance_m: float = 0.2
    angle_deg: float = 10.0
    parallax_px: float = 10.0
    min_shared: float = 0.5
    min_tracks: int = 40
    min_interval_s: float = 0.08


@dataclass(frozen=True, eq=False)
class LastKeyframe:
    """What the next frames are held against."""

    t_ns: int
    T_map_body: SE3
    tracks: Tracks


def keyframe_reason(
    last: LastKeyframe, tracks: Tracks, T_map_body: SE3, R_body_cam: Array, focal_px: float, rule: KeyframeRule
) -> str:
    """Why this frame is a keyframe; empty where it is none."""
    if (tracks.t_ns - last.t_ns) * 1e-9 < rule.min_interval_s - 1e-6:
        return ""
    T_last_now = last.T_map_body.inverse() @ T_map_body
    distance = float(np.linalg.norm(T_last_now.t))
    if distance >= rule.distance_m:
        return f"{distance:.2f} m from the last"
    angle = math.degrees(T_last_now.angle)
    if angle >= rule.angle_deg:
        return f"{angle:.1f} deg from the last"
    _, a, b = np.intersect1d(last.tracks.id, tracks.id, assume_unique=True, return_indices=True)
    if len(a) < max(rule.min_shared * len(last.tracks), rule.min_tracks):
        return f"{len(a)} of the last one's {len(last.tracks)} tracks are left"
    R_last_now_cam = R_body_cam.T @ T_last_now.R @ R_body_cam
    turned = tracks.ray[b] @ R_last_now_cam.T
    parallax = float(np.median(np.linalg.norm(turned - last.tracks.ray[a], axis=1))) * focal_px
    if parallax >= rule.parallax_px:
        return f"parallax of {parallax:.1f} px to the last"
    return ""
