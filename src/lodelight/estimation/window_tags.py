"""The tags a window knows: surveyed, believed, or estimated along with it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from lodelight.errors import ConfigError
from lodelight.estimation.factors.tag_corners import tag_corner_jacobian, tag_corner_residual
from lodelight.estimation.window_frames import SeenTag, pose_row
from lodelight.estimation.window_problem import Belief, Problem
from lodelight.estimation.window_types import Tag, TagView, WindowConfig
from lodelight.geometry.se3 import SE3
from lodelight.types import Array


@dataclass(eq=False)
class TagState:
    """row (12,) pose in the window's frame; exact : surveyed, not estimated; lin : where the prior holds it

    given : what is believed of it was told, and is believed again whenever it comes back
    started : row means something; established : a sighting of it has counted, so that the next one can be tested
    """

    id: str
    corners: Array
    row: Array
    exact: bool = False
    given: bool = False
    started: bool = False
    established: bool = False
    belief: Belief | None = None
    lin: Array | None = None


@dataclass(eq=False)
class TagStates:
    states: list[TagState] = field(default_factory=list)
    number: dict[str, int] = field(default_factory=dict)

    def declare(self, tag: Tag) -> None:
        """A tag of which something is known; again to correct what was said before its sightings entered the prior."""
        T = tag.T_world_tag
        state = TagState(tag.id, np.ascontiguousarray(tag.corners_tag, np.float64), pose_row(T or SE3.identity()))
        if T is not None:
            state.started = state.given = True
            state.exact = tag.covariance is None
            if tag.covariance is not None:
                state.belief = Belief(state.row.copy(), inverse(tag.covariance))
        at = self.number.setdefault(tag.id, len(self.states))
        if at == len(self.states):
            self.states.append(state)
        elif self.states[at].lin is None:
            self.states[at] = state
        elif T is not None:  # its estimate is in the prior: believe the new pose as well
            sigma = np.array([1e-4] * 3 + [1e-4] * 3)
            information = np.diag(sigma**-2.0) if tag.covariance is None else inverse(tag.covariance)
            self.states[at].belief, self.states[at].given = Belief(state.row, information), True

    def sighted(self, view: TagView, T_world_cam: SE3) -> None:
        """Raises ConfigError for a tag that was not declared, or of which nothing says where it is."""
        if view.id not in self.number:
            raise ConfigError(f"tag {view.id} was not declared to the window; declare its corners before its sighting")
        state = self.states[self.number[view.id]]
        if not state.started:
            if view.T_cam_tag is None:
                raise ConfigError(f"nothing says where tag {view.id} is; give T_cam_tag with its first sighting")
            state.row = pose_row(T_world_cam @ view.T_cam_tag)
            state.started = True

    def is_known(self, id: str) -> bool:
        """Whether a sighting of it can contradict something."""
        state = self.states[self.number[id]]
        return state.exact or state.belief is not None or state.established

    def test(self, problem: Problem, doubtful: Sequence[SeenTag], config: WindowConfig) -> None:
        """Judge sightings in the newest frame against a problem that was solved without them."""
        for seen in doubtful:
            seen.chi2 = self._innovation(problem, seen.view, config)
            seen.tested = True
            seen.agrees = seen.view.trusted or seen.chi2 <= config.tag_gate_chi2
            seen.use = seen.agrees and not seen.view.held

    def _innovation(self, problem: Problem, view: TagView, config: WindowConfig) -> float:
        """Chi-square, of 8 degrees of freedom, of what the window expects of these corners; inf where it cannot see
        them. The uncertainties of the pose and of the tag count."""
        x, c = problem.state, view.camera
        number = self.number[view.id]
        state = self.states[number]
        inside = number in problem.keys_tag
        row = x.tags[problem.keys_tag.index(number)] if inside else state.row
        shift = float(x.offset_s[0]) + view.dt_s
        R, p = _rotation(x.frames[-1]), x.frames[-1, 9:12] + shift * problem.motion[-1, 3:]
        R = SE3(R, p).perturbed(np.concatenate([shift * problem.motion[-1, :3], np.zeros(3)])).R
        mount = (_rotation(x.mounts[c]), np.ascontiguousarray(x.mounts[c, 9:12]))
        at = (_rotation(row), np.ascontiguousarray(row[9:12]))
        r, J = np.empty(8), np.empty((8, 18))
        E, r2, J2 = np.empty((2, 3)), np.empty(2), np.empty((2, 18))
        lens = (problem.models[c], problem.params[c])
        for k in range(4):
            s0, s1, s2 = (float(v) for v in state.corners[k])
            u, v = (float(value) for value in view.corners_px[k])
            sigma = float(view.sigma_px[k])
            where = (*lens, R, p, *mount, *at, s0, s1, s2)
            if not tag_corner_residual(*where, u, v, sigma, r2) or not tag_corner_jacobian(*where, sigma, E, J2):
                return float("inf")
            r[2 * k : 2 * k + 2], J[2 * k : 2 * k + 2] = r2, J2
        columns = problem.columns(("pose", problem.keys_frame[-1]))
        unknown = J[:, :6]
        S = np.eye(8)
        if inside and not state.exact:
            columns = np.concatenate([columns, problem.columns(("tag", number))])
            unknown = J[:, :12]
        elif state.belief is not None:
            S += J[:, 6:12] @ np.linalg.solve(state.belief.information, J[:, 6:12].T)
        P = problem.covariance(columns)
        if P is None:
            return float("inf")
        S += unknown @ P @ unknown.T
        off = J[:, :6] * np.repeat([config.tag_gate_rad, config.tag_gate_m], 3)
        S += off @ off.T
        return float(r @ np.linalg.solve(S, r))

    def move(self, moved: Callable[[Array], Array], R: Array, all_of_them: bool) -> None:
        """Into another frame; surveyed ones are given in the new one already."""
        B = np.eye(6)
        B[3:, 3:] = R
        for state in self.states:
            if state.exact or (state.lin is None and not all_of_them):
                continue
            state.row = moved(state.row)
            state.lin = None if state.lin is None else moved(state.lin)
            if state.belief is not None and all_of_them:
                mean, information = state.belief.mean, state.belief.information
                state.belief = Belief(moved(mean), B @ information @ B.T)


def inverse(covariance: Array) -> Array:
    found = np.linalg.inv(covariance)
    information: Array = 0.5 * (found + found.T)
    return information


def _rotation(row: Array) -> Array:
    return np.ascontiguousarray(row[:9].reshape(3, 3))
