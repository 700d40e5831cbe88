"""Time and accuracy of the visual estimators on simulated problems: `python benchmarks/estimators.py [--full]`.

Prints docs/benchmarks-estimators.md's tables. `--full` adds the adjustment of a whole map. OpenCV and, where the extra
"reference" is installed, GTSAM solve the same problems beside.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import platform
import resource
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from estimator_scenes import LENSES, T_BODY_CAM, Walk, chart_error, random_pose, random_view, walk
from lodelight.estimation.bundle import bundle_adjust
from lodelight.estimation.pose import optimize_pose
from lodelight.estimation.posegraph import optimize_pose_graph
from lodelight.geometry.pnp import ransac_pnp
from lodelight.geometry.se3 import SE3
from test_posegraph import SIGMA, rounds

CAMERA = LENSES["radtan"]


def timed(work: Callable[[], Any]) -> tuple[float, Any]:
    """Milliseconds of processor time, which a busy machine disturbs less than the wall's."""
    start = time.process_time()
    done = work()
    return 1e3 * (time.process_time() - start), done


def spread(ms: list[float]) -> str:
    """Median, and the 95th percentile where there are enough runs for one."""
    median = f"{statistics.median(ms):.3g}"
    return median if len(ms) < 20 else f"{median} (p95 {np.percentile(ms, 95):.3g})"


def row(*cells: object) -> None:
    print("| " + " | ".join(str(cell) for cell in cells) + " |", flush=True)


def table(title: str, *heads: str) -> None:
    print(f"\n**{title}**\n")
    row(*heads)
    row(*("---" for _ in heads))


def pose() -> None:
    table("One pose against known points", "points", "depth", "wrong", "ms", "error mm", "error mdeg", "NEES / dof")
    for n, depth, wrong in ((100, 0.0, 0.0), (500, 0.0, 0.1), (500, 0.7, 0.1), (500, 0.0, 0.4), (2000, 0.7, 0.1)):
        ms, mm, mdeg, nees = [], [], [], []
        for seed in range(200):
            rng = np.random.default_rng(seed)
            truth = random_pose(rng)
            view = random_view(rng, truth, CAMERA, n, depth=depth, outliers=wrong)
            start = truth.perturbed(rng.normal(size=6) * np.array([0.02] * 3 + [0.05] * 3))
            took, found = timed(lambda: optimize_pose(start, T_BODY_CAM, CAMERA, *view.observations))  # noqa: B023
            d = chart_error(found.T_world_body, truth)
            ms.append(took)
            mm.append(1e3 * np.linalg.norm(d[3:]))
            mdeg.append(1e3 * np.degrees(np.linalg.norm(d[:3])))
            nees.append(d @ np.linalg.solve(found.covariance, d) / 6)
        row(n, f"{depth:.0%}", f"{wrong:.0%}", spread(ms), *(f"{np.mean(v):.2f}" for v in (mm, mdeg, nees)))


def pnp() -> None:
    table("A camera among wrong matches, 200 of them", "wrong", "solver", "ms", "found", "error mm")
    solvers = {"lodelight": _pnp_ours, "cv2 AP3P": _pnp_opencv(cv2.SOLVEPNP_AP3P), "cv2 MAGSAC": _pnp_opencv(None)}
    for wrong_share in (0.3, 0.5, 0.8):
        for name, solve in solvers.items():
            ms, mm = [], []
            for seed in range(100):
                rng = np.random.default_rng(seed)
                T, sigma = SE3.exp(rng.normal(size=6)), 1.0 / CAMERA.focal_px
                X = np.column_stack([rng.uniform(-0.6, 0.6, 200), rng.uniform(-0.4, 0.4, 200), np.ones(200)])
                X *= rng.uniform(1.0, 6.0, (200, 1))
                seen = X[:, :2] / X[:, 2:] + sigma * rng.normal(size=(200, 2))
                wrong = rng.random(200) < wrong_share
                seen[wrong] = rng.uniform([-0.6, -0.4], [0.6, 0.4], (int(wrong.sum()), 2))
                took, pose = timed(lambda: solve(seen, T @ X, sigma))  # noqa: B023
                ms.append(took)
                error = np.linalg.norm((T.inverse() @ pose).t) if pose is not None else np.inf
                if error < 0.1:
                    mm.append(1e3 * error)
            row(f"{wrong_share:.0%}", name, spread(ms), f"{len(mm)} %", f"{np.mean(mm):.1f}" if mm else "-")


def _pnp_ours(seen: Any, xyz: Any, sigma: float) -> SE3 | None:
    rays = np.column_stack([seen, np.ones(len(seen))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    found = ransac_pnp(rays, xyz, np.full(len(seen), sigma))
    return None if found is None else found[0]


def _pnp_opencv(flags: int | None) -> Callable[[Any, Any, float], SE3 | None]:
    def solve(seen: Any, xyz: Any, sigma: float) -> SE3 | None:
        K, seen = np.diag([1.0 / sigma, 1.0 / sigma, 1.0]), seen / sigma  # pixels of unit noise
        bound = float(np.sqrt(5.991))
        if flags is None:
            params = cv2.UsacParams()
            params.threshold, params.confidence, params.maxIterations = bound, 0.999, 2000
            params.score = cv2.SCORE_METHOD_MAGSAC
            ok, _, rvec, tvec, _ = cv2.solvePnPRansac(xyz, seen, K, None, params=params)
        else:
            ok, rvec, tvec, _ = cv2.solvePnPRansac(
                xyz, seen, K, None, iterationsCount=2000, reprojectionError=bound, confidence=0.999, flags=flags
            )
        return SE3(cv2.Rodrigues(rvec)[0], tvec.ravel()).inverse() if ok else None

    return solve


def bundle(full: bool) -> None:
    table(
        "Poses and points together",
        "keyframes",
        "points",
        "observations",
        "iterations",
        "ms",
        "error mm before",
        "after",
    )
    sizes = [(10, 1000, 4.8, 9), (30, 3000, 4.8, 9), (60, 6000, 6.0, 5)]
    sizes += [(300, 30000, 6.0, 3), (1000, 100000, 6.0, 1)] if full else []
    for keyframes, points, per_point, runs in sizes:
        made = walk(np.random.default_rng(0), CAMERA, keyframes, points, per_point=per_point, depth=0.3)
        ms = []
        for _ in range(runs):
            took, found = timed(lambda: bundle_adjust(made.problem, 8))  # noqa: B023
            ms.append(took)
        row(
            keyframes, points, len(made.problem.keyframe), len(found.cost) - 1, spread(ms),
            f"{_mm(made, made.problem.p):.1f}", f"{_mm(made, found.p):.1f}",
        )  # fmt: skip
    two_stages()


def two_stages() -> None:
    made = walk(np.random.default_rng(0), CAMERA, 30, 3000, per_point=4.8, depth=0.3, outliers=0.05)
    ms = []
    for _ in range(9):
        took, found = timed(lambda: bundle_adjust(made.problem, 5, polish=10))
        ms.append(took)
    row(
        30, 3000, len(made.problem.keyframe), f"{len(found.cost) - 2} (5 robust, then on inliers; 5 % wrong)",
        spread(ms), f"{_mm(made, made.problem.p):.1f}", f"{_mm(made, found.p):.1f}",
    )  # fmt: skip


def _mm(made: Walk, p: Any) -> float:
    """Root mean square of the positions' errors."""
    return float(1e3 * np.sqrt(np.mean(np.sum((p - [T.t for T in made.truth]) ** 2, axis=1))))


def pose_graph() -> None:
    table("Pose graph", "poses", "edges", "wrong loops", "kernel", "iterations", "ms", "error mm before", "after")
    for turns, each, wrong, kernel in (
        (4, 50, 0, "none"),
        (4, 250, 0, "none"),
        (4, 250, 0, "dcs"),
        (4, 250, 25, "dcs"),
    ):
        graph, truth = rounds(np.random.default_rng(0), each, turns, wrong=wrong)
        graph = _denser(graph, truth, 3 * len(truth))
        ms = []
        for _ in range(7):
            took, found = timed(lambda: optimize_pose_graph(graph, robust=kernel))  # noqa: B023
            ms.append(took)
        error = [1e3 * np.sqrt(np.mean(np.sum((p - [T.t for T in truth]) ** 2, axis=1))) for p in (graph.p, found.p)]
        row(
            len(truth), len(graph.a), wrong, kernel, len(found.cost) - 1, spread(ms), *(f"{e:.0f}" for e in error)
        )  # fmt: skip


def _denser(graph: Any, truth: list[SE3], edges: int) -> Any:
    """As many more edges between poses up to five apart as a covisibility graph has."""
    rng = np.random.default_rng(1)
    extra = edges - len(graph.a)
    a = rng.integers(0, len(truth) - 5, extra)
    b = a + rng.integers(2, 6, extra)
    T = [(truth[i].inverse() @ truth[j]).perturbed(SIGMA * rng.normal(size=6)) for i, j in zip(a, b, strict=True)]
    return replace(
        graph,
        a=np.append(graph.a, a),
        b=np.append(graph.b, b),
        R_ab=np.concatenate([graph.R_ab, [t.R for t in T]]),
        p_ab=np.concatenate([graph.p_ab, [t.t for t in T]]),
        information=np.concatenate([graph.information, np.tile(np.diag(SIGMA**-2.0), (extra, 1, 1))]),
        doubtful=np.append(graph.doubtful, np.zeros(extra, bool)),
    )


def gtsam_beside() -> None:
    try:
        import gtsam
    except ImportError:
        print("\nGTSAM is not installed (extra `reference`).")
        return
    table("GTSAM on the problem of 30 keyframes", "what", "ms")
    made = walk(np.random.default_rng(0), CAMERA, 30, 3000, per_point=4.8)
    fx, fy, cx, cy, k1, k2, p1, p2 = CAMERA.params[:8]
    lens = gtsam.Cal3DS2(fx, fy, 0.0, cx, cy, k1, k2, p1, p2)
    sensor = gtsam.Pose3(gtsam.Rot3(T_BODY_CAM.R), T_BODY_CAM.t)
    q, many = made.problem, np.bincount(made.problem.point, minlength=3000) > 1

    def build() -> Any:
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for k in range(30):
            values.insert(k, gtsam.Pose3(gtsam.Rot3(q.R[k]), q.p[k]))
            if q.fixed[k]:
                graph.add(gtsam.PriorFactorPose3(k, values.atPose3(k), gtsam.noiseModel.Constrained.All(6)))
        for m in np.flatnonzero(many):
            values.insert(1000 + int(m), q.xyz[m])
        for k, m, px, sigma in zip(q.keyframe, q.point, q.px, q.sigma_px, strict=True):
            if many[m]:
                noise = gtsam.noiseModel.Isotropic.Sigma(2, sigma)
                graph.add(gtsam.GenericProjectionFactorCal3DS2(px, noise, int(k), 1000 + int(m), lens, sensor))
        return graph, values

    took, (graph, values) = timed(build)
    row("building", f"{took:.0f}")
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(8)
    took, _ = timed(lambda: gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize())
    row("8 iterations", f"{took:.0f}")


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--full", action="store_true", help="also maps of 300 and 1000 keyframes (minutes)")
    full = arguments.parse_args().full
    cv2.setNumThreads(1)
    print(f"{platform.processor() or platform.machine()}, Python {platform.python_version()}, numpy {np.__version__}")
    warm = timed(lambda: bundle_adjust(walk(np.random.default_rng(1), CAMERA, 4, 40).problem, 2, covariance_of=[3]))
    print(f"kernels ready after {warm[0] / 1e3:.1f} s")
    pose()
    pnp()
    bundle(full)
    pose_graph()
    gtsam_beside()
    print(f"\npeak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3:.0f} MB")
