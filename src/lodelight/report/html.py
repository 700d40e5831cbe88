"""`report.html`: one file that opens from disk, with plotly.js inside and no request to anywhere."""

from __future__ import annotations

import html
import json
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from lodelight.evaluation.align import Mode
from lodelight.io.text import read_text, write_text
from lodelight.report import figures
from lodelight.report.figures import Figure
from lodelight.report.folder import RunFolder, read_folder
from lodelight.trajectory import Trajectory

MAX_EVENTS_OF_A_KIND = 400
_PAGE = files("lodelight.report") / "page"


def write_report(out: Path, truth: Trajectory | None, mode: Mode = "se3") -> Path:
    """Draw an out folder into `out/report.html`; truth : T_world_body where the source has it.

    Raises SourceError where the folder is not complete or cannot be written.
    """
    run = read_folder(out, truth, mode)
    plots = _plots(run)
    events, events_note = _events(run)
    tail = Template((_PAGE / "events.html").read_text(encoding="utf-8")).substitute(
        events_note=events_note, config=html.escape(read_text(out / "config.toml"))
    )
    sections = [section(name, *plot[:3]) for name, plot in plots.items()]
    data = {"figures": {name: figure for name, (_, _, _, figure) in plots.items()}, "events": events}
    return write_page(out / "report.html", run.name, _lead(run), _cards(run.metrics), sections, tail, data)


def write_page(
    path: Path, title: str, lead: str, cards: Sequence[str], sections: Sequence[str], tail: str, data: dict[str, Any]
) -> Path:
    """One page with everything inside. data : figures by the name of their section, and events to list."""
    from plotly.offline import get_plotlyjs

    document = Template((_PAGE / "page.html").read_text(encoding="utf-8")).substitute(
        title=html.escape(title),
        lead=html.escape(lead),
        cards="\n".join(cards),
        plots="\n".join(sections),
        tail=tail,
        css=(_PAGE / "page.css").read_text(encoding="utf-8"),
        js=(_PAGE / "page.js").read_text(encoding="utf-8"),
        plotly=get_plotlyjs(),
        # a text in the data must not end the script that holds it
        data=json.dumps(data, separators=(",", ":"), allow_nan=False).replace("</", "<\\/"),
    )
    write_text(path, document)
    return path


def _plots(run: RunFolder) -> dict[str, tuple[str, str, bool, Figure]]:
    """Title, note, whether it takes the page's width, figure."""
    drawn = {}
    if run.frames["t_ns"]:
        drawn["states"] = ("State", "", True, figures.states(run))
    if len(run.final.poses):
        drawn["above"] = ("Path, x-y", f"From above where z points up.{_tags(run)}", False, figures.plane(run, "xy"))
        drawn["side"] = ("Path, x-z", "From the side where z points up.", False, figures.plane(run, "xz"))
        count = len(run.cloud_xyz)
        shown = f"{min(count, figures.MAX_POINTS):,} of {count:,} map points" if count else "no map points"
        drawn["map"] = ("Map", f"{shown}, coloured by z. Drag to turn.", True, figures.space(run))
    if run.final.errors or run.live.errors:
        note = "Of each pose, after one alignment of the whole path."
        drawn["error-time"] = ("Error over time", note, False, figures.errors_over(run, "time"))
        drawn["error-distance"] = ("Error over distance", note, False, figures.errors_over(run, "distance"))
    if run.frames["t_ns"]:
        note = "Tracking: from the decoded image to its pose. Mapping: what a keyframe costs besides."
        drawn["timing"] = ("Time per frame", note, False, figures.timing(run))
        drawn["inliers"] = ("Inliers", "Points that agree with the frame's pose.", False, figures.inliers(run))
    speed = figures.velocity(run)
    if speed:
        drawn["velocity"] = ("Velocity", "As estimated at the time, world axes.", False, speed)
    for kind, title, unit, per in (
        ("gyro", "Bias of the gyroscope", "mrad/s", 1e3), ("accel", "Bias of the accelerometer", "m/s²", 1.0)
    ):  # fmt: skip
        bias = figures.biases(run, kind, unit, per)
        if bias:
            drawn[f"bias-{kind}"] = (title, "As estimated at the time, within one standard deviation.", False, bias)
    consistency = figures.nees(run)
    if consistency:
        note = "Squared error of the live poses, after one alignment of the whole path, over what the system believed."
        drawn["nees"] = ("NEES", f"{note} 1 is honest; 95 % of honest ones lie between the dots.", False, consistency)
    if len(run.sigma_m):
        note = "What the system believed of its own error at the time; root of the summed variances."
        drawn["sigma"] = ("Uncertainty", note, True, figures.sigma(run))
    return drawn


def _tags(run: RunFolder) -> str:
    n = len(figures.tags(run)[0])
    return f" {n} tag{'s' if n > 1 else ''} as found." if n else ""


def section(name: str, title: str, note: str, wide: bool) -> str:
    below = f'<p class="note">{html.escape(note)}</p>' if note else ""
    height = {"states": ' style="height:110px"', "map": ' style="height:560px"'}.get(name, "")
    kind = ' class="wide"' if wide else ""
    return f'<section{kind}><h2>{html.escape(title)}</h2>{below}<div class="plot" id="{name}"{height}></div></section>'


def _lead(run: RunFolder) -> str:
    t_s = run.seconds(np.array(run.frames["t_ns"], dtype=np.int64))
    parts = [f"{run.metrics['frames']:,} frames", f"{t_s[-1] if len(t_s) else 0.0:.1f} s"]
    if len(run.final.poses):
        parts.append(f"{run.final.poses.length_m:.1f} m of path")
    return " · ".join(parts)


def _cards(m: dict[str, Any]) -> list[str]:
    cards = []
    final, live = (m["ate"] or {}).get("final"), (m["ate"] or {}).get("live")
    if final:
        more = f"rotation {final['rotation_deg']:.2f}°, {final['align']} aligned"
        cards.append(card("Error (ATE RMSE)", f"{100 * final['rmse_m']:.2f} cm", more))
    if live:
        more = f"as known at the time; p95 {100 * live['p95_m']:.2f} cm"
        cards.append(card("Live error", f"{100 * live['rmse_m']:.2f} cm", more))
    lost = m["states"]["lost"]
    cards.append(card("Tracked", f"{100 * m['tracked_fraction']:.1f} %", f"lost {100 * lost:.1f} % of the frames"))
    ms = m["ms_per_frame"]
    if ms["p50"] is not None:
        more = f"mean {ms['mean']:.1f} · p95 {ms['p95']:.1f} · p99 {ms['p99']:.1f}"
        cards.append(card("Per frame, median", f"{ms['p50']:.1f} ms", more))
    if m["real_time_factor"] is not None:
        cards.append(card("Real-time factor", f"{m['real_time_factor']:.2f}", "mapping counted in; below 1 keeps up"))
    more = f"keyframes {m['keyframes']:,} · loops {m['loops']} · relocalizations {m['relocalizations']}"
    cards.append(card("Map points", f"{m['map_points']:,}", more))
    if any(m["gate"].values()):
        more = f"{m['gate']['veto']} vetoed · {m['gate']['abstain']} unverified"
        cards.append(card("Keyframes the gate passed", f"{m['gate']['pass']}", more))
    if m["temporary_points"]["created"]:
        cards.append(
            card("Temporary points", f"{m['temporary_points']['created']:,}", f"{m['temporary_points']['left']} left")
        )
    if m["peak_rss_mb"] is not None:
        cards.append(card("Peak memory", f"{m['peak_rss_mb']:.0f} MB", f"compiling took {m['compile_s']:.1f} s"))
    return cards


def card(label: str, value: str, more: str) -> str:
    parts = (("label", label), ("value", value), ("more", more))
    inner = "".join(f'<div class="{name}">{html.escape(text)}</div>' for name, text in parts)
    return f'<div class="card">{inner}</div>'


def _events(run: RunFolder) -> tuple[list[dict[str, Any]], str]:
    """Rows of the table, of each kind at most MAX_EVENTS_OF_A_KIND evenly spread, and a line that says so."""
    by_kind: dict[str, list[int]] = {}
    for i, event in enumerate(run.events):
        none = " (none)" if event.get("inserted") is False else ""
        by_kind.setdefault(f"{event['kind']}{none}", []).append(i)
    rows, cut = [], []
    for kind, indices in by_kind.items():
        if len(indices) > MAX_EVENTS_OF_A_KIND:
            cut.append(f"{MAX_EVENTS_OF_A_KIND} of {len(indices):,} {kind}")
            indices = [indices[k] for k in np.linspace(0, len(indices) - 1, MAX_EVENTS_OF_A_KIND).astype(int)]
        for i in indices:
            event = run.events[i]
            rest = {
                k: v for k, v in event.items() if k not in ("t_ns", "kind", "inserted", "why") and v not in ("", None)
            }
            what = " · ".join([*filter(None, [event.get("why")]), *(f"{k} {_word(v)}" for k, v in rest.items())])
            t_ns = event["t_ns"]  # None of what a file has no stamp for
            t_s = None if t_ns is None else round(float(run.seconds(np.array(t_ns, dtype=np.int64))), 3)
            rows.append((i, {"t_s": t_s, "kind": kind, "what": what}))
    shown = f"Shown: {'; '.join(cut)}. " if cut else ""
    return [row for _, row in sorted(rows, key=lambda r: r[0])], f"{shown}All are in events.jsonl."


def _word(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return json.dumps(value) if isinstance(value, list | dict) else str(value)
