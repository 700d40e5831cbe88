"""Ending a live camera's run with Ctrl-C: what was done until then is finished and written."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lodelight.io.recording import Recording


@contextlib.contextmanager
def stopped_by_interrupt(recording: Recording) -> Iterator[None]:
    """The first interrupt ends the stream of a live camera, the next one the program; nothing for other recordings."""
    if not recording.is_live or threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(*_: Any) -> None:
        recording.stop()
        signal.signal(signal.SIGINT, before)

    before = signal.signal(signal.SIGINT, stop)
    if sys.stderr.isatty():
        print("camera is running; Ctrl-C ends the run and writes it", file=sys.stderr)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
