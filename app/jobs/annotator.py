"""The process that finds masks and tracks of a recording: reads the order, tells how far it is."""

import os
import threading
import time
from typing import Any

from physhandi.child import Channel, run_child
from physhandi.errors import CancelledError
from physhandi.perception.annotation import annotate
from physhandi.perception.segmentation import Click
from physhandi.progress import Progress

_POLITENESS = 5
_LEAST_PAUSE_S = 0.2


class _Told(Progress):
    """Passes on how far the work is, and hears of a cancel."""

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._last = 0.0
        self.is_cancelled = threading.Event()

    def report(
        self,
        stage: str,
        iteration: int,
        total: int,
        loss: float | None = None,  # noqa: ARG002  # these stages have none
        message: str = "",
    ) -> None:
        """Tell it, but not more often than anybody can read."""
        now = time.monotonic()
        if now - self._last >= _LEAST_PAUSE_S or iteration == total:
            self._last = now
            self._channel.tell(stage=stage, iteration=iteration, total=total, message=message)

    def check_cancelled(self) -> None:
        """Stop if the server asked for it."""
        if self.is_cancelled.is_set():
            raise CancelledError("Cancelled; nothing was changed.")


def work(channel: Channel) -> None:
    """Annotate the sequence that the first request names; any further request cancels."""
    os.nice(_POLITENESS)
    requests = channel.requests()
    order: dict[str, Any] = next(requests)
    told = _Told(channel)

    def hear() -> None:
        for _ in requests:
            told.is_cancelled.set()

    threading.Thread(target=hear, daemon=True).start()
    clicks = [Click(**click) for click in order["clicks"]]
    annotate(order["folder"], clicks, told, overwrite=order["overwrite"])


if __name__ == "__main__":
    run_child(work)
