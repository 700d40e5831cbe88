"""The sensors a simulated body carries.

Body frame of `standard`: x forward, y left, z up, in the IMU. `euroc` is the calibration of the EuRoC recordings'
sensor head, for flying them again with their own IMU.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.rig import CameraSpec, DepthSpec, ImuSpec, Rig
from lodelight.sim.imu import SPECS
from lodelight.types import Array

FORWARD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # camera axes in a body x forward, z up
UPWARD = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # looks along +z, its rows across the way
BASELINE_M = 0.11
ROW_TIME_S, LIGHT_EXPOSURE_S = 18.9e-6, 60e-6  # IMX219; short enough to keep the stripes (science note A2)


def standard(
    size: tuple[int, int] = (752, 480),
    rate_hz: float = 20.0,
    lens: str = "radtan",
    depth: bool = True,
    lights: bool = True,
    light_size: tuple[int, int] = (1280, 960),
    light_rate_hz: float = 10.0,
    imu: str = "euroc",
    body_is_camera: bool = False,
    cameras: int = 2,
) -> Rig:
    """Stereo or one camera, depth registered to camera 0, an upward light camera, an IMU. Lenses scale with `size`.

    body_is_camera : the trajectory is camera 0's own, z forward, as those of RGB-D recordings are
    """
    specs = tuple(
        CameraSpec(f"cam{i}", _lens(lens, size, i), _mounted(FORWARD, (0.06, y, 0.02), i), rate_hz)
        for i, y in enumerate((0.5 * BASELINE_M, -0.5 * BASELINE_M)[:cameras])
    )
    f = 1000.0 * light_size[0] / 1280.0
    up = Camera.create("radtan", *light_size, (f, f, 0.5 * light_size[0] - 2.3, 0.5 * light_size[1] + 1.7))
    light = CameraSpec(
        "light0",
        up,
        _mounted(UPWARD, (0.0, 0.0, 0.08), 2),
        light_rate_hz,
        row_time_s=ROW_TIME_S * 960.0 / light_size[1],
        exposure_s=LIGHT_EXPOSURE_S,
    )
    if body_is_camera:
        T_cam_body = specs[0].T_body_cam.inverse()
        specs = tuple(replace(spec, T_body_cam=T_cam_body @ spec.T_body_cam) for spec in specs)
        light = replace(light, T_body_cam=T_cam_body @ light.T_body_cam)
    return Rig(
        specs,
        DepthSpec(specs[0].camera, specs[0].T_body_cam) if depth else None,
        replace(SPECS[imu]),
        light if lights else None,
    )


def _lens(model: str, size: tuple[int, int], i: int) -> Camera:
    """Two lenses of one make: alike, not equal."""
    w, h = size
    k = w / 752.0
    if model == "equidistant":
        f = 190.0 * w / 512.0  # the fisheye of the TUM-VI recordings
        intrinsics = (f * (1.0, 0.998)[i], f * (1.0, 0.998)[i], 0.5 * w + (-1.4, 2.1)[i], 0.5 * h + (0.9, -1.2)[i])
        distortion: tuple[float, ...] = ((0.0034, 0.0007, -0.0020, 0.0002), (0.0030, 0.0009, -0.0022, 0.0003))[i]
    else:
        f = (458.0, 456.5)[i] * k
        intrinsics = (f, f * 0.998, 0.5 * w + (-8.0, 3.5)[i] * k, 0.5 * h + (7.5, 11.0)[i] * k)
        distortion = ((-0.283, 0.0740, 0.0002, 0.00002), (-0.2835, 0.0745, -0.0001, -0.00004))[i]
    return Camera.create(model, w, h, intrinsics, distortion)


def _mounted(R_body_cam: Array, t: tuple[float, float, float], i: int) -> SE3:
    """Nothing is mounted quite straight: some milliradians each."""
    tilt = np.array([[0.004, -0.003, 0.006], [-0.005, 0.007, -0.003], [0.006, 0.004, 0.010]])[i]
    return SE3(R_body_cam, np.array(t)).perturbed(np.concatenate([tilt, np.zeros(3)]))


def euroc(depth: bool = True) -> Rig:
    """Facts of calibration of EuRoC's V1 recordings (Burri et al. 2016); depth registered to camera 0."""
    T0 = [
        [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975],
        [0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768],
        [-0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949],
    ]
    T1 = [
        [0.0125552670891, -0.999755099723, 0.0182237714554, -0.0198435579556],
        [0.999598781151, 0.0130119051815, 0.0251588363115, 0.0453689425024],
        [-0.0253898008918, 0.0179005838253, 0.999517347078, 0.00786212447038],
    ]
    lens0 = (458.654, 457.296, 367.215, 248.375), (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)
    lens1 = (457.587, 456.134, 379.999, 255.238), (-0.28368365, 0.07451284, -0.00010473, -3.55590700e-05)
    cameras = tuple(
        CameraSpec(f"cam{i}", Camera.create("radtan", 752, 480, *lens), SE3.from_matrix(np.array(T)), 20.0)
        for i, (lens, T) in enumerate(((lens0, T0), (lens1, T1)))
    )
    return Rig(cameras, DepthSpec(cameras[0].camera, cameras[0].T_body_cam) if depth else None, ImuSpec())
