"""The shortest way between two keyframes, along which an estimate can have drifted."""

import math

import numpy as np
import pytest

from lodelight.features.features import Features
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.mapping.drift import path_between
from lodelight.mapping.map import Map
from lodelight.rig import CameraSpec, Rig


@pytest.fixture
def walk():
    """Ten keyframes, 1 m and 10 degrees from one to the next, each the child of the one before."""
    camera = Camera.create("radtan", 640, 480, (500.0, 500.0, 320.0, 240.0))
    map = Map(Rig((CameraSpec("cam0", camera, SE3.identity()),)))
    T = SE3.identity()
    for k in range(10):
        map.add_keyframe(k, T, Features.empty(), parent=k - 1)
        T = T @ SE3.exp(np.array([0.0, math.radians(10.0), 0.0, 0.0, 0.0, 1.0]))
    return map


def test_the_way_along_the_spanning_tree_is_as_long_as_its_steps(walk):
    assert path_between(walk, 9, 2) == pytest.approx((7.0, 70.0))
    assert path_between(walk, 2, 9) == pytest.approx((7.0, 70.0))
    assert path_between(walk, 4, 4) == (0.0, 0.0)


def test_a_closed_loop_shortens_the_way(walk):
    step = walk.pose(0).inverse() @ walk.pose(8)
    walk.loops.append(1, a=8, b=0, R=step.R, p=step.t)
    across = float(np.linalg.norm(step.t))
    turned = math.degrees(step.angle)
    assert across < 8.0
    assert path_between(walk, 9, 0) == pytest.approx((1.0 + across, 10.0 + turned))
    assert path_between(walk, 5, 3) == pytest.approx((2.0, 20.0))


def test_a_culled_keyframe_hands_its_children_on(walk):
    walk.remove_keyframe(5)
    length_m, turns_deg = path_between(walk, 9, 2)
    assert turns_deg == pytest.approx(70.0)
    assert 6.9 < length_m < 7.0  # straight past the one that is gone


def test_nothing_ties_two_trees(walk):
    walk.keyframes.parent[5] = -1
    assert path_between(walk, 9, 2) == (math.inf, math.inf)
