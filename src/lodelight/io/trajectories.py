"""Trajectory files: TUM text, EuRoC csv, KITTI poses; read by content, written whole."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from lodelight.errors import SourceError
from lodelight.geometry.se3 import SE3
from lodelight.io.rosbag import recognize
from lodelight.io.rosbag_poses import read_poses
from lodelight.io.stamps import ns_from_seconds, ns_from_text, seconds_text
from lodelight.io.text import Table, fields, lines, read_table, write_text
from lodelight.trajectory import Trajectory

EUROC_HEADER = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []\n"


def read_trajectory(path: str | Path, times: str | Path | None = None) -> Trajectory:
    """The poses of a file, sorted by stamp; of rows with one stamp the first counts.

    TUM: `t_s tx ty tz qx qy qz qw`, blanks. EuRoC: `t_ns,px,py,pz,qw,qx,qy,qz,...`, commas; further columns are
    left alone. KITTI: twelve numbers of a 3x4 matrix per row, stamps in seconds from `times` or from `times.txt`
    beside the poses. A ROS bag: the poses in it, as `read_poses` finds them. Raises SourceError with file and line.
    """
    path = Path(path)
    if recognize(path):
        return read_poses(path)
    number, line = next(lines(path), (0, ""))
    width = len(fields(line))
    if not width:
        raise SourceError(f"trajectory {path} is empty; expected TUM text, EuRoC csv or KITTI poses")
    if "," in line and width >= 8:
        return _from_table(path, read_table(path, 7, ns_from_text), quat_columns=[4, 5, 6, 3])
    if width == 8:
        return _from_table(path, read_table(path, 7, ns_from_seconds), quat_columns=[3, 4, 5, 6])
    if width == 12:
        return _read_kitti(path, Path(times) if times else path.parent / "times.txt")
    raise SourceError(
        f"{path} line {number}: {width} columns are no pose; expected TUM (8, blanks), EuRoC (8 or more, commas) "
        "or KITTI (12, blanks)"
    )


def write_tum(path: str | Path, trajectory: Trajectory) -> None:
    """`t_s tx ty tz qx qy qz qw`, nine decimals, T_world_body."""
    lines = ["# timestamp tx ty tz qx qy qz qw\n"]
    for t, p, q in _listed(trajectory):
        lines.append(" ".join([seconds_text(t), *(f"{v:.9f}" for v in (*p, *q))]) + "\n")
    write_text(Path(path), "".join(lines))


def write_euroc(path: str | Path, trajectory: Trajectory) -> None:
    """`t_ns,px,py,pz,qw,qx,qy,qz` as in EuRoC's state_groundtruth_estimate0, without velocity and biases."""
    lines = [EUROC_HEADER]
    for t, p, (x, y, z, w) in _listed(trajectory):
        lines.append(",".join([str(t), *(f"{v:.9f}" for v in (*p, w, x, y, z))]) + "\n")
    write_text(Path(path), "".join(lines))


def write_kitti(path: str | Path, trajectory: Trajectory) -> None:
    """3x4 matrices by rows; the stamps go to `times.txt` beside them, in seconds."""
    path = Path(path)
    matrices = (trajectory.pose(i).matrix[:3].ravel() for i in range(len(trajectory)))
    write_text(path, "".join(" ".join(f"{v:.9e}" for v in row) + "\n" for row in matrices))
    write_text(path.parent / "times.txt", "".join(seconds_text(t) + "\n" for t in trajectory.t_ns.tolist()))


WRITERS: dict[str, Callable[[str | Path, Trajectory], None]] = {
    ".tum": write_tum,
    ".txt": write_tum,
    ".csv": write_euroc,
    ".kitti": write_kitti,
}


def write_trajectory(path: str | Path, trajectory: Trajectory) -> None:
    """Write in the format the name ends in: `.tum` or `.txt`, `.csv` (EuRoC), `.kitti`."""
    suffix = Path(path).suffix.lower()
    if suffix not in WRITERS:
        raise SourceError(f"{path}: unknown trajectory format; end the name in one of {', '.join(WRITERS)}")
    WRITERS[suffix](path, trajectory)


def _listed(trajectory: Trajectory) -> zip[tuple[int, list[float], list[float]]]:
    return zip(trajectory.t_ns.tolist(), trajectory.xyz.tolist(), trajectory.quat_xyzw.tolist(), strict=True)


def _from_table(path: Path, table: Table, quat_columns: list[int]) -> Trajectory:
    if table.bad:
        raise SourceError(f"{path} line {table.bad[0]} is no pose: a stamp and seven finite numbers expected")
    quat = table.values[:, quat_columns]
    norm = np.linalg.norm(quat, axis=1)
    if (norm < 0.1).any():
        t = seconds_text(int(table.t_ns[np.argmin(norm)]))
        raise SourceError(f"{path}: the quaternion at {t} s has length {norm.min():.3g}, a rotation's is 1")
    t_ns, first = np.unique(table.t_ns, return_index=True)
    return Trajectory(t_ns, table.values[first, :3].copy(), (quat / norm[:, None])[first])


def _read_kitti(path: Path, times: Path) -> Trajectory:
    if not times.is_file():
        raise SourceError(f"{path} holds KITTI poses, which have no stamps; put them in {times}, in seconds")
    poses = [_kitti_pose(path, number, line) for number, line in lines(path)]
    try:
        t_ns = [ns_from_seconds(fields(line)[0]) for _, line in lines(times)]
    except ValueError as error:
        raise SourceError(f"{times}: {error}") from None
    if len(t_ns) != len(poses):
        raise SourceError(f"{path} has {len(poses)} poses but {times} {len(t_ns)} stamps; they must pair up")
    return Trajectory.from_poses(t_ns, poses)


def _kitti_pose(path: Path, number: int, line: str) -> SE3:
    try:
        return SE3.from_matrix(np.array([float(v) for v in fields(line)]).reshape(3, 4))
    except (ValueError, np.linalg.LinAlgError):
        raise SourceError(f"{path} line {number} is no pose: twelve finite numbers expected") from None
