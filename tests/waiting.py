"""Wait for what other threads and processes do, without guessing how long that takes."""

import threading
import time
from collections.abc import Callable
from typing import TypeVar

Answer = TypeVar("Answer")

LIMIT_S = 120.0
"""So long a machine may be busy with something else; what takes longer does not happen [s]."""
_INTERVAL_S = 0.01


def until(
    ask: Callable[[], Answer], tell: Callable[[], object] = str, *, seconds: float = LIMIT_S
) -> Answer:
    """Ask until the answer is true, and return it.

    Args:
        ask: What is waited for.
        tell: What the failure says, asked when time is up.
        seconds: When to give up [s].
    """
    end = time.monotonic() + seconds
    while not (answer := ask()):
        assert time.monotonic() < end, f"it did not come true within {seconds:g} s: {tell()}"
        time.sleep(_INTERVAL_S)
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
