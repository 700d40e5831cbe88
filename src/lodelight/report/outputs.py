"""The out folder of a run: events as they happen, everything else at the end.

Same input, same seed, same bytes; wall times stand in `metrics.json`, `frames.csv` and `report.html` alone.
"""

from __future__ import annotations

import contextlib
import json
import platform
import threading
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import tomli_w

from lodelight import __version__
from lodelight.anchors import Anchors, Tag
from lodelight.errors import SourceError
from lodelight.evaluation.align import Mode
from lodelight.io.anchors_toml import write_anchors
from lodelight.io.clouds import write_ply
from lodelight.io.covariances import write_covariances
from lodelight.io.text import write_text
from lodelight.io.trajectories import write_tum
from lodelight.messages import Estimate
from lodelight.report.frame_log import FrameLog
from lodelight.report.html import write_report
from lodelight.report.metrics import ate_entry, peak_rss_mb, spread_ms, state_fractions, with_map_stats
from lodelight.report.plain import json_line, plain
from lodelight.trajectory import Trajectory
from lodelight.types import AnyArray

FILES = (
    *("config.toml", "events.jsonl", "frames.csv", "trajectory.tum", "trajectory_live.tum", "covariance.csv"),
    *("cloud.ply", "anchors.toml", "metrics.json", "report.html"),
)


class Outputs:
    """Owns the out folder from its creation to `finish`; `with Outputs(...)` closes the events on an error.

    config : everything in force, seed included, in tables as TOML has them; what is None is left out
    An earlier run's files of the same names are removed first. Raises SourceError where the folder cannot be written.
    """

    def __init__(self, out: Path, config: dict[str, Any]) -> None:
        self.out = Path(out)
        self._frames = FrameLog()
        self._why = ""  # of the last frame
        self._lock = threading.Lock()
        try:
            self.out.mkdir(parents=True, exist_ok=True)
            for name in FILES:
                (self.out / name).unlink(missing_ok=True)
            self._events = (self.out / "events.jsonl").open("w", encoding="utf-8", newline="\n")
        except OSError as error:
            raise SourceError(f"cannot write {self.out}: {error.strerror}; choose another --out") from None
        write_text(self.out / "config.toml", tomli_w.dumps(_without_none(plain(config)) | {"versions": versions()}))

    def event(self, t_ns: int | None, kind: str, **fields: Any) -> None:
        """One line of `events.jsonl`, on disk when this returns; from any thread."""
        line = json_line({"t_ns": t_ns, "kind": kind, **fields})
        try:
            with self._lock:
                self._events.write(line)
                self._events.flush()
        except OSError as error:
            raise self._unwritten(error) from None

    def frame(self, estimate: Estimate, track_ms: float, map_ms: float, **details: float) -> None:
        """A frame's estimate as it was at the time; a change of state becomes an event.

        track_ms : from the decoded image to its pose; map_ms : mapping done for this frame, 0 where it was none
        details : further columns of `frames.csv`
        """
        before = self._frames.status[-1] if len(self._frames) else None
        if estimate.status != before:
            self.event(estimate.t_ns, "state", before=before, now=estimate.status, why=estimate.why)
        self._frames.add(estimate, track_ms, map_ms, details)
        self._why = estimate.why

    def finish(
        self,
        final: Trajectory,
        cloud_xyz: AnyArray,
        map_stats: dict[str, Any],
        truth: Trajectory | None,
        *,
        wall_s: float,
        compile_s: float,
        recording_s: float,
        align: Mode = "se3",
        tags: Sequence[Tag] = (),
    ) -> dict[str, Any]:
        """Write every file and return what `metrics.json` holds.

        final : poses as known at the end; cloud_xyz : (N, 3) m map points
        map_stats : keyframes, map_points, gate, temporary_points, loops, relocalizations, and what else is worth saying
        wall_s : of the whole run; compile_s : spent in it on compiling; recording_s : length of what was run
        align : how the error against the truth is measured (sim3 for a scale that was free; none for a path in the
            world, of which the live one then counts from the frame on that was)
        tags : as they were found; into `anchors.toml`, and their corners into the cloud
        """
        frames, localized = self._frames, self._frames.column("localized").astype(np.bool_)
        if len(frames) and not localized[-1]:  # what was missing to the end
            status = frames.status[-1]
            self.event(int(frames.column("t_ns")[-1]), "state", before=status, now=status, why=self._why)
        self.close()
        live = frames.trajectory(localized)
        write_tum(self.out / "trajectory.tum", final)
        write_tum(self.out / "trajectory_live.tum", live)
        write_covariances(self.out / "covariance.csv", live.t_ns.tolist(), frames.covariances(localized))
        write_text(self.out / "frames.csv", frames.csv())
        write_cloud(self.out / "cloud.ply", cloud_xyz, tags)
        write_anchors(self.out / "anchors.toml", Anchors(tuple(tags)))
        track_ms, map_ms = frames.column("ms").reshape(-1, 2).T.tolist()
        metrics: dict[str, Any] = {
            "frames": len(frames),
            "tracked_fraction": int(localized.sum()) / max(len(frames), 1),
            **with_map_stats(map_stats),
            "ms_per_frame": spread_ms(track_ms),
            "ms_per_keyframe": spread_ms([mapping for mapping in map_ms if mapping > 0]),
            "compile_s": compile_s,
            "real_time_factor": (wall_s - compile_s) / recording_s if recording_s > 0 else None,
            "peak_rss_mb": peak_rss_mb(),
            "states": state_fractions(frames.status),
            "ate": None,
        }
        if truth is not None:
            aligned = frames.column("aligned").astype(np.bool_)
            then = frames.trajectory(localized if align != "none" else localized & aligned)
            metrics["ate"] = {"final": ate_entry(final, truth, align), "live": ate_entry(then, truth, align)}
        metrics = plain(metrics)
        write_text(self.out / "metrics.json", json.dumps(metrics, indent=2) + "\n")
        write_report(self.out, truth, align)
        return metrics

    def close(self) -> None:
        """No more events. Raises SourceError where the last of them did not reach the disk."""
        try:
            self._events.close()
        except OSError as error:
            raise self._unwritten(error) from None

    def _unwritten(self, error: OSError) -> SourceError:
        return SourceError(
            f"cannot write {self.out / 'events.jsonl'}: {error.strerror}; make room or choose another --out"
        )

    def __enter__(self) -> Outputs:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        with contextlib.suppress(SourceError) if error else contextlib.nullcontext():
            self.close()


def write_cloud(path: Path, xyz: AnyArray, tags: Sequence[Tag]) -> None:
    """Points (N, 3) m with `tag` 0, then four corners of each placed tag with its number, which comments name."""
    placed = [tag for tag in tags if tag.corners_world is not None]
    corners = [tag.corners_world for tag in placed if tag.corners_world is not None]
    number = np.concatenate([np.zeros(len(xyz)), np.repeat(np.arange(1, len(placed) + 1), 4)]).astype(np.int32)
    comments = [f"tag {i} is {tag.family} {tag.id}" for i, tag in enumerate(placed, 1)]
    write_ply(path, np.concatenate([xyz, *corners]), comments=comments, tag=number)


def versions() -> dict[str, str]:
    """What the run was made with."""
    import cv2
    import numba
    import numpy

    modules = {"numpy": numpy, "numba": numba, "opencv": cv2}
    found = {name: str(module.__version__) for name, module in modules.items()}
    return {"lodelight": __version__, "python": platform.python_version()} | found


def _without_none(table: dict[str, Any]) -> dict[str, Any]:
    """TOML has no null: a setting that is absent was not set."""
    return {k: _without_none(v) if isinstance(v, dict) else v for k, v in table.items() if v is not None}
