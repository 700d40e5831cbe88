"""Tiny recordings of every format, written by hand: the readers are held to the formats, not to our own writer."""

from pathlib import Path

import cv2
import numpy as np

from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.rig import CameraSpec, DepthSpec, Rig

WIDTH, HEIGHT = 64, 48
LENS = Camera.create("radtan", WIDTH, HEIGHT, (50.0, 50.0, 31.5, 23.5))
PERIOD_NS = 50_000_000
START_NS = 1_403_638_577_829_376_123  # its last digits do not survive a float

SENSOR_YAML = """%YAML:1.0
# General sensor definitions.
sensor_type: camera
comment: written by hand

# Sensor extrinsics wrt. the body-frame.
T_BS:
  cols: 4
  rows: 4
  data: [1.0, 0.0, 0.0, {x},
         0.0, 1.0, 0.0, 0.0,
         0.0, 0.0, 1.0, 0.0,
         0.0, 0.0, 0.0, 1.0]

# Camera specific definitions.
rate_hz: 20
resolution: [64, 48]
camera_model: pinhole
intrinsics: [50, 50.5, 31.5, 23.5] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 1e-4, 1.76187114e-05]
"""
IMU_YAML = """%YAML:1.0
sensor_type: imu
T_BS:
  cols: 4
  rows: 4
  data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
rate_hz: 200
gyroscope_noise_density: 1.6968e-04     # [ rad / s / sqrt(Hz) ]
gyroscope_random_walk: 1.9393e-05
accelerometer_noise_density: 2.0000e-3
accelerometer_random_walk: 3.0000e-3
"""


def tiny_rig(**camera) -> Rig:
    """One 64x48 camera at 20 Hz, for the formats that say nothing of theirs."""
    return Rig((CameraSpec("cam0", LENS, SE3.identity(), **({"rate_hz": 20.0} | camera)),))


def tiny_depth_rig() -> Rig:
    """The same with registered depth in mm."""
    return Rig(tiny_rig().cameras, depth=DepthSpec(LENS, SE3.identity()))


def picture(i: int) -> np.ndarray:
    """(48, 64) uint8 of the grey value 10 i + 5."""
    return np.full((HEIGHT, WIDTH), 10 * i + 5, np.uint8)


def write(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def number(frame) -> int:
    """Which `picture` a frame is of."""
    return round((float(frame.images[0].mean()) - 5) / 10)


def seconds(t_ns: int) -> str:
    return f"{t_ns // 10**9}.{t_ns % 10**9:09d}"


def write_tum(root: Path, n: int = 6, depth_m: float = 2.0, lag_ns: int = 3_000_000) -> Path:
    """Colour and depth `lag_ns` apart, of the size of the built-in lens, with truth; a freiburg1 by its comment."""
    rgb, depth = ["# color images", "# file: 'rgbd_dataset_freiburg1_xyz.bag'"], ["# depth maps"]
    for i in range(n):
        t = START_NS + i * PERIOD_NS
        write(root / f"rgb/{seconds(t)}.png", cv2.resize(picture(i), (640, 480)))
        write(root / f"depth/{seconds(t + lag_ns)}.png", np.full((480, 640), round(depth_m * 5000), np.uint16))
        rgb.append(f"{seconds(t)} rgb/{seconds(t)}.png")
        depth.append(f"{seconds(t + lag_ns)} depth/{seconds(t + lag_ns)}.png")
    truth = [f"{seconds(START_NS + i * PERIOD_NS)} {i} 0 0 0 0 0 1" for i in range(n)]
    for name, rows in (("rgb.txt", rgb), ("depth.txt", depth), ("groundtruth.txt", truth)):
        (root / name).write_text("\n".join(rows) + "\n")
    return root


def write_euroc(root: Path, n: int = 6, cameras: int = 2, imu: bool = True) -> Path:
    """mav0 with cameras 0.1 m apart, an IMU at 200 Hz from 20 ms before the first frame on, and truth."""
    mav = root / "mav0"
    for c in range(cameras):
        rows = ["#timestamp [ns],filename"]
        for i in range(n):
            t = START_NS + i * PERIOD_NS
            write(mav / f"cam{c}/data/{t}.png", picture(i) + c)
            rows.append(f"{t},{t}.png")
        (mav / f"cam{c}/data.csv").write_text("\r\n".join(rows) + "\r\n")
        (mav / f"cam{c}/sensor.yaml").write_text(SENSOR_YAML.format(x=0.1 * c))
    if imu:
        stamps = range(START_NS - 20_000_000, START_NS + n * PERIOD_NS, 5_000_000)
        (mav / "imu0").mkdir()
        (mav / "imu0/sensor.yaml").write_text(IMU_YAML)
        (mav / "imu0/data.csv").write_text("#timestamp [ns],...\n" + "".join(f"{t},0,0,0.1,0,0,9.81\n" for t in stamps))
    (mav / "state_groundtruth_estimate0").mkdir(parents=True)
    truth = "".join(f"{START_NS + i * PERIOD_NS},{i},0,0,1,0,0,0,0,0,0,0,0,0,0,0,0\n" for i in range(n))
    (mav / "state_groundtruth_estimate0/data.csv").write_text("#timestamp, p_RS_R_x [m], ...\n" + truth)
    return root


def write_sevenscenes(root: Path, n: int = 6, first: int = 0) -> Path:
    """640x480 colour and depth of 1.5 m; the depth camera's pose moves along x."""
    for i in range(first, first + n):
        write(root / f"frame-{i:06d}.color.png", cv2.resize(picture(i - first), (640, 480)))
        write(root / f"frame-{i:06d}.depth.png", np.full((480, 640), 1500, np.uint16))
        pose = np.eye(4)
        pose[0, 3] = i
        np.savetxt(root / f"frame-{i:06d}.pose.txt", pose, delimiter="\t ")
    return root


def write_kitti(root: Path, n: int = 6) -> Path:
    """sequences/07 with a grey pair 0.54 m apart, and its truth in poses/07.txt beside the sequences."""
    folder = root / "sequences" / "07"
    for c in (0, 1):
        for i in range(n):
            write(folder / f"image_{c}/{i:06d}.png", picture(i) + c)
    (folder / "times.txt").write_text("".join(f"{0.1 * i:.6e}\n" for i in range(n)))
    rows = [f"P{c}: 50 0 31.5 {-50 * 0.54 * (c % 2)} 0 50 23.5 0 0 0 1 0" for c in range(4)]
    (folder / "calib.txt").write_text("\n".join(rows) + "\n")
    (root / "poses").mkdir()
    (root / "poses/07.txt").write_text("".join(f"1 0 0 0 0 1 0 0 0 0 1 {i}\n" for i in range(n)))
    return folder
