"""Programs that run until they are told to end: SIGTERM and SIGINT set an event, and the program leaves by itself.

The main thread must wait with a timeout, again and again: a signal may reach another thread, and does not wake it then.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def until_signal() -> Iterator[threading.Event]:
    """An event that is set by SIGTERM or SIGINT; what the signals did before is put back at the end."""
    stop = threading.Event()
    handled = (signal.SIGTERM, signal.SIGINT)
    before = [signal.signal(number, lambda *_: _set_elsewhere(stop)) for number in handled]
    try:
        yield stop
    finally:
        for number, handler in zip(handled, before, strict=True):
            signal.signal(number, handler)


def _set_elsewhere(stop: threading.Event) -> None:
    # The handler runs in the main thread, perhaps within `stop.wait`, which holds the lock that `stop.set` needs.
    threading.Thread(target=stop.set, daemon=True).start()
