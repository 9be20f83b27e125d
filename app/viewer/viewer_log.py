"""Log of failed viser connections, which anybody who connects can cause."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable

from physhandi.errors import describe

MOST_LINES = 20
"""Lines that are written in a minute."""
_MINUTE = 60.0


class BrokenConnections(logging.Filter):
    """Makes one line of the traceback of a connection that failed, and lets few through.

    A viewer whose frame cannot be read ends its connection with an exception in viser, which the
    websocket server logs with its traceback, as often as somebody sends one.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._clock = clock
        self._lock = threading.Lock()
        self._written: deque[float] = deque(maxlen=MOST_LINES)
        self._left_out = 0

    def filter(self, record: logging.LogRecord) -> bool:
        """Shorten a record of an exception; returns whether it is to be written."""
        if not record.exc_info or record.exc_info[1] is None:
            return True
        now = self._clock()
        with self._lock:
            if len(self._written) == MOST_LINES and now - self._written[0] < _MINUTE:
                self._left_out += 1
                return False
            self._written.append(now)
            left_out, self._left_out = self._left_out, 0
        error = record.exc_info[1]
        # As repr, since it may quote what was sent.
        text = f"{record.getMessage()}: {type(error).__name__}: {describe(error)[:200]!r}"
        more = f" ({left_out} more were left out)" if left_out else ""
        record.msg, record.args = f"a viewer's {text}{more}", ()
        record.exc_info = record.exc_text = None
        return True


_filter = BrokenConnections()


def limit_viewer_log() -> None:
    """Let connections to viser that fail write a line each, and few of these."""
    logging.getLogger("websockets.server").addFilter(_filter)
