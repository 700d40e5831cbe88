"""The gate: does the pose in the map agree with the pose by the lights alone?

PASS, and the keyframe has a weight; VETO, but not for longer than is bearable, and then somebody is to blame; ABSTAIN,
where the lights say nothing. Source: science note A8, A9; Sattler et al. 2018 for the two differences.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lodelight.geometry.se3 import SE3
from lodelight.geometry.so3 import rotation_angle, so3_log
from lodelight.lights.buffer import LightPose
from lodelight.mapping.keyframes import Candidate, Verdict
from lodelight.types import Array

MODES = ("centre", "patent", "chi2")
SURE_LIGHTS, SURE_PX = 3, 1.0  # lights that a fix of its own contradicts, were one of them wrong; their misfit
LEAST_WEIGHT = 0.05
CLOSE_LOW = 60  # close points tracked, below which a frame that could make more of them cannot wait


@dataclass(frozen=True)
class GateConfig:
    """use : none, or lights
    mode : centre (distance of camera centres), patent (of the translations of T_cam_world, which a turn of one degree
        changes by 17 cm ten metres from the origin), chi2 (both, by both covariances)
    max_deg, max_m : differences that still pass; chi2 : likewise, of six degrees of freedom; below it centre abstains
    stale_s : age of the last fix, carried on by tracking, beyond which the gate abstains; max_rms_px : of the lights
    veto_s : of vetoes without a pass between, before somebody is blamed; distrust_s : what the blamed lights get
    overlap : share of the reference's points in view above which a frame that passed can wait: the lights hold the map
        together where keyframes do not, so that fewer do; 1 = the keyframes' own overlap alone
    unverified_weight : of a keyframe that no light has checked
    anchor : a pose that passed holds its keyframe in every adjustment, with its weight
    """

    use: str = "none"
    mode: str = "centre"
    max_deg: float = 3.0
    max_m: float = 0.10
    chi2: float = 16.81
    stale_s: float = 0.2
    max_rms_px: float = 2.0
    veto_s: float = 1.0
    distrust_s: float = 2.0
    overlap: float = 0.5
    unverified_weight: float = 0.5
    anchor: bool = True

    def __post_init__(self) -> None:
        if self.use not in ("none", "lights"):
            raise ValueError(f"{self.use!r} is no gate; choose none or lights")
        if self.mode not in MODES:
            raise ValueError(f"{self.mode!r} is unknown; choose one of {', '.join(MODES)}")
        if min(self.max_deg, self.max_m, self.chi2) <= 0.0:
            raise ValueError("the largest differences must be positive")

    def near(self, angle_deg: float, centre_m: float, share: float = 1.0) -> bool:
        """Whether two differences are within a share of what passes, whatever the mode."""
        return angle_deg <= share * self.max_deg and centre_m <= share * self.max_m


@dataclass(frozen=True)
class Difference:
    """Of two poses of one camera: angle_deg, and in metres that of the centres and of the translations of T_cam_world;
    chi2 of both, by both covariances."""

    angle_deg: float
    centre_m: float
    translation_m: float
    chi2: float


def difference(T_world_body: SE3, covariance: Array, light: LightPose, T_body_cam: SE3) -> Difference:
    """Between the depth camera's pose in the map and by the lights."""
    T_cam_world = (T_world_body @ T_body_cam).inverse()
    T_cam_world_light = (light.T_world_body @ T_body_cam).inverse()  # odometry holds T_world_cam: invert
    D = np.ascontiguousarray(T_cam_world.R.T @ T_cam_world_light.R)
    centre = T_cam_world.R.T @ T_cam_world.t - T_cam_world_light.R.T @ T_cam_world_light.t
    turn = so3_log(np.ascontiguousarray(light.T_world_body.R.T @ T_world_body.R))
    e = np.concatenate([turn, T_world_body.t - light.T_world_body.t])
    chi2 = float(e @ np.linalg.solve(covariance + light.covariance + 1e-12 * np.eye(6), e))
    return Difference(
        math.degrees(rotation_angle(D)),
        float(np.linalg.norm(centre)),
        float(np.linalg.norm(T_cam_world.t - T_cam_world_light.t)),
        chi2,
    )


class LightGate:
    """Remembers how long it has refused, and whom it blamed."""

    def __init__(self, config: GateConfig, T_body_cam: SE3) -> None:
        self.config = config
        self._T_body_cam = T_body_cam
        self._refusing_since_ns: int | None = None
        self._last_ns = 0
        self._refused_by: list[tuple[str, ...]] = []
        self.trusted_from_ns = self.lenient_until_ns = -(10**18)
        self.counts = {"pass": 0, "veto": 0, "abstain": 0}
        self.blamed = ""  # "map" or "lights", by the last question alone

    def ask(self, c: Candidate, light: LightPose | None, why_not: str) -> Verdict:
        """The verdict on a frame. why_not : why there is no pose by the lights, where there is none."""
        self.blamed = ""
        verdict = self._judge(c, light, why_not)
        self.counts[verdict.verdict.lower()] += 1
        self._last_ns = c.t_ns
        return verdict

    def _judge(self, c: Candidate, light: LightPose | None, why_not: str) -> Verdict:
        config = self.config
        if light is None:
            return self._abstain(why_not)
        if c.t_ns < self.trusted_from_ns:
            return self._abstain("lights are not trusted for now, they were blamed")
        if light.rms_px > config.max_rms_px:
            return self._abstain(f"lights misfit by {light.rms_px:.1f} px")
        d = difference(c.T_world_body, c.covariance, light, self._T_body_cam)
        off_m = d.translation_m if config.mode == "patent" else d.centre_m
        told = f"lights differ by {d.angle_deg:.2f} deg and {off_m:.3f} m"
        if config.mode == "chi2":
            agrees, excess = d.chi2 <= config.chi2, 2.0 * d.chi2 / config.chi2
            told += f", chi2 {d.chi2:.1f}"
        else:
            agrees = d.angle_deg <= config.max_deg and off_m <= config.max_m
            excess = (d.angle_deg / config.max_deg) ** 2 + (off_m / config.max_m) ** 2
        share = min(1.0, len(light.lights) / 3.0) if light.lights else 1.0
        weight = max(math.exp(-0.5 * excess) * share, LEAST_WEIGHT)
        if agrees:
            self._refusing_since_ns = None
            return Verdict("PASS", told, weight, self._can_wait(c))
        if config.mode == "centre" and d.chi2 <= config.chi2:
            return self._abstain(f"{told}, which may well be the lights' own error")
        return self._refuse(c, light, told, weight)

    def _can_wait(self, c: Candidate) -> str:
        starved = c.close_tracked < CLOSE_LOW and c.close_untracked > c.close_tracked
        if self.config.anchor and c.inliers >= self.config.overlap * c.reference_points and not starved:
            return f"lights agree, and {c.inliers} of the reference's {c.reference_points} points are still in view"
        return ""

    def _refuse(self, c: Candidate, light: LightPose, told: str, weight: float) -> Verdict:
        """VETO, unless tracking hangs by a thread, or it has been said for too long: then blame somebody."""
        if c.inliers < 0.25 * c.reference_points:
            return self._abstain(f"{told}, but tracking cannot wait", weight)
        if c.t_ns < self.lenient_until_ns:  # the map must go on, or it is lost as well as wrong
            return self._abstain(f"{told}, the map is wrong here and was told so", LEAST_WEIGHT)
        if self._refusing_since_ns is None or (c.t_ns - self._last_ns) * 1e-9 > self.config.veto_s:
            self._refusing_since_ns, self._refused_by = c.t_ns, []
        self._refused_by.append(light.lights)
        if (c.t_ns - self._refusing_since_ns) * 1e-9 <= self.config.veto_s:
            return Verdict("VETO", told, weight)
        self._refusing_since_ns = None
        if self._sure(light):
            self.blamed, self.lenient_until_ns = "map", c.t_ns + round(self.config.distrust_s * 1e9)
            return Verdict("VETO", f"{told} for {self.config.veto_s:g} s; the lights agree among themselves", weight)
        self.distrust(c.t_ns)
        return self._abstain(f"{told} for {self.config.veto_s:g} s; the lights cannot prove themselves")

    def distrust(self, t_ns: int) -> None:
        self.blamed = "lights"
        self.trusted_from_ns = t_ns + round(self.config.distrust_s * 1e9)

    def _sure(self, light: LightPose) -> bool:
        """Whether the lights cannot be wrong: one wrong light of three would show, or different ones say the same."""
        if len(light.lights) >= SURE_LIGHTS and light.rms_px < SURE_PX:
            return True
        sets = [set(names) for names in self._refused_by if names]
        return bool(sets) and len(set.union(*sets)) > SURE_LIGHTS and not set.intersection(*sets)

    def _abstain(self, why: str, weight: float | None = None) -> Verdict:
        return Verdict("ABSTAIN", why, self.config.unverified_weight if weight is None else weight)
