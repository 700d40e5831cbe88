"""When a keyframe's mapping is done: at once, or on a second thread while tracking goes on."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import Generic, TypeVar

Job = TypeVar("Job")


class InlineMapping(Generic[Job]):
    """Every keyframe is mapped before `submit` returns: deterministic."""

    idle = True
    queued = 0

    def __init__(self, work: Callable[[Job], None]) -> None:
        self._work = work

    def submit(self, job: Job) -> None:
        self._work(job)

    def interrupted(self) -> bool:
        return False

    def close(self) -> None:
        pass


class ThreadedMapping(Generic[Job]):
    """Keyframes are mapped in turn on a thread of their own; a waiting one cuts the adjustment of the present short.

    What the work raises is raised again by the next `submit`, or by `close`, which waits for all that was submitted.
    """

    def __init__(self, work: Callable[[Job], None]) -> None:
        self._work = work
        self._queue: queue.Queue[Job | None] = queue.Queue()
        self._busy = False
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="mapping", daemon=True)
        self._thread.start()

    @property
    def idle(self) -> bool:
        return not self._busy and self._queue.empty()

    @property
    def queued(self) -> int:
        return self._queue.qsize()

    def submit(self, job: Job) -> None:
        self._raise()
        self._queue.put(job)

    def interrupted(self) -> bool:
        """Asked by the work: should it hurry because another keyframe waits?"""
        return not self._queue.empty()

    def close(self) -> None:
        self._queue.put(None)
        self._thread.join()
        self._raise()

    def _raise(self) -> None:
        if self._error is not None:
            error, self._error = self._error, None
            raise error

    def _run(self) -> None:
        while (job := self._queue.get()) is not None:
            self._busy = True
            try:
                if self._error is None:
                    self._work(job)
            except BaseException as error:
                self._error = error
            self._busy = False
