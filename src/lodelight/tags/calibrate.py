"""A camera's lens from images of a printed board of tags.

A tag says which it is, so a board need not be seen whole: its corner regions, where lenses bend most, can be held into
the corners of the image. The corners of every tag are measured on its whole print, then OpenCV's solvers find the
lens. What cannot be known from the images is refused: too few views, all from one side, or none near the rim.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from lodelight.errors import CalibrationError
from lodelight.geometry.cameras import Camera
from lodelight.tagboard import TagBoard
from lodelight.tags.detect import TagConfig, TagDetector
from lodelight.types import AnyArray, Array, Bytes, Ints

MIN_VIEWS, MIN_TAGS = 8, 6
MAX_VIEWS = 60  # beyond this they are thinned
MIN_TILT_DEG = 15.0  # between the two most different views
MIN_COVERED = 0.4  # of the image's cells must hold a corner
CELLS = 6
REGIONS = 3  # of each side, by which errors are told
WORST = 3.0  # a view with so many times the median error is left out
NEW_VIEW = 0.02  # of the image's width, by which a board must have moved to be another view


@dataclass(frozen=True, eq=False)
class BoardView:
    """name; numbers (N,) of the tags seen; px (N, 4, 2) of their corners"""

    name: str
    numbers: Ints
    px: Array


@dataclass(frozen=True, eq=False)
class Calibration:
    """camera; rms_px of all corners; sigma_focal_px of the focal lengths; views used, and those left out with why

    regions_px (3, 3) rms error by region of the image, NaN where nothing was seen; covered : share of its cells
    """

    camera: Camera
    rms_px: float
    sigma_focal_px: float
    views: int
    left_out: tuple[str, ...]
    regions_px: Array
    covered: float


def find_board(images: Iterable[tuple[str, Bytes]], board: TagBoard) -> tuple[list[BoardView], tuple[int, int], int]:
    """Views of a board in named images of one size; that size (width, height), and how many images there were.

    Raises CalibrationError where the images differ in size, or there is none.
    """
    views: list[BoardView] = []
    size, count = (0, 0), 0
    for name, image in images:
        shape = (image.shape[1], image.shape[0])
        if count and shape != size:
            raise CalibrationError(f"{name} is {shape[0]}x{shape[1]}, the images before it {size[0]}x{size[1]}")
        size, count = shape, count + 1
        view = _view(name, image, board)
        if view is not None and all(_moved(view, other, size[0]) for other in views[-3:]):
            views.append(view)
    if not count:
        raise CalibrationError("there is no image to calibrate with")
    if len(views) > MAX_VIEWS:
        views = [views[i] for i in np.linspace(0, len(views) - 1, MAX_VIEWS).round().astype(int).tolist()]
    return views, size, count


def calibrate(views: Sequence[BoardView], size: tuple[int, int], board: TagBoard, model: str = "radtan") -> Calibration:
    """The lens that explains the views; model : radtan or equidistant.

    Raises CalibrationError where the views are too few, too much alike, or cover too little of the image.
    """
    if len(views) < MIN_VIEWS:
        raise CalibrationError(
            f"{len(views)} images show {MIN_TAGS} tags of the board or more, {MIN_VIEWS} are needed; "
            f"print it with: lodelight tags print --board {board}"
        )
    covered = _covered(views, size)
    if covered < MIN_COVERED:
        raise CalibrationError(
            f"the board was seen in {covered:.0%} of the image, {MIN_COVERED:.0%} are needed; hold it into the corners"
        )
    left_out: tuple[str, ...] = ()
    for attempt in range(3):
        K, distortion, rotations, errors, sigma = _solve(views, size, board, model)
        if attempt == 0 and _tilt_deg(rotations) < MIN_TILT_DEG:
            raise CalibrationError(
                f"all views are within {_tilt_deg(rotations):.0f} deg of each other, {MIN_TILT_DEG:.0f} are needed; "
                "tilt the board, or focal length and distance cannot be told apart"
            )
        per_view = np.array([np.sqrt(np.mean(e**2)) for e in errors])
        bad = per_view > WORST * np.median(per_view)
        if not bad.any() or len(views) - np.count_nonzero(bad) < MIN_VIEWS:
            break
        left_out += tuple(f"{views[i].name}: {per_view[i]:.2f} px" for i in np.flatnonzero(bad).tolist())
        views = [view for view, b in zip(views, bad, strict=True) if not b]
    camera = Camera.create(model, *size, (K[0, 0], K[1, 1], K[0, 2], K[1, 2]), tuple(distortion))
    every = np.concatenate(errors)
    at = np.concatenate([view.px.reshape(-1, 2) for view in views])
    return Calibration(
        camera, float(np.sqrt(np.mean(np.sum(every**2, axis=1)))), sigma, len(views), left_out,
        _by_region(at, every, size), covered,
    )  # fmt: skip


# -- views ----------------------------------------------------------------------------------------------------------


def _view(name: str, image: Bytes, board: TagBoard) -> BoardView | None:
    h, w = image.shape
    pinhole = Camera.create("radtan", w, h, (float(w), float(w), 0.5 * w, 0.5 * h))  # a homography takes up the rest
    detector = TagDetector(pinhole, (), TagConfig(families=board.family, decimate=1.0))
    seen = {}
    for s in detector.detect(image, 0, thorough=True):
        number = int(s.id)
        if number in board.numbers:
            seen[number] = None if number in seen else s.corners_px  # twice: one of them is no tag of the board
    found = sorted((number, px) for number, px in seen.items() if px is not None)
    if len(found) < MIN_TAGS:
        return None
    return BoardView(name, np.array([n for n, _ in found], np.int32), np.array([px for _, px in found]))


def _moved(a: BoardView, b: BoardView, width: int) -> bool:
    """Whether two views are worth more than one."""
    both, in_a, in_b = np.intersect1d(a.numbers, b.numbers, return_indices=True)
    if not len(both):
        return True
    return float(np.linalg.norm(a.px[in_a] - b.px[in_b], axis=2).mean()) > NEW_VIEW * width


def _covered(views: Sequence[BoardView], size: tuple[int, int]) -> float:
    px = np.concatenate([view.px.reshape(-1, 2) for view in views])
    cell = np.clip((px / size * CELLS).astype(int), 0, CELLS - 1)
    return len(np.unique(cell, axis=0)) / CELLS**2


# -- solving --------------------------------------------------------------------------------------------------------


def _solve(
    views: Sequence[BoardView], size: tuple[int, int], board: TagBoard, model: str
) -> tuple[Array, Array, list[Array], list[Array], float]:
    """K, distortion, each view's rotation (3, 3) and errors (N, 2) px, and the focal lengths' sigma."""
    xyz = [np.concatenate([board.corners(int(n)) for n in view.numbers]) for view in views]
    px = [np.ascontiguousarray(view.px.reshape(-1, 2)) for view in views]
    start = np.array([[0.8 * size[0], 0, 0.5 * size[0] - 0.5], [0, 0.8 * size[0], 0.5 * size[1] - 0.5], [0, 0, 1.0]])
    try:
        if model == "equidistant":
            flags = _fisheye_flag("CALIB_RECOMPUTE_EXTRINSIC") | _fisheye_flag("CALIB_FIX_SKEW")
            start[0, 0] = start[1, 1] = size[0] / np.pi
            _, K, d, r, t = cv2.fisheye.calibrate(
                [x[None] for x in xyz], [p[None] for p in px], size, start, np.zeros((4, 1)), flags=flags
            )
            shown = [cv2.fisheye.projectPoints(x[None], a, b, K, d)[0] for x, a, b in zip(xyz, r, t, strict=True)]
            spread = None
        else:
            points = [x.astype(np.float32) for x in xyz], [p.astype(np.float32) for p in px]
            _, K, d, r, t, spread, _, _ = cv2.calibrateCameraExtended(
                *points, size, start, np.zeros(5), flags=cv2.CALIB_USE_INTRINSIC_GUESS
            )
            shown = [cv2.projectPoints(x, a, b, K, d)[0] for x, a, b in zip(xyz, r, t, strict=True)]
    except cv2.error as error:
        raise CalibrationError(
            f"no {model} lens explains the views ({str(error).strip().splitlines()[-1][:80]}); try the other --model"
        ) from None
    errors = [np.asarray(s, np.float64).reshape(-1, 2) - p for s, p in zip(shown, px, strict=True)]
    n = sum(len(e) for e in errors)
    rms = float(np.sqrt(np.mean(np.square(np.concatenate(errors)))))
    sigma = float(np.ravel(spread)[0]) if spread is not None else rms * K[0, 0] / (0.25 * size[0] * np.sqrt(n))
    rotations = [np.asarray(cv2.Rodrigues(np.asarray(a, np.float64))[0], np.float64) for a in r]
    return np.asarray(K, np.float64), np.ravel(np.asarray(d, np.float64)), rotations, errors, sigma


def _fisheye_flag(name: str) -> int:
    """OpenCV 5 has these flags beside the others, OpenCV 4 in its fisheye module, with other values."""
    return int(getattr(cv2, name) if hasattr(cv2, name) else getattr(cv2.fisheye, name))


def _tilt_deg(rotations: Sequence[Array]) -> float:
    """Largest angle between the boards' normals."""
    normal = np.array([R[:, 2] for R in rotations])
    return float(np.degrees(np.arccos(np.clip((normal @ normal.T).min(), -1.0, 1.0))))


def _by_region(px: Array, errors: Array, size: tuple[int, int]) -> Array:
    cell = np.clip((px / size * REGIONS).astype(int), 0, REGIONS - 1)
    out = np.full((REGIONS, REGIONS), np.nan)
    squared: AnyArray = np.sum(errors**2, axis=1)
    for r in range(REGIONS):
        for c in range(REGIONS):
            here = (cell[:, 0] == c) & (cell[:, 1] == r)
            if here.any():
                out[r, c] = np.sqrt(squared[here].mean())
    return out
