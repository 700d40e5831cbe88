"""Recordings that are lists of image files: the common half of most formats."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lodelight.errors import SourceError
from lodelight.io.depth import DepthReader
from lodelight.io.pictures import BadFrame, read_grey, read_raw
from lodelight.io.recording import Recording, Shot, Skipped
from lodelight.io.stamps import NS_PER_S, increasing, ns_from_text
from lodelight.io.text import read_table
from lodelight.messages import Frame, Imu
from lodelight.rig import CameraSpec, Rig
from lodelight.trajectory import Trajectory
from lodelight.types import Array


@dataclass(frozen=True, eq=False)
class Listing:
    """The frames of a recording, in the order of its files.

    t_ns : (N,) stamps of camera 0; images : per camera N paths, None where it took none
    depth : N paths, None where there is none near enough in time; None without a depth sensor
    bad : rows of the lists that name no frame
    """

    t_ns: NDArray[np.int64]
    images: tuple[list[Path | None], ...]
    depth: list[Path | None] | None = None
    bad: tuple[Skipped, ...] = ()


@dataclass(frozen=True, eq=False)
class ImuTable:
    """Inertial samples in the body frame. t_ns : (N,) increasing; gyro : (N, 3) rad/s; accel : (N, 3) m/s^2."""

    t_ns: NDArray[np.int64]
    gyro: Array
    accel: Array
    bad: tuple[Skipped, ...] = ()

    @staticmethod
    def read(path: Path) -> ImuTable:
        """Rows of t_ns, gyro, accel as in EuRoC's `imu0/data.csv`; unusable ones are told in `bad`."""
        table = read_table(path, 6, ns_from_text)
        keep = increasing(table.t_ns)
        bad = [Skipped(int(t), str(path), "IMU stamp is a duplicate or out of order") for t in table.t_ns[~keep]]
        return ImuTable(
            table.t_ns[keep], table.values[keep, :3], table.values[keep, 3:], (*bad_rows(path, table.bad), *bad)
        )


def bad_rows(path: Path, numbers: Iterable[int]) -> tuple[Skipped, ...]:
    """What to tell of lines that could not be read."""
    return tuple(Skipped(None, f"{path} line {number}", "row cannot be read") for number in numbers)


class ListedRecording(Recording):
    """A recording whose files are all known beforehand."""

    def __init__(
        self,
        path: Path,
        format: str,
        rig: Rig,
        listing: Listing,
        imu: ImuTable | None = None,
        truth: Callable[[], Trajectory | None] | None = None,
        lights: Listing | None = None,
    ) -> None:
        """Keeps of the rig what the files serve. Raises SourceError on an empty list."""
        if not len(listing.t_ns):
            raise SourceError(f"{path} is an empty recording: it lists no frame")
        cameras = rig.cameras[: len(listing.images)]
        cameras = tuple(spec if spec.rate_hz > 0 else _with_rate(spec, listing.t_ns) for spec in cameras)
        rig = replace(
            rig,
            cameras=cameras,
            depth=rig.depth if listing.depth is not None else None,
            imu=rig.imu if imu is not None else None,
            lights=rig.lights if lights is not None else None,
        )
        super().__init__(path, format, rig, listing.bad + (imu.bad if imu else ()))
        self._lights = lights
        self._listing = listing
        self._keep = increasing(listing.t_ns)
        self._imu_table = imu
        self._truth = truth
        self._depth_reader = DepthReader(rig.depth, rig.cameras[0]) if rig.depth else None

    @property
    def n_frames(self) -> int:
        return len(self._listing.t_ns)

    @property
    def span_ns(self) -> tuple[int, int]:
        kept = self._listing.t_ns[self._keep]
        return int(kept[0]), int(kept[-1])

    def ground_truth(self) -> Trajectory | None:
        return self._truth() if self._truth else None

    def imu(self) -> Iterator[Imu]:
        table = self._imu_table
        if table is None:
            return
        for t_ns, gyro, accel in zip(table.t_ns.tolist(), table.gyro, table.accel, strict=True):
            yield Imu(t_ns, gyro, accel)

    def shots(self, cameras: int, depth: bool) -> Iterator[Shot]:
        if depth:
            self._check_depth()
        for i, t_ns in enumerate(self._listing.t_ns.tolist()):
            path = self._listing.images[0][i]
            yield Shot(t_ns, str(path), partial(self._load, i, cameras, depth))

    def light_shots(self) -> Iterator[Shot]:
        if self._lights is None or self.rig.lights is None:
            return
        lens = self.rig.lights.camera
        keep = increasing(self._lights.t_ns)
        for t_ns, path, good in zip(self._lights.t_ns.tolist(), self._lights.images[0], keep.tolist(), strict=True):
            yield Shot(t_ns, str(path), partial(_light_frame, t_ns, path, (lens.width, lens.height), good))

    def _load(self, i: int, cameras: int, depth: bool) -> Frame:
        listing = self._listing
        t_ns = int(listing.t_ns[i])
        if not self._keep[i]:
            raise BadFrame("stamp is a duplicate or out of order")
        images = []
        for spec, paths in zip(self.rig.cameras[:cameras], listing.images, strict=False):
            path = paths[i]
            if path is None:
                raise BadFrame(f"{spec.name} has no image near enough in time")
            images.append(read_grey(path, (spec.camera.width, spec.camera.height)))
        if not depth:
            return Frame(t_ns, tuple(images))
        assert self._depth_reader is not None
        return Frame(t_ns, tuple(images), self._depth_reader.metres(self._raw_depth(i)))

    def _raw_depth(self, i: int) -> NDArray[np.uint16]:
        assert self._listing.depth is not None
        assert self.rig.depth is not None
        path = self._listing.depth[i]
        if path is None:
            raise BadFrame("no depth image near enough in time")
        lens = self.rig.depth.camera
        return read_raw(path, (lens.width, lens.height))

    def _check_depth(self) -> None:
        """Stop early where the depth is nothing at all, or in another unit than the rig says.

        Looks at five frames spread over the recording, and at the others only where these are empty.
        """
        assert self._depth_reader is not None
        spread = sorted(set(np.linspace(0, self.n_frames - 1, 5).astype(int).tolist()))
        medians = [m for i in spread if (m := self._median_depth_m(i)) is not None]
        if not any(medians):
            others = (self._median_depth_m(i) for i in range(self.n_frames) if i not in spread)
            found = next((m for m in others if m), None)
            if found is None and medians:
                raise SourceError(f"{self.path}: every depth image is zero throughout; check the depth sensor")
            medians = [found] if found else []
        if readings := [m for m in medians if m > 0]:
            self._depth_reader.check_unit(float(np.median(readings)), str(self.path))

    def _median_depth_m(self, i: int) -> float | None:
        """Of a frame's readings; 0 where it has none, None where its depth cannot be read."""
        assert self._depth_reader is not None
        try:
            return self._depth_reader.median_m(self._raw_depth(i))
        except BadFrame:
            return None


def _light_frame(t_ns: int, path: Path | None, size: tuple[int, int], in_order: bool) -> Frame:
    if not in_order:
        raise BadFrame("stamp is a duplicate or out of order")
    assert path is not None
    return Frame(t_ns, (read_grey(path, size),))


def _with_rate(spec: CameraSpec, t_ns: NDArray[np.int64]) -> CameraSpec:
    """The rate the stamps have, where the rig does not say one."""
    gap_ns = float(np.median(np.abs(np.diff(t_ns)))) if len(t_ns) > 1 else 0.0
    return replace(spec, rate_hz=round(NS_PER_S / gap_ns, 3)) if gap_ns > 0 else spec
