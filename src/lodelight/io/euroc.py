"""EuRoC/ASL folders (`mav0/`), TUM-VI and what this project's simulator writes among them.

Source: Burri et al. 2016 for the layout; Schubert et al. 2018 for TUM-VI (equidistant lenses, `mocap0`, Kalibr files).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodelight.errors import CalibrationError, SourceError
from lodelight.geometry.se3 import SE3
from lodelight.io.calibrations import euroc_camera, euroc_depth, imu_spec, kalibr_rig
from lodelight.io.listing import ImuTable, ListedRecording, Listing, bad_rows
from lodelight.io.recording import Skipped
from lodelight.io.stamps import NS_PER_S, associate, ns_from_text
from lodelight.io.text import lines, read_files
from lodelight.io.trajectories import read_trajectory
from lodelight.io.yaml_file import read_yaml
from lodelight.rig import CameraSpec, ImuSpec, Rig
from lodelight.trajectory import Trajectory

FORMAT = "euroc"
TOLERANCE_NS = 5_000_000
TRUTHS = ("state_groundtruth_estimate0", "mocap0", "vicon0")


def recognize(path: Path) -> bool:
    return (path / "mav0").is_dir()


def open_euroc(path: Path, rig: Rig | None) -> ListedRecording:
    """Images of cam1, depth0 belong to the image of cam0 nearest in time: within 5 ms and half a frame period."""
    mav = path / "mav0"
    folders = sorted(folder for folder in mav.glob("cam[0-9]") if (folder / "data.csv").is_file())
    if not folders:
        raise SourceError(f"{mav} has no cam0/data.csv; an EuRoC recording lists its images there")
    rig = rig or _folder_rig(path, folders)
    lists = [_Images.read(folder) for folder in folders[: len(rig.cameras)]]
    first, offset_s = lists[0], rig.cameras[0].time_offset_s
    images: list[list[Path | None]] = [
        first.paired(other, round((spec.time_offset_s - offset_s) * NS_PER_S))
        for other, spec in zip(lists, rig.cameras, strict=False)
    ]
    depth: list[Path | None] | None = None
    bad = tuple(skip for images_of in lists for skip in images_of.bad)
    if (mav / "depth0" / "data.csv").is_file():
        readings = _Images.read(mav / "depth0")
        depth, bad = first.paired(readings, round(-offset_s * NS_PER_S)), bad + readings.bad
    imu_file = mav / "imu0" / "data.csv"
    lights = _Images.read(mav / "light0") if (mav / "light0" / "data.csv").is_file() else None
    return ListedRecording(
        path,
        FORMAT,
        rig,
        Listing(first.t_ns, tuple(images), depth, bad),
        imu=ImuTable.read(imu_file) if imu_file.is_file() else None,
        truth=lambda: _truth(path),
        lights=None if lights is None else Listing(lights.t_ns, ([*lights.files],), bad=lights.bad),
    )


@dataclass(frozen=True, eq=False)
class _Images:
    """One `data.csv` of images: t_ns (N,), their files, and what could not be read."""

    t_ns: NDArray[np.int64]
    files: list[Path]
    bad: tuple[Skipped, ...]

    @staticmethod
    def read(folder: Path) -> _Images:
        t_ns, names, bad = read_files(folder / "data.csv", ns_from_text)
        files = [folder / "data" / name for name in names]
        return _Images(t_ns, files, bad_rows(folder / "data.csv", bad))

    def paired(self, other: _Images, ahead_ns: int) -> list[Path | None]:
        """For each of these images the other's nearest in time; `ahead_ns` is added to the other's stamps."""
        if other is self:
            return [*self.files]
        period_ns = int(np.median(np.abs(np.diff(self.t_ns)))) if len(self.t_ns) > 1 else 2 * TOLERANCE_NS
        partner = associate(self.t_ns, other.t_ns + ahead_ns, min(TOLERANCE_NS, period_ns // 2))
        return [other.files[j] if j >= 0 else None for j in partner.tolist()]


def _folder_rig(root: Path, folders: list[Path]) -> Rig:
    """From the `sensor.yaml` files, else from the Kalibr files TUM-VI comes with. The body is the IMU."""
    mav = root / "mav0"
    if not (folders[0] / "sensor.yaml").is_file():
        chains = [file for folder in (root, root / "dso", mav) for file in sorted(folder.glob("*camchain*.yaml"))]
        if not chains:
            raise CalibrationError(
                f"{folders[0]} has no sensor.yaml, {root} no camchain.yaml; add one or give --rig FILE"
            )
        return kalibr_rig(chains[0])
    cameras = tuple(euroc_camera(read_yaml(folder / "sensor.yaml"), folder.name) for folder in folders)
    lights_file, depth_file = mav / "light0" / "sensor.yaml", mav / "depth0" / "sensor.yaml"
    imu_file = mav / "imu0" / "sensor.yaml"
    lights = euroc_camera(read_yaml(lights_file), "light0") if lights_file.is_file() else None
    depth = euroc_depth(read_yaml(depth_file), cameras[0]) if depth_file.is_file() else None
    imu: ImuSpec | None = None
    T_imu_body = SE3.identity()
    if imu_file.is_file():
        yaml = read_yaml(imu_file)
        imu, T_imu_body = imu_spec(yaml), _pose_on_body(mav, "imu0").inverse()

    def seen_from_imu(spec: CameraSpec) -> CameraSpec:
        return replace(spec, T_body_cam=T_imu_body @ spec.T_body_cam)

    return Rig(
        tuple(map(seen_from_imu, cameras)),
        depth=replace(depth, T_body_depth=T_imu_body @ depth.T_body_depth) if depth else None,
        imu=imu,
        lights=seen_from_imu(lights) if lights else None,
    )


def _pose_on_body(mav: Path, sensor: str) -> SE3:
    """T_BS of a sensor in the recording's own body frame, identity where the file does not say."""
    file = mav / sensor / "sensor.yaml"
    if not file.is_file():
        return SE3.identity()
    yaml = read_yaml(file)
    return yaml.motion("T_BS") if "T_BS" in yaml else SE3.identity()


def _truth(root: Path) -> Trajectory | None:
    """T_world_body from the ground truth folders of EuRoC and TUM-VI, or from a lone csv in `groundtruth/`."""
    mav = root / "mav0"
    for name in TRUTHS:
        if (mav / name / "data.csv").is_file() and any(lines(mav / name / "data.csv")):  # one is laid out empty
            truth = read_trajectory(mav / name / "data.csv")
            T_sensor_imu = _pose_on_body(mav, name).inverse() @ _pose_on_body(mav, "imu0")
            return _on(truth, T_sensor_imu)
    lone = sorted((root / "groundtruth").glob("*.csv"))
    return read_trajectory(lone[0]) if len(lone) == 1 else None


def _on(trajectory: Trajectory, T_sensor_body: SE3) -> Trajectory:
    """Of a body fixed to the sensor whose trajectory this is."""
    if np.array_equal(T_sensor_body.matrix, np.eye(4)):
        return trajectory
    poses = [trajectory.pose(i) @ T_sensor_body for i in range(len(trajectory))]
    return Trajectory.from_poses(trajectory.t_ns.tolist(), poses)
