"""A map laid down by single lights, from rays alone: exact truth, a light camera's noise, codes used again."""

import math
from dataclasses import replace

import numpy as np

from light_scenes import measured_up
from lodelight.anchors import Light
from lodelight.geometry.se3 import SE3
from lodelight.lights.rays import Track, lay_down, settle

T_WORLD_MAP = SE3.exp(np.array([0.02, -0.03, 2.1, 4.0, -2.0, 0.7]))
# Zigzag along a corridor, one in view at a time; three codes, each used every third light
LIGHTS = {
    f"L{i}": Light(f"L{i}", 2000.0 + 200.0 * (i % 3), np.array([2.3 * i + 0.2 * (i % 4), 0.4 * (-1) ** i, 2.4]))
    for i in range(9)
}
SIGMA_RAD = 5e-4


def passed(rng, names=("L2", "L3", "L4", "L5"), lights=LIGHTS):
    """Tracks of lights that a camera passes 0.9 m over the floor, 20 rays each."""
    T_map_world = T_WORLD_MAP.inverse()
    tracks = []
    for name in names:
        xyz = LIGHTS[name].xyz
        x = xyz[0] + np.linspace(-0.6, 0.6, 20)
        eyes = np.column_stack([x, np.zeros(20), np.full(20, 0.9)])
        rays = xyz - eyes
        rays = rays / np.linalg.norm(rays, axis=1)[:, None] + SIGMA_RAD * rng.normal(size=(20, 3))
        rays = (rays / np.linalg.norm(rays, axis=1)[:, None]) @ T_map_world.R.T
        same = tuple(o.id for o in lights.values() if o.frequency_hz == LIGHTS[name].frequency_hz)
        tracks.append(Track(same, T_map_world @ eyes, rays, np.full(20, SIGMA_RAD)))
    return tracks


def test_lights_passed_one_after_another_lay_the_map_down_within_their_covariance():
    nees = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        up = measured_up(T_WORLD_MAP, 0.5, rng)
        moved = {name: replace(k, xyz=k.xyz + rng.normal(0.0, 0.005, 3)) for name, k in LIGHTS.items()}
        laid = lay_down(passed(rng), moved, up, math.radians(0.5))
        assert laid.lights == ("L2", "L3", "L4", "L5")
        off = laid.T_world_map.inverse() @ T_WORLD_MAP
        e = np.concatenate([off.log()[:3], T_WORLD_MAP.t - laid.T_world_map.t])
        assert math.degrees(off.angle) < 2.0  # of which a turn about the corridor is known by up alone
        nees.append(e @ np.linalg.solve(laid.covariance, e) / 6.0)
    assert 0.3 < np.mean(nees) < 1.3  # a map that is off by a centimetre is allowed for, and is not here


def test_two_lights_or_two_places_that_fit_alike_say_nothing():
    rng = np.random.default_rng(0)
    assert lay_down(passed(rng, ("L2", "L3")), LIGHTS, T_WORLD_MAP.R[2], 0.01) is None
    even = {name: replace(k, xyz=np.array([2.3 * i, 0.0, 2.4])) for i, (name, k) in enumerate(LIGHTS.items())}
    tracks = passed(rng)
    assert lay_down(tracks, LIGHTS, T_WORLD_MAP.R[2], 0.01) is not None
    assert lay_down(tracks, even, T_WORLD_MAP.R[2], 0.01) is None  # three lights further on they look the same


def test_one_light_that_hangs_elsewhere_is_left_out():
    rng = np.random.default_rng(1)
    wrong = LIGHTS | {"L4": replace(LIGHTS["L4"], xyz=LIGHTS["L4"].xyz + np.array([0.0, 1.0, 0.0]))}
    laid = lay_down(passed(rng, ("L1", "L2", "L3", "L4", "L5")), wrong, T_WORLD_MAP.R[2], 0.005)
    assert laid.lights == ("L1", "L2", "L3", "L5")
    assert np.linalg.norm((laid.T_world_map.inverse() @ T_WORLD_MAP).t) < 0.05


def test_a_map_that_is_tipped_settles():
    rng = np.random.default_rng(2)
    tipped = SE3.exp(np.array([0.03, -0.04, 0.02, 0.05, 0.02, 0.0])) @ T_WORLD_MAP
    up = measured_up(T_WORLD_MAP, 1.0, rng)
    laid = settle(tipped, passed(rng, tuple(LIGHTS)), LIGHTS, up, math.radians(1.0))
    assert set(laid.lights) == set(LIGHTS)
    assert np.linalg.norm((laid.T_world_map.inverse() @ T_WORLD_MAP).t) < 0.05
