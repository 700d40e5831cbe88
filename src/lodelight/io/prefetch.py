"""Work done a few steps ahead on one background thread, handed over in order."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")


def prefetch(items: Iterable[T], work: Callable[[T], R], ahead: int = 4) -> Generator[R, None, None]:
    """`work(item)` of each item in order, up to `ahead` of them computed before they are asked for.

    An exception of `work` comes out where its result would have. Closing the iterator ends the thread.
    """
    pending: deque[Future[R]] = deque()
    with ThreadPoolExecutor(1, thread_name_prefix="prefetch") as pool:
        try:
            for item in items:
                pending.append(pool.submit(work, item))
                if len(pending) > ahead:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        finally:
            for future in pending:
                future.cancel()
