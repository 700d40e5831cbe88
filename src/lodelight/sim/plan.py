"""A building from above: walls, furniture, tags, lights and the way through it, as PNG and as HTML."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from lodelight.errors import SourceError
from lodelight.io.text import write_text
from lodelight.sim.builder import Building
from lodelight.sim.motion import Motion
from lodelight.types import Array, Bytes

CUT_M = 1.0  # walls are what reaches from the floor to above this
PIXELS_PER_M = 40
MARGIN_M = 0.8
GREYS = {"wall": (40, 40, 40), "thing": (190, 185, 175)}  # blue, green, red


@dataclass(frozen=True, eq=False)
class Lines:
    """Segments from (N, 2) to (N, 2), m."""

    start: Array
    end: Array


def walls_and_things(building: Building) -> dict[str, Lines]:
    """Upright faces, by whether they run from the floor to CUT_M or stand lower or higher."""
    scene = building.scene
    g = scene.geometry[: scene.static]
    upright = np.abs(g[:, 5]) < 0.3
    z = np.stack([g[:, 2], g[:, 2] + g[:, 17], g[:, 2] + g[:, 14]])
    low, high = z.min(axis=0), z.max(axis=0)
    tall = upright & (low < 0.05) & (high > max(CUT_M, 0.8 * building.height_m))
    thing = upright & ~tall & (low < 1.8) & (np.linalg.norm(g[:, 12:14], axis=1) > 0.15)
    out = {}
    for name, mask in (("thing", thing), ("wall", tall)):
        start = g[mask, :2]
        out[name] = Lines(start, start + g[mask, 12:14])
    return out


def draw(building: Building, motion: Motion | None = None) -> Bytes:
    """(H, W, 3) uint8 blue, green, red."""
    lo, hi = building.scene.tree.boxes[0, :2] - MARGIN_M, building.scene.tree.boxes[0, 3:5] + MARGIN_M
    size = np.ceil((hi - lo) * PIXELS_PER_M).astype(int)
    canvas = np.full((size[1], size[0], 3), 255, np.uint8)

    def px(p: Array) -> tuple[int, int]:
        u = (p[:2] - lo) * PIXELS_PER_M
        return int(u[0]), int(size[1] - u[1])

    for name, lines in walls_and_things(building).items():
        for a, b in zip(lines.start, lines.end, strict=True):
            cv2.line(canvas, px(a), px(b), GREYS[name], 3 if name == "wall" else 1, cv2.LINE_AA)
    for light in building.anchors.lights:
        cv2.circle(canvas, px(light.xyz), 4, (0, 170, 240), -1, cv2.LINE_AA)
    if motion is not None:
        path = np.array([px(p) for p in motion.at(np.arange(0.0, motion.duration_s, 0.05)).xyz], np.int32)
        cv2.polylines(canvas, [path.reshape(-1, 1, 2)], False, (200, 90, 30), 2, cv2.LINE_AA)
        cv2.circle(canvas, (int(path[0, 0]), int(path[0, 1])), 7, (60, 160, 40), -1, cv2.LINE_AA)
    for tag in building.anchors.tags:
        assert tag.T_world_tag is not None
        at, out = tag.T_world_tag.t, -tag.T_world_tag.R[:, 2]
        colour = (40, 40, 200) if tag.family == "qr" else (160, 40, 140)
        cv2.line(canvas, px(at), px(at + 0.3 * out), colour, 2, cv2.LINE_AA)
        x, y = px(at + 0.45 * out)
        cv2.putText(canvas, tag.id, (x - 10, y + 4), cv2.FONT_HERSHEY_SIMPLEX, 0.36, colour, 1, cv2.LINE_AA)
    for k in range(0, int(hi[0] - lo[0]), 5):  # a rule along the lower edge
        x, y = px(np.array([lo[0] + MARGIN_M + k, lo[1] + 0.1]))
        cv2.line(canvas, (x, y - 6), (x, y), (0, 0, 0), 1)
        cv2.putText(canvas, f"{k} m", (x + 3, y - 2), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 0), 1, cv2.LINE_AA)
    return canvas


def write_plan(path: str | Path, building: Building, motion: Motion | None = None) -> None:
    """Write `.png` or `.html` as the name says; the page holds all it needs."""
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in (".png", ".html"):
        raise SourceError(f"{path}: a plan is written as .png or .html")
    if suffix == ".html":
        write_text(path, _page(building, motion))
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(cv2.imencode(".png", draw(building, motion))[1].tobytes())
    except OSError as error:
        raise SourceError(f"cannot write {path}: {error.strerror}") from None


def _page(building: Building, motion: Motion | None) -> str:
    import plotly.graph_objects as go

    figure = go.Figure()
    for name, lines in walls_and_things(building).items():
        gap = np.full(len(lines.start), np.nan)
        x, y = (np.stack([lines.start[:, k], lines.end[:, k], gap], axis=1).ravel() for k in range(2))
        style = {"color": "#282828" if name == "wall" else "#b8b2a8", "width": 2 if name == "wall" else 1}
        figure.add_scatter(x=x, y=y, mode="lines", name=name, line=style, hoverinfo="skip")
    lights = building.anchors.lights
    figure.add_scatter(
        x=[light.xyz[0] for light in lights],
        y=[light.xyz[1] for light in lights],
        mode="markers",
        name="lights",
        marker={"color": "#f0aa00", "size": 7},
        text=[f"{light.id} {light.frequency_hz:g} Hz, z {light.xyz[2]:.2f} m" for light in lights],
    )
    for family in sorted({tag.family for tag in building.anchors.tags}):
        tags = [tag for tag in building.anchors.tags if tag.family == family and tag.T_world_tag is not None]
        spots = [tag.T_world_tag.t for tag in tags if tag.T_world_tag is not None]
        figure.add_scatter(
            x=[p[0] for p in spots],
            y=[p[1] for p in spots],
            mode="markers",
            name=family,
            marker={"symbol": "square", "size": 7},
            text=[f"{tag.id}, {tag.size_m:g} m, z {p[2]:.2f} m" for tag, p in zip(tags, spots, strict=True)],
        )
    if motion is not None:
        xyz = motion.at(np.arange(0.0, motion.duration_s, 0.1)).xyz
        figure.add_scatter(x=xyz[:, 0], y=xyz[:, 1], mode="lines", name="path", line={"color": "#1e5ac8"})
    figure.update_layout(title=building.name, template="simple_white", hovermode="closest", height=800)
    figure.update_yaxes(scaleanchor="x", title="y, m")
    figure.update_xaxes(title="x, m")
    page: str = figure.to_html(include_plotlyjs=True, full_html=True, div_id="plan")  # not a random name
    return page
