"""The report of a fleet: what became of every recording, and where all of them went in the one map."""

from __future__ import annotations

import html
from pathlib import Path
from typing import Any

import numpy as np

from lodelight.report.figures import MAX_POINTS, TRUTH, Figure, line
from lodelight.report.html import card, section, write_page
from lodelight.types import Array

COLOURS = ("#2f7ff0", "#f08a24", "#2fa866", "#a05fd6", "#e0443e", "#14a3a8", "#c7387f", "#8a7a2a")
HEAD = ("recording", "state", "frames", "tracked", "keyframes", "points", "ms a frame", "ATE", "in the map")


def write_fleet_report(
    out: Path, told: dict[str, Any], paths: dict[str, Array] | None = None, xyz: Array | None = None
) -> Path:
    """`out/report.html` of what `summary.json` holds.

    paths : keyframes (K, 3) m of every recording in the map; xyz (N, 3) m its points
    """
    sections, figures = [_table(told["recordings"])], {}
    if paths:
        note = "Keyframes of every recording in the one map, and its points. From above where z points up."
        sections.insert(
            0, section("above", "All paths", note, True).replace('id="above"', 'id="above" style="height:640px"')
        )
        figures["above"] = _above(paths, np.zeros((0, 3)) if xyz is None else xyz)
    states = [row["state"] for row in told["recordings"]]
    lead = f"{len(states)} recordings · {sum(state in ('done', 'kept') for state in states)} mapped"
    return write_page(out / "report.html", out.resolve().name, lead, _cards(told), sections, "", {"figures": figures})


def _cards(told: dict[str, Any]) -> list[str]:
    states = [row["state"] for row in told["recordings"]]
    failed = sum(state in ("failed", "lost") for state in states)
    cards = [card("Recordings", str(len(states)), f"{states.count('kept')} kept from before · {failed} failed")]
    if told["map"]:
        m = told["map"]
        joined = sum(bool(row["in_map"] and row["in_map"]["by"]) for row in told["recordings"])
        low, high = m["bounds_m"] or ([0.0] * 3, [0.0] * 3)
        size = " x ".join(f"{b - a:.1f}" for a, b in zip(low, high, strict=True))
        cards.append(card("In the map", f"{joined} of {len(states)}", f"{m['loops']} loops · {m['tags']} tags"))
        cards.append(card("Map points", f"{m['points']:,}", f"keyframes {m['keyframes']:,} · {size} m"))
    return cards


def _table(rows: list[dict[str, Any]]) -> str:
    head = "".join(f"<th>{name}</th>" for name in HEAD)
    body = "".join(f"<tr>{''.join(f'<td>{_held(cell)}</td>' for cell in _cells(row))}</tr>" for row in rows)
    return (
        f'<section class="wide"><h2>Recordings</h2><div class="scroll"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div></section>"
    )


def _held(text: str) -> str:
    """As HTML, with numbers and their units in one line."""
    return html.escape(text).replace(" %", "&nbsp;%").replace(" cm", "&nbsp;cm")


def _cells(row: dict[str, Any]) -> list[str]:
    m, part = row["metrics"], row["in_map"]
    where = "" if part is None else part["why"] if not part["by"] else part["by"]
    if part is not None and part["by"] not in ("", "base"):
        where = f"by {part['by']}: {part['pairs']} places, {len(part['tags'])} tags, {part['shared_points']} points"
    if m is None:
        return [row["name"], row["state"], *["-"] * 6, row["why"]]
    ms = m["ms_per_frame"]["p50"]
    ate = m["ate"] and m["ate"]["final"]
    return [
        row["name"], row["state"], f"{m['frames']:,}", f"{100 * m['tracked_fraction']:.1f} %", f"{m['keyframes']:,}",
        f"{m['map_points']:,}", "-" if ms is None else f"{ms:.1f}",
        f"{100 * ate['rmse_m']:.1f} cm" if ate else "-", where,
    ]  # fmt: skip


def _above(paths: dict[str, Array], xyz: Array) -> Figure:
    traces = []
    if len(xyz):
        low, high = np.percentile(xyz, (1, 99), axis=0)
        shown = xyz[((xyz >= low) & (xyz <= high)).all(axis=1)][:: max(1, len(xyz) // MAX_POINTS)]
        dots = {"type": "scattergl", "mode": "markers", "marker": {"color": TRUTH, "size": 1.5, "opacity": 0.5}}
        traces.append(line(shown[:, 0], shown[:, 1], "map points", TRUTH, hoverinfo="skip", **dots))
    for i, (name, path) in enumerate(paths.items()):
        marks = {"mode": "lines+markers", "marker": {"size": 4, "color": COLOURS[i % len(COLOURS)]}}
        traces.append(line(path[:, 0], path[:, 1], name, COLOURS[i % len(COLOURS)], **marks))
    y_axis = {"title": {"text": "y (m)"}, "scaleanchor": "x", "scaleratio": 1}
    return {"data": traces, "layout": {"xaxis": {"title": {"text": "x (m)"}}, "yaxis": y_axis}}
