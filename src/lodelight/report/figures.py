"""The report's plots, as the plain data that plotly.js draws; no colour of text or paper, which the page sets."""

from __future__ import annotations

import base64
from typing import Any, TypeAlias, get_args

import numpy as np

from lodelight.messages import Status
from lodelight.report.folder import RunFolder
from lodelight.types import AnyArray, Array

Figure: TypeAlias = dict[str, Any]

# Enough for a screen; a report of an hour's recording stays as light as one of a minute.
MAX_SAMPLES = 6000
MAX_POINTS = 30_000

FINAL, LIVE, TRUTH, TAG = "#2f7ff0", "#f08a24", "#8a94a3", "#c02f8f"
AXES = ("#e0443e", "#2fa866", "#8a5cf0")
NEES_95 = (0.206, 2.408)  # of six degrees of freedom, per degree: 2.5 and 97.5 % of a chi-square distribution
MAX_SHADE = 4000  # map points behind the path from above
STATE_COLOURS = {
    "initializing": "#9aa5b4",
    "tracking": "#2fa866",
    "degraded": "#f0b429",
    "lost": "#e0443e",
    "relocalized": "#2f7ff0",
}


def packed(values: AnyArray) -> dict[str, str]:
    """Numbers as plotly.js reads them fastest and smallest: base64 of little-endian floats."""
    return {"dtype": "f4", "bdata": base64.b64encode(np.asarray(values, dtype="<f4").tobytes()).decode("ascii")}


def thinned(count: int, worst: Array | None = None, most: int = MAX_SAMPLES) -> AnyArray:
    """Rows to draw of `count`: at most `most`, evenly spread, of each stretch the one that is worst."""
    if count <= most:
        return np.arange(count)
    edges = np.linspace(0, count, most + 1).astype(int)[:-1]
    if worst is None:
        return edges
    ends = np.append(edges[1:], count)
    return np.array([a + int(np.argmax(worst[a:b])) for a, b in zip(edges, ends, strict=True)])


def broken(t_ns: AnyArray, rows: AnyArray, *columns: AnyArray) -> list[Array]:
    """The drawn rows of some columns (N, ...), with NaN between rows where the stamps (N,) have a hole."""
    steps = np.diff(t_ns)
    usual = np.median(steps) if len(steps) else 0
    holes = np.flatnonzero(steps > 5 * usual) + 1
    after = np.unique(np.searchsorted(rows, holes))
    return [np.insert(np.asarray(column, dtype=float)[rows], after, np.nan, axis=0) for column in columns]


def line(x: AnyArray, y: AnyArray, name: str, colour: str, **style: Any) -> Figure:
    trace = {"type": "scatter", "mode": "lines", "name": name, "x": packed(x), "y": packed(y)}
    return trace | {"line": {"color": colour, "width": 1.5, **style.pop("line", {})}} | style


def over_time(traces: list[Figure], y_title: str, **layout: Any) -> Figure:
    x_axis = {"title": {"text": "time (s)"}}
    y_axis = {"title": {"text": y_title}, "rangemode": "tozero", **layout.pop("yaxis", {})}
    return {"data": traces, "layout": {"xaxis": x_axis, "yaxis": y_axis, **layout}, "time": True}


def states(run: RunFolder) -> Figure:
    """A strip: one bar for each stretch of one state."""
    status = run.frames["status"]
    t_s = run.seconds(np.array(run.frames["t_ns"], dtype=np.int64))
    starts = [i for i in range(len(status)) if i == 0 or status[i] != status[i - 1]]
    ends = [*starts[1:], len(status) - 1]
    traces = []
    for state in get_args(Status):
        bars = [(t_s[a], t_s[b] - t_s[a]) for a, b in zip(starts, ends, strict=True) if status[a] == state]
        if bars:
            traces.append(
                {
                    **{"type": "bar", "orientation": "h", "name": state, "y": ["state"] * len(bars), "width": 1},
                    **{"base": [round(b, 4) for b, _ in bars], "x": [round(w, 4) for _, w in bars]},
                    "marker": {"color": STATE_COLOURS[state], "line": {"width": 0}},
                    "hovertemplate": "%{base:.2f} s, for %{x:.2f} s<extra>" + state + "</extra>",
                }
            )
    return over_time(traces, "", yaxis={"visible": False, "fixedrange": True}, barmode="overlay")


def timing(run: RunFolder) -> Figure:
    t_ns = np.array(run.frames["t_ns"], dtype=np.int64)
    track, mapping = (np.array(run.frames[name], dtype=float) for name in ("track_ms", "map_ms"))
    rows = thinned(len(track), track)
    traces = [line(run.seconds(t_ns[rows]), track[rows], "tracking", FINAL, line={"width": 1})]
    mapped = np.flatnonzero(mapping > 0)
    mapped = mapped[thinned(len(mapped), mapping[mapped])]
    if len(mapped):
        marks = {"mode": "markers", "marker": {"color": LIVE, "size": 4, "opacity": 0.7}}
        traces.append(line(run.seconds(t_ns[mapped]), mapping[mapped], "mapping (keyframes)", LIVE, **marks))
    shapes, notes = [], []
    for name, anchor in (("p50", "top"), ("p95", "middle"), ("p99", "bottom")):
        y = run.metrics["ms_per_frame"][name]
        if y is not None:
            across = {"xref": "paper", "x0": 0, "x1": 1, "y0": y, "y1": y}
            shapes.append({"type": "line", **across, "line": {"color": TRUTH, "width": 1, "dash": "dot"}})
            place = {"xref": "paper", "x": 1, "xanchor": "left", "y": y, "yanchor": anchor, "showarrow": False}
            notes.append({"text": f" {name}", "font": {"color": TRUTH, "size": 11}, **place})
    return over_time(traces, "ms", shapes=shapes, annotations=notes, margin={"r": 36})


def inliers(run: RunFolder) -> Figure:
    t_ns = np.array(run.frames["t_ns"], dtype=np.int64)
    count = np.array(run.frames["inliers"], dtype=float)
    rows = thinned(len(count), -count)
    traces = [line(run.seconds(t_ns[rows]), count[rows], "inliers", FINAL)]
    temporary = run.column("temporary")
    if temporary is not None and temporary[1].any():
        t_s, count = temporary
        rows = thinned(len(count), count)
        traces.append(line(t_s[rows], count[rows], "temporary points", STATE_COLOURS["degraded"]))
    return over_time(traces, "points matched")


def sigma(run: RunFolder) -> Figure:
    t_ns = run.sigma_t_ns
    rows = thinned(len(t_ns), run.sigma_m)
    t_s, metres, degrees = broken(t_ns, rows, run.seconds(t_ns), run.sigma_m, run.sigma_deg)
    traces = [line(t_s, 100 * metres, "position, cm", FINAL), line(t_s, degrees, "rotation, deg", LIVE)]
    if run.live.errors:
        e = run.live.errors
        t_s, metres = broken(e.t_ns, thinned(len(e.t_ns), e.position_m), run.seconds(e.t_ns), e.position_m)
        traces.insert(0, line(t_s, 100 * metres, "true position error, cm", TRUTH, line={"width": 1}))
    return over_time(traces, "1 sigma", yaxis={"type": "log", "rangemode": "normal"})


def biases(run: RunFolder, kind: str, unit: str, per: float) -> Figure | None:
    """Of the "gyro" or "accel", each axis between its two standard deviations; None where there was no IMU."""
    traces: list[Figure] = []
    for axis, colour in zip("xyz", AXES, strict=True):
        value, sigma = run.column(f"bias_{kind}_{axis}"), run.column(f"sigma_bias_{kind}_{axis}")
        if value is None or sigma is None:
            return None
        rows = thinned(len(value[0]), most=MAX_SAMPLES // 4)  # they change slowly
        t_s, middle, off = value[0][rows], per * value[1][rows], per * sigma[1][rows]
        for y, fill in ((middle - off, "none"), (middle + off, "tonexty")):
            band = {"fill": fill, "fillcolor": f"{colour}30", "showlegend": False, "hoverinfo": "skip"}
            traces.append(line(t_s, y, axis, colour, line={"width": 0}, **band))
        traces.append(line(t_s, middle, axis, colour))
    return over_time(traces, unit, yaxis={"rangemode": "normal"})


def velocity(run: RunFolder) -> Figure | None:
    """As estimated at the time, and the true speed where the truth is known; None where nothing estimates it."""
    columns = [run.column(f"velocity_{axis}") for axis in "xyz"]
    if columns[0] is None:
        return None
    rows = thinned(len(columns[0][0]))
    traces = [
        line(c[0][rows], c[1][rows], axis, colour, line={"width": 1})
        for axis, colour, c in zip("xyz", AXES, columns, strict=True)
        if c is not None
    ]
    speed = np.sqrt(sum(c[1] ** 2 for c in columns if c is not None))
    if run.truth is not None and run.final.alignment is not None and len(run.truth) > 2:
        t_s = run.seconds(run.truth.t_ns)
        true = np.linalg.norm(np.gradient(run.truth.xyz, t_s, axis=0), axis=1)
        during = np.flatnonzero((t_s >= columns[0][0][0]) & (t_s <= columns[0][0][-1]))
        during = during[thinned(len(during))]
        traces.insert(0, line(t_s[during], true[during], "true speed", TRUTH, line={"width": 4}, opacity=0.6))
    traces.append(line(columns[0][0][rows], speed[rows], "speed", FINAL))
    return over_time(traces, "m/s", yaxis={"rangemode": "normal"})


def nees(run: RunFolder) -> Figure | None:
    """Of the live poses, with 1 and the band that holds 95 % of honest ones; None without truth and covariance."""
    if run.nees is None or not np.isfinite(run.nees.nees).any():
        return None
    t_ns, value = run.nees.t_ns, run.nees.nees
    rows = thinned(len(value), np.nan_to_num(value))
    t_s, y = broken(t_ns, rows, run.seconds(t_ns), value)
    across = {"type": "line", "xref": "paper", "x0": 0, "x1": 1, "line": {"color": TRUTH, "width": 1}}
    marks = [(1.0, "solid"), *((bound, "dot") for bound in NEES_95)]
    shapes = [across | {"y0": at, "y1": at, "line": {"color": TRUTH, "width": 1, "dash": dash}} for at, dash in marks]
    figure = over_time([line(t_s, y, "NEES / 6", FINAL)], "per degree of freedom", yaxis={"type": "log"}, shapes=shapes)
    figure["layout"]["yaxis"]["rangemode"] = "normal"
    return figure


def errors_over(run: RunFolder, abscissa: str) -> Figure:
    """Position error in cm, left, and rotation error in degrees, right, over time or over the distance travelled."""
    traces = []
    for path, name, colour in ((run.live, "live", LIVE), (run.final, "final", FINAL)):
        e = path.errors
        if e is None:
            continue
        x = run.seconds(e.t_ns) if abscissa == "time" else e.along_m
        x, metres, degrees = broken(e.t_ns, thinned(len(e.t_ns), e.position_m), x, e.position_m, e.rotation_deg)
        traces.append(line(x, 100 * metres, f"{name}, cm", colour))
        traces.append(line(x, degrees, f"{name}, deg", colour, yaxis="y2", line={"width": 1, "dash": "dot"}))
    right = {"overlaying": "y", "side": "right", "tickmode": "auto", "rangemode": "tozero", "showgrid": False}
    figure = over_time(traces, "position (cm)", yaxis2={"title": {"text": "rotation (deg)"}, **right})
    if abscissa != "time":
        figure["time"] = False
        figure["layout"]["xaxis"]["title"]["text"] = "distance travelled (m)"
    return figure


def plane(run: RunFolder, axes: str) -> Figure:
    """The path projected on two world axes, to scale, with the tags; from above over the map's points."""
    i, j = ("xyz".index(axis) for axis in axes)
    traces = []
    if axes == "xy":
        xyz, _ = _cloud(run, MAX_SHADE)
        dots = {"mode": "markers", "marker": {"color": TRUTH, "size": 1.5, "opacity": 0.5}, "hoverinfo": "skip"}
        traces.append(line(xyz[:, i], xyz[:, j], "map points", TRUTH, **dots))
    if run.truth is not None and run.final.alignment is not None:
        xyz = _during(run.truth.xyz, run.truth.t_ns, run)
        traces.append(line(xyz[:, i], xyz[:, j], "truth", TRUTH, opacity=0.6, line={"width": 4}))
    for path, name, colour, width in ((run.live, "live", LIVE, 1), (run.final, "final", FINAL, 2)):
        (xyz,) = broken(path.poses.t_ns, thinned(len(path.poses)), path.poses.xyz)
        traces.append(line(xyz[:, i], xyz[:, j], name, colour, line={"width": width}))
    for state, xyz in along(run).items():
        marks = {"mode": "markers", "marker": {"color": STATE_COLOURS[state], "size": 5}}
        traces.append(line(xyz[:, i], xyz[:, j], state, STATE_COLOURS[state], **marks))
    xyz = keyframes(run)
    marks = {"mode": "markers", "marker": {"color": FINAL, "size": 4, "symbol": "square-open"}}
    traces.append(line(xyz[:, i], xyz[:, j], "keyframes", FINAL, **marks))
    names, spots = tags(run)
    if names:
        marks = {"mode": "markers+text", "marker": {"color": TAG, "size": 8, "symbol": "square"}}
        said = {"text": names, "textposition": "top right", "textfont": {"color": TAG, "size": 11}}
        traces.append(line(spots[:, i], spots[:, j], "tags", TAG, **marks, **said))
    x_axis = {"title": {"text": f"{axes[0]} (m)"}}
    y_axis = {"title": {"text": f"{axes[1]} (m)"}, "scaleanchor": "x", "scaleratio": 1}
    return {"data": traces, "layout": {"xaxis": x_axis, "yaxis": y_axis}}


def space(run: RunFolder) -> Figure:
    """Map points, coloured by height, with path and keyframes; far strays are left outside the box."""
    xyz, (low, high) = _cloud(run, MAX_POINTS)
    poses = run.final.poses
    (path,) = broken(poses.t_ns, thinned(len(poses)), poses.xyz)
    marker = {"size": 1.4, "color": packed(xyz[:, 2]), "colorscale": "Viridis", "opacity": 0.8}
    traces = [
        {"name": "map points", "mode": "markers", "marker": marker, "hoverinfo": "skip", **_xyz(xyz)},
        {"name": "path", "mode": "lines", "line": {"color": FINAL, "width": 4}, **_xyz(path)},
        {"name": "keyframes", "mode": "markers", "marker": {"size": 2.5, "color": LIVE}, **_xyz(keyframes(run))},
    ]
    for state, xyz in along(run).items():
        traces.append(
            {"name": state, "mode": "markers", "marker": {"size": 3, "color": STATE_COLOURS[state]}, **_xyz(xyz)}
        )
    names, spots = tags(run)
    if names:
        marker = {"size": 5, "color": TAG, "symbol": "square"}
        traces.append({"name": "tags", "mode": "markers+text", "marker": marker, "text": names, **_xyz(spots)})
    ranges = {f"{axis}axis": {"range": [float(low[k]), float(high[k])]} for k, axis in enumerate("xyz")}
    camera = {"eye": {"x": -0.9, "y": -1.2, "z": 0.85}, "center": {"x": 0, "y": 0, "z": -0.1}}
    return {"data": traces, "layout": {"scene": {"aspectmode": "data", "camera": camera, **ranges}}}


def tags(run: RunFolder) -> tuple[list[str], Array]:
    """Names, and where they hang in what is drawn, (N, 3) m."""
    placed = [(tag.id, tag.T_world_tag.t) for tag in run.tags if tag.T_world_tag is not None]
    return [name for name, _ in placed], _drawn(np.array([spot for _, spot in placed]).reshape(-1, 3), run)


def _drawn(xyz: AnyArray, run: RunFolder) -> Array:
    """Points (N, 3) of the run in the frame that is drawn."""
    a = run.final.alignment
    return np.asarray(xyz if a is None else a.scale * xyz @ a.R.T + a.t, dtype=float)


def _cloud(run: RunFolder, most: int) -> tuple[Array, tuple[Array, Array]]:
    """Map points, evenly chosen, without strays; and the box they lie in."""
    count = len(run.cloud_xyz)
    xyz = _drawn(run.cloud_xyz[np.linspace(0, count, min(count, most), endpoint=False, dtype=int)], run)
    low, high = _box(xyz, run.final.poses.xyz)
    return xyz[((xyz >= low) & (xyz <= high)).all(axis=1)], (low, high)


def keyframes(run: RunFolder) -> Array:
    """Where the final path was at the keyframes' stamps, (K, 3) m."""
    stamps = [e["t_ns"] for e in run.events if e.get("kind") == "keyframe" and e.get("inserted")]
    rows = np.flatnonzero(np.isin(run.final.poses.t_ns, np.array(stamps, dtype=np.int64)))
    return run.final.poses.xyz[rows[thinned(len(rows))]]


def along(run: RunFolder) -> dict[str, Array]:
    """Where the live path was in each state but that of plain tracking, (N, 3) m."""
    poses = run.live.poses
    frame = np.searchsorted(np.array(run.frames["t_ns"], dtype=np.int64), poses.t_ns)
    status = np.array(run.frames["status"])[frame]
    found = {state: poses.xyz[status == state] for state in get_args(Status) if state != "tracking"}
    return {state: xyz[thinned(len(xyz))] for state, xyz in found.items() if len(xyz)}


def _xyz(points: AnyArray) -> Figure:
    return {"type": "scatter3d", "x": packed(points[:, 0]), "y": packed(points[:, 1]), "z": packed(points[:, 2])}


def _box(points: AnyArray, path: Array) -> tuple[Array, Array]:
    """The path and the middle 98 % of the points in every axis, with a tenth to spare."""
    inside = np.vstack([path, np.percentile(points, (1, 99), axis=0)]) if len(points) else path
    low, high = inside.min(axis=0), inside.max(axis=0)
    spare = 0.1 * (high - low) + 0.05
    return low - spare, high + spare


def _during(xyz: Array, t_ns: AnyArray, run: RunFolder) -> Array:
    """The truth while the run lasted."""
    stamps = run.final.poses.t_ns
    inside = np.flatnonzero((t_ns >= stamps[0]) & (t_ns <= stamps[-1]))
    return xyz[inside[thinned(len(inside))]]
