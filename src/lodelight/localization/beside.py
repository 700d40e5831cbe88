"""A search that runs beside tracking: at once, or on a second thread while tracking goes on."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

Asked = TypeVar("Asked")
Answer = TypeVar("Answer")


class InlineSearch(Generic[Asked, Answer]):
    """The answer is there when `ask` returns: deterministic."""

    idle = True

    def __init__(self, work: Callable[[Asked], Answer]) -> None:
        self._work = work
        self._answer: Answer | None = None

    def ask(self, what: Asked) -> None:
        self._answer = self._work(what)

    def answer(self) -> Answer | None:
        """The last answer, once; None where there is none yet."""
        answer, self._answer = self._answer, None
        return answer

    def close(self) -> None:
        pass


class ThreadedSearch(Generic[Asked, Answer]):
    """One question at a time on a thread of its own; ask only while it is idle.

    What the work raises is raised by the next `answer`.
    """

    def __init__(self, work: Callable[[Asked], Answer]) -> None:
        self._work = work
        self._answer: Answer | None = None
        self._error: BaseException | None = None
        self._thread: threading.Thread | None = None

    @property
    def idle(self) -> bool:
        return self._thread is None or not self._thread.is_alive()

    def ask(self, what: Asked) -> None:
        self.close()
        self._thread = threading.Thread(target=self._run, args=(what,), name="relocalization", daemon=True)
        self._thread.start()

    def answer(self) -> Answer | None:
        if not self.idle:
            return None
        if self._error is not None:
            error, self._error = self._error, None
            raise error
        answer, self._answer = self._answer, None
        return answer

    def close(self) -> None:
        if self._thread is not None:
            self._thread.join()

    def _run(self, what: Asked) -> None:
        try:
            self._answer = self._work(what)
        except BaseException as error:
            self._error = error
