"""What is to be done over which recording, and what came of it.

A run appears in its folder at once and whole, when it is finished: a fleet that was stopped goes on with those that
are missing.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lodelight.errors import ConfigError, MapError

KEPT = "fleet.json"  # in a run's folder: what was asked for


@dataclass(frozen=True)
class Job:
    """One recording to run over; all paths absolute, for it may be done elsewhere.

    out : folder that the run becomes; options : of the run, in plain values
    """

    name: str
    source: str
    out: str
    options: dict[str, Any]


@dataclass(frozen=True)
class Outcome:
    """state : "done", "kept" from before, "lost" (no frame could be localized) or "failed", for which `why`
    metrics : as `metrics.json` has them, None where it failed
    """

    name: str
    state: str
    why: str = ""
    metrics: dict[str, Any] | None = None


Work = Callable[[Job], Outcome]


def jobs_of(recordings: Sequence[Path], out: Path, options: dict[str, Any]) -> list[Job]:
    """A job for each recording, named like it; those of one name get a part of their path's hash."""
    paths = [Path(os.path.abspath(path)) for path in recordings]
    if twice := [path for path, n in Counter(paths).items() if n > 1]:
        raise ConfigError(f"{twice[0]} is named twice; name each recording once")
    names = Counter(path.stem for path in paths)
    jobs = []
    for path in paths:
        mark = hashlib.sha256(str(path).encode()).hexdigest()[:6]
        name = path.stem if names[path.stem] == 1 else f"{path.stem}-{mark}"
        jobs.append(Job(name, str(path), str(Path(os.path.abspath(out)) / "runs" / name), options))
    return jobs


def kept(job: Job) -> Outcome | None:
    """What an earlier fleet made of this very job, if its folder holds all of it."""
    from lodelight.mapping.store import map_info

    out = Path(job.out)
    try:
        asked = json.loads((out / KEPT).read_text(encoding="utf-8"))
        metrics = json.loads((out / "metrics.json").read_text(encoding="utf-8"))
        map_info(out / "map.lode")
    except (OSError, ValueError, MapError):
        return None
    if asked != as_asked(job):
        return None
    return Outcome(job.name, "kept" if metrics["tracked_fraction"] > 0.0 else "lost", "from before", metrics)


def as_asked(job: Job) -> dict[str, Any]:
    """What makes a run another run."""
    plain: dict[str, Any] = json.loads(json.dumps({"source": job.source, "options": job.options}))
    return plain
