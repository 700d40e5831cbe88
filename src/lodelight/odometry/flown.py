"""What the inertial window has left behind, kept for an adjustment of the whole flight."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from lodelight.estimation.inertial_bundle import REST, ImuChain, standing
from lodelight.estimation.window_frames import prepared
from lodelight.imu.preintegration import NavState, preintegrate
from lodelight.imu.samples import ImuSamples
from lodelight.rig import ImuSpec
from lodelight.types import Array, Bools, Ints

# Keyframes farther apart are not linked. The noise of a flying IMU, 0.02 m/s^2/sqrt(Hz), grows to 6 cm in 3 s and to
# 37 cm in 10; images of a known space know the way to a centimetre.
LONGEST_LINK_S = 3.0


@dataclass(frozen=True, eq=False)
class Leg:
    """A keyframe as the window saw it last, and the way to the next one.

    imu : on that way, None = there is no next one, or none near enough; spec : its noise at the time
    still : the keyframe stands still; stood : and so does the whole way
    """

    state: NavState
    imu: ImuSamples | None
    spec: ImuSpec
    still: bool
    stood: bool

    def joined(self, later: Leg) -> Leg:
        """The way on through `later`, whose keyframe is gone."""
        imu = None if self.imu is None or later.imu is None else self.imu.joined(later.imu)
        if imu is not None and imu.t_ns[-1] - imu.t_ns[0] > LONGEST_LINK_S * 1e9:
            imu = None
        return replace(self, imu=imu, stood=self.stood and later.stood)


@dataclass(eq=False)
class Flown:
    """Keyframes of the windows in the order of their stamps; number : by stamp, of those that came into the map."""

    legs: list[Leg] = field(default_factory=list)
    number: dict[int, int] = field(default_factory=dict)

    def add(self, state: NavState, imu: ImuSamples | None, spec: ImuSpec, still: bool) -> None:
        self.legs.append(Leg(state, imu, spec, still, still))

    def thin(self, alive: Bools, until_ns: int) -> None:
        """Forget keyframes that are not in the map, or not alive (K,) there, up to a stamp; ways go on through them."""
        self.number = {t_ns: keyframe for t_ns, keyframe in self.number.items() if alive[keyframe]}
        kept: list[Leg] = []
        for leg in self.legs:
            if leg.state.t_ns in self.number or leg.state.t_ns > until_ns:
                kept.append(leg)
            elif kept:
                kept[-1] = kept[-1].joined(leg)
        self.legs = kept

    def chain(self, keyframes: Ints, R: Array) -> ImuChain | None:
        """Between those of the keyframes (K,), sorted, that flew; R (K, 3, 3) as they stand now, by which velocities
        are turned."""
        alive = np.zeros(max(max(self.number.values(), default=0), int(keyframes.max(initial=0))) + 1, np.bool_)
        alive[keyframes] = True
        self.thin(alive, self.legs[-1].state.t_ns if self.legs else 0)
        rest = np.zeros((len(keyframes), REST))
        links: list[tuple[int, int, Array, Array]] = []
        first: list[int] = []
        before: Leg | None = None  # the one that this one's way comes from
        last = -1  # its row
        for leg in self.legs:
            row = int(np.searchsorted(keyframes, self.number[leg.state.t_ns]))
            v_world = R[row] @ leg.state.T_world_body.R.T @ leg.state.v_world
            rest[row] = np.concatenate([v_world, leg.state.bias_gyro, leg.state.bias_accel])
            if before is not None and before.imu is not None:
                motion = preintegrate(before.imu, rest[last, 3:6], rest[last, 6:], leg.spec)
                first += [] if links and links[-1][1] == last else [last]
                links.append((last, row, *prepared(motion)))
                links += [(last, row, *standing())] if before.stood and leg.still else []
            before, last = leg, row
        if not links:
            return None
        linked = {row for link in links for row in link[:2]}
        still = [int(np.searchsorted(keyframes, self.number[leg.state.t_ns])) for leg in self.legs if leg.still]
        befores, afters, measured, whiten = zip(*links, strict=True)
        return ImuChain(
            np.array(befores, np.int32), np.array(afters, np.int32), np.stack(measured), np.stack(whiten),
            np.array(first, np.int32), rest, np.array([row for row in still if row in linked], np.int32),
        )  # fmt: skip
