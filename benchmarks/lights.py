"""Receiver and positioning of coded lights against exact truth: `python benchmarks/lights.py [--crops N]`."""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from light_scenes import CODES_HZ, LIGHTS, ROW_S, SPEC, crop, measured_up, paint, random_pose, sightings
from lodelight.anchors import Light
from lodelight.geometry.se3 import SE3
from lodelight.lights.modulation import MIN_STRIPES, Pwm
from lodelight.lights.odometry import LightOdometry
from lodelight.lights.receiver import EDGE, receiver

DIAMETERS = (20, 30, 40, 60, 80, 120)


def lit_rows(diameter: float, bell: bool, level: float) -> float:
    """Rows in which a face is at least a twentieth as bright as its brightest pixel: there the receiver sees stripes.

    A disc's own diameter; a bell-shaped face, 1 / (1 + r^8), is wider than at half of its brightness.
    """
    floor = EDGE * min(1.0, 255.0 / level)
    return diameter * (1.0 / floor - 1.0) ** 0.125 if bell else diameter


def identities(count: int) -> None:
    """Random diameters, frequencies and phases of even and of bell-shaped faces, within the eight bits and beyond."""
    reader = receiver(SPEC, LIGHTS)
    for bell in (False, True):
        for level in (180.0, 600.0):
            rng = np.random.default_rng(11)
            named = wrong = below = guessed = 0
            for _ in range(count // 4):
                diameter, frequency = rng.uniform(20.0, 120.0), rng.choice(CODES_HZ)
                image, _ = crop(rng, diameter, frequency, bell, level)
                ids = [s.id for s in reader.sightings(image, 0) if s.id]
                named += bool(ids)
                wrong += any(i != f"{frequency:.0f}" for i in ids)
                if frequency * lit_rows(diameter, bell, level) * ROW_S < MIN_STRIPES:
                    below += 1
                    guessed += bool(ids)
            face = f"{'bell' if bell else 'even'}, peak {level:.0f} DN"
            print(f"{face}: {named} of {count // 4} named, {wrong} wrong; {guessed} of {below} below 2.5 stripes named")


def accuracy(count: int) -> None:
    reader = receiver(SPEC, LIGHTS)
    for bell in (False, True):
        for diameter in DIAMETERS:
            rng = np.random.default_rng(diameter)
            off_hz, off_px = [], []
            codes = CODES_HZ[CODES_HZ * diameter * ROW_S > MIN_STRIPES]
            for _ in range(count):
                frequency = rng.choice(codes)
                image, centre = crop(rng, diameter, frequency, bell)
                for seen in reader.sightings(image, 0):
                    if seen.id:
                        off_hz.append(seen.frequency_hz - frequency)
                        off_px.append(seen.centre_px - centre)
            if off_hz:
                hz, px = (float(np.sqrt(np.mean(np.square(v)))) for v in (off_hz, off_px))
                face = "bell" if bell else "even"
                print(f"{face} D {diameter:3d}: {len(off_hz)}/{count} named, f rms {hz:.1f} Hz, centre rms {px:.3f} px")


def positions(runs: int = 200) -> None:
    places = {2: [(-0.6, 0.0), (0.6, 0.0)], 4: [(-0.6, -0.45), (0.6, -0.45), (0.6, 0.45), (-0.6, 0.45)]}
    for survey_m in (2e-4, 5e-3):
        for count, xy in places.items():
            rng, errors, nees = np.random.default_rng(2), [], []
            for _ in range(runs):
                true = [Light(f"L{i}", 2000.0 + 200 * i, np.array([*p, 2.2])) for i, p in enumerate(xy)]
                known = tuple(
                    Light(k.id, k.frequency_hz, k.xyz + rng.normal(0.0, survey_m, 3), sigma_m=survey_m) for k in true
                )
                truth = random_pose(rng)
                seen = sightings(truth, true, rng)
                fix = LightOdometry(SPEC, known, 0.25).locate(seen, measured_up(truth, 0.25, rng))
                if fix.T_world_body is None:
                    continue
                turn = SE3(fix.T_world_body.R.T @ truth.R, np.zeros(3)).log()[:3]
                errors.append(np.concatenate([turn, truth.t - fix.T_world_body.t]))
                nees.append(errors[-1] @ np.linalg.solve(fix.covariance, errors[-1]) / 6.0)
            e = np.array(errors)
            cm, deg = 100.0 * np.sqrt((e[:, 3:] ** 2).sum(1).mean()), np.degrees(np.sqrt((e[:, :3] ** 2).sum(1).mean()))
            print(
                f"{count} lights, survey {1e3 * survey_m:.1f} mm: {len(e)}/{runs}, {cm:.2f} cm, {deg:.2f} deg, "
                f"NEES {np.mean(nees):.2f}"
            )


def speed(repeats: int = 40) -> None:
    rng = np.random.default_rng(0)
    discs = [(np.array([220.0 + 380 * (i % 3), 260.0 + 420 * (i // 3)]), 80.0, Pwm(2600.0 + 800 * i)) for i in range(6)]
    for bell in (False, True):
        image = paint((960, 1280), discs, rng, bell)
        reader = receiver(SPEC, LIGHTS)
        assert len([s for s in reader.sightings(image, 0) if s.id]) == 6
        times = []
        for _ in range(repeats):
            began = time.process_time()
            reader.sightings(image, 0)
            times.append(1e3 * (time.process_time() - began))
        p50, p95 = np.percentile(times, (50, 95))
        print(f"1280x960 with 6 {'bell' if bell else 'even'} lights: CPU {p50:.1f} ms, p95 {p95:.1f}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--crops", type=int, default=10_000)
    wanted = parser.parse_args().crops
    speed()
    positions()
    accuracy(max(20, wanted // 40))
    identities(wanted)
