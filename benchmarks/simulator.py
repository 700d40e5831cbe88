"""The simulator against its figures: speed, exactness, texture, codes, lights.

    python benchmarks/simulator.py            # the table; some ten minutes on two cores
    python benchmarks/simulator.py --plot gradients.png --real recordings/euroc/mav0/cam0/data

Run it on a quiet machine: the speeds are wall time. CPU time stands beside them.
"""

from __future__ import annotations

import argparse
import hashlib
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from lodelight.anchors import Tag
from lodelight.geometry.se3 import SE3
from lodelight.geometry.so3 import so3_exp
from lodelight.sim.imager import Imager
from lodelight.sim.imu import SPECS, read_out
from lodelight.sim.metering import LONGEST_S, TARGET_DN, exposures
from lodelight.sim.motion import GRAVITY, Motion
from lodelight.sim.recorder import Simulation, record
from lodelight.sim.render import Eye, render
from lodelight.sim.scenarios import Request, prepare
from lodelight.sim.sensor import Exposure, develop, level_for, shading

NS = 1_000_000_000


def views(simulation: Simulation, count: int):
    """(image 0, image 1, exact view 0, imager 0, imager 1, seconds) of `count` instants spread over the motion."""
    first, second = (Imager(simulation.building, spec, simulation.motion) for spec in simulation.rig.cameras)
    step = simulation.motion.duration_s / count
    t_ns = simulation.motion.start_ns + np.round((np.arange(count) + 0.5) * step * NS).astype(np.int64)
    metered = exposures(simulation.building, first.spec, simulation.motion, t_ns)
    for i, t in enumerate(t_ns.tolist()):
        left, view = first.take(t, metered[i], 2 * i)
        right, _ = second.take(t, metered[i], 2 * i + 1)
        yield left, right, view, first, second, first.true_s(t)


def disparity_errors(simulation: Simulation, count: int = 24) -> np.ndarray:
    """|error| px along x of KLT from left to right image against the exact depth, off depth edges."""
    out = []
    for left, right, view, first, second, t in views(simulation, count):
        near, far = cv2.erode(view.depth, np.ones((9, 9))), cv2.dilate(view.depth, np.ones((9, 9)))
        smooth = ((far - near < 0.15 * view.depth) & (view.depth > 0)).astype(np.uint8)
        corners = cv2.goodFeaturesToTrack(left, 500, 0.01, 8, mask=smooth)
        if corners is None:
            continue
        p = corners.reshape(-1, 2)
        T0, T1 = first.poses(t)[0], second.poses(t)[0]
        g = simulation.building.scene.geometry[view.quad[np.rint(p[:, 1]).astype(int), np.rint(p[:, 0]).astype(int)]]
        d = first.spec.camera.unproject(p.astype(float))[0] @ T0.R.T
        reach = ((g[:, :3] - T0.t) * g[:, 3:6]).sum(1) / (d * g[:, 3:6]).sum(1)
        truth, seen = second.spec.camera.project(T1.inverse() @ (T0.t + reach[:, None] * d))
        options = {"winSize": (11, 11), "maxLevel": 0, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW, "criteria": (3, 50, 1e-4)}
        there, ok, _ = cv2.calcOpticalFlowPyrLK(left, right, p, truth.astype(np.float32), **options)
        back, ok2, _ = cv2.calcOpticalFlowPyrLK(right, left, there, p.copy(), **options)
        good = seen & (ok.ravel() == 1) & (ok2.ravel() == 1) & (np.linalg.norm(back - p, axis=1) < 0.5)
        out.append(np.abs(there[good, 0] - truth[good, 0]))
    return np.concatenate(out)


def orb_coverage(image: np.ndarray) -> tuple[int, float]:
    """(corners, share of a 16 x 10 grid that has one) of plain ORB."""
    points = np.array([k.pt for k in cv2.ORB_create(nfeatures=30000).detect(image)]).reshape(-1, 2)
    grid = np.zeros((10, 16), bool)
    h, w = image.shape
    grid[(points[:, 1] * 10 / h).astype(int), (points[:, 0] * 16 / w).astype(int)] = True
    return len(points), float(grid.mean())


def drift(motion: Motion, window_s: float = 10.0, fine: bool = True) -> tuple[float, float]:
    """Largest (m, deg) over windows of integrating a noise-free IMU at 200 Hz.

    fine : readings are joined by cubics and rotation includes the commutator; else by the midpoint rule, whose own
    error of dt^2/12 times the change of the slope is then what is measured
    """
    spec = replace(SPECS["perfect"], rate_hz=200.0)
    series = read_out(motion, spec, np.random.default_rng(0))
    dt, n = 1.0 / 200.0, int(window_s * 200)
    worst = np.zeros(2)
    for first in range(1, len(series.t_ns) - n - 2, n // 4):
        k = np.arange(first, first + n)
        state = motion.at_ns(series.t_ns[[first, first + n]])
        turns = dt * _means(series.gyro, k, fine)
        if fine:
            turns += dt * dt / 12.0 * np.cross(series.gyro[k], series.gyro[k + 1])
        R = [state.R_world_body[0]]
        for turn in turns:
            R.append(R[-1] @ so3_exp(turn))
        before, after = (R[0] @ so3_exp(-dt * series.gyro[first]), R[-1] @ so3_exp(dt * series.gyro[first + n]))
        turned = np.array([before, *R, after])
        a = np.einsum("nij,nj->ni", turned, series.accel[first - 1 : first + n + 2]) + GRAVITY
        inner = np.arange(1, n + 1)
        mean, slope = _means(a, inner, fine), a[inner + 1] - a[inner]
        v = state.v_world[0] + dt * np.vstack([np.zeros(3), np.cumsum(mean, axis=0)])
        p = state.xyz[0] + (v[:-1] * dt + (0.5 * mean - slope / 12.0 * fine) * dt * dt).sum(axis=0)
        off = SE3(state.R_world_body[1], state.xyz[1]).inverse() @ SE3(R[-1], p)
        worst = np.maximum(worst, [np.linalg.norm(off.t), np.degrees(off.angle)])
    return float(worst[0]), float(worst[1])


def _means(values: np.ndarray, k: np.ndarray, fine: bool) -> np.ndarray:
    """Means over the steps from samples k to k + 1."""
    if not fine:
        return 0.5 * (values[k] + values[k + 1])
    return (13.0 * (values[k] + values[k + 1]) - values[k - 1] - values[k + 2]) / 24.0


def light_frequencies(simulation: Simulation, count: int = 20) -> tuple[int, float]:
    """(lights looked at, largest relative error) of a plain FFT along the rows of every light wholly in view."""
    spec = simulation.rig.lights
    imager = Imager(simulation.building, spec, simulation.motion)
    worst, looked = 0.0, 0
    for t in np.linspace(1.0, simulation.motion.duration_s - 1.0, count):
        stamp = simulation.motion.start_ns + round(t * NS)
        image, _ = imager.take(stamp, Exposure(spec.exposure_s), stamp % 1000)
        T_cam_world = imager.poses(t)[0].inverse()
        for light in simulation.building.anchors.lights:
            center, seen = spec.camera.project((T_cam_world @ light.xyz)[None])
            radius = spec.camera.focal_px * light.radius_m / max((T_cam_world @ light.xyz)[2], 0.1)
            rows = np.arange(int(center[0, 1] - 0.9 * radius), int(center[0, 1] + 0.9 * radius))
            if not seen[0] or rows[0] < 0 or rows[-1] >= spec.camera.height or len(rows) < 20:
                continue
            half = max(2, int(0.15 * radius))
            columns = slice(max(0, int(center[0, 0]) - half), int(center[0, 0]) + half)
            profile = image[rows, columns].mean(axis=1)
            if profile.max() < 60:
                continue  # hidden
            spectrum = np.abs(np.fft.rfft((profile - profile.mean()) * np.hanning(len(rows)), 1 << 15))
            f = np.fft.rfftfreq(1 << 15, spec.row_time_s)
            band = f > max(1500.0, 2.5 / (len(rows) * spec.row_time_s))
            worst = max(worst, abs(f[band][spectrum[band].argmax()] / light.frequency_hz - 1.0))
            looked += 1
    return looked, worst


def look_at(simulation: Simulation, tag: Tag, distance_m: float, turn: np.ndarray) -> tuple[np.ndarray, SE3]:
    """Camera 0's image from `distance_m` off a tag, and T_world_cam; turn : (3,) rad, about the tag's x and y for the
    point of view, and about the camera's axis."""
    about = SE3(so3_exp(np.array([turn[0], turn[1], 0.0])), np.zeros(3))
    back = SE3(so3_exp(np.array([0.0, 0.0, turn[2]])), np.array([0.0, 0.0, -distance_m]))
    T_world_cam = tag.T_world_tag @ about @ back
    spec = simulation.rig.cameras[0]
    view = render(simulation.building.scene, Eye.of(spec.camera), [T_world_cam])
    shade = shading(spec.camera)
    exposure = Exposure.for_level(level_for(view.image * shade, TARGET_DN), LONGEST_S)
    return develop(view.image, shade, exposure, 7), T_world_cam


def codes(simulation: Simulation) -> tuple[int, int, float, int]:
    """(QR codes of 0.2 m read head-on at 1.5 m, of so many, median error px of AprilTag corners, of so many tags)."""
    import zxingcpp
    from pupil_apriltags import Detector

    Detector.__del__ = lambda self: None  # its destructor may crash the process
    detector = Detector("tag36h11", quad_decimate=1.0)
    camera = simulation.rig.cameras[0].camera
    rng = np.random.default_rng(0)
    read, of, errors = 0, 0, []
    for tag in simulation.building.anchors.tags:
        if tag.family == "qr" and abs(tag.size_m - 0.2) < 1e-6:
            image, _ = look_at(simulation, tag, 1.5, np.zeros(3))
            of += 1
            read += any(f"id={tag.id};" in found.text for found in zxingcpp.read_barcodes(image))
        elif tag.family == "tag36h11":
            for distance in (1.0, 1.5, 2.0, 2.5):
                image, T = look_at(simulation, tag, distance, rng.uniform(-0.5, 0.5, 3))
                truth, seen = camera.project(T.inverse() @ tag.corners_world)
                errors += [
                    np.linalg.norm(found.corners - 0.5 - truth, axis=1)
                    for found in detector.detect(image)
                    if str(found.tag_id) == tag.id and seen.all()
                ]
    return read, of, float(np.median(np.concatenate(errors))), len(errors)


def digest(folder: Path) -> str:
    """One hash over all files of a recording and their names."""
    total = hashlib.sha256()
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        total.update(str(path.relative_to(folder)).encode() + path.read_bytes())
    return total.hexdigest()[:16]


def repeats() -> list[str]:
    """Digests of the same recording made in three processes, with 1 and 2 threads."""
    out = []
    with tempfile.TemporaryDirectory() as folder:
        for k, threads in enumerate((1, 2, 2)):
            target = Path(folder) / str(k)
            arguments = ["office", "--out", str(target), "--duration", "1", "--rate", "10", "--threads", str(threads)]
            subprocess.run([sys.executable, "-m", "lodelight", "sim", *arguments], check=True, capture_output=True)
            out.append(digest(target))
    return out


def speed() -> dict[str, float]:
    """40 s of stereo at 20 Hz from `office`, 752 x 480."""
    with tempfile.TemporaryDirectory() as folder:
        record(prepare(Request("office", duration_s=0.2, depth=False, lights=False)), Path(folder) / "warm")
        start, cpu = time.perf_counter(), time.process_time()
        simulation = prepare(Request("office", duration_s=40.0, depth=False, lights=False))
        prepared = time.perf_counter()
        record(simulation, Path(folder) / "out")
        end, used = time.perf_counter(), time.process_time() - cpu
        count = len(list((Path(folder) / "out" / "mav0").glob("cam*/data/*.png")))
    rss = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"wall": end - start, "rate": count / (end - prepared), "cpu": used / count, "rss": rss}


def gradients(images: list[np.ndarray]) -> np.ndarray:
    """Gradient magnitudes, grey levels per px, of many images in one row."""
    out = []
    for image in images:
        gx, gy = (cv2.Sobel(image.astype(np.float32), -1, *d) / 8.0 for d in ((1, 0), (0, 1)))
        out.append(np.hypot(gx, gy).ravel())
    return np.concatenate(out)


def plot_gradients(path: Path, sets: dict[str, np.ndarray]) -> None:
    """Cumulative distributions side by side."""
    from matplotlib import pyplot as plt

    figure, axis = plt.subplots(figsize=(7, 4.5))
    for name, values in sets.items():
        x = np.quantile(values, np.linspace(0, 1, 500))
        axis.semilogx(np.maximum(x, 0.1), np.linspace(0, 1, 500), label=name)
    axis.set_xlabel("gradient magnitude, grey levels per px")
    axis.set_ylabel("share of pixels below")
    axis.legend()
    axis.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(path, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plot", type=Path, help="write the gradient statistics as a picture")
    parser.add_argument("--real", type=Path, nargs="*", default=[], help="folders of real images to plot beside")
    parser.add_argument("--skip-speed", action="store_true")
    parser.add_argument("--frames", type=int, default=40)
    given = parser.parse_args()
    rows: list[tuple[str, str, str]] = []

    def row(what: str, figure: str, measured: str) -> None:
        rows.append((what, figure, measured))
        print(f"| {what} | {figure} | {measured} |", flush=True)

    if not given.skip_speed:
        s = speed()
        row("rendering 752x480", ">= 20 images/s, two cores", f"{s['rate']:.1f}/s; {1e3 * s['cpu']:.0f} ms CPU each")
        row(
            "40 s of stereo at 20 Hz", "< 100 s; <= 1 GB", f"{s['wall']:.0f} s, preparation included; {s['rss']:.0f} MB"
        )
        found = repeats()
        row("same seed, same bytes", "runs, processes, threads", "equal" if len(set(found)) == 1 else str(found))
    for kind in ("cart", "walk", "drone", "hand"):
        motions = [prepare(Request("office", seed, 60.0, kind), lit=False).motion for seed in range(3)]
        for fine, rule in ((True, "cubic"), (False, "midpoint rule")):
            m, deg = np.max([drift(motion, fine=fine) for motion in motions], axis=0)
            row(
                f"IMU against truth, {kind}, {rule}",
                "<= 1 mm, <= 0.01 deg in 10 s",
                f"{1e3 * m:.3f} mm, {deg:.5f} deg (worst window of 3 seeds)",
            )
    sets = {}
    for name in ("office", "warehouse"):
        simulation = prepare(Request(name, motion="walk"))
        images = [left for left, *_ in views(simulation, given.frames)]
        covered = [orb_coverage(image) for image in images]
        good = np.mean([n >= 1000 and share >= 0.8 for n, share in covered])
        low = min(share for _, share in covered)
        row(
            f"ORB in {name}",
            ">= 1000 corners on >= 80 % of the grid in >= 95 %",
            f"{100 * good:.0f} % of frames; least {100 * low:.0f} %",
        )
        errors = disparity_errors(simulation)
        row(
            f"KLT disparity in {name}",
            "median <= 0.05 px",
            f"{np.median(errors):.3f} px; p90 {np.quantile(errors, 0.9):.2f}",
        )
        sets[name] = gradients(images)
    simulation = prepare(Request("office", motion="cart", duration_s=60.0))
    read, of, corner, sightings = codes(simulation)
    row("QR of 0.20 m at 1.5 m", "read", f"{read} of {of}")
    row(
        "AprilTag corners",
        "median <= 0.1 px",
        f"{corner:.3f} px over {sightings} sightings, 1 to 2.5 m, tilted to 30 deg",
    )
    looked, worst = light_frequencies(simulation)
    row("light frequency, plain FFT", "within 1 %", f"{100 * worst:.2f} % at worst, of {looked}")
    for folder in given.real:
        files = sorted([*folder.glob("*.png"), *folder.glob("*.jpg")])
        images = [cv2.imread(str(f), cv2.IMREAD_GRAYSCALE) for f in files[:: max(1, len(files) // given.frames)]]
        sets[str(folder)] = gradients(images)
    for name, values in sets.items():
        q = np.quantile(values, (0.25, 0.5, 0.75, 0.9, 0.99))
        row(
            f"gradients, {name}",
            "beside real frames",
            "quartiles " + ", ".join(f"{v:.1f}" for v in q[:3]) + f"; p90 {q[3]:.1f}, p99 {q[4]:.1f}",
        )
    if given.plot:
        plot_gradients(given.plot, sets)


if __name__ == "__main__":
    main()
