"""Rows of the window that are held against the last one of their track: their cost, and the slope of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from inertial_scenes import START, look, perturbed, samples_near, scene
from lodelight.estimation.window import Window
from lodelight.estimation.window_build import build
from lodelight.estimation.window_problem import Problem, Unknowns
from lodelight.estimation.window_visual import visual_terms
from lodelight.geometry.so3 import so3_exp

STEP_PX2 = 0.04  # of a track from one frame to the next


@pytest.fixture(scope="module", params=[1, 2])
def problem(request: pytest.FixtureRequest) -> Problem:
    made = scene(3, duration_s=1.0, rate_hz=5.0, cameras=request.param, max_tracks=12)
    window = Window(made.rig)
    for i, t_ns in enumerate(made.frame_ns):
        seen, _ = look(made, int(t_ns))
        seen = replace(seen, sigma_px=np.full(len(seen.track), 0.3), wander_px2=np.full(len(seen.track), i * STEP_PX2))
        state = perturbed(made.truth(int(t_ns)), START, made.rng)
        if i == 0:
            window.start(state, START, seen)
        else:
            imu = samples_near(made.samples, window.newest.t_ns, int(t_ns))
            window.add_frame(int(t_ns), imu, seen, keyframe=True, guess=state)
    return build(window)[0]


def seen(problem: Problem, x: Unknowns, robust: bool):
    """Cost and slope of the sightings alone, all else left out."""
    out, s = problem._allocated(), problem.sightings
    out.H[:], out.g[:] = 0.0, 0.0
    out.cost, _ = visual_terms(
        x.frames, x.frames, problem.motion, problem.models, problem.params, x.mounts, x.mounts, 0.0, problem.base,
        x.landmarks, s.start, s.frame, s.camera, s.before, s.px, s.sigma_px, s.inv_depth, s.sigma_inv_depth, s.shift_s,
        problem.active, robust, out.chi2, problem.usual_inv_depth, problem.pose_at, -1, -1, True, out.H, out.g, out.V,
        out.g_landmark, out.W, out.chi2,
    )  # fmt: skip
    return out


def test_every_row_is_held_against_the_right_one(problem: Problem):
    """Camera 0 against the last frame with the track, camera 1 against camera 0; the first against nothing.

    Errors in camera 1 are alike: n of them with a correlation of a half together weigh as much as they should.
    """
    s = problem.sightings
    for m in range(len(s.track)):
        last = -1
        n = int((s.camera[s.start[m] : s.start[m + 1]] == 1).sum())
        alike = 0.3 * np.sqrt(1.0 + 0.5 * (n - 1))
        for o in range(s.start[m], s.start[m + 1]):
            if s.camera[o] == 0:
                assert s.before[o] == last
                gap = 0 if last < 0 else s.frame[o] - s.frame[last]
                assert s.sigma_px[o] == pytest.approx(0.3 if last < 0 else np.sqrt(gap * STEP_PX2))
                last = o
            else:
                assert s.before[o] == (last if last >= 0 and s.frame[last] == s.frame[o] else -1)
                assert s.sigma_px[o] == pytest.approx(alike)


@pytest.mark.parametrize("robust", [False, True])
def test_the_slope_is_that_of_the_cost(problem: Problem, robust: bool):
    """With the kernels on each sighting and on each landmark as well."""
    x = problem.state
    out = seen(problem, x, robust)
    if robust:
        s = problem.sightings
        chi2 = np.add.reduceat(out.chi2, s.start[:-1])
        assert (chi2 > 3.0 * np.diff(s.start)).any()  # the kernels have something to do
    for f in (0, 2, 4):
        for a in range(6):
            slopes = []
            for h in (1e-6, -1e-6):
                frames = x.frames.copy()
                if a < 3:
                    turn = so3_exp(np.ascontiguousarray(h * np.eye(3)[a]))
                    frames[f, :9] = (frames[f, :9].reshape(3, 3) @ turn).ravel()
                else:
                    frames[f, 6 + a] += h
                slopes.append(seen(problem, replace(x, frames=frames), robust).cost)
            numeric = (slopes[0] - slopes[1]) / 4e-6
            assert out.g[problem.pose_at + 6 * f + a] == pytest.approx(numeric, rel=1e-4, abs=1e-2)
