"""An image of a rolling shutter to the lights in it."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lodelight.anchors import Light
from lodelight.compiled import kernel
from lodelight.errors import CalibrationError, ConfigError
from lodelight.lights.decoders import LedDecoder, ManchesterDecoder, PwmDecoder
from lodelight.lights.outline import LEAST_EDGES, Outline, fit_outline, row_edges
from lodelight.lights.regions import Region, find_regions
from lodelight.messages import LightSighting
from lodelight.rig import CameraSpec
from lodelight.types import Array, Bytes

LEAST_ASPECT, MOST_ASPECT = 0.5, 2.0
CENTRAL = 0.15  # of the width either side of the middle: there the chords are all but equally long
SATURATED = 250
MOST_SATURATED = 0.05  # of a column's pixels
EDGE, BLUR_PX = 0.05, 3.0  # a light ends at that part of its brightness; there a lens has widened it by that much
BRIGHT_GAIN = 0.6  # of the brightest row's; darker rows have edges too blurred to help
PLATEAU_DN = 230.0  # the highest level that is surely not clipped
LEAST_PX = 0.05  # sigma of a centre: the lens is not known better
NS_PER_S = 1_000_000_000


@dataclass(frozen=True, eq=False)
class Receiver:
    """Reads lights. spec : a camera with row_time_s > 0; decoder : what the lights' stripes mean

    stripes : "rows", or "columns" where images are stored a quarter turn from the sensor's rows
    """

    spec: CameraSpec
    decoder: LedDecoder
    stripes: str = "rows"

    def __post_init__(self) -> None:
        if self.stripes not in ("rows", "columns"):
            raise ConfigError(f"stripes {self.stripes!r} are unknown; they run along rows or columns")

    def sightings(self, image: Bytes, t_ns: int) -> list[LightSighting]:
        """All spots that may be lights, named or with the reason why not; t_ns : when row 0 began to be exposed."""
        turned = self.stripes == "columns"
        image = np.ascontiguousarray(image.T if turned else image)
        period = self.decoder.longest_period_rows
        seen = [self._read(image, region, t_ns) for region in find_regions(image, period)]
        seen = _without_doubles(seen)
        return (
            [replace(s, centre_px=s.centre_px[::-1].copy(), edges=s.edges[:, ::-1]) for s in seen] if turned else seen
        )

    def _read(self, image: Bytes, region: Region, t_ns: int) -> LightSighting:
        box = (region.left, region.top, region.columns, region.rows)
        middle = np.array([region.left + 0.5 * region.columns, region.top + 0.5 * region.rows])
        height = float(max(region.rows, region.columns))
        refused = LightSighting(t_ns, middle, np.eye(2) * height**2, height, box_px=box)
        if region.touches_border(image.shape):
            return replace(refused, why="cut by the image border")
        if not LEAST_ASPECT <= region.rows / region.columns <= MOST_ASPECT:
            return replace(refused, why=f"{region.columns} x {region.rows} px is not round")
        profile = _profile(image, region)
        rows = _stripe_rows(image, region)
        rough = self.decoder.decode(profile.values, None, rows, profile.noise)
        if rough is None:
            return replace(refused, why="no stripes: another lamp or a reflection")
        outline = _outline(image, region, profile.values, rough.gain)
        envelope = None if outline is None else _envelope(image, region, profile.columns, rough.gain, outline)
        reading = rough if envelope is None else self.decoder.decode(profile.values, envelope, rows, profile.noise)
        if reading is None or outline is None:
            return replace(refused, why=rough.why or "no round outline")
        outline = _outline(image, region, profile.values, reading.gain) or outline
        known = replace(
            refused, frequency_hz=reading.frequency_hz, sigma_hz=reading.sigma_hz, why=reading.why,
            candidates=reading.lights, confidence=reading.confidence, clear=reading.clear,
        )  # fmt: skip
        u, v = (float(c) for c in outline.centre_px)
        if not (region.left <= u < region.right and region.top <= v < region.bottom):
            return replace(known, candidates=(), confidence=0.0, why="its outline is not where its light is")
        delay_s = v * self.spec.row_time_s + 0.5 * self.spec.exposure_s
        return replace(
            known,
            t_ns=t_ns + round(delay_s * NS_PER_S),
            centre_px=outline.centre_px,
            covariance_px=outline.covariance + LEAST_PX**2 * np.eye(2),
            diameter_rows=2.0 * outline.radius_px,
            edges=outline.edges,
        )


def receiver(spec: CameraSpec | None, lights: tuple[Light, ...], stripes: str = "rows") -> Receiver:
    """The receiver for a rig's light camera and a building's lights. Raises where either cannot be used."""
    if spec is None:
        raise CalibrationError("the rig has no light camera; add a [lights] table to rig.toml")
    if not spec.row_time_s > 0.0:
        raise CalibrationError(f'{spec.name} has no row_time_s; find it with "lodelight lights calibrate"')
    if not lights:
        raise ConfigError('the anchors name no light; add [[light]] entries, or make them with "lodelight lights plan"')
    words = {bool(light.word) for light in lights}
    if len(words) > 1:
        raise ConfigError("some lights have words and some frequencies; one camera reads one kind of code")
    kind = ManchesterDecoder if words.pop() else PwmDecoder
    return Receiver(spec, kind(lights, spec.row_time_s, spec.exposure_s), stripes)


def _stripe_rows(image: Bytes, region: Region) -> float:
    """Height of a round light in rows, by its width: its top and bottom may lie in dark stripes, its sides do not.

    Down to a twentieth of its brightness: a face that fades shows stripes far outside of where it is half as bright.
    """
    piece = image[region.top : region.bottom, region.left : region.right]
    brightest = piece.max(axis=0).astype(np.float64) - region.background_dn
    lit = np.flatnonzero(brightest > max(region.level_dn, EDGE * float(brightest.max())))
    return float(lit[-1] - lit[0] + 1 - BLUR_PX) if len(lit) else 0.0


@dataclass(frozen=True, eq=False)
class _Profile:
    """values (rows,): mean of each row over `columns` (of the region), background taken off; noise of such a mean."""

    values: Array
    columns: NDArray[np.int64]
    noise: float


def _profile(image: Bytes, region: Region) -> _Profile:
    """Over the columns in the middle; where those are saturated, over the nearest ones left and right that are not."""
    piece = image[region.top : region.bottom, region.left : region.right]
    sums = column_sums(piece, region.background_dn + 0.5 * region.level_dn)
    total = np.cumsum(sums[0])
    middle = int(np.searchsorted(total, 0.5 * total[-1]))
    width, half = region.columns, max(1, round(CENTRAL * region.columns))
    columns = np.arange(max(0, middle - half), min(width, middle + half + 1))
    if sums[1][columns].mean() > MOST_SATURATED * region.rows:
        band = np.arange(-(half // 2), half // 2 + 1)
        for offset in range(half, width // 2 - half, 2):
            wings = np.concatenate([middle - offset + band, middle + offset + band])
            wings = wings[(wings >= 0) & (wings < width)]
            if sums[1][wings].mean() < 0.2 * MOST_SATURATED * region.rows:
                columns = wings if sums[2][wings].mean() > 4.0 * region.level_dn else columns
                break
    values = piece[:, columns].mean(axis=1, dtype=np.float64) - region.background_dn
    return _Profile(np.maximum(values, 0.0), columns, max(region.noise_dn, 1.0) / np.sqrt(len(columns)))


@kernel
def column_sums(piece: Bytes, floor: float) -> Array:
    """(3, columns): sum of what is above the floor, number of saturated pixels, largest value."""
    h, w = piece.shape
    out = np.zeros((3, w))
    for y in range(h):
        for x in range(w):
            v = float(piece[y, x])
            if v > floor:
                out[0, x] += v - floor
            if v >= SATURATED:
                out[1, x] += 1.0
            out[2, x] = max(out[2, x], v)
    return out


def _outline(image: Bytes, region: Region, profile: Array, gain: Array) -> Outline | None:
    """Edges at half of the face's brightness, as each row shows it."""
    gain = np.maximum(gain, 1e-3)
    rows = np.flatnonzero(gain > BRIGHT_GAIN * gain.max())
    brightest = row_maxima(image[region.top : region.bottom, region.left : region.right])[rows]
    faces = np.sort((brightest - region.background_dn) / gain[rows])
    face = float(np.median(faces[-max(3, len(rows) // 3) :]))
    half = min(0.5 * face, 0.5 * PLATEAU_DN / float(gain.max()))
    if half * gain.max() < region.level_dn:
        return None
    edges = np.empty((2 * len(rows), 2))
    levels = region.background_dn + half * gain[rows]
    count = row_edges(image, (rows + region.top).astype(np.int32), levels, region.left, region.right, edges)
    return fit_outline(edges[:count]) if count >= LEAST_EDGES else None


def _envelope(image: Bytes, region: Region, columns: NDArray[np.int64], gain: Array, outline: Outline) -> Array | None:
    """What the profile were without stripes. The light is round: how it fades along its rows, it fades across them."""
    piece = image[region.top : region.bottom, region.left : region.right]
    x, y = outline.centre_px[0] - region.left, outline.centre_px[1] - region.top
    gain = np.maximum(gain, 1e-3)
    floor = np.where(gain > BRIGHT_GAIN * gain.max(), gain, 0.0)
    face = radial_mean(piece, region.background_dn, floor, x, y, 0.5 * outline.radius_px)
    if not face[:2].any():
        return None
    apart = np.hypot(columns[None, :] - x, np.arange(region.rows)[:, None] - y)
    out: Array = np.interp(apart, np.arange(len(face)), face).mean(axis=1)
    return out


@kernel
def row_maxima(piece: Bytes) -> Array:
    out = np.zeros(piece.shape[0])
    for y in range(piece.shape[0]):
        for x in range(piece.shape[1]):
            out[y] = max(out[y], piece[y, x])
    return out


@kernel
def radial_mean(piece: Bytes, background: float, gain: Array, x0: float, y0: float, reach: float) -> Array:
    """Mean brightness over the row's gain at 0, 1, 2 ... px from (x0, y0), of rows within `reach` that have a gain."""
    h, w = piece.shape
    n = int(math.hypot(max(x0, w - x0), max(y0, h - y0))) + 2
    total, count = np.zeros(n), np.zeros(n)
    for y in range(h):
        if gain[y] <= 0.0 or abs(y - y0) > reach:
            continue
        for x in range(w):
            r = math.hypot(x - x0, y - y0)
            k = int(r)
            f = r - k
            v = (piece[y, x] - background) / gain[y]
            total[k] += (1.0 - f) * v
            count[k] += 1.0 - f
            total[k + 1] += f * v
            count[k + 1] += f
    last = 0.0
    for k in range(n):
        inside = -1
        if count[k] <= 0.0:
            for j in range(k + 1, n):  # nearer to the middle than any bright row
                if count[j] > 0.0:
                    inside = j
                    break
        if count[k] > 0.0:
            last = total[k] / count[k]
        elif last == 0.0 and inside >= 0:
            last = total[inside] / count[inside]
        total[k] = max(last, 0.0)
    return total


def _without_doubles(seen: list[LightSighting]) -> list[LightSighting]:
    """Two spots of one code, of which a building has one light: nobody knows which it is."""
    codes = Counter(s.candidates for s in seen if s.candidates)
    return [
        replace(
            s,
            candidates=(),
            confidence=0.0,
            why=f"{codes[s.candidates]} spots in view have the code of {s.candidates[0]}",
        )
        if s.candidates and codes[s.candidates] > len(s.candidates)
        else s
        for s in seen
    ]
