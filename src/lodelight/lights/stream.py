"""From a light camera's images to fixes, one an image."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

from lodelight.lights.level import Leveller
from lodelight.lights.odometry import LightOdometry
from lodelight.lights.receiver import Receiver
from lodelight.messages import Frame, Imu, LightFix, LightSighting
from lodelight.types import Array, Bytes


@dataclass(frozen=True, eq=False)
class LightFrame:
    """An image, what was seen in it, and where that puts the body. times_ms : that reading and placing took."""

    t_ns: int
    image: Bytes
    sightings: list[LightSighting]
    fix: LightFix
    times_ms: tuple[float, float] = (0.0, 0.0)


def levelled(frames: Iterable[Frame], inertial: Iterator[Imu]) -> Iterator[tuple[Frame, Array | None, float]]:
    """Every frame with up in the body frame when it was taken and its sigma, rad.

    None and 0 where no inertial sample came before it.
    """
    leveller, waiting = Leveller(), next(inertial, None)
    for frame in frames:
        while waiting is not None and waiting.t_ns <= frame.t_ns:
            leveller.feed(waiting)
            waiting = next(inertial, None)
        yield frame, leveller.up_body, leveller.sigma_rad if leveller.up_body is not None else 0.0


def read_lights(
    frames: Iterable[Frame], inertial: Iterator[Imu], reader: Receiver, odometry: LightOdometry
) -> Iterator[LightFrame]:
    """Read one image after another. Without inertial samples the body is taken to stand level.

    Raises CalibrationError where the map of lights is mirrored.
    """
    for frame, up_body, sigma_rad in levelled(frames, inertial):
        began = time.perf_counter()
        sightings = reader.sightings(frame.images[0], frame.t_ns)
        decoded = time.perf_counter()
        fix = odometry.locate(sightings, up_body, sigma_rad)
        times_ms = (1e3 * (decoded - began), 1e3 * (time.perf_counter() - decoded))
        named = tuple(s for s in sightings if s.candidates)
        fix = replace(fix, t_ns=fix.t_ns or frame.t_ns, seen=named)
        yield LightFrame(frame.t_ns, frame.images[0], sightings, fix, times_ms)
