"""What the checks look at: stretches of a recording, its corners tracked between frames a moment apart."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lodelight.doctor.rims import Rims, rims_of
from lodelight.io.recording import Recording
from lodelight.io.stamps import NS_PER_S
from lodelight.messages import Frame, Imu, TagSighting
from lodelight.tags.detect import TagDetector
from lodelight.types import Array, ArrayF32, Bytes

MOMENT_S = 0.15  # between the frames of a pair: long enough to turn, short enough to be tracked
N_CORNERS, WINDOW = 250, (21, 21)
CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01)
STRETCH_S, BUDGET_FRAMES = 4.0, 360
RETURN_PX = 0.5  # by how much a corner may miss itself when it is tracked there and back
ORB_EVERY, N_ORB = 8, 800
RIMS_EVERY = 4
TAGS_EVERY, TAGS = 6, ("qr", "tag36h11")


@dataclass(frozen=True, eq=False)
class Pair:
    """Corners of camera 0 in two frames. t_a, t_b ns; a_px, b_px (N, 2); depth_a (N,) m, 0 = none."""

    t_a: int
    t_b: int
    a_px: Array
    b_px: Array
    right_a_px: Array  # (N, 2), NaN where the other camera does not show it
    depth_a: Array


@dataclass(eq=False)
class Seen:
    """All that was looked at.

    pairs : those of one stretch follow one another, each beginning where the last one ended
    stereo : matched corners of frames, (N, 2) px in camera 0 and in camera 1, found without the rig
    rims : of depth, in every RIMS_EVERYth frame
    tags : of TAGS in every TAGS_EVERYth frame
    brightness : (mean, share that is black, share that is white) of frames; sharpness : `blur_of` them
    """

    pairs: list[Pair] = field(default_factory=list)
    stereo: list[tuple[Array, Array]] = field(default_factory=list)
    brightness: list[tuple[float, float, float]] = field(default_factory=list)
    blur: list[float] = field(default_factory=list)
    imu: list[Imu] = field(default_factory=list)
    t_ns: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    tags: list[TagSighting] = field(default_factory=list)
    rims: list[list[Rims]] = field(default_factory=list)


def gather(recording: Recording, stretches: list[tuple[float, float]]) -> Iterator[tuple[Seen, int]]:
    """Look at stretches (start, end in s from the first frame) with all cameras and depth; yields after each frame."""
    seen = Seen()
    rig = recording.rig
    period_s = 1.0 / rig.cameras[0].rate_hz if rig.cameras[0].rate_hz > 0 else 0.05
    gap = max(1, round(MOMENT_S / period_s))
    detector = TagDetector(rig.cameras[0].camera, TAGS)
    count = 0
    for start_s, end_s in stretches:
        open_pair: _Tracking | None = None
        for i, frame in enumerate(recording.frames(min(len(rig.cameras), 2), rig.depth is not None, start_s, end_s)):
            count += 1
            if i % 4 == 0:
                seen.brightness.append(brightness_of(frame.images[0]))
                seen.blur.append(blur_of(frame.images[0]))
            if i % TAGS_EVERY == 0:
                seen.tags += detector.detect(frame.images[0], frame.t_ns, thorough=True)
            if len(frame.images) > 1 and i % ORB_EVERY == 0:
                seen.stereo.append(matched(frame.images[0], frame.images[1]))
            if frame.depth is not None and i % RIMS_EVERY == 0:
                seen.rims.append(rims_of(frame.images[0], frame.depth, rig.cameras[0].camera.focal_px))
            if open_pair is not None:
                open_pair.follow(frame)
                lost = frame.t_ns - open_pair.last_ns > 3 * period_s * NS_PER_S
                open_pair.last_ns = frame.t_ns
                if lost:
                    open_pair = None
            if i % gap == 0:
                if open_pair is not None and (pair := open_pair.pair(frame.t_ns)) is not None:
                    seen.pairs.append(pair)
                open_pair = _Tracking(frame)
            yield seen, count


class _Tracking:
    """Corners of one frame on their way through the next ones."""

    def __init__(self, frame: Frame) -> None:
        image = frame.images[0]
        self.t_ns = self.last_ns = frame.t_ns
        distance = max(4, image.shape[1] // 32)
        found = cv2.goodFeaturesToTrack(image, N_CORNERS, 0.005, distance, blockSize=5)
        self._first: ArrayF32 = np.zeros((0, 2), np.float32)
        if found is not None:
            self._first = np.asarray(found.reshape(-1, 2), dtype=np.float32)
        if len(self._first):
            cv2.cornerSubPix(image, self._first, (3, 3), (-1, -1), CRITERIA)
        self._right = _other_camera(image, frame.images[1], self._first) if len(frame.images) > 1 else None
        self._depth = None if frame.depth is None else _depth_at(frame.depth, self._first)
        self._now, self._kept = self._first.copy(), np.arange(len(self._first))
        self._image = image

    def follow(self, frame: Frame) -> None:
        if len(self._now):
            there, good = tracked(self._image, frame.images[0], self._now)
            self._now, self._kept = there[good], self._kept[good]
        self._image = frame.images[0]

    def pair(self, t_ns: int) -> Pair | None:
        if len(self._kept) < 20:
            return None
        kept = self._kept
        right = np.full((len(kept), 2), np.nan) if self._right is None else self._right[kept]
        depth = np.zeros(len(kept)) if self._depth is None else self._depth[kept]
        a_px, b_px = (np.asarray(px, dtype=np.float64) for px in (self._first[kept], self._now))
        return Pair(self.t_ns, t_ns, a_px, b_px, right, depth)


def tracked(a: Bytes, b: Bytes, points: ArrayF32, guess: ArrayF32 | None = None) -> tuple[ArrayF32, NDArray[np.bool_]]:
    """(N, 2) px of the points of image a in image b, and which of them come back to themselves."""
    options: Any = {"winSize": WINDOW, "maxLevel": 4, "criteria": CRITERIA}
    start = points.reshape(-1, 1, 2)
    flags = 0 if guess is None else cv2.OPTFLOW_USE_INITIAL_FLOW
    first: Any = None if guess is None else guess.reshape(-1, 1, 2).copy()
    there, found, _ = cv2.calcOpticalFlowPyrLK(a, b, start, first, flags=flags, **options)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(
        b, a, there, start.copy(), flags=cv2.OPTFLOW_USE_INITIAL_FLOW, **options
    )
    miss = np.linalg.norm((back - start).reshape(-1, 2), axis=1)
    flat = np.asarray(there.reshape(-1, 2), dtype=np.float32)
    height, width = b.shape
    inside = (flat > 2).all(axis=1) & (flat[:, 0] < width - 3) & (flat[:, 1] < height - 3)
    return flat, np.asarray((found.ravel() > 0) & (found_back.ravel() > 0) & (miss < RETURN_PX) & inside)


def matched(left: Bytes, right: Bytes) -> tuple[Array, Array]:
    """(N, 2) px of corners in two images that are each other's best match by descriptor, refined by tracking.

    Nothing of the rig is used, as it is what is in question.
    """
    orb = cv2.ORB.create(N_ORB, 1.2, 6)
    points, words = zip(*(orb.detectAndCompute(image, None) for image in (left, right)), strict=True)
    if any(w is None or len(w) < 8 for w in words):
        return np.zeros((0, 2)), np.zeros((0, 2))
    found = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(*words)
    close = [m for m in found if m.distance < 50]
    if not close:
        return np.zeros((0, 2)), np.zeros((0, 2))
    a = np.array([points[0][m.queryIdx].pt for m in close], np.float32)
    b = np.array([points[1][m.trainIdx].pt for m in close], np.float32)
    there, good = tracked(left, right, a, guess=b)
    good &= np.linalg.norm(there - b, axis=1) < 4.0
    return a[good].astype(np.float64), there[good].astype(np.float64)


def brightness_of(image: Bytes) -> tuple[float, float, float]:
    return float(image.mean()), float(np.mean(image <= 4)), float(np.mean(image >= 251))


def blur_of(image: Bytes) -> float:
    """How little an image loses when it is blurred further: 0 sharp, 1 nothing to lose.

    Crete et al. 2007, "The blur effect": the neighbouring differences that a nine-tap blur takes away.
    """
    values = image.astype(np.float32)
    worst = 0.0
    for size, axis in (((9, 1), 1), ((1, 9), 0)):
        softer = cv2.blur(values, size)
        before, after = np.abs(np.diff(values, axis=axis)), np.abs(np.diff(softer, axis=axis))
        total = float(before.sum())
        lost = float(np.maximum(before - after, 0.0).sum())
        worst = max(worst, 1.0 - lost / total if total > 0 else 1.0)
    return worst


def _other_camera(left: Bytes, right: Bytes, points: ArrayF32) -> Array:
    out = np.full((len(points), 2), np.nan)
    if len(points):
        there, good = tracked(left, right, points)
        out[good] = there[good]
    return out


def _depth_at(depth: ArrayF32, points: ArrayF32) -> Array:
    """Readings at points (N, 2) px, 0 where the surface breaks off nearby."""
    u, v = np.rint(points).astype(int).T
    height, width = depth.shape
    near = [
        depth[np.clip(v + dv, 0, height - 1), np.clip(u + du, 0, width - 1)] for du in (-2, 0, 2) for dv in (-2, 0, 2)
    ]
    patch = np.array(near)
    middle = depth[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)].astype(np.float64)
    even = (patch.min(axis=0) > 0) & (patch.max(axis=0) - patch.min(axis=0) < 0.03 * middle)
    return np.where(even, middle, 0.0)
