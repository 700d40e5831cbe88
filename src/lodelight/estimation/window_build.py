"""From the window's frames to the arrays of a problem, and back."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lodelight.estimation.marginalization import Key
from lodelight.estimation.window_frames import SeenTag, WindowFrame, gathered
from lodelight.estimation.window_landmarks import place_landmarks, world_landmarks
from lodelight.estimation.window_problem import Belief, Problem, Sightings, TagSightings, Unknowns
from lodelight.types import AnyArray, Array, Bools, Ints

if TYPE_CHECKING:
    from lodelight.estimation.window import Window

DEFAULT_INV_DEPTH = 0.3  # 1/m, of points of which nothing is known
MANY = 10  # landmarks of sure depth tell what is usual


@dataclass(eq=False)
class Rows:
    """For every row of a problem's sightings its frame, and its row in that frame."""

    frame: Ints
    row: Ints


@dataclass(eq=False)
class Leaving:
    """What goes with the oldest frame: sightings (N,) of the gathered ones, in landmarks (M,)."""

    sightings: Bools
    landmarks: Bools


def build(window: Window, without: Collection[SeenTag] = (), leaving: Leaving | None = None) -> tuple[Problem, Rows]:
    """The problem of all frames; or, `leaving`, of the factors that leave with the oldest frame."""
    frames = window.frames
    F = len(frames)
    s, frame_of, row_of = gathered(frames)
    active = np.ones(len(s), bool)
    if leaving is not None:
        rejected = _column(frames, "rejected", frame_of, row_of)
        count = np.add.reduceat(leaving.sightings, s.start[:-1]) if len(s) else np.zeros(0, int)
        kept = np.repeat(leaving.landmarks, np.diff(s.start)) & leaving.sightings
        s = _chosen(s, kept, leaving.landmarks, count)
        active, frame_of, row_of = ~rejected[kept], frame_of[kept], row_of[kept]
    x = np.array([f.x for f in frames])
    lin = np.array([f.x if f.lin is None else f.lin for f in frames])
    motion = np.hstack([np.array([f.omega for f in frames]), x[:, 12:15]])
    models = np.array([c.camera.model for c in window.cameras], np.int32)
    base, landmark, usual = _placed(window, s, x, motion, models)
    tags, states = window.tag_states, window.tag_states.states
    views = [
        (i, v) for i, f in enumerate(frames) for v in f.tags
        if v.use and not any(v is w for w in without) and (leaving is None or i == 0)
    ]  # fmt: skip
    numbers = sorted(
        {tags.number[v.view.id] for _, v in views} | {n for n, t in enumerate(states) if t.lin is not None}
    )
    packed = {number: i for i, number in enumerate(numbers)}
    tag_rows = np.array([states[n].row for n in numbers]).reshape(-1, 12)
    tag_lin = np.array([states[n].row if states[n].lin is None else states[n].lin for n in numbers]).reshape(-1, 12)
    tag_sightings = TagSightings(
        np.array([packed[tags.number[v.view.id]] for _, v in views], np.int32),
        np.array([i for i, _ in views], np.int32),
        np.array([v.view.camera for _, v in views], np.int32),
        np.array([v.view.corners_px for _, v in views], np.float64).reshape(-1, 4, 2),
        np.array([v.view.sigma_px for _, v in views], np.float64).reshape(-1, 4),
        np.array([v.view.dt_s for _, v in views], np.float64),
        np.ones(len(views), bool),
    )
    use_imu = np.ones(F - 1, bool)
    still = np.array([f.still_sigma for f in frames])
    if leaving is not None:
        use_imu[1:] = False
        still[1:] = 0.0
    mounts_lin = window.mounts if window.mounts_lin is None else window.mounts_lin
    offset_lin = window.offset_s if window.offset_lin is None else window.offset_lin
    problem = Problem(
        keys_frame=[f.key for f in frames],
        keys_tag=numbers,
        models=models,
        params=np.array([c.camera.params for c in window.cameras]),
        motion=motion,
        start=Unknowns(x, window.mounts.copy(), window.offset_s.copy(), tag_rows, landmark),
        lin=Unknowns(lin, mounts_lin, offset_lin, tag_lin, landmark),
        frozen_frames=np.array([f.lin is not None for f in frames]),
        frozen_mounts=window.mounts_lin is not None,
        frozen_offset=window.offset_lin is not None,
        frozen_tags=np.array([states[n].lin is not None for n in numbers], bool),
        tag_estimated=np.array([not states[n].exact for n in numbers], bool),
        corners_tag=np.array([states[n].corners for n in numbers]).reshape(-1, 4, 3),
        calibrate_mounts=("mount", 0) in window.beliefs,
        calibrate_offset=("offset", 0) in window.beliefs,
        sightings=s,
        base=base,
        usual_inv_depth=usual,
        active=active,
        tag_sightings=tag_sightings,
        measured=np.array([f.measured for f in frames[1:]]).reshape(F - 1, -1),
        whiten=np.array([f.whiten for f in frames[1:]]).reshape(F - 1, 15, 15),
        use_imu=use_imu,
        still_sigma=still,
        still_sigma_m=window.config.still_sigma_m,
        prior=window.prior,
        first_estimates=leaving is not None,
        beliefs=_beliefs(window, numbers, leaving is not None),
    )
    return problem, Rows(frame_of, row_of)


def _beliefs(window: Window, tags: list[int], leaving: bool) -> dict[Key, Belief]:
    """Those of what is in the problem; with the oldest frame only its own leaves."""
    own = ("frame", window.frames[0].key)
    out = {key: belief for key, belief in window.beliefs.items() if not leaving or key == own}
    if not leaving:
        for number in tags:
            belief_or_none = window.tag_states.states[number].belief
            if belief_or_none is not None:
                out["tag", number] = belief_or_none
    return out


def _column(frames: list[WindowFrame], name: str, frame: Ints, row: Ints) -> AnyArray:
    """A column of the frames' sightings in the order of the gathered ones."""
    start = np.cumsum([0] + [len(f.seen) for f in frames])
    return np.concatenate([getattr(f.seen, name) for f in frames])[start[frame] + row]


def _chosen(s: Sightings, kept: Bools, landmarks: Bools, count: AnyArray) -> Sightings:
    start = np.concatenate([[0], np.cumsum(count[landmarks])]).astype(np.int32)
    columns = ("frame", "camera", "before", "px", "sigma_px", "inv_depth", "sigma_inv_depth", "shift_s", "rays")
    out = Sightings(s.track[landmarks], start, *(np.ascontiguousarray(getattr(s, name)[kept]) for name in columns))
    place = np.where(kept, np.cumsum(kept) - 1, -1)
    out.before = np.where(out.before >= 0, place[out.before], -1).astype(np.int32)
    return out


def _placed(window: Window, s: Sightings, x: Array, motion: Array, models: Ints) -> tuple[Array, Array, float]:
    """Base (M, 3, 3) and landmark (M, 3), where they were or triangulated, and the inverse depth usual here."""
    M = len(s.track)
    at = np.searchsorted(window.landmark_track, s.track)
    at = np.minimum(at, max(len(window.landmark_track) - 1, 0))
    known = window.landmark_track[at] == s.track if len(window.landmark_track) else np.zeros(M, bool)
    world = window.landmark_world[at] if len(window.landmark_track) else np.zeros((M, 4))
    sure = window.landmark_sigma < 0.25 * window.landmark_inv_depth
    usual = float(np.median(window.landmark_inv_depth[sure])) if sure.sum() >= MANY else DEFAULT_INV_DEPTH
    base, landmark, parallax = np.empty((M, 3, 3)), np.empty((M, 3)), np.empty(M)
    place_landmarks(
        x, motion, models, window.mounts, float(window.offset_s[0]), s.rays, s.start, s.frame, s.camera, s.inv_depth,
        s.shift_s, world, known, usual, base, landmark, parallax,
    )  # fmt: skip
    return base, landmark, usual


def store(window: Window, problem: Problem, rows: Rows) -> Bools:
    """Take the problem's state over; returns which sightings (N,) were rejected."""
    x, s = problem.state, problem.sightings
    for row, frame in zip(x.frames, window.frames, strict=True):
        frame.x = row.copy()
    window.mounts, window.offset_s = x.mounts.copy(), x.offset_s.copy()
    for number, row in zip(problem.keys_tag, x.tags, strict=True):
        window.tag_states.states[number].row = row.copy()
    world = np.empty((len(s.track), 4))
    world_landmarks(
        x.frames, problem.motion, x.mounts, float(x.offset_s[0]), s.start, s.frame, s.camera, s.shift_s,
        problem.base, x.landmarks, world,
    )  # fmt: skip
    rejected = problem.linear.chi2 > window.config.reject_px**2
    starts = np.cumsum([0] + [len(f.seen) for f in window.frames])
    everywhere = np.zeros(starts[-1], bool)
    everywhere[starts[rows.frame] + rows.row] = rejected
    for i, frame in enumerate(window.frames):
        frame.seen.rejected = everywhere[starts[i] : starts[i + 1]]
    seen = np.add.reduceat(~rejected, s.start[:-1]) if len(s) else np.zeros(0, int)
    # one that is left with a single sighting is triangulated anew next time
    good = (seen > 1) | ((seen == 1) & (np.diff(s.start) == 1))
    window.landmark_track, window.landmark_world = s.track[good], world[good]
    window.landmark_inv_depth = x.landmarks[good, 2].copy()
    window.landmark_sigma = np.sqrt(np.maximum(problem.V_inverse[good, 5], 0.0))
    window.landmark_seen = seen[good].astype(np.int32)
    for view in (v for f in window.frames for v in f.tags if v.use):
        window.tag_states.states[window.tag_states.number[view.view.id]].established = True
    newest = {v.view.id: v for v in window.frames[-1].tags}
    t = problem.tag_sightings
    for tag, frame_row, chi2 in zip(t.tag, t.frame, problem.linear.tag_chi2, strict=True):
        seen_tag = newest.get(window.tag_states.states[problem.keys_tag[tag]].id)
        if frame_row == len(window.frames) - 1 and seen_tag is not None and not seen_tag.tested:
            seen_tag.chi2 = float(chi2)
    return rejected
