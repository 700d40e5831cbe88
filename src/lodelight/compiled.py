"""The one decorator for hot loops: numba, cached on disk, releasing the GIL, IEEE arithmetic.

No fastmath and no parallel reductions: sums keep their order, so bytes repeat between runs.
"""

from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

from numba import njit

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
