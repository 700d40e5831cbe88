"""What is known of the sensors: lenses, where they sit on the body, how noisy they are.

The body is the IMU, or camera 0 where there is none. Files: `rig.toml`, read and written in `lodelight.io.rig_toml`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from lodelight.errors import CalibrationError
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3

# Of the colour camera of a Kinect, whose shutter rolls. The turns that rows of one image show against one another are
# those that its neighbours' poses say at 53 us in freiburg1_rpy (2 us standard deviation) and 58 us in the red kitchen
# (4 us), without any truth but with poses that assumed 50 us: with 25 us they say 37. Pairs straightened by the turns
# of motion capture fit one pose best between 42 and 54 us.
KINECT_ROW_TIME_S = 50e-6


@dataclass(frozen=True, eq=False)
class CameraSpec:
    """A camera on the body. `row_time_s` is 0 for a global shutter; `time_offset_s` is added to its stamps.

    Row `stamped_row` is exposed at the stamp, row v `(v - stamped_row) row_time_s` later: 0 where a driver stamps the
    first row, the image's height where it stamps what has arrived.
    """

    name: str
    camera: Camera
    T_body_cam: SE3
    rate_hz: float = 0.0
    time_offset_s: float = 0.0
    row_time_s: float = 0.0
    stamped_row: float = 0.0
    exposure_s: float = 0.0

    def resized(self, factor: float) -> CameraSpec:
        """The camera whose images are this one's resized: more rows take the same time."""
        camera = self.camera.resized(factor)
        rows = camera.height / self.camera.height
        return replace(
            self, camera=camera, row_time_s=self.row_time_s / rows, stamped_row=(self.stamped_row + 0.5) * rows - 0.5
        )


@dataclass(frozen=True, eq=False)
class DepthSpec:
    """A depth sensor. Its own lens and pose, which differ from camera 0's where it is not registered to it.

    units_per_m : raw value of one metre; min_m, max_m : readings outside are dropped
    noise : (a, b, c) of sigma_z = a + b (z - c)^2 m; the default is Kinect-like (science note E)
    """

    camera: Camera
    T_body_depth: SE3
    units_per_m: float = 1000.0
    registered: bool = True
    min_m: float = 0.3
    max_m: float = 8.0
    noise: tuple[float, float, float] = (0.0012, 0.0019, 0.4)


@dataclass(frozen=True)
class ImuSpec:
    """Continuous-time noise densities: rad/s/sqrt(Hz), rad/s^2/sqrt(Hz), m/s^2/sqrt(Hz), m/s^3/sqrt(Hz).

    The defaults are those of the EuRoC recordings' ADIS16448.
    """

    rate_hz: float = 200.0
    gyro_noise: float = 1.6968e-4
    gyro_walk: float = 1.9393e-5
    accel_noise: float = 2.0e-3
    accel_walk: float = 3.0e-3
    time_offset_s: float = 0.0


@dataclass(frozen=True, eq=False)
class Rig:
    """All sensors of a recording. `lights` is the upward rolling-shutter camera that reads coded ceiling lights."""

    cameras: tuple[CameraSpec, ...]
    depth: DepthSpec | None = None
    imu: ImuSpec | None = None
    lights: CameraSpec | None = None

    def __post_init__(self) -> None:
        if not self.cameras:
            raise CalibrationError("the rig has no camera; give one with --rig FILE")

    @property
    def sensors(self) -> str:
        """The richest `--sensors` this rig can serve."""
        base = "rgbd" if self.depth is not None else "stereo" if len(self.cameras) > 1 else "mono"
        return base + "-inertial" if self.imu is not None else base

    def with_cameras(self, count: int) -> Rig:
        """The same rig seen through its first `count` cameras."""
        return replace(self, cameras=self.cameras[:count])

    def resized(self, factor: float) -> Rig:
        """The rig whose cameras' images are this one's resized. Depth images stay as they are."""
        return replace(self, cameras=tuple(spec.resized(factor) for spec in self.cameras))
