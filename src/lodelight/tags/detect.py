"""Tags in an image: found by libraries, read, checked, and their corners measured on the whole print.

QR codes are looked for in every image, which costs half a millisecond; the squares of AprilTags and ArUco markers,
which cost ten times that, in every few images, and in between only where one was seen before. What is refused is kept
with its reason in `refused`: a code half out of the image, too small, no square, or one whose print does not fit the
image, which is how a misread code shows.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from lodelight.anchors.payload import MAX_CHARS, shown, tag_from_payload
from lodelight.errors import ConfigError, SourceError
from lodelight.fiducials import APRILTAG, FAMILIES, dictionary, fiducial_modules
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.messages import TagSighting
from lodelight.tags.apriltags import Quad, detect_apriltags
from lodelight.tags.pattern import fit_pattern
from lodelight.tags.qrcodes import READING_ORDER, QrCode, read_qr
from lodelight.types import Array, Bytes

DEFAULT_FAMILIES = ("qr", "tag36h11")
MAX_ASPECT = 6.0  # longest over shortest side or diagonal of a square that can still be read
CHOP_MARGIN = 0.6  # of a tag's size, around where it was seen last


@dataclass(frozen=True)
class TagConfig:
    """families : looked for, blank-separated; what the anchors name is added
    search_every : images between two searches of a whole image for squares, and for QR codes too small to read as is
    decimate : of the AprilTag search
    min_side_px : of a code that is used; border_px : that its corners keep from the image's edge
    min_agreement : correlation of print and image, below which a code was misread, is covered or smeared
    sigma_px, sigma_scale : of a corner at best, and what the fit's own estimate is multiplied with
    """

    families: str = " ".join(DEFAULT_FAMILIES)
    search_every: int = 3
    decimate: float = 2.0
    min_side_px: float = 14.0
    border_px: float = 4.0
    min_agreement: float = 0.7
    sigma_px: float = 0.15
    sigma_scale: float = 2.5


@dataclass(frozen=True)
class Refused:
    """A code that was seen and is not used, and why."""

    name: str
    why: str


@dataclass(frozen=True, eq=False)
class _Read:
    """What a library read: corners (4, 2) px in our order, known to start_px; modules as printed."""

    family: str
    id: str
    corners_px: Array
    modules: Bytes
    start_px: float
    size_m: float | None = None
    T_world_tag: SE3 | None = None


class TagDetector:
    """Finds the tags of given families in the images of one camera, in the order they come.

    camera : its lens; seen : in the last image; refused : what it had that is not used
    Raises ConfigError on an unknown family.
    """

    def __init__(
        self, camera: Camera, families: Iterable[str] = (), config: TagConfig | None = None, index: int = 0
    ) -> None:
        self.camera = camera
        self.config = config or TagConfig()
        self.index = index
        self.families = tuple(sorted({*self.config.families.split(), *families}))
        if unknown := [f for f in self.families if f != "qr" and f not in FAMILIES]:
            raise ConfigError(f"tag family {unknown[0]!r} is unknown; choose qr or one of {', '.join(FAMILIES)}")
        self.refused: list[Refused] = []
        self._count = 0
        self.seen: list[TagSighting] = []

    def detect(self, image: Bytes, t_ns: int, thorough: bool = False) -> list[TagSighting]:
        """Sightings in an image (H, W) uint8, at most one of each place; by family, then id, then position.

        thorough : search everything now, whatever the turn
        """
        self.refused = []
        turn = self._count % max(self.config.search_every, 1)
        self._count += 1
        first = thorough or self._count == 1
        sightings = []
        for read in self._distinct([*self._squares(image, first or turn == 0), *self._qr(image, first or turn == 1)]):
            refusal = self._unusable(read)
            sighting = None if refusal else self._measured(read, image, t_ns)
            if sighting is not None:
                sightings.append(sighting)
            elif refusal:
                self._refuse(f"{read.family} {read.id}", refusal)
        sightings.sort(key=lambda s: (s.family, s.id, s.corners_px[0, 0], s.corners_px[0, 1]))
        self.seen = sightings
        return sightings

    # -- reading ------------------------------------------------------------------------------------------------

    def _squares(self, image: Bytes, everywhere: bool) -> Iterator[_Read]:
        """AprilTags and ArUco markers, in the whole image or near where one was."""
        for family in self.families:
            if family == "qr":
                continue
            if everywhere:
                chops = [(0, 0, image)]
            else:
                chops = [self._chop(image, s.corners_px) for s in self.seen if s.family == family]
            for left, top, part in chops:
                for quad in _read_squares(part, family, self.config.decimate if everywhere else 1.0):
                    number = quad.number
                    corners = quad.corners_px + np.array([left, top])
                    yield _Read(family, str(number), corners, fiducial_modules(family, number), 0.5)

    def _chop(self, image: Bytes, corners_px: Array) -> tuple[int, int, Bytes]:
        """The part of an image around a tag: left, top, and its pixels."""
        low, high = corners_px.min(axis=0), corners_px.max(axis=0)
        reach = CHOP_MARGIN * float((high - low).max()) + 8.0
        left, top = (max(int(v), 0) for v in low - reach)
        right, bottom = (math.ceil(v) for v in high + reach)
        return left, top, np.ascontiguousarray(image[top:bottom, left:right])

    def _qr(self, image: Bytes, enlarge: bool) -> Iterator[_Read]:
        if "qr" not in self.families:
            return
        found = read_qr(image)
        if enlarge and not found:  # thin codes can be read where there are more pixels to a module
            larger = cv2.resize(image, None, fx=2.0, fy=2.0, interpolation=cv2.INTER_CUBIC)
            found = read_qr(np.asarray(larger, np.uint8), 2.0)
        for code in found:
            read = self._said(code)
            if read is not None:
                yield read

    def _said(self, code: QrCode) -> _Read | None:
        text, corners, modules = code.text, code.corners_px, code.modules
        if code.mirrored:
            self._refuse("qr", f"{shown(text)} is mirrored")
            return None
        start_px = max(2.0, 0.3 * _side(corners) / len(modules))
        try:
            tag = tag_from_payload(text)
        except SourceError as error:
            self._refuse("qr", str(error))
            return None
        if tag is None:
            if len(text) > MAX_CHARS or not text.isprintable():
                self._refuse("qr", f"its text {shown(text)} is no name for a tag")
                return None
            return _Read("qr", text, corners, modules, start_px)
        return _Read("qr", tag.id, corners, modules, start_px, tag.size_m, tag.T_world_tag)

    # -- checking -----------------------------------------------------------------------------------------------

    def _distinct(self, reads: list[_Read]) -> list[_Read]:
        """Each code once, though two searches found it."""
        kept: list[_Read] = []
        for read in reads:
            near = 0.5 * _side(read.corners_px)
            centre = read.corners_px.mean(axis=0)
            if not any(
                k.family == read.family
                and k.id == read.id
                and np.linalg.norm(k.corners_px.mean(axis=0) - centre) < near
                for k in kept
            ):
                kept.append(read)
        return kept

    def _unusable(self, read: _Read) -> str:
        """Why a code's outline rules it out; empty where it does not."""
        corners = read.corners_px
        side = _side(corners)
        if side < self.config.min_side_px:
            return f"its side is {side:.0f} px, {self.config.min_side_px:.0f} are needed"
        if not self.camera.inside(corners, self.config.border_px).all():
            return "it reaches over the image's edge"
        edges = np.roll(corners, -1, axis=0) - corners
        turns = edges[:, 0] * np.roll(edges[:, 1], -1) - edges[:, 1] * np.roll(edges[:, 0], -1)
        if turns.max() >= 0.0:  # counter-clockwise as one reads it, with v downwards
            return "it is mirrored" if turns.min() > 0.0 else "its outline is no square in perspective"
        lengths = [
            *np.linalg.norm(edges, axis=1),
            np.linalg.norm(corners[0] - corners[2]),
            np.linalg.norm(corners[1] - corners[3]),
        ]
        if max(lengths) > MAX_ASPECT * min(lengths):
            return "it is seen too flat"
        return ""

    def _measured(self, read: _Read, image: Bytes, t_ns: int) -> TagSighting | None:
        name = f"{read.family} {read.id}"
        fit = fit_pattern(image, self.camera, read.modules, read.corners_px, read.start_px)
        if fit is None or not fit.agreement >= self.config.min_agreement or fit.contrast <= 0.0:
            agreement = 0.0 if fit is None else fit.agreement
            self._refuse(
                name, f"what is printed agrees with the image to {agreement:.2f} only: misread, covered or smeared"
            )
            return None
        slid = float(np.linalg.norm(fit.corners_px - read.corners_px, axis=1).max())
        if slid > max(2.0 * read.start_px, 0.05 * _side(read.corners_px)):
            self._refuse(name, f"its print lies {slid:.1f} px from where it was read")
            return None
        variance = np.diag(fit.covariance_px).reshape(4, 2).mean(axis=1)
        sigma = np.hypot(self.config.sigma_px, self.config.sigma_scale * np.sqrt(variance))
        return TagSighting(
            t_ns, read.family, read.id, fit.corners_px, sigma, self.index, read.size_m, read.T_world_tag, fit.agreement
        )  # fmt: skip

    def _refuse(self, name: str, why: str) -> None:
        self.refused.append(Refused(name, why))


def _side(corners_px: Array) -> float:
    return float(np.linalg.norm(np.roll(corners_px, -1, axis=0) - corners_px, axis=1).min())


def _read_squares(image: Bytes, family: str, decimate: float) -> list[Quad]:
    if min(image.shape) < 8:
        return []
    if family in APRILTAG:
        return detect_apriltags(image, family, decimate)
    params = cv2.aruco.DetectorParameters()
    params.adaptiveThreshWinSizeMin = params.adaptiveThreshWinSizeMax = (
        13  # one threshold of three: a third of the time
    )
    corners, numbers, _ = cv2.aruco.ArucoDetector(dictionary(family), params).detectMarkers(image)
    if numbers is None:
        return []
    return [
        Quad(family, int(n), np.asarray(c, np.float64).reshape(4, 2)[READING_ORDER])
        for c, n in zip(corners, np.ravel(numbers), strict=True)
    ]
