"""What the doctor names: every simulated fault on every recording, and nothing on the recordings as they are.

    python benchmarks/doctor_faults.py RECORDING...

A recording is looked at once; faults are put into its rig, its stamps or its IMU afterwards, which is what a wrong
calibration does. Prints a row for each recording: what is named as it is, and for each fault whether it is named.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from itertools import islice

import numpy as np

from lodelight.doctor.examine import judge, look
from lodelight.doctor.gather import RIMS_EVERY, Seen
from lodelight.doctor.rims import Rims, rims_of
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.geometry.so3 import so3_exp
from lodelight.io import open_source
from lodelight.io.recording import Recording
from lodelight.io.registration import Registration
from lodelight.messages import Imu
from lodelight.rig import Rig

NAMED = (
    "time offset",
    "IMU turn",
    "stereo turn",
    "stereo shift",
    "stereo focal",
    "focal length",
    "gyro unit",
    "swapped cameras",
    "IMU shift",
    "depth on image",
    "tag focal",
    "tag aspect",
    "tag squareness",
)


def turned(rig: Rig, rng: np.random.Generator, degrees: float, metres: float) -> Rig:
    """Every camera where it is not, each in its own direction, as `lodelight sim --fault extrinsics` does."""
    moved = []
    for spec in rig.cameras:
        turn, shift = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        d = np.concatenate([np.radians(degrees) * turn, metres * shift])
        moved.append(replace(spec, T_body_cam=spec.T_body_cam.perturbed(d)))
    return replace(rig, cameras=tuple(moved))


def longer(rig: Rig, factor: float) -> Rig:
    """All focal lengths `factor` times what they are; of registered depth too."""
    cameras = []
    for spec in rig.cameras:
        lens, (fx, fy, cx, cy) = spec.camera, spec.camera.params[:4].tolist()
        wrong = Camera.create(
            lens.model_name, lens.width, lens.height, (fx * factor, fy * factor, cx, cy), lens.distortion
        )
        cameras.append(replace(spec, camera=wrong))
    return replace(rig, cameras=tuple(cameras))


def late(seen: Seen, ms: float) -> Seen:
    """IMU samples as they would be stamped if all images were stamped `ms` too early."""
    shift = round(ms * 1e6)
    return replace(seen, imu=[Imu(s.t_ns + shift, s.gyro, s.accel) for s in seen.imu])


def faults(recording: Recording, seen: Seen, rng: np.random.Generator) -> dict[str, Callable[[], tuple[Seen, Rig]]]:
    rig = recording.rig
    out: dict[str, Callable[[], tuple[Seen, Rig]]] = {}
    stereo, inertial = len(rig.cameras) > 1, rig.imu is not None
    if inertial:
        out["offset +5 ms"] = lambda: (late(seen, 5.0), rig)
        out["offset -5 ms"] = lambda: (late(seen, -5.0), rig)
        out["gyro in degrees"] = lambda: (
            replace(seen, imu=[Imu(s.t_ns, np.degrees(s.gyro), s.accel) for s in seen.imu]), rig
        )  # fmt: skip
    if stereo or inertial:
        out["turned 3 deg"] = lambda: (seen, turned(rig, rng, 3.0, 0.0))
    if stereo or (inertial and rig.depth is not None):
        out["shifted 3 cm"] = lambda: (seen, turned(rig, rng, 0.0, 0.03))
    if stereo:
        out["swapped"] = lambda: (replace(seen, stereo=[(b, a) for a, b in seen.stereo]), rig)
    if inertial:
        out["focal +3 %"] = lambda: (seen, longer(rig, 1.03))
        out["focal -3 %"] = lambda: (seen, longer(rig, 0.97))
    if rig.depth is not None:
        out["depth 3 cm"] = lambda: (replace(seen, rims=beside_the_image(recording, 0.03, 0.0, rng)), rig)
        out["depth 3 deg"] = lambda: (replace(seen, rims=beside_the_image(recording, 0.0, 3.0, rng)), rig)
    return out


def beside_the_image(recording: Recording, metres: float, degrees: float, rng: np.random.Generator) -> list[list[Rims]]:
    """Rims of a recording whose depth lies as by a sensor shifted and turned across its axis."""
    lens, angle = recording.rig.cameras[0].camera, rng.uniform(0.0, 2.0 * np.pi)
    across = np.array([np.cos(angle), np.sin(angle), 0.0])
    turn = so3_exp(np.radians(degrees) * np.array([-across[1], across[0], 0.0]))
    moved = Registration(lens, lens, SE3(turn, metres * across))
    frames = islice(recording.frames(1, True, 0.0, 24.0), 0, None, RIMS_EVERY)
    return [rims_of(f.images[0], moved(f.depth), lens.focal_px) for f in frames if f.depth is not None]


def main(paths: list[str]) -> None:
    for number, path in enumerate(paths):
        recording, seen = open_source(path), Seen()
        for seen, _ in look(recording):  # noqa: B007
            pass
        rig, rng = recording.rig, np.random.default_rng(number)
        good = [f for f in judge(seen, rig, recording) if f.level == "fault"]
        print(
            f"{recording.name}: as it is: {'; '.join(f'{f.name}: {f.text}' for f in good) or 'nothing named'}",
            flush=True,
        )
        for name, make in faults(recording, seen, rng).items():
            named = [f for f in judge(*make()) if f.level == "fault" and f.name in NAMED]
            print(
                f"    {name:16} {'; '.join(f'{f.name} {f.value:.2f} {f.unit}' for f in named) or 'NOT NAMED'}",
                flush=True,
            )


if __name__ == "__main__":
    main(sys.argv[1:])
