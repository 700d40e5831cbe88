"""A recording played at the speed it was made, to a consumer that may be too slow for it."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator

from lodelight.io.stamps import NS_PER_S
from lodelight.messages import Frame, Message

QUEUE_FRAMES = 2  # frames that may wait; a robot has no use for older ones


class Paced:
    """Messages as they become due; of more than QUEUE_FRAMES waiting frames the oldest is dropped.

    on_drop : told the stamp, ns, of every frame that was
    """

    def __init__(self, messages: Iterator[Message], on_drop: Callable[[int], None]) -> None:
        self._messages = messages
        self._on_drop = on_drop
        self._queue: queue.Queue[Message | BaseException | None] = queue.Queue()
        self._waiting = 0
        self._lock = threading.Lock()

    def __iter__(self) -> Iterator[Message]:
        left = threading.Event()
        threading.Thread(target=self._play, args=(left,), name="pacing", daemon=True).start()
        try:
            while (item := self._queue.get()) is not None:
                if isinstance(item, BaseException):
                    raise item
                if not isinstance(item, Frame) or self._in_time(item):
                    yield item
        finally:
            left.set()

    def _in_time(self, frame: Frame) -> bool:
        with self._lock:
            self._waiting -= 1
            late = self._waiting >= QUEUE_FRAMES
        if late:
            self._on_drop(frame.t_ns)
        return not late

    def _play(self, left: threading.Event) -> None:
        """Put every message into the queue when it is due, until the consumer has left."""
        start_s: float | None = None
        try:
            for message in self._messages:
                due_s = message.t_ns / NS_PER_S
                if start_s is None:
                    start_s = time.monotonic() - due_s
                if left.wait(max(0.0, start_s + due_s - time.monotonic())):
                    break
                if isinstance(message, Frame):
                    with self._lock:
                        self._waiting += 1
                self._queue.put(message)
            self._queue.put(None)
        except BaseException as error:
            self._queue.put(error)
        finally:
            close = getattr(self._messages, "close", None)
            if close is not None:
                close()
