"""Simulated lights: crops of one, frames of several, sightings without images."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from lodelight.anchors import Light
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.lights.conic import conic_centre, image_of_disc
from lodelight.lights.modulation import Pwm
from lodelight.lights.odometry import LightOdometry
from lodelight.messages import LightSighting
from lodelight.rig import CameraSpec
from lodelight.sim.sensor import Exposure, develop

ROW_S, EXPOSURE_S = 18.9e-6, 60e-6
CODES_HZ = np.arange(2000.0, 8001.0, 200.0)
UP = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
SPEC = CameraSpec(
    "light0",
    Camera.create("radtan", 1280, 960, (1000.0, 1000.0, 639.0, 479.0)),
    SE3(UP, np.array([0.02, 0.01, 0.08])),
    row_time_s=ROW_S,
    exposure_s=EXPOSURE_S,
)
LIGHTS = tuple(Light(f"{f:.0f}", f, np.array([0.1 * i, 0.0, 2.5])) for i, f in enumerate(CODES_HZ.tolist()))


def paint(shape, discs, rng, bell=False, level=180.0, psf_px=0.7, background=2.0):
    """An image of discs (centre (2,), diameter px, modulation): sub-sampled rims, shot and read noise, eight bits.

    The lens blurs a face before its rows are exposed: blurred afterwards, stripes on a face that fades would shift.
    """
    scene = np.full(shape, background)
    fine = 4
    rows_s = rng.uniform() + ROW_S * np.arange(shape[0])
    for centre, diameter, code in discs:
        reach = int(0.5 * diameter * (2.4 if bell else 1.2)) + 6
        x0, y0 = (max(0, int(c) - reach) for c in centre)
        x1, y1 = min(shape[1], int(centre[0]) + reach), min(shape[0], int(centre[1]) + reach)
        ax, ay = ((np.arange((b - a) * fine) + 0.5) / fine - 0.5 + a for a, b in ((x0, x1), (y0, y1)))
        r = np.hypot(ax[None] - centre[0], ay[:, None] - centre[1]) / (0.5 * diameter)
        face = 1.0 / (1.0 + r**8) if bell else (r < 1.0).astype(float)
        face = face.reshape(y1 - y0, fine, x1 - x0, fine).mean(axis=(1, 3))
        face = cv2.GaussianBlur(face, (0, 0), psf_px) if psf_px > 0.0 else face
        lit = code.mean(rows_s[y0:y1], EXPOSURE_S) if code else np.ones(y1 - y0)
        scene[y0:y1, x0:x1] += level * face * lit[:, None]
    unit = Exposure(1.0 / 385.0)  # one grey level per unit of radiance
    shade = np.ones(shape, np.float32)
    return develop(scene.astype(np.float32), shade, unit, int(rng.integers(1 << 40)), psf_px=0.0)


def crop(rng, diameter, frequency_hz, bell=False, level=180.0):
    """An image of one light and its true centre."""
    n = int(2.4 * diameter) + 24
    centre = 0.5 * n + rng.uniform(-2.0, 2.0, 2)
    code = Pwm(frequency_hz, 0.5, rng.uniform())
    return paint((n, n), [(centre, diameter, code)], rng, bell, level), centre


def sightings(T_world_body, lights, rng, sigma_px=0.3, spec=SPEC, names=None):
    """What a perfect receiver would say of lights, given its noise: the centres of their ellipses."""
    T = T_world_body @ spec.T_body_cam
    out = []
    for i, light in enumerate(lights):
        X = T.R.T @ (light.xyz - T.t)
        centre = conic_centre(image_of_disc(X, T.R.T @ light.normal, light.radius_m))
        px, _ = spec.camera.project(np.array([[*centre, 1.0]]))
        width = 2.0 * light.radius_m * spec.camera.focal_px / X[2]
        noise = sigma_px * rng.normal(size=2)
        candidates = (light.id,) if names is None else names[i]
        out.append(
            LightSighting(0, px[0] + noise, sigma_px**2 * np.eye(2), width, light.frequency_hz, 2.0, candidates, 1.0)
        )
    return out


def random_pose(rng, tilt_deg=3.0):
    yaw = SE3.exp(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi), *rng.uniform(-0.3, 0.3, 2), 0.0]))
    return yaw @ SE3.exp(np.array([*np.radians(rng.normal(0.0, tilt_deg, 2)), 0.0, 0.0, 0.0, 0.0]))


def measured_up(T_world_body, sigma_deg, rng):
    e = np.radians(sigma_deg) * rng.normal(size=2)
    return SE3.exp(np.array([*e, 0.0, 0.0, 0.0, 0.0])).R @ T_world_body.R[2]


def along(truth, lights, spec, rng, rate_hz=10.0, sigma_px=0.3, tilt_deg=0.25, known=None):
    """Fixes along a true trajectory, as light images of a clean receiver would give them.

    known : the survey the receiver goes by, where it is not the truth; codes are shared where frequencies are
    The level errs by tilt_deg, wandering over some seconds as that of an inertial sensor does.
    """
    odometry = LightOdometry(spec, known or lights, 2.0 * tilt_deg)
    by_code = {}
    for light in known or lights:
        by_code.setdefault(light.frequency_hz, []).append(light.id)
    tilt, keep = rng.normal(size=2), np.exp(-1.0 / (rate_hz * 2.0))
    first, last = int(truth.t_ns[0]), int(truth.t_ns[-1])
    fixes = []
    for t_ns in range(first, last - 30_000_000, round(1e9 / rate_hz)):
        seen = []
        middle = pose_at(truth, t_ns) @ spec.T_body_cam
        for light in lights:
            if not _in_view(light, middle, spec, margin=0.0):
                continue
            rows = spec.camera.project(((middle.inverse()) @ light.xyz)[None])[0][0, 1]
            s_ns = t_ns + round((rows * spec.row_time_s + 0.5 * spec.exposure_s) * 1e9)
            T = pose_at(truth, s_ns)
            if _in_view(light, T @ spec.T_body_cam, spec, margin=3.0):
                (one,) = sightings(T, [light], rng, sigma_px, spec, [tuple(by_code[light.frequency_hz])])
                seen.append(replace(one, t_ns=s_ns))
        tilt = keep * tilt + np.sqrt(1.0 - keep**2) * rng.normal(size=2)
        e = np.radians(tilt_deg) * tilt
        up = SE3.exp(np.array([*e, 0.0, 0.0, 0.0, 0.0])).R @ pose_at(truth, t_ns).R[2]
        fix = odometry.locate(seen, up)
        fixes.append(replace(fix, t_ns=fix.t_ns or t_ns, seen=tuple(seen)))
    return fixes


def pose_at(truth, t_ns):
    """Of a trajectory that is sampled finely."""
    j = int(np.clip(np.searchsorted(truth.t_ns, t_ns), 1, len(truth) - 1))
    a, b = int(truth.t_ns[j - 1]), int(truth.t_ns[j])
    return truth.pose(j - 1).interpolate(truth.pose(j), (t_ns - a) / (b - a))


def _in_view(light, T_world_cam, spec, margin):
    """Whether the whole face is in the image, with so many pixels around it."""
    X = T_world_cam.R.T @ (light.xyz - T_world_cam.t)
    if X[2] < 0.3:
        return False
    px, seen = spec.camera.project(X[None])
    edge = margin + spec.camera.focal_px * light.radius_m / X[2]
    (u, v), w, h = px[0], spec.camera.width, spec.camera.height
    return bool(seen[0] and edge < u < w - 1 - edge and edge < v < h - 1 - edge)
