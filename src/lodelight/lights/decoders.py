"""From a striped profile to a name: frequencies (PWM) and words (OOK-Manchester) behind one interface."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from lodelight.anchors import Light
from lodelight.lights.frequency import Tone, estimate_tone, running_mean
from lodelight.lights.modulation import MIN_STRIPES, Manchester, band_hz
from lodelight.types import Array

MAX_RESIDUAL = 0.5  # of the profile's variance; more is no PWM
APART_SIGMA = 5.0  # by which the second nearest code must be farther off than the nearest
TOLERANCE = 0.01  # of the frequency: oscillators and the row time
ENVELOPE_SHARE = 0.005  # of 1 / (the time a light takes to be read): real faces are not quite round or even
LEAST_CORRELATION = 0.7
LEAST_MARGIN = 0.1  # of the best word's correlation over the second's


@dataclass(frozen=True, eq=False)
class Reading:
    """What a profile says. lights : ids of all lights with that code, none where it is unknown

    gain : (n,) brightness of each row over the light's mean; why : the reason where it is unknown
    clear : whether there are enough stripes, and little else, whatever they mean
    """

    frequency_hz: float
    sigma_hz: float
    lights: tuple[str, ...]
    confidence: float
    gain: Array
    why: str = ""
    clear: bool = False


class LedDecoder(Protocol):
    """What stripes mean."""

    @property
    def longest_period_rows(self) -> float:
        """Of any stripe it expects; rows that are dark for less belong to one light."""

    def decode(self, profile: Array, envelope: Array | None, diameter_rows: float, noise: float) -> Reading | None:
        """Reads a profile (n,), one sample a row, background taken off; None where it holds no stripes at all.

        envelope : (n,) what the profile were without stripes, None where that is not known yet
        diameter_rows : height of the light; noise : sigma of a sample
        """


@dataclass(frozen=True, eq=False)
class PwmDecoder:
    """Names by frequency. tolerance : largest deviation from the registered frequency, as a part of it."""

    lights: tuple[Light, ...]
    row_time_s: float
    exposure_s: float
    tolerance: float = TOLERANCE

    @property
    def codes_hz(self) -> Array:
        """The frequencies in use, rising."""
        return np.unique([light.frequency_hz for light in self.lights if not light.word])

    @property
    def longest_period_rows(self) -> float:
        codes = self.codes_hz
        return 1.0 / ((float(codes[0]) if len(codes) else 1200.0) * self.row_time_s)

    def decode(self, profile: Array, envelope: Array | None, diameter_rows: float, noise: float) -> Reading | None:
        lowest, highest = band_hz(self.row_time_s, 0.0, diameter_rows)
        # A margin below, so that what has too few stripes is seen as such and not forced onto a code above
        tone = estimate_tone(profile, envelope, self.row_time_s, lowest * 1.6 / MIN_STRIPES, highest, noise)
        if tone is None:
            return None
        # What the face's evenness hides of the envelope shifts the tone by a part of its resolution
        sigma_hz = math.hypot(tone.sigma_hz, ENVELOPE_SHARE / (diameter_rows * self.row_time_s))
        return self._named(replace(tone, sigma_hz=sigma_hz), diameter_rows)

    def _named(self, tone: Tone, diameter_rows: float) -> Reading:
        def unknown(why: str, clear: bool = True) -> Reading:
            return Reading(tone.frequency_hz, tone.sigma_hz, (), 0.0, tone.gain, why, clear)

        stripes = tone.frequency_hz * diameter_rows * self.row_time_s
        if stripes < MIN_STRIPES:
            return unknown(
                f"{stripes:.1f} stripes, {MIN_STRIPES} needed: come closer, or give it a higher frequency", False
            )
        if tone.residual > MAX_RESIDUAL:
            return unknown(f"no clear stripes: {100 * tone.residual:.0f} % of the profile is no tone", False)
        codes = self.codes_hz
        if not len(codes):
            return unknown("no light of the anchors has a frequency")
        off = np.abs(codes - tone.frequency_hz)
        order = np.argsort(off, kind="stable")
        nearest = float(codes[order[0]])
        allowed = self.tolerance * nearest + 3.0 * tone.sigma_hz
        if off[order[0]] > allowed:
            return unknown(f"{tone.frequency_hz:.0f} Hz is no light's: the nearest has {nearest:g} Hz")
        if len(codes) > 1 and off[order[1]] - off[order[0]] < APART_SIGMA * tone.sigma_hz:
            second = float(codes[order[1]])
            return unknown(f"{tone.frequency_hz:.0f} +- {tone.sigma_hz:.0f} Hz may be {nearest:g} or {second:g} Hz")
        named = tuple(light.id for light in self.lights if light.frequency_hz == nearest and not light.word)
        # Odds of the nearest code against the second, both with their oscillators' spread
        spread2 = tone.sigma_hz**2 + (0.3 * self.tolerance * nearest) ** 2
        rival = off[order[1]] ** 2 if len(codes) > 1 else allowed**2 + off[order[0]] ** 2
        odds = math.exp(-0.5 * min((rival - off[order[0]] ** 2) / spread2, 700.0))
        return Reading(
            tone.frequency_hz, tone.sigma_hz, named, (1.0 - tone.residual) / (1.0 + odds), tone.gain, clear=True
        )


@dataclass(frozen=True, eq=False)
class ManchesterDecoder:
    """Names by word: the profile against every registered word at every phase. At least one loop must be in view.

    A light's `frequency_hz` is then its half-bit rate.
    """

    lights: tuple[Light, ...]
    row_time_s: float
    exposure_s: float

    @property
    def longest_period_rows(self) -> float:
        # Up to four half bits are dark in a row; blurred by the exposure, a lone bright one hardly parts two such
        return 6.0 / (min((light.frequency_hz for light in self.lights), default=1200.0) * self.row_time_s)

    def decode(self, profile: Array, envelope: Array | None, diameter_rows: float, noise: float) -> Reading | None:
        scored = [(*self._correlation(profile, envelope, noise, light), light) for light in self.lights]
        fitting = [s for s in scored if s[3].frequency_hz * diameter_rows * self.row_time_s >= len(_code(s[3]).chips)]
        if not scored:
            return None
        best = max(fitting or scored, key=lambda s: s[0])
        score, gain, light = best[0], best[1], best[3]

        def unknown(why: str) -> Reading:
            return Reading(light.frequency_hz, math.inf, (), 0.0, gain, why)

        if not fitting:
            return unknown("less than one loop of its word is in view: come closer, or make half bits shorter")
        if score < LEAST_CORRELATION:
            return unknown(f"no word fits: the best correlates by {score:.2f}")
        same = (light.word, light.frequency_hz)
        rival = max((s[0] for s in scored if (s[3].word, s[3].frequency_hz) != same), default=0.0)
        if score - rival < LEAST_MARGIN:
            return unknown(f"two words fit alike, by {score:.2f} and {rival:.2f}")
        named = tuple(other.id for other in self.lights if (other.word, other.frequency_hz) == same)
        return Reading(light.frequency_hz, 0.0, named, min(1.0, score), gain, clear=True)

    def _correlation(
        self, profile: Array, envelope: Array | None, noise: float, light: Light
    ) -> tuple[float, Array, float]:
        """Best correlation with a word over all phases, its row gains, and its phase in s."""
        code = _code(light)
        chip_rows = code.half_bit_s / self.row_time_s
        n = len(profile)
        mean = running_mean(profile, min(2.0 * len(code.chips) * chip_rows, float(n))) if envelope is None else envelope
        values = profile / np.maximum(mean, max(3.0 * noise, 0.02 * float(mean.max())))
        loop_s = len(code.chips) * code.half_bit_s
        phases = np.arange(0.0, loop_s, min(0.5 * self.row_time_s, 0.125 * code.half_bit_s))
        rows_s = self.row_time_s * np.arange(n)
        words = code.mean(rows_s[None, :] + phases[:, None], self.exposure_s)
        window = np.sqrt(np.sin(math.pi * (np.arange(n) + 0.5) / n))
        a = (values - np.average(values, weights=window)) * window
        b = (words - np.average(words, axis=1, weights=window)[:, None]) * window
        scores = (b @ a) / (np.linalg.norm(a) * np.linalg.norm(b, axis=1) + 1e-12)
        k = int(np.argmax(scores))
        return float(scores[k]), words[k] / max(float(words[k].mean()), 1e-9), float(phases[k])


def _code(light: Light) -> Manchester:
    return Manchester(int(light.word, 2), len(light.word), 1.0 / light.frequency_hz)
