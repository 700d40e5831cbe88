"""The one decorator for hot loops: numba, cached on disk, releasing the GIL, IEEE arithmetic.

No fastmath and no parallel reductions: sums keep their order, so bytes repeat between runs.
"""

from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

from numba import njit

P = ParamSpec("P")
R = TypeVar("R")


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile `function` (plain arrays and scalars in, plain arrays and scalars out)."""
    return cast(Callable[P, R], njit(cache=True, nogil=True, error_model="numpy")(function))
