"""Wait for what other threads and processes do, without guessing how long that takes."""

import threading
import time
from collections.abc import Callable
from typing import TypeVar

Answer = TypeVar("Answer")

LIMIT_S = 300.0
"""So long a machine may be busy with something else; what takes longer does not happen [s]."""
_REST = 6.0
"""So many times as long as asking took, the processor is left to others."""
_LONGEST_REST = 0.1
"""But no longer than this, or what has come is not seen [s]."""


def until(
    ask: Callable[[], Answer], tell: Callable[[], object] = str, *, interval: float = 0.02
) -> Answer:
    """Ask until the answer is true, and return it.

    Args:
        ask: What is waited for.
        tell: What the failure says, asked when time is up.
        interval: How long to leave the processor to others before asking again, at least [s].
            What takes long to ask, such as a page, is asked for seldom: what is waited for wants
            the processor too.
    """
    end = time.monotonic() + LIMIT_S
    begin = time.process_time()
    while not (answer := ask()):
        assert time.monotonic() < end, f"it did not come true within {LIMIT_S:g} s: {tell()}"
        time.sleep(max(interval, min(_LONGEST_REST, _REST * (time.process_time() - begin))))
        begin = time.process_time()
    return answer


class WatchedLock:
    """A lock that knows which threads wait for it."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self.waiting: set[int] = set()

    def __enter__(self) -> None:
        self.waiting.add(threading.get_ident())
        self._lock.acquire()
        self.waiting.discard(threading.get_ident())

    def __exit__(self, *_: object) -> None:
        self._lock.release()
