"""`lodelight eval`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from lodelight.evaluation.compare import Comparison
    from lodelight.evaluation.rpe import Rpe
    from lodelight.trajectory import Trajectory

app = typer.Typer(add_completion=False)


@app.command(epilog="Example: lodelight eval out/trajectory.tum recordings/room --align se3 --json")
def evaluate(
    estimate: Path = typer.Argument(..., help="Trajectory file (TUM, EuRoC, KITTI), out folder or recording."),
    truth: Path = typer.Argument(..., help="Likewise; of a recording its ground truth counts."),
    align: str = typer.Option("se3", help="se3, yaw (rotation about z), sim3 (monocular scale) or none."),
    max_dt: float = typer.Option(0.02, min=0.0, help="Largest time between an estimated pose and a true one, s."),
    as_json: bool = typer.Option(False, "--json", help="Print JSON."),
) -> None:
    """Compare a trajectory with the truth: ATE, RPE, coverage, NEES."""
    from lodelight.evaluation.compare import compare
    from lodelight.io.covariances import read_covariances

    covariances = estimate.with_name("covariance.csv")
    live = estimate.name == "trajectory_live.tum" and covariances.is_file()
    known = read_covariances(covariances) if live else None
    result = compare(_read(estimate), _read(truth), align, max_dt, known)  # type: ignore[arg-type]  # checked there
    print(json.dumps(result.as_dict(), indent=2) if as_json else _table(result))


def _read(path: Path) -> Trajectory:
    from lodelight.errors import SourceError
    from lodelight.io.trajectories import read_trajectory

    if (path / "trajectory.tum").is_file():
        path = path / "trajectory.tum"
    if not path.is_dir():
        return read_trajectory(path)
    from lodelight.io.sources import open_source

    truth = open_source(path).ground_truth()
    if truth is None:
        raise SourceError(f"{path} has no ground truth; name a trajectory file instead")
    return truth


def _table(c: Comparison) -> str:
    e = c.ate
    lines = [
        f"ATE        rmse {e.rmse_m:.4f} m, mean {e.mean_m:.4f}, median {e.median_m:.4f}, p95 {e.p95_m:.4f}, "
        f"max {e.max_m:.4f}",
        f"rotation   rmse {e.rotation_deg:.3f} deg",
        f"RPE 1 s    {_stretches(c.rpe_1s)}",
        f"RPE 1 m    {_stretches(c.rpe_1m)}",
        f"coverage   {100 * c.coverage:.1f} % of the truth, {c.pairs} of {c.estimated} poses matched, "
        f"path {c.length_m:.2f} m",
        f"alignment  {c.align}" + (f", scale {e.scale:.5f}" if c.align == "sim3" else ""),
    ]
    if c.nees is not None:
        lines.append(
            f"NEES/dof   pose {c.nees.pose:.2f}, rotation {c.nees.rotation:.2f}, position {c.nees.position:.2f}; "
            f"{100 * c.nees.within_95:.0f} % of {c.nees.poses} poses within their 95 % ellipsoid"
        )
    return "\n".join(lines)


def _stretches(r: Rpe) -> str:
    if r.translation_m is None:
        return "no such stretch"
    return f"rmse {r.translation_m:.4f} m, {r.rotation_deg:.3f} deg over {r.pairs} stretches"
