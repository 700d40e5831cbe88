"""Time and memory of saving, loading, checking and exporting a large map: `python benchmarks/map_file.py`.

Each operation runs in a process of its own, so that its peak memory is its own; medians of the runs.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from lodelight.mapping.export import export_cloud, export_colmap
from lodelight.mapping.map import Map
from lodelight.mapping.store import check_map, load_map, map_info, save_map
from maps import large_map


def operations(path: Path) -> dict[str, Callable[[], object]]:
    """What is timed; those that need a map in memory load it before."""
    out = path.parent

    def with_map(use: Callable[[Map], object]) -> Callable[[], object]:
        map = load_map(path)
        return lambda: use(map)

    return {
        "load": lambda: load_map(path),
        "info": lambda: map_info(path),
        "check": lambda: check_map(path),
        "save": lambda: with_map(lambda map: save_map(map, out / "again.lode")),
        "ply": lambda: with_map(lambda map: export_cloud(map, out / "cloud.ply", "ply")),
        "colmap": lambda: with_map(lambda map: export_colmap(map, out / "colmap")),
    }


def peak_mb() -> float:
    """Peak resident memory of this program alone; getrusage counts what its parent had when it forked."""
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1000


def measure(name: str, path: Path) -> dict[str, float]:
    """Seconds of one operation, and MB of memory its process reached in all and before it began."""
    work = operations(path)[name]
    if name in ("save", "ply", "colmap"):
        work = work()  # type: ignore[assignment]
    before = peak_mb()
    start = time.perf_counter()
    work()
    seconds = time.perf_counter() - start
    return {"s": seconds, "peak_mb": peak_mb(), "before_mb": before}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--keyframes", type=int, default=2000)
    parser.add_argument("--features", type=int, default=1000)
    parser.add_argument("--points", type=int, default=100_000)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--one", nargs=2, metavar=("OPERATION", "MAP"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(measure(options.one[0], Path(options.one[1]))))
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.lode"
        save_map(large_map(options.keyframes, options.features, options.points), path)
        print(f"{options.keyframes} keyframes x {options.features} features, {options.points} points")
        print(f"{path.stat().st_size / 1e6:.0f} MB on disk")
        for name in operations(path):
            command = [sys.executable, __file__, "--one", name, str(path)]
            runs = [json.loads(subprocess.check_output(command)) for _ in range(options.runs)]
            times = sorted(run["s"] for run in runs)
            peak, before = (statistics.median(run[key] for run in runs) for key in ("peak_mb", "before_mb"))
            print(f"{name:7} {statistics.median(times):6.3f} s ({times[0]:.3f} to {times[-1]:.3f}), "
                  f"peak {peak:.0f} MB, {before:.0f} MB before")  # fmt: skip


if __name__ == "__main__":
    main()
