"""What can go wrong, on demand: in the building, in the sensors, in the recording.

A fault is written `name` or `name=value`. `lodelight sim --list` prints this table.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from lodelight.errors import ConfigError
from lodelight.rig import Rig
from lodelight.sim.scene import Lamp
from lodelight.sim.sensor import Exposure
from lodelight.types import Array, Bools

BLURRED_S = 0.04
NAMES = {
    "dropped": "share of instants without images (0.2)",
    "blackout": "START:LENGTH in s during which all cameras see black (5:2)",
    "blur": "START:LENGTH in s during which the shutter of all but the light camera stays open for 40 ms (5:2)",
    "time-offset": "seconds to add to image stamps to get the IMU's time, not told in rig.toml (0.02)",
    "extrinsics": "DEGREES:METRES by which rig.toml is wrong about every camera (1:0.01)",
    "light": "id of a light that blinks at another's frequency (L02)",
    "moved-light": "id of a light that hangs a metre from where it was surveyed (L02)",
    "swapped-lights": "FIRST:SECOND, ids of two lights that blink at each other's frequency (L02:L03)",
    "moved-tag": "id of a tag that hangs half a metre from where it was surveyed (the first QR code)",
    "duplicated-tag": "id of a tag of which a second copy hangs beside the last one (the first QR code)",
    "people": "number of person-sized boxes that walk about (2)",
    "kidnap": "time in s at which the body finds itself elsewhere on its way (half time)",
}


@dataclass(frozen=True)
class Faults:
    """The faults of one recording; the defaults are none."""

    dropped: float = 0.0
    blackout: tuple[float, float] | None = None
    blur: tuple[float, float] | None = None
    time_offset_s: float = 0.0
    extrinsics: tuple[float, float] = (0.0, 0.0)
    light: str = ""
    moved_light: str = ""
    swapped_lights: tuple[str, ...] = ()
    moved_tag: str = ""
    duplicated_tag: str = ""
    people: int = 0
    kidnap_s: float | None = None

    @staticmethod
    def parse(texts: Iterable[str], duration_s: float) -> Faults:
        """Raises ConfigError on an unknown name or a value that is none."""
        out = Faults()
        for text in texts:
            name, _, value = text.partition("=")
            if name not in NAMES:
                raise ConfigError(f"unknown fault {name!r}; choose one of {', '.join(NAMES)}")
            try:
                out = out._with(name, value, duration_s)
            except ValueError:
                raise ConfigError(f"fault {text!r}: the value must be {NAMES[name]}") from None
        return out

    def _with(self, name: str, value: str, duration_s: float) -> Faults:
        if name == "dropped":
            share = float(value or 0.2)
            if not 0.0 <= share < 1.0:
                raise ValueError
            return replace(self, dropped=share)
        if name == "blackout":
            return replace(self, blackout=_pair(value or "5:2"))
        if name == "blur":
            return replace(self, blur=_pair(value or "5:2"))
        if name == "time-offset":
            return replace(self, time_offset_s=float(value or 0.02))
        if name == "extrinsics":
            return replace(self, extrinsics=_pair(value or "1:0.01"))
        if name == "people":
            return replace(self, people=int(value or 2))
        if name == "kidnap":
            return replace(self, kidnap_s=float(value or 0.5 * duration_s))
        if name == "light":
            return replace(self, light=value or "L02")
        if name == "moved-light":
            return replace(self, moved_light=value or "L02")
        if name == "swapped-lights":
            first, colon, second = (value or "L02:L03").partition(":")
            if not colon or first == second:
                raise ValueError
            return replace(self, swapped_lights=(first, second))
        if name == "moved-tag":
            return replace(self, moved_tag=value or "Q01")
        return replace(self, duplicated_tag=value or "Q01")

    def check(self, building: str, tags: set[str], lights: set[str]) -> None:
        """Raises ConfigError where a tag or light that is to go wrong is not among the building's."""
        for label, known in (
            (self.moved_tag, tags),
            (self.duplicated_tag, tags),
            *((label, lights) for label in (self.light, self.moved_light, *self.swapped_lights)),
        ):
            if label and label not in known:
                raise ConfigError(f"{building} has no {label!r} to go wrong; it has {', '.join(sorted(known))}")

    def swapped(self, lamps: list[Lamp]) -> list[Lamp]:
        """The lamps with two lights blinking as each other; the survey does not know."""
        theirs = {lamp.id: lamp.frequency_hz for lamp in lamps if lamp.id in self.swapped_lights}
        other = dict(zip(self.swapped_lights, reversed(self.swapped_lights), strict=True))
        return [replace(p, frequency_hz=theirs[other[p.id]]) if p.id in theirs else p for p in lamps]

    def kept(self, count: int, rng: np.random.Generator) -> Bools:
        """Which of `count` instants have images; the first always has."""
        out: Bools = rng.random(count) >= self.dropped
        out[:1] = True
        return out

    def dark(self, t_s: float) -> bool:
        """Whether the cameras are covered at a time from the start."""
        return self.blackout is not None and 0.0 <= t_s - self.blackout[0] < self.blackout[1]

    def smeared(self, t_s: float, exposure: Exposure) -> Exposure:
        """The exposure at a time from the start: in a blurred stretch as bright as it was, and much longer."""
        if self.blur is None or not 0.0 <= t_s - self.blur[0] < self.blur[1]:
            return exposure
        return Exposure(BLURRED_S, exposure.gain * exposure.time_s / BLURRED_S)

    def true_rig(self, stated: Rig, rng: np.random.Generator) -> Rig:
        """The rig as it really is, where `stated` is what will be written down."""
        degrees, metres = self.extrinsics
        cameras = []
        for spec in stated.cameras:
            turn, shift = (_unit(rng) * np.radians(degrees), _unit(rng) * metres)
            T = spec.T_body_cam.perturbed(np.concatenate([turn, shift]))
            cameras.append(replace(spec, T_body_cam=T, time_offset_s=spec.time_offset_s + self.time_offset_s))
        depth = stated.depth
        if depth is not None and depth.registered:
            depth = replace(depth, T_body_depth=cameras[0].T_body_cam)
        return replace(stated, cameras=tuple(cameras), depth=depth)


def _pair(text: str) -> tuple[float, float]:
    first, colon, second = text.partition(":")
    if not colon:
        raise ValueError
    return float(first), float(second)


def _unit(rng: np.random.Generator) -> Array:
    v = rng.standard_normal(3)
    out: Array = v / np.linalg.norm(v)
    return out
