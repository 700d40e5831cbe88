"""How far mapped tags are from where they hang."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lodelight.anchors import Tag
from lodelight.evaluation.align import align
from lodelight.trajectory import Trajectory


@dataclass(frozen=True)
class TagErrors:
    """Of `count` tags that both surveys have: distances between their middles, angles between their attitudes.

    aligned : by the rigid motion that fits the middles best; else the surveys are compared as they are
    """

    count: int
    aligned: bool
    rmse_m: float
    median_m: float
    max_m: float
    rotation_deg: float
    worst: str


def compare_surveys(found: Sequence[Tag], truth: Sequence[Tag], aligned: bool) -> TagErrors | None:
    """None where fewer tags are in both than can be compared: one, or three to align by."""
    true = {(tag.family, tag.id): tag.T_world_tag for tag in truth if tag.T_world_tag is not None}
    both = [tag for tag in found if tag.T_world_tag is not None and (tag.family, tag.id) in true]
    if len(both) < (3 if aligned else 1):
        return None
    stamps = list(range(len(both)))
    ours = Trajectory.from_poses(stamps, [tag.T_world_tag for tag in both if tag.T_world_tag is not None])
    theirs = Trajectory.from_poses(stamps, [true[tag.family, tag.id] for tag in both])
    ours = align(ours, theirs, "se3" if aligned else "none").apply(ours)
    distance = np.linalg.norm(ours.xyz - theirs.xyz, axis=1)
    turned = [math.degrees((ours.pose(i).inverse() @ theirs.pose(i)).angle) for i in stamps]
    worst = both[int(np.argmax(distance))]
    return TagErrors(
        len(both), aligned, float(np.sqrt(np.mean(distance**2))), float(np.median(distance)), float(distance.max()),
        float(np.median(turned)), f"{worst.family} {worst.id}",
    )  # fmt: skip
