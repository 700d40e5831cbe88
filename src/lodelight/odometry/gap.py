"""Between two windows: where the body went meanwhile, by the IMU alone, and how well that is known."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lodelight.geometry.se3 import SE3, level
from lodelight.geometry.so3 import skew
from lodelight.imu.preintegration import NavState, preintegrate
from lodelight.imu.samples import ImuSamples
from lodelight.rig import ImuSpec
from lodelight.types import Array

AWAY_M, AWAY_RAD = 1.0, 0.2  # deviations of a place that is not to be relied on
FASTER_M_S, TURNS_RAD_S = 1.0, 1.0  # by which it grows where no IMU tells, beside the speed at the time
FAR_M = 2.0  # deviation with which the IMU's path is worth no more than to stay


@dataclass(frozen=True, eq=False)
class Left:
    """The last state of a window that was believed, and its covariance (15, 15).

    reliable : the window was left because it saw nothing, not because it was wrong
    """

    state: NavState
    covariance: Array
    reliable: bool


@dataclass(frozen=True, eq=False)
class Continuation:
    """Where a new window's frame lies in the old one's, T_map_new, a turn about z and a shift; and the covariance
    (4, 4) of how far off that may be, about the old frame's origin."""

    T_map_new: SE3
    adrift: Array

    @staticmethod
    def at(T_map_new: SE3, first: Array, sigma_yaw: float, sigma_m: float) -> Continuation:
        """first (3,) : where the new window begins, in the old frame, known to sigma_m; and its yaw to sigma_yaw."""
        J = np.eye(4)
        J[1:, 0] = first[1], -first[0], 0.0  # the shift of the origin by a turn about where the window begins
        return Continuation(T_map_new, J @ np.diag([sigma_yaw**2, *np.full(3, sigma_m**2)]) @ J.T)

    def spread(self, T_map: SE3) -> Array:
        """(6, 6) by which a pose in the new window, or a tag, may be off with it; the chart of SE3.perturbed."""
        M = np.zeros((6, 4))
        M[:3, 0], M[3:, 0], M[3:, 1:] = T_map.R[2], (-T_map.t[1], T_map.t[0], 0.0), np.eye(3)
        P: Array = M @ self.adrift @ M.T
        return P


def continued(left: Left, first: NavState, samples: ImuSamples | str, spec: ImuSpec) -> Continuation:
    """Where a window that begins with the state `first` goes on.

    samples : of the time between; or why there are none
    """
    at, yaw, far = left.state.T_world_body, math.inf, math.inf
    if left.reliable and not isinstance(samples, str):
        state, P = carried(left.state, left.covariance, samples, spec)
        yaw = math.sqrt(float(np.linalg.eigvalsh(P[:3, :3])[-1]))
        far = math.sqrt(float(np.linalg.eigvalsh(P[3:6, 3:6])[-1]))
        at = state.T_world_body if far < FAR_M else at
    if not far < FAR_M:
        gone_s = (first.t_ns - left.state.t_ns) * 1e-9
        yaw = min(AWAY_RAD + TURNS_RAD_S * gone_s, 0.5 * math.pi)
        far = AWAY_M + (float(np.linalg.norm(left.state.v_world)) + FASTER_M_S) * gone_s
    T_map_new = level(at @ first.T_world_body.inverse(), first.T_world_body.t)
    return Continuation.at(T_map_new, T_map_new @ first.T_world_body.t, yaw, far)


def carried(state: NavState, covariance: Array, samples: ImuSamples, spec: ImuSpec) -> tuple[NavState, Array]:
    """A state carried on by samples, and its covariance (15, 15), in the order of `Window.covariance`."""
    motion = preintegrate(samples, state.bias_gyro, state.bias_accel, spec)
    R, T = state.T_world_body.R, motion.dt_s
    F, G = np.eye(15), np.eye(15)
    F[:3, :3], F[:3, 9:] = motion.dR.T, motion.jacobian[:3]
    F[3:6, :3], F[3:6, 6:9], F[3:6, 9:] = -R @ skew(motion.dp), T * np.eye(3), R @ motion.jacobian[3:6]
    F[6:9, :3], F[6:9, 9:] = -R @ skew(motion.dv), R @ motion.jacobian[6:9]
    G[3:6, 3:6] = G[6:9, 6:9] = R
    P: Array = F @ covariance @ F.T + G @ motion.covariance @ G.T
    return state.predicted(motion), P
