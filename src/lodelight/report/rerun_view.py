"""A run watched while it goes on, or recorded to be scrubbed: the one place that knows rerun.

An observer: it is handed what a system has said already, as plain arrays, and nothing knows of it. Entities:
`world/points`, `keyframes`, `path`, `tags`, `lights`; `world/camera/image` with `tracks` and `tags`; `lights/seen` in
the light camera's image plane; `plots/...`; `log`.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from lodelight.errors import ConfigError, SourceError
from lodelight.messages import Estimate, LightSighting, TagSighting
from lodelight.report.figures import STATE_COLOURS
from lodelight.report.rerun_web import GRPC_PORT, free_port, serve
from lodelight.rig import Rig
from lodelight.types import AnyArray, Array, Bools, Bytes

JPEG_QUALITY = 75
PATH_CHUNK = 200  # poses of the path in one entity, which is sent anew with every pose
MAX_POINTS = 100_000
MAPPED, NEW, TAG, LIGHT, KEYFRAME = "#2fa866", "#f0b429", "#e0443e", "#a05fd6", "#f08a24"
TOLD = {"state", "loop", "relocalized", "aligned", "tag", "tags", "dropped", "light"}  # events worth a line


@dataclass(frozen=True, eq=False)
class Sight:
    """What one frame showed. tracks_px (N, 2), of which `mapped` (N,) are map points; lights : in their own camera"""

    image: Bytes | None = None
    tracks_px: Array = field(default_factory=lambda: np.zeros((0, 2)))
    mapped: Bools = field(default_factory=lambda: np.zeros(0, np.bool_))
    tags: Sequence[TagSighting] = ()
    lights: Sequence[LightSighting] = ()


@dataclass(frozen=True, eq=False)
class Scene:
    """What is known of the building. xyz (N, 3) m, keyframes (K, 3) m; tags : corners (4, 3) m; lights : (3,) m"""

    xyz: Array
    keyframes: Array
    tags: Mapping[str, Array] = field(default_factory=dict)
    lights: Mapping[str, Array] = field(default_factory=dict)


class RerunView:
    """Shows a run in a window of its own, in a browser, and in a file, in any of them at once.

    window : opens rerun's viewer; web : serves one, and `url` is its address; rrd : file to write
    Raises ConfigError where rerun or a display is missing, SourceError where the file cannot be written.
    """

    def __init__(self, name: str, rig: Rig, window: bool = False, web: bool = False, rrd: Path | None = None) -> None:
        self._rr = rr = _rerun()
        self._rig = rig
        self._path: list[Array] = []
        self._frame = 0
        self._status = ""
        self._t0_ns: int | None = None
        self.url = ""
        self._stream = rr.RecordingStream("lodelight", recording_id=f"{name}-{os.urandom(4).hex()}")
        sinks: list[Any] = []
        if rrd is not None:
            sinks.append(_file_sink(rr, rrd))
        if window:
            _check_display()
            port = free_port(GRPC_PORT)
            rr.spawn(connect=False, port=port, hide_welcome_screen=True)
            sinks.append(rr.GrpcSink(f"rerun+http://127.0.0.1:{port}/proxy"))
        if web:
            server, self.url = serve(rr)
            sinks.append(server)
        rr.set_sinks(*sinks, default_blueprint=_layout(), recording=self._stream)
        self._log("world", getattr(rr.ViewCoordinates, _up(rig)), static=True)

    def frame(self, estimate: Estimate, sight: Sight) -> None:
        """One frame, with what it showed."""
        rr = self._rr
        self._set_time(estimate.t_ns)
        self._frame += 1
        if estimate.status != self._status:
            self.event(estimate.t_ns, "state", now=estimate.status, why=estimate.why)
            self._status = estimate.status
        camera, T_world_cam = self._rig.cameras[0].camera, estimate.T_world_body @ self._rig.cameras[0].T_body_cam
        if estimate.localized:
            self._log("world/camera", rr.Transform3D(translation=T_world_cam.t, mat3x3=T_world_cam.R))
            self._log_path(estimate.T_world_body.t)
        pinhole = rr.Pinhole(
            focal_length=list(camera.params[:2]), principal_point=list(camera.params[2:4]),
            resolution=[camera.width, camera.height], image_plane_distance=0.3,
            color=tuple(_rgb(STATE_COLOURS[estimate.status]).tolist()),
        )  # fmt: skip
        self._log("world/camera/image", pinhole)
        if sight.image is not None:
            _, jpeg = cv2.imencode(".jpg", sight.image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
            self._log("world/camera/image", rr.EncodedImage(contents=jpeg.tobytes(), media_type="image/jpeg"))
        colours = np.where(sight.mapped[:, None], _rgb(MAPPED), _rgb(NEW))
        self._log("world/camera/image/tracks", rr.Points2D(sight.tracks_px, colors=colours, radii=1.5))
        rings = [np.vstack([tag.corners_px, tag.corners_px[:1]]) for tag in sight.tags]
        self._log(
            "world/camera/image/tags",
            rr.LineStrips2D(rings, colors=_rgb(TAG), radii=1.0, labels=[tag.name for tag in sight.tags]),
        )
        spots = np.array([light.centre_px for light in sight.lights]).reshape(-1, 2)
        names = [light.id or "?" for light in sight.lights]
        self._log("lights/seen", rr.Points2D(spots, colors=_rgb(LIGHT), radii=6.0, labels=names))
        for name, value in {"inliers": estimate.inliers, "track_ms": estimate.details.get("track_ms")}.items():
            if value is not None:
                self._log(f"plots/{name}", rr.Scalars(float(value)))

    def scene(self, scene: Scene) -> None:
        """The map as it stands now."""
        rr = self._rr
        xyz = scene.xyz[:: max(1, len(scene.xyz) // MAX_POINTS)]
        self._log("world/points", rr.Points3D(xyz, colors=_by_height(xyz), radii=-1.0))
        self._log("world/keyframes", rr.Points3D(scene.keyframes, colors=_rgb(KEYFRAME), radii=-3.0))
        rings = [np.vstack([corners, corners[:1]]) for corners in scene.tags.values()]
        self._log("world/tags", rr.LineStrips3D(rings, colors=_rgb(TAG), labels=list(scene.tags), radii=-2.0))
        spots = np.array(list(scene.lights.values())).reshape(-1, 3)
        self._log("world/lights", rr.Points3D(spots, colors=_rgb(LIGHT), labels=list(scene.lights), radii=-6.0))

    def event(self, t_ns: int | None, kind: str, **fields: Any) -> None:
        """A line of the log, for those events that tell of more than one frame."""
        if kind not in TOLD:
            return
        if t_ns is not None:
            self._set_time(t_ns)
        rest = ", ".join(
            f"{name} {value}" for name, value in fields.items() if name != "why" and value not in ("", None)
        )
        text = f"{kind}: {': '.join(filter(None, [rest, str(fields.get('why') or '')]))}"
        level = "WARN" if fields.get("now") in ("lost", "degraded") else "INFO"
        self._log("log", self._rr.TextLog(text, level=level))

    def close(self) -> None:
        """Everything is written, or on its way."""
        self._stream.flush()

    # -- parts --------------------------------------------------------------------------------------------------

    def _log(self, path: str, what: Any, static: bool = False) -> None:
        self._rr.log(path, what, static=static, recording=self._stream)

    def _set_time(self, t_ns: int) -> None:
        self._t0_ns = t_ns if self._t0_ns is None else self._t0_ns
        self._rr.set_time("time", duration=(t_ns - self._t0_ns) * 1e-9, recording=self._stream)
        self._rr.set_time("frame", sequence=self._frame, recording=self._stream)

    def _log_path(self, p: Array) -> None:
        """Append to the path; chunks overlap by one pose, so that the line has no gap."""
        self._path.append(p)
        chunk = (len(self._path) - 1) // PATH_CHUNK
        strip = np.array(self._path[max(chunk * PATH_CHUNK - 1, 0) :])
        if len(strip) > 1:
            self._log(f"world/path/{chunk}", self._rr.LineStrips3D([strip], colors=_rgb("#2f7ff0"), radii=-1.5))


def _rerun() -> Any:
    """The module, with its analytics switched off first."""
    try:
        import rerun_bindings  # noqa: F401  (there, and not imported for what it does)
    except ImportError:
        raise ConfigError('watching a run needs rerun; pip install "lodelight[viewer]"') from None
    subprocess.run([sys.executable, "-m", "rerun", "analytics", "disable"], capture_output=True, check=False)
    import rerun

    return rerun


def _file_sink(rr: Any, path: Path) -> Any:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.open("wb").close()
    except OSError as error:
        raise SourceError(f"cannot write {path}: {error.strerror}; choose another --rrd") from None
    return rr.FileSink(str(path))


def _check_display() -> None:
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ConfigError("--view needs a display; use --web to watch in a browser, or --rrd FILE to watch later")


def _layout() -> Any:
    import rerun.blueprint as rrb

    right = rrb.Vertical(
        rrb.Spatial2DView(origin="world/camera/image", name="camera"),
        rrb.TimeSeriesView(origin="plots", name="inliers, ms"),
        rrb.TextLogView(origin="log", name="states and events"),
        row_shares=[3, 2, 2],
    )
    world = rrb.Spatial3DView(
        origin="world", name="map", contents=["$origin/**", "- world/camera/image/tracks", "- world/camera/image/tags"]
    )
    return rrb.Blueprint(rrb.Horizontal(world, right, column_shares=[3, 2]), collapse_panels=True)


def _up(rig: Rig) -> str:
    """Which axis of a map that begins with this rig points up: z with an IMU, else as its camera was held."""
    if rig.imu is not None:
        return "RIGHT_HAND_Z_UP"
    up = -rig.cameras[0].T_body_cam.R[:, 1]
    axis = int(np.argmax(np.abs(up)))
    return f"RIGHT_HAND_{'XYZ'[axis]}_{'UP' if up[axis] > 0 else 'DOWN'}"


def _rgb(colour: str) -> AnyArray:
    return np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)], np.uint8)


def _by_height(xyz: Array) -> AnyArray:
    """(N, 3) viridis by the third coordinate, between its second and last but second percentile."""
    if len(xyz) == 0:
        return np.zeros((0, 3), np.uint8)
    low, high = np.percentile(xyz[:, 2], (2, 98))
    share = np.clip((xyz[:, 2] - low) / max(high - low, 1e-6), 0.0, 1.0)
    bgr = cv2.applyColorMap((255 * share).astype(np.uint8).reshape(-1, 1), cv2.COLORMAP_VIRIDIS)
    rgb: AnyArray = bgr.reshape(-1, 3)[:, ::-1]
    return rgb
