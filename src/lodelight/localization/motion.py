"""How the camera moves from frame to frame: where to look for it next, and what a rolling shutter did to its rows.

A Kalman filter of the body's twist, whose only model is that what is carried or driven indoors does not change its
motion faster than so much. Two poses a frame apart say little of a velocity where each is known to centimetres, and
then many frames are weighed; where they are known to millimetres, the last two decide.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lodelight.geometry.se3 import SE3
from lodelight.geometry.so3 import skew
from lodelight.types import Array

ANGULAR_ACCELERATION = 10.0  # rad/s^2, of a camera in the hand
ACCELERATION = 5.0  # m/s^2
UNKNOWN_TURN, UNKNOWN_SPEED = 1.0, 1.0  # rad/s and m/s, where nothing is known of the motion


def _squares(turn: float, shift: float) -> Array:
    out: Array = np.diag([turn**2] * 3 + [shift**2] * 3)
    return out


@dataclass(frozen=True, eq=False)
class Motion:
    """twist : (6,) rad/s and m/s of the body in its own frame, rotation first; covariance : (6, 6)"""

    twist: Array = field(default_factory=lambda: np.zeros(6))
    covariance: Array = field(default_factory=lambda: _squares(UNKNOWN_TURN, UNKNOWN_SPEED))

    def later(self, dt_s: float) -> Motion:
        """The same, so much later: less is known of it, but no less than of any motion."""
        grown = self.covariance + _squares(ANGULAR_ACCELERATION * dt_s, ACCELERATION * dt_s)
        most = _squares(UNKNOWN_TURN, UNKNOWN_SPEED)
        if np.all(np.diag(grown) <= np.diag(most)):
            return Motion(self.twist, grown)
        share = np.linalg.inv(grown + most)  # what any motion is like, taken for one more measurement
        return Motion(most @ share @ self.twist, grown @ share @ most)

    def over(self, dt_s: float) -> SE3:
        """T_now_later by this motion."""
        return SE3.exp(dt_s * self.twist)

    def measured(self, T_world_last: SE3, of_last: Array, T_world_now: SE3, of_now: Array, dt_s: float) -> Motion:
        """With two poses taken into account. of_last, of_now : (6, 6) covariances, chart of SE3.perturbed

        What they say is the mean over the time between them, and this is the motion at its end.
        """
        T_last_now = T_world_last.inverse() @ T_world_now
        turned = np.zeros((6, 6))
        turned[:3, :3], turned[3:, 3:] = np.eye(3), T_world_last.R.T
        noise = turned @ (of_last + of_now) @ turned.T / dt_s**2
        noise += _squares(0.5 * ANGULAR_ACCELERATION * dt_s, 0.5 * ACCELERATION * dt_s)
        gain = self.covariance @ np.linalg.inv(self.covariance + noise)
        twist = self.twist + gain @ (T_last_now.log() / dt_s - self.twist)
        rest = np.eye(6) - gain
        return Motion(twist, rest @ self.covariance @ rest.T + gain @ noise @ gain.T)

    def of_camera(self, T_body_cam: SE3) -> Motion:
        """The motion of a camera on the body, in the camera's frame."""
        A = np.zeros((6, 6))
        A[:3, :3] = A[3:, 3:] = T_body_cam.R.T
        A[3:, :3] = -T_body_cam.R.T @ skew(T_body_cam.t)
        return Motion(A @ self.twist, A @ self.covariance @ A.T)
