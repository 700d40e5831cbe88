"""The row time of a camera, from lights of known frequency: t_row = 1 / (f P), P the stripes' period in rows."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from lodelight.anchors import Light
from lodelight.errors import RunError
from lodelight.lights.decoders import PwmDecoder
from lodelight.lights.receiver import Receiver
from lodelight.rig import CameraSpec
from lodelight.types import Bytes

LONGEST_PERIOD_ROWS = 60.0


@dataclass(frozen=True)
class RowTime:
    """row_time_s with its sigma, from that many images."""

    row_time_s: float
    sigma_s: float
    images: int


def calibrate_row_time(
    images: Iterable[Bytes], frequency_hz: float, spec: CameraSpec, stripes: str = "rows"
) -> RowTime:
    """From images of one light that blinks at `frequency_hz`; of several spots with stripes the clearest counts.

    spec : its row time is not used. Raises RunError where no image shows clear stripes.
    """
    # Time counted in rows: frequencies are cycles per row
    slowest = Light("known", 1.0 / LONGEST_PERIOD_ROWS, np.zeros(3))
    receiver = Receiver(spec, PwmDecoder((slowest,), 1.0, 0.0), stripes)
    found = []
    for image in images:
        spots = [s for s in receiver.sightings(image, 0) if s.clear]
        if spots:
            best = min(spots, key=lambda s: s.sigma_hz / s.frequency_hz)
            found.append((best.frequency_hz, best.sigma_hz))
    if not found:
        raise RunError("no light with clear stripes in the images; move closer, or expose for 60 us or less")
    nu, sigma = np.array(found).T
    weights = 1.0 / sigma**2
    mean = float(np.sum(weights * nu) / np.sum(weights))
    scatter = float(np.sqrt(np.mean((nu - mean) ** 2) / len(nu)))
    sigma_mean = max(float(np.sqrt(1.0 / np.sum(weights))), scatter)
    return RowTime(mean / frequency_hz, sigma_mean / frequency_hz, len(found))
