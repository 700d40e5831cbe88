"""What leaves the window: its oldest keyframe, and tags long out of sight."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lodelight.estimation.marginalization import Key, Prior, schur
from lodelight.estimation.window_build import Leaving, build
from lodelight.estimation.window_frames import WindowFrame, gathered, joined_imu
from lodelight.estimation.window_poses import chart_difference
from lodelight.estimation.window_problem import Belief, Problem
from lodelight.estimation.window_tags import inverse
from lodelight.estimation.window_types import Departed, Landmarks
from lodelight.types import AnyArray, Bools

if TYPE_CHECKING:
    from lodelight.estimation.window import Window


def marginalize_oldest(window: Window) -> Departed:
    """Turn the oldest frame, and what was measured in it or to the next, into the prior of the others.

    Of a landmark that it saw first all sightings go, or, if the newest frame still sees it, those in the oldest
    `split` frames: each sighting counts once, in the prior or in the window.
    """
    frames = window.frames
    s, frame_of, row_of = gathered(frames)
    first, last = s.frame[s.start[:-1]], s.frame[s.start[1:] - 1]
    new = np.concatenate([[True], s.frame[1:] != s.frame[:-1]]) if len(s) else np.zeros(0, bool)
    new[s.start[:-1]] = True
    late = s.frame >= window.config.split
    later = np.add.reduceat(new & late, s.start[:-1]) if len(s) else np.zeros(0, int)
    goes = first == 0
    divided = goes & (last == len(frames) - 1) & (later >= 2)
    rows = np.repeat(goes, np.diff(s.start)) & ~(np.repeat(divided, np.diff(s.start)) & late)
    problem, _ = build(window, leaving=Leaving(rows, goes & _sure(window, s.track)))
    problem.linearize(problem.state, problem.linear)
    oldest = frames[0]
    ended = _finished(window, s.track[goes & ~divided])
    departed = Departed(oldest.state, joined_imu(frames[1]), ended, oldest.still_sigma > 0.0)
    window.prior = _prior_after(window, problem, oldest)
    window.beliefs.pop(("frame", oldest.key), None)
    for i, frame in enumerate(frames):
        used = row_of[rows & (frame_of == i)]
        keep = np.ones(len(frame.seen), bool)
        keep[used] = False
        frame.seen = frame.seen.kept(keep)
    frames.pop(0)
    frames[0].imu = None
    frames[0].measured, frames[0].whiten = np.zeros_like(oldest.measured), np.zeros((15, 15))
    return departed


def _sure(window: Window, track: AnyArray) -> Bools:
    """Which landmarks (M,) have a depth to speak of.

    What is marginalized is linearized once for all, and what a sighting says of the position goes with the inverse
    depth: where that is noise, it would say something all the same, every time in the same direction.
    """
    relative = window.landmark_sigma / np.maximum(window.landmark_inv_depth, 1e-9)
    sure = window.landmark_track[relative < window.config.sure_depth]
    return np.isin(track, sure)


def _prior_after(window: Window, problem: Problem, oldest: WindowFrame) -> Prior:
    H, g = problem.eliminated()
    touched = np.abs(H).max(axis=1) > 0.0
    gone = problem.columns(("frame", oldest.key))
    keys: list[Key] = []
    for frame in window.frames[1:]:
        keys += [("rest", frame.key), ("pose", frame.key)]
    keys += [("mount", c) for c in range(len(window.mounts)) if problem.calibrate_mounts]
    keys += [("offset", 0)] if problem.calibrate_offset else []
    keys += [("tag", n) for n, at in zip(problem.keys_tag, problem.tag_column, strict=True) if at >= 0]
    keys = [key for key in keys if touched[problem.columns(key)].any()]
    columns = np.concatenate([gone, *(problem.columns(key) for key in keys)])
    reduced, gradient = schur(H[np.ix_(columns, columns)], g[columns], np.arange(len(columns)) < len(gone))
    held = {key[1] for key in keys if key[0] in ("pose", "rest")}
    for frame in window.frames[1:]:
        if frame.lin is None and frame.key in held:
            frame.lin = frame.x.copy()
    kinds = {key[0] for key in keys}
    if "mount" in kinds and window.mounts_lin is None:
        window.mounts_lin = window.mounts.copy()
    if "offset" in kinds and window.offset_lin is None:
        window.offset_lin = window.offset_s.copy()
    for kind, number in keys:
        if kind == "tag" and window.tag_states.states[number].lin is None:
            window.tag_states.states[number].lin = window.tag_states.states[number].row.copy()
    return Prior(keys, reduced, gradient)


def _finished(window: Window, tracks: AnyArray) -> Landmarks:
    mine = np.isin(window.landmark_track, tracks)
    all_of_them = window.landmarks()
    return Landmarks(
        all_of_them.track[mine], all_of_them.xyz[mine], all_of_them.inv_depth[mine],
        all_of_them.sigma_inv_depth[mine], all_of_them.seen[mine],
    )  # fmt: skip


def forget_tags(window: Window) -> None:
    """Marginalize estimated tags that no frame of the window sees, beyond those it may remember.

    What was known of one, its correlation with the window forgotten, is believed when it is seen again; of a surveyed
    one its survey is.
    """
    states = window.tag_states.states
    viewed = {window.tag_states.number[v.view.id] for f in window.frames for v in f.tags}
    unseen = [key[1] for key in window.prior.keys if key[0] == "tag" and key[1] not in viewed]
    for number in unseen[: max(0, len(unseen) - window.config.tag_memory)]:
        state = states[number]
        problem, _ = build(window)
        problem.linearize(problem.state, problem.linear)
        covariance = problem.covariance(problem.columns(("tag", number)))
        lin = state.lin
        assert lin is not None
        if state.belief is not None:
            d = np.empty((1, 6))
            chart_difference(lin[None], state.belief.mean[None], d)
            span = window.prior.spans()["tag", number]
            window.prior.H[span, span] += state.belief.information
            window.prior.g[span] += state.belief.information @ d[0]
        window.prior = window.prior.without([("tag", number)])
        state.lin = None
        if covariance is not None and not state.given:
            state.belief = Belief(state.row.copy(), inverse(window.config.tag_inflation * covariance))
