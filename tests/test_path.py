"""Frames between keyframes follow both of them."""

from __future__ import annotations

import numpy as np

from lodelight.geometry.se3 import SE3
from lodelight.mapping.path import PathNode, laid_down


def at(x: float, yaw: float = 0.0) -> SE3:
    return SE3.exp(np.array([0.0, 0.0, yaw, 0.0, 0.0, 0.0])) @ SE3(np.eye(3), np.array([x, 0.0, 0.0]))


def test_what_a_correction_did_between_two_keyframes_is_shared_out():
    """Live, the second keyframe was 1 m ahead of the first; it turned out to be 1.2 m."""
    path = [PathNode(10 * i, 0, at(0.25 * i)) for i in range(4)]
    path += [PathNode(40, 1, at(0.0), (0, at(1.0))), PathNode(50, 1, at(0.25))]
    poses = laid_down(path, [at(0.0), at(1.2)].__getitem__)
    assert np.allclose([T.t[0] for T in poses], [0.0, 0.3, 0.6, 0.9, 1.2, 1.45])


def test_without_a_correction_nothing_moves():
    keyframes = [at(0.0), at(1.0, 0.3)]
    between = keyframes[0].inverse() @ keyframes[1]
    path = [PathNode(0, 0, at(0.0)), PathNode(10, 0, at(0.4, 0.1)), PathNode(20, 1, at(0.0), (0, between))]
    poses = laid_down(path, keyframes.__getitem__)
    assert np.allclose(poses[1].matrix, at(0.4, 0.1).matrix)
    assert np.allclose(poses[2].matrix, keyframes[1].matrix)
