"""Which light of a building blinks at which frequency.

A camera tells so many frequencies apart; where there are more lights than that, they are used again, so far apart
that no camera sees two of one frequency at a time. Source: science note A1, A3.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lodelight.anchors import Light
from lodelight.errors import ConfigError
from lodelight.lights.modulation import band_hz, contrast, flicker
from lodelight.rig import CameraSpec
from lodelight.types import Array

SPACING_HZ = 200.0
LOWEST_HZ, HIGHEST_HZ = 2000.0, 8000.0
OSCILLATOR = 0.01  # of the frequency, by which a driver may miss it


@dataclass(frozen=True, eq=False)
class Plan:
    """lights : with their frequencies; codes_hz : all that could be used; diameter_rows : of the smallest light

    reuse_m : least horizontal distance of two lights of one frequency, inf if there are none
    """

    lights: tuple[Light, ...]
    codes_hz: Array
    diameter_rows: float
    reach_m: float
    reuse_m: float
    notes: tuple[str, ...]


def smallest_diameter_rows(lights: tuple[Light, ...], spec: CameraSpec, camera_height_m: float) -> float:
    """Rows of the light that looks smallest to a level camera at that height, whichever way it is off."""
    above = np.array([light.xyz[2] - camera_height_m for light in lights])
    if (above <= 0.1).any():
        low = lights[int(np.argmin(above))]
        raise ConfigError(f"light {low.id} hangs at {low.xyz[2]:.2f} m, not above a camera at {camera_height_m:.2f} m")
    return float(min(2.0 * light.radius_m * spec.camera.params[1] / h for light, h in zip(lights, above, strict=True)))


def reach_of(lights: tuple[Light, ...], spec: CameraSpec, camera_height_m: float) -> float:
    """Greatest horizontal distance of two lights that one image may show: the diagonal of its view under them, m."""
    lens = spec.camera
    corners, _ = lens.unproject(np.array([[0.0, 0.0], [lens.width - 1.0, lens.height - 1.0]]))
    spread = np.linalg.norm(corners[0, :2] / corners[0, 2] - corners[1, :2] / corners[1, 2])
    return float(spread * max(light.xyz[2] - camera_height_m for light in lights))


def frequencies(
    row_time_s: float, exposure_s: float, diameter_rows: float, spacing_hz: float = SPACING_HZ,
    lowest_hz: float = LOWEST_HZ, highest_hz: float = HIGHEST_HZ,
) -> Array:  # fmt: skip
    """Codes (N,) Hz, multiples of the spacing, that a camera can tell apart in a light that many rows high."""
    if spacing_hz <= 0.0:
        raise ConfigError(f"spacing {spacing_hz:g} Hz must be positive")
    low, high = band_hz(row_time_s, exposure_s, diameter_rows)
    first = np.ceil(max(low, lowest_hz) / spacing_hz - 1e-9)
    last = np.floor(min(high, highest_hz) / spacing_hz + 1e-9)
    if last < first:
        raise ConfigError(
            f"no frequency: a light {diameter_rows:.0f} rows high needs {low:.0f} Hz or more, and the camera reads up "
            f"to {high:.0f} Hz; come closer, take larger lights, or a shorter exposure"
        )
    codes: Array = spacing_hz * np.arange(first, last + 1.0)
    return codes


def plan_frequencies(
    lights: tuple[Light, ...], spec: CameraSpec, camera_height_m: float, duty: float = 0.5,
    spacing_hz: float = SPACING_HZ, reach_m: float | None = None,
    within_hz: tuple[float, float] = (LOWEST_HZ, HIGHEST_HZ),
) -> Plan:  # fmt: skip
    """Give every light a frequency: those with the most neighbours first, each the code that is used farthest away.

    Raises ConfigError where two lights of one frequency would be in one image.
    """
    if not lights:
        raise ConfigError("no light to plan for; list them as [[light]] entries or as rows of id x y z")
    rows = smallest_diameter_rows(lights, spec, camera_height_m)
    codes = frequencies(spec.row_time_s, spec.exposure_s, rows, spacing_hz, *within_hz)
    reach = reach_of(lights, spec, camera_height_m) if reach_m is None else reach_m
    xy = np.array([light.xyz[:2] for light in lights])
    apart = np.linalg.norm(xy[:, None] - xy[None, :], axis=2)
    code = colour(apart, len(codes), reach)
    same = (code[:, None] == code[None, :]) & ~np.eye(len(lights), dtype=bool)
    reuse = float(apart[same].min()) if same.any() else np.inf
    if reuse < reach:
        i, j = np.argwhere(same & (apart == reuse))[0]
        raise ConfigError(
            f"{len(codes)} frequencies are too few: {lights[i].id} and {lights[j].id}, {reuse:.1f} m apart, would have "
            f"one, and an image reaches {reach:.1f} m; allow a smaller spacing, or words instead of frequencies"
        )
    planned = tuple(replace(light, frequency_hz=float(codes[k])) for light, k in zip(lights, code, strict=True))
    return Plan(planned, codes, rows, reach, reuse, tuple(_notes(codes, duty, spec, spacing_hz)))


def colour(apart: Array, count: int, reach: float) -> Array:
    """One of `count` colours for each of N points, (N,) int: unused ones first, then the one used farthest away.

    The point with the fewest colours left goes first, the one with the most neighbours among equals (DSATUR, Brelaz
    1979). apart : (N, N) m
    """
    n = len(apart)
    out = np.full(n, -1)
    near = (apart < reach) & ~np.eye(n, dtype=bool)
    distance = np.full((n, count), np.inf)  # of the nearest point with a colour
    for _ in range(n):
        waiting = np.flatnonzero(out < 0)
        taken = (distance[waiting] < reach).sum(axis=1)
        i = int(waiting[np.lexsort((waiting, -near[waiting].sum(axis=1), -taken))[0]])
        out[i] = int(np.argmax(distance[i]))
        distance[:, out[i]] = np.minimum(distance[:, out[i]], apart[:, i])
    return out


def _notes(codes: Array, duty: float, spec: CameraSpec, spacing_hz: float) -> list[str]:
    notes = []
    worst = flicker(float(codes[0]), duty)
    if worst != "no effect":
        below = codes[codes <= 3000.0]
        notes.append(f"flicker at {below[0]:g} to {below[-1]:g} Hz: {worst} (IEEE 1789); none from 3000 Hz up")
    if spacing_hz < 2.0 * OSCILLATOR * codes[-1]:
        notes.append(
            f"a driver 1 % off is {OSCILLATOR * codes[-1]:.0f} Hz off at {codes[-1]:g} Hz, near half the spacing: "
            "measure each light's frequency and put that into the anchors"
        )
    weakest = min(contrast(float(f), duty, spec.exposure_s) for f in codes)
    notes.append(f"weakest stripes: amplitude {100 * weakest:.0f} % of the light's brightness")
    return notes
