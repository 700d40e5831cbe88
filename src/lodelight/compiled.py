"""The one decorator for hot loops: numba, cached on disk, releasing the GIL, IEEE arithmetic.

No fastmath and no parallel reductions: sums keep their order, so bytes repeat between runs.
"""

import time
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, cast

from numba import njit
from numba.core import event

from lodelight.freshness import source_stamp

P = ParamSpec("P")
R = TypeVar("R")


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile `function` (plain arrays and scalars in, plain arrays and scalars out)."""
    compiled = njit(cache=True, nogil=True, error_model="numpy")(function)
    cache = getattr(compiled, "_cache", None)  # absent where NUMBA_DISABLE_JIT leaves plain Python
    if cache is not None:
        cache._cache_file._source_stamp = source_stamp(function.__module__, function.__code__.co_filename)
    return cast(Callable[P, R], compiled)


class _CompileClock(event.Listener):  # type: ignore[misc, unused-ignore]
    """Wall time spent compiling kernels or fetching them from the cache; one kernel may compile another."""

    def __init__(self) -> None:
        self.total_s = 0.0
        self._depth = 0
        self._since = 0.0

    def on_start(self, event: Any) -> None:
        if self._depth == 0:
            self._since = time.perf_counter()
        self._depth += 1

    def on_end(self, event: Any) -> None:
        self._depth -= 1
        if self._depth == 0:
            self.total_s += time.perf_counter() - self._since


_clock = _CompileClock()
event.register("numba:compiler_lock", _clock)  # type: ignore[no-untyped-call]


def compile_seconds() -> float:
    """Seconds this process has spent on compiling so far: to be left out of what a frame costs."""
    return _clock.total_s


class Stopwatch:
    """Wall time since it was made, without what went into compiling kernels."""

    def __init__(self) -> None:
        self._start = time.perf_counter() - compile_seconds()

    def ms(self) -> float:
        return 1e3 * (time.perf_counter() - compile_seconds() - self._start)
