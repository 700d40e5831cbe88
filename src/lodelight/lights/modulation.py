"""How a light says which it is: by the frequency of its blinking, or by a word of bits.

A rolling shutter turns time into rows: row k is open during [t_k, t_k + exposure], t_k = t_0 + k row_time.
Sources: science note A1, A2; IEEE 1789-2015 for flicker; Rajagopal, Lazik, Rowe, IPSN 2014 for frequencies as names.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lodelight.types import Array

MIN_STRIPES = 2.5  # below it 40 % of the frequencies are grossly wrong (science note A3)
MAX_OF_NYQUIST = 0.96  # of half the row rate; at half of it a stripe pair is two rows and its phase is lost


@dataclass(frozen=True)
class Pwm:
    """On for `duty` of every period, off for the rest."""

    frequency_hz: float
    duty: float = 0.5
    phase: float = 0.0

    def mean(self, start_s: Array, exposure_s: float) -> Array:
        """Mean intensity (0 to 1) over [start, start + exposure], exactly; exposure 0 gives the instant."""
        x = self.frequency_hz * np.asarray(start_s, dtype=np.float64) + self.phase
        if exposure_s <= 0.0:
            instant: Array = (x - np.floor(x) < self.duty).astype(np.float64)
            return instant
        span = self.frequency_hz * exposure_s
        out: Array = (self._lit(x + span) - self._lit(x)) / span
        return out

    def _lit(self, x: Array) -> Array:
        """Periods of light until x periods have passed."""
        whole = np.floor(x)
        out: Array = whole * self.duty + np.minimum(x - whole, self.duty)
        return out


@dataclass(frozen=True)
class Manchester:
    """OOK: a word of bits in a loop, every bit two half bits (1 = on off, 0 = off on), after a header.

    The header is three half bits on and three off: no Manchester word has three alike. A loop is light for half of
    its time, whatever the word, so lights do not differ in brightness.
    """

    word: int
    bits: int
    half_bit_s: float

    @property
    def chips(self) -> Array:
        """The half bits of one loop, 1 on and 0 off: header 1 1 1 0 0 0, then the bits, the highest first."""
        data = [(self.word >> (self.bits - 1 - i)) & 1 for i in range(self.bits)]
        pairs = [chip for bit in data for chip in ((1, 0) if bit else (0, 1))]
        return np.array([1, 1, 1, 0, 0, 0, *pairs], dtype=np.float64)

    def mean(self, start_s: Array, exposure_s: float) -> Array:
        """Mean intensity (0 to 1) over [start, start + exposure], exactly."""
        chips = self.chips
        total = np.concatenate([[0.0], np.cumsum(chips)])
        start = np.asarray(start_s, dtype=np.float64) / self.half_bit_s

        def lit(x: Array) -> Array:
            loops, inside = np.floor(x / len(chips)), np.mod(x, len(chips))
            out: Array = loops * total[-1] + np.interp(inside, np.arange(len(total)), total)
            return out

        span = max(exposure_s / self.half_bit_s, 1e-9)
        mean: Array = (lit(start + span) - lit(start)) / span
        return mean


def contrast(frequency_hz: float, duty: float, exposure_s: float) -> float:
    """Amplitude of the stripes' fundamental over a light's full brightness: 2/pi sin(pi d) |sinc(f exposure)|."""
    return float(2.0 / math.pi * math.sin(math.pi * duty) * abs(np.sinc(frequency_hz * exposure_s)))


def null_hz(exposure_s: float) -> float:
    """The lowest frequency that leaves no stripes: a row is open for a whole period."""
    return math.inf if exposure_s <= 0 else 1.0 / exposure_s


def band_hz(row_time_s: float, exposure_s: float, diameter_rows: float) -> tuple[float, float]:
    """Frequencies that a camera reads from a light that many rows high: lowest and highest.

    At least 2.5 stripes in the light; below the row rate's Nyquist limit, and with f exposure < 1/2, where the
    contrast is still 64 % of a short exposure's.
    """
    highest = MAX_OF_NYQUIST * 0.5 / row_time_s
    return MIN_STRIPES / (diameter_rows * row_time_s), min(highest, 0.5 * null_hz(exposure_s))


def flicker(frequency_hz: float, duty: float = 0.5) -> str:
    """ "no effect", "low risk" or "visible" of IEEE 1789-2015, for a light that is fully off for part of a period.

    Modulation, in percent, is (max - min) / (max + min) = 100. Low risk: up to 0.08 f, without limit above 1250 Hz;
    no effect: up to 0.0333 f, without limit above 3000 Hz.
    """
    depth = 0.0 if duty >= 1.0 else 100.0
    if frequency_hz > 3000.0 or depth <= 0.0333 * frequency_hz:
        return "no effect"
    return "low risk" if depth <= 0.08 * frequency_hz else "visible"
