"""Sheets to print: tags for a building, and a board of tags to calibrate a camera with."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lodelight.anchors import Tag
from lodelight.anchors.payload import tag_payload
from lodelight.errors import ConfigError
from lodelight.fiducials import fiducial_modules, qr_modules
from lodelight.report.paper import SIZES_MM, Page, text_width_mm
from lodelight.tagboard import TagBoard
from lodelight.types import Bytes

EDGE_MM = 8.0  # of the paper, where many printers print nothing
FOOT_MM = 30.0  # for the text and the ruler below a tag
QUIET = {"qr": 4}  # modules of white around a code; one around the others
MARK_MM, HAIR_MM = 6.0, 0.2
RULER_MM = 100.0


def page_size_mm(name: str) -> tuple[float, float]:
    """Width and height of "a4", "letter", ... or "300x400". Raises ConfigError on another text."""
    if name.lower() in SIZES_MM:
        return SIZES_MM[name.lower()]
    try:
        width, height = (float(part) for part in name.lower().split("x"))
    except ValueError:
        raise ConfigError(f"page {name!r} is unknown; choose {', '.join(SIZES_MM)}, or 300x400 in mm") from None
    if not (20.0 <= width <= 5000.0 and 20.0 <= height <= 5000.0):
        raise ConfigError(f"page {name!r}: sides must lie between 20 and 5000 mm")
    return width, height


def tag_modules(tag: Tag, say_place: bool = True) -> Bytes:
    """What is printed of a tag, (n, n), 0 black.

    say_place : a QR code carries where it hangs, if that is known. Raises ConfigError on what cannot be printed.
    """
    if tag.family == "qr":
        said = tag if say_place else Tag(tag.family, tag.id, tag.size_m)
        return qr_modules(tag_payload(said))
    if not tag.id.isdecimal():
        raise ConfigError(f"{tag.family} has numbers, not {tag.id!r}")
    return fiducial_modules(tag.family, int(tag.id))


def tag_sheet(tag: Tag, page_mm: tuple[float, float], say_place: bool = True) -> Page:
    """One tag on a page, upright, with cut marks, its name, and a ruler to check the printer by."""
    modules = tag_modules(tag, say_place)
    page = Page(*page_mm)
    side = 1e3 * tag.size_m
    pitch = side / len(modules)
    quiet = QUIET.get(tag.family, 1) * pitch
    whole = side + 2.0 * quiet
    room = min(page.width_mm - 2.0 * EDGE_MM, page.height_mm - 2.0 * EDGE_MM - FOOT_MM)
    if whole > room:
        fits = [n for n, (w, h) in SIZES_MM.items() if min(w - 2 * EDGE_MM, h - 2 * EDGE_MM - FOOT_MM) >= whole]
        advice = f"use --page {fits[0]}" if fits else f"it needs {whole + 2 * EDGE_MM:.0f} mm of width"
        raise ConfigError(
            f"{tag.family} {tag.id} of {tag.size_m:g} m with its white border is {whole:.0f} mm wide; {advice}"
        )
    left, top = 0.5 * (page.width_mm - whole), EDGE_MM + 0.5 * (page.height_mm - 2.0 * EDGE_MM - FOOT_MM - whole)
    draw_modules(page, modules, left + quiet, top + quiet, pitch)
    _cut_marks(page, left, top, whole)
    middle, y = 0.5 * page.width_mm, top + whole + MARK_MM + 6.0
    page.text(middle, y, 6.0, f"{tag.family} {tag.id}", middle=True)
    page.text(middle, y + 5.0, 3.2, f"this side down - black square {side:g} mm, cut outside the marks", middle=True)
    _ruler(page, page.height_mm - EDGE_MM - 6.0)
    return page


def board_sheet(board: TagBoard, page_mm: tuple[float, float]) -> Page:
    """A calibration board on one page."""
    page = Page(*page_mm)
    width, height = 1e3 * board.width_m, 1e3 * board.height_m
    if width > page.width_mm - 2 * EDGE_MM or height > page.height_mm - 2 * EDGE_MM - 14.0:
        raise ConfigError(f"the board is {width:.0f} x {height:.0f} mm; use a larger --page or a smaller --size")
    left, top = 0.5 * (page.width_mm - width), EDGE_MM
    for number, corner in zip(board.numbers, board.upper_left_m, strict=True):
        modules = fiducial_modules(board.family, number)
        x, y = left + 1e3 * corner[0], top + 1e3 * corner[1]
        draw_modules(page, modules, x, y, 1e3 * board.size_m / len(modules))
    said = f"lodelight calibrate --board {board}"
    page.text(left, page.height_mm - EDGE_MM - 10.0, 3.2, f"{said}   (tags of {1e3 * board.size_m:g} mm: measure them)")
    _ruler(page, page.height_mm - EDGE_MM - 5.0)
    return page


def draw_modules(page: Page, modules: Bytes, x_mm: float, y_mm: float, pitch_mm: float) -> None:
    """Black modules as boxes, each row's runs in one, so that no hairline runs through them."""
    for r, row in enumerate(np.asarray(modules)):
        edges = np.flatnonzero(np.diff(np.concatenate([[1], row, [1]]).astype(int)))
        for start, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
            page.box(x_mm + start * pitch_mm, y_mm + r * pitch_mm, (end - start) * pitch_mm, pitch_mm)


def _cut_marks(page: Page, left: float, top: float, side: float) -> None:
    """Hairlines that point at the corners of the white border from outside."""
    for x in (left, left + side):
        for y0 in (top - MARK_MM, top + side):
            page.box(x - 0.5 * HAIR_MM, y0, HAIR_MM, MARK_MM)
    for y in (top, top + side):
        for x0 in (left - MARK_MM, left + side):
            page.box(x0, y - 0.5 * HAIR_MM, MARK_MM, HAIR_MM)


def _ruler(page: Page, y: float) -> None:
    length = min(RULER_MM, 10.0 * ((page.width_mm - 2.0 * EDGE_MM) // 10.0))
    left = 0.5 * (page.width_mm - length)
    page.box(left, y, length, 0.3)
    for i in range(round(length / 10.0) + 1):
        tall = 3.0 if i % 5 == 0 else 1.8
        page.box(left + 10.0 * i - 0.1, y - tall, 0.2, tall)
    said = f"{length:g} mm on a ruler, or the printer has scaled the page"
    page.text(0.5 * (page.width_mm - text_width_mm(said, 3.0)), y + 4.5, 3.0, said)


def sheets(tags: Sequence[Tag], page_mm: tuple[float, float], say_place: bool = True) -> list[Page]:
    """A page for each tag. Raises ConfigError where there is none, or one does not fit."""
    if not tags:
        raise ConfigError("there is no tag to print; name some with --ids, or give an anchors.toml that has some")
    return [tag_sheet(tag, page_mm, say_place) for tag in tags]
