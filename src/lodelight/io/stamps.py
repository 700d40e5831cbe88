"""Time stamps: exact integers of nanoseconds, their order, and their association between sensors."""

from __future__ import annotations

from bisect import bisect_left
from decimal import Decimal

import numpy as np
from numpy.typing import NDArray

from lodelight.types import Bools

NS_PER_S = 1_000_000_000
LATEST_NS = 1 << 62  # the year 2116; sums and differences of such stamps fit an int64


def ns_from_seconds(text: str) -> int:
    """The nanoseconds a decimal text of seconds stands for, exactly (a float would lose 100 ns on a Unix time).

    Raises ValueError where the text is no number, or no time.
    """
    whole, point, fraction = text.partition(".")
    if point and whole.isdigit() and fraction.isdigit() and len(whole) <= 10 and len(fraction) <= 9:
        return int(whole) * NS_PER_S + int(fraction.ljust(9, "0"))
    return ns_from_text(text, NS_PER_S)


def ns_from_text(text: str, units_to_ns: int = 1) -> int:
    """The nanoseconds of any decimal text, `1.4e18` included, rounded to the nearest; ValueError as above."""
    try:
        t_ns = (Decimal(text) * units_to_ns).to_integral_value()
        if abs(t_ns) < LATEST_NS:
            return int(t_ns)
    except ArithmeticError:  # of which the errors of decimal are
        pass
    raise ValueError(f"{text!r} is no time stamp")


def seconds_text(t_ns: int) -> str:
    """Seconds with nine decimals, exactly."""
    whole, fraction = divmod(abs(t_ns), NS_PER_S)
    return f"{'-' if t_ns < 0 else ''}{whole}.{fraction:09d}"


def increasing(t_ns: NDArray[np.int64]) -> Bools:
    """Which of (N,) stamps to keep so that the kept ones strictly increase and the fewest are lost.

    The longest increasing subsequence, of several the one that takes the earlier stamps: one that jumps ahead costs
    itself, not all that follow it, and of two alike the first stays.
    """
    stamps = t_ns.tolist()
    ahead: list[int] = []  # for each length, minus the largest stamp that begins an increasing run of it
    lengths = [0] * len(stamps)
    for i in range(len(stamps) - 1, -1, -1):
        at = bisect_left(ahead, -stamps[i])
        ahead[at : at + 1] = [-stamps[i]]
        lengths[i] = at + 1
    keep = np.zeros(len(stamps), dtype=np.bool_)
    wanted, last = len(ahead), -1
    for i, t in enumerate(stamps):
        if lengths[i] == wanted and (last < 0 or t > stamps[last]):
            keep[i], last, wanted = True, i, wanted - 1
    return keep


def associate(t_a: NDArray[np.int64], t_b: NDArray[np.int64], tolerance_ns: int) -> NDArray[np.int64]:
    """For each stamp of a the index of its partner in b, or -1; closest pairs first, each of b used once.

    t_a, t_b : (N,), (M,) ns, in any order. Partners differ by no more than `tolerance_ns`.
    """
    partner = np.full(len(t_a), -1, dtype=np.int64)
    order = np.argsort(t_b, kind="stable")
    ordered = t_b[order]
    low = np.searchsorted(ordered, t_a - tolerance_ns, "left")
    high = np.searchsorted(ordered, t_a + tolerance_ns, "right")
    pairs = [
        (abs(int(ordered[k]) - int(t_a[i])), i, int(order[k]))
        for i in range(len(t_a))
        for k in range(int(low[i]), int(high[i]))
    ]
    taken: set[int] = set()
    for _, i, j in sorted(pairs):
        if partner[i] < 0 and j not in taken:
            partner[i] = j
            taken.add(j)
    return partner
