"""What goes into the sliding window and what comes out of it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lodelight.geometry.se3 import SE3
from lodelight.imu.preintegration import NavState
from lodelight.imu.samples import ImuSamples
from lodelight.types import AnyArray, Array


@dataclass(frozen=True)
class WindowConfig:
    """Settings of the window.

    keyframes : that stay; one more frame, the newest, is there besides
    iterations : at most, per solve of a keyframe
    tail_iterations : of another frame, which starts from a settled window and leaves nothing behind
    calibrate : "none", "extrinsics" (where the cameras sit), "time" (offset of their clock) or "both", with the sigmas
        of what the rig says
    reject_px : a residual of so many sigmas is no measurement of its point
    split : of a landmark that is still seen when its first keyframe leaves, the sightings in so many of its oldest
        keyframes go into the prior, the later ones go on as a new landmark: no sighting counts twice
    sure_depth : relative sigma of the inverse depth above which a landmark that leaves is dropped
    tag_gate_chi2 : of the eight residuals of a tag against the window without it; 99 % of a chi-square distribution
    tag_gate_rad, tag_gate_m : sigmas by which the window's pose may be off beyond its covariance in that test, which
        knows of no lens and no IMU that does not quite fit: half a per cent of the 10 m to the next tag
    tag_memory : estimated tags that stay in the window after their last sighting has left it
    tag_inflation : on the covariance of one that leaves, whose correlation with the window is forgotten
    imu_noise_scale : on the rig's noise densities, which are those of a sensor at rest
    still_sigma_m_s, still_sigma_m : of the velocity at standstill, and of the way between frames of one.
        With more than a millimetre of freedom two views of a still camera fit their own pixel noise by a motion
    """

    keyframes: int = 10
    iterations: int = 4
    tail_iterations: int = 2
    calibrate: str = "none"
    mount_sigma_rad: float = 0.01
    mount_sigma_m: float = 0.01
    offset_sigma_s: float = 0.01
    reject_px: float = 5.0
    split: int = 5
    sure_depth: float = 0.5
    tag_gate_chi2: float = 20.09
    tag_gate_rad: float = 0.01
    tag_gate_m: float = 0.05
    tag_memory: int = 8
    tag_inflation: float = 4.0
    imu_noise_scale: float = 1.0
    still_sigma_m_s: float = 0.01
    still_sigma_m: float = 0.001

    def __post_init__(self) -> None:
        if self.calibrate not in ("none", "extrinsics", "time", "both"):
            raise ValueError("calibrate is none, extrinsics, time or both")
        if self.keyframes < 3 or self.split < 1:
            raise ValueError("a window needs three keyframes or more, and split 1 or more")


@dataclass(frozen=True)
class StartSigma:
    """Deviations of the first state. Yaw and position define the frame: what is small there is a choice, no claim."""

    tilt_rad: float = 0.02
    yaw_rad: float = 1e-3
    position_m: float = 1e-3
    velocity_m_s: float = 0.1
    bias_gyro: float = 0.02
    bias_accel: float = 0.2


@dataclass(frozen=True, eq=False)
class Observations:
    """What the front end saw in one frame, a row per track and camera.

    track (N,) int64 ids; camera (N,) index in the rig; px (N, 2), sigma_px (N,) raw pixels
    wander_px2 (N,) : variance that a track followed from frame to frame has gathered, up to this frame, since any
        time: a row is then held against the last one of its track, see the derivations; default (NaN) the noise of
        every row is its own
    inv_depth, sigma_inv_depth (N,) 1/m along z of that camera, inv_depth 0 = not measured; default none
    dt_s (N,) : exposure of the row after the frame's stamp (rolling shutter); default 0
    """

    track: AnyArray
    camera: AnyArray
    px: AnyArray
    sigma_px: AnyArray
    inv_depth: AnyArray | None = None
    sigma_inv_depth: AnyArray | None = None
    dt_s: AnyArray | None = None
    wander_px2: AnyArray | None = None

    @staticmethod
    def none() -> Observations:
        empty = np.zeros(0)
        return Observations(empty.astype(np.int64), empty.astype(np.int32), np.zeros((0, 2)), empty)


@dataclass(frozen=True, eq=False)
class Tag:
    """A tag: its corners (4, 3) m in its own frame, and where it is, T_world_tag in the window's frame.

    covariance (6, 6), chart of SE3.perturbed : None = T_world_tag is exact (surveyed)
    T_world_tag None : nothing is known, it is estimated from where its first sighting puts it
    """

    id: str
    corners_tag: Array
    T_world_tag: SE3 | None = None
    covariance: Array | None = None


@dataclass(frozen=True, eq=False)
class TagView:
    """A tag in an image: corners_px (4, 2) in the order of Tag.corners_tag, sigma_px (4,).

    T_cam_tag : of the sighting alone; where to start a tag of which nothing is known
    trusted : not to be tested against the window (what follows a relocalization by this very tag)
    held : tested, but without a say until the window is told to admit its tag
    """

    id: str
    camera: int
    corners_px: Array
    sigma_px: Array
    T_cam_tag: SE3 | None = None
    dt_s: float = 0.0
    trusted: bool = False
    held: bool = False


@dataclass(frozen=True, eq=False)
class Solution:
    """ok False : the equations were not definite or not finite; the window is where it was

    outliers : tracks whose sighting in the newest frame was rejected
    imu_chi2 : of the IMU between the frames, per degree of freedom: 1 or less where it agrees with the images
    tag_chi2 : by id, of 8 degrees of freedom, of the newest frame's sightings: against the window before them where it
        was tested, else at the result
    tag_rejected : ids of those that contradicted it, and were left out
    """

    ok: bool
    cost: float
    iterations: int
    n_observations: int
    n_inliers: int
    outliers: AnyArray
    imu_chi2: float = 0.0
    tag_chi2: dict[str, float] = field(default_factory=dict)
    tag_rejected: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Landmarks:
    """track (M,); xyz (M, 3) m, window's frame; inv_depth (M,) 1/m, of the distance from the anchor's camera, with its
    sigma given the poses; seen (M,) sightings that count. A point at infinity has inv_depth <= 0 and xyz far away."""

    track: AnyArray
    xyz: Array
    inv_depth: Array
    sigma_inv_depth: Array
    seen: AnyArray


@dataclass(frozen=True, eq=False)
class Departed:
    """A keyframe that left, as the window saw it last, and the landmarks that ended with it.

    imu : from this keyframe to the next; still : it was at a standstill
    """

    state: NavState
    imu: ImuSamples
    landmarks: Landmarks
    still: bool = False

    @property
    def t_ns(self) -> int:
        return self.state.t_ns
