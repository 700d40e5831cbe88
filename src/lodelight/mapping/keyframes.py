"""Does this frame become a keyframe? Small predicates, each with its reason, and gates beside them.

A frame is inserted if nothing forbids it, its quality asks for it, the time is right, and every gate lets it pass.
Source: science note A9 (the conditions of ORB-SLAM2's NeedNewKeyFrame, as published).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

import numpy as np

from lodelight.geometry.se3 import SE3
from lodelight.types import Array


@dataclass(frozen=True)
class KeyframeConfig:
    """max_interval_s : one is inserted after this long even if mapping is busy; min_interval_s : never sooner
    overlap : the share of the reference keyframe's points above which a frame adds nothing new; overlap_mono : where
        no depth is measured, and new points need two keyframes
    weak_overlap : the share below which one is inserted whatever the timing (if weak_tracking_override)
    min_points : with fewer tracked points a frame is not trusted to become one
    max_noise : a frame whose corners are noisier than a sharp one's by more waits for a sharper one, if it can
    close_low, close_new : few close points tracked, and so many that could be made
    queue_limit : keyframes that may wait for mapping
    map_limit : keyframes above which none is inserted within max_interval_s of a relocalization
    """

    max_interval_s: float = 1.0
    min_interval_s: float = 0.0
    overlap: float = 0.8
    overlap_mono: float = 0.9
    overlap_young: float = 0.4
    weak_overlap: float = 0.25
    weak_tracking_override: bool = True
    min_points: int = 15
    max_noise: float = 1.5
    close_low: int = 100
    close_new: int = 70
    queue_limit: int = 3
    map_limit: int = 30


@dataclass(frozen=True)
class Candidate:
    """What is known of a frame when it is asked whether it becomes a keyframe.

    reference_points : of the reference keyframe, those seen often enough to be expected again
    noise : sigma of this frame's corners over a sharp frame's
    close_tracked, close_untracked : features with good depth, with and without a map point
    T_world_body, covariance : its pose, as in `Estimate`; for gates
    """

    t_ns: int
    inliers: int
    reference_points: int
    close_tracked: int
    close_untracked: int
    n_keyframes: int
    noise: float
    since_keyframe_s: float
    since_relocalization_s: float
    mapping_idle: bool = True
    queue: int = 0
    mapping_stopped: bool = False
    localization_only: bool = False
    measures_depth: bool = True
    T_world_body: SE3 = field(default_factory=SE3.identity)
    covariance: Array = field(default_factory=lambda: np.zeros((6, 6)))


@dataclass(frozen=True)
class Verdict:
    """What a gate says. PASS with a weight in (0, 1]; VETO; ABSTAIN where it cannot tell: passed, unverified.

    can_wait : why a frame that passed need not become a keyframe yet; empty where it may
    """

    verdict: Literal["PASS", "VETO", "ABSTAIN"]
    why: str
    weight: float = 1.0
    can_wait: str = ""


Gate: TypeAlias = Callable[[Candidate], Verdict]


@dataclass(frozen=True)
class Decision:
    insert: bool
    why: str
    weight: float = 1.0


def forbidden(c: Candidate, config: KeyframeConfig) -> str:
    """Why no frame may become a keyframe now; empty where one may."""
    if c.localization_only:
        return "localization only"
    if c.mapping_stopped:
        return "local mapping is stopped or the map is being corrected"
    if c.since_relocalization_s < config.max_interval_s and c.n_keyframes > config.map_limit:
        return "soon after a relocalization in a large map"
    return ""


def needs_close_points(c: Candidate, config: KeyframeConfig) -> bool:
    return c.close_tracked < config.close_low and c.close_untracked > config.close_new


def too_few_points(c: Candidate, config: KeyframeConfig) -> str:
    if c.inliers <= config.min_points:
        return f"{c.inliers} tracked points are too few to trust"
    return ""


def blurred(c: Candidate, config: KeyframeConfig) -> str:
    if c.noise > config.max_noise and c.since_keyframe_s < config.max_interval_s and not is_weak(c, config):
        return f"its corners are {c.noise:.1f} times as noisy as a sharp frame's, and tracking can wait"
    return ""


def overlap_too_high(c: Candidate, config: KeyframeConfig) -> str:
    limit = config.overlap_young if c.n_keyframes < 2 else config.overlap if c.measures_depth else config.overlap_mono
    if c.inliers >= limit * c.reference_points and not needs_close_points(c, config):
        return f"{c.inliers} of the reference's {c.reference_points} points still in view"
    return ""


def is_weak(c: Candidate, config: KeyframeConfig) -> bool:
    """Tracking hangs on few of the reference's points: a keyframe cannot wait."""
    return c.inliers < config.weak_overlap * c.reference_points or needs_close_points(c, config)


def too_early(c: Candidate, config: KeyframeConfig) -> str:
    if config.weak_tracking_override and is_weak(c, config) and c.queue < config.queue_limit:
        return ""
    if c.since_keyframe_s >= config.max_interval_s and c.queue < config.queue_limit:
        return ""
    if c.since_keyframe_s >= config.min_interval_s and c.mapping_idle:
        return ""
    if c.queue >= config.queue_limit:
        return f"{c.queue} keyframes wait for mapping"
    return "mapping is busy and the last keyframe is recent"


def decide(c: Candidate, config: KeyframeConfig, gates: tuple[Gate, ...] = ()) -> Decision:
    """Whether to insert, why, and the weight the gates give: the least of theirs."""
    for refuses in (forbidden, too_few_points, blurred, overlap_too_high, too_early):
        why = refuses(c, config)
        if why:
            return Decision(False, why)
    said = gated(c, gates)
    if not said.insert:
        return said
    why = "needs close points" if needs_close_points(c, config) else f"{c.inliers} of {c.reference_points} points left"
    return replace(said, why="; ".join(filter(None, [why, said.why])))


def gated(c: Candidate, gates: tuple[Gate, ...]) -> Decision:
    """What the gates alone say of a frame that is to become a keyframe: the weight is the least of theirs."""
    weight, reasons = 1.0, []
    for gate in gates:
        said = gate(c)
        if said.verdict == "VETO":
            return Decision(False, said.why)
        if said.can_wait:
            return Decision(False, said.can_wait)
        weight = min(weight, said.weight)
        reasons.append(said.why)
    return Decision(True, "; ".join(reasons), weight)
