"""What the inertial window has left behind, kept for an adjustment of the whole flight."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lodelight.estimation.inertial_bundle import REST, ImuChain, standing
from lodelight.estimation.window_frames import prepared
from lodelight.imu.preintegration import NavState, preintegrate
from lodelight.imu.samples import ImuSamples
from lodelight.rig import ImuSpec
from lodelight.types import Array, Ints


@dataclass(eq=False)
class Flown:
    """Keyframes of the windows in the order of their stamps: state, the samples to the next one (None = a window ended
    here), the noise of the IMU at the time, and whether it stood still.

    number : by stamp, of those that are in the map
    """

    entries: list[tuple[NavState, ImuSamples | None, ImuSpec, bool]] = field(default_factory=list)
    number: dict[int, int] = field(default_factory=dict)

    def add(self, state: NavState, imu: ImuSamples | None, spec: ImuSpec, still: bool) -> None:
        self.entries.append((state, imu, spec, still))

    def chain(self, keyframes: Ints, R: Array) -> ImuChain | None:
        """Between those of the keyframes (K,), sorted, that flew; R (K, 3, 3) as they stand now, by which velocities
        are turned. Those that are not among them, or were culled, are bridged."""
        rest = np.zeros((len(keyframes), REST))
        links: list[tuple[int, int, Array, Array]] = []
        first: list[int] = []
        at_rest: list[int] = []
        stood = False  # ever since `last`
        last, since = -1, None  # row of the last keyframe, and the samples since then
        begun = False  # whether a link has come to `last`
        for state, imu, spec, still in self.entries:
            stood &= still
            keyframe = self.number.get(state.t_ns, -1)
            row = int(np.searchsorted(keyframes, keyframe)) if keyframe >= 0 else len(keyframes)
            if row < len(keyframes) and keyframes[row] == keyframe:
                if last >= 0 and since is not None:
                    bias_gyro, bias_accel = rest[last, 3:6], rest[last, 6:]
                    links.append((last, row, *prepared(preintegrate(since, bias_gyro, bias_accel, spec))))
                    links += [(last, row, *standing())] if stood else []
                    first += [] if begun else [last]
                begun = last >= 0 and since is not None
                v_world = R[row] @ state.T_world_body.R.T @ state.v_world
                rest[row] = np.concatenate([v_world, state.bias_gyro, state.bias_accel])
                last, since, stood = row, imu, still
                at_rest += [row] if still else []
            elif since is not None:
                since = None if imu is None else since.joined(imu)
            if imu is None:
                last, since, begun = -1, None, False
        if not links:
            return None
        linked = {row for link in links for row in link[:2]}
        before, after, measured, whiten = zip(*links, strict=True)
        return ImuChain(
            np.array(before, np.int32), np.array(after, np.int32), np.stack(measured), np.stack(whiten),
            np.array(first, np.int32), rest, np.array([k for k in at_rest if k in linked], np.int32),
        )  # fmt: skip
