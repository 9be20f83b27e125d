"""The other end of `BackgroundTasks`: reads the order, tells how far it is, hears of a cancel."""

import os
import threading
import time
from collections.abc import Callable
from typing import Any, NoReturn

from physhandi.child import Channel, run_child
from physhandi.errors import CancelledError
from physhandi.progress import Progress

_POLITENESS = 5
_LEAST_PAUSE_S = 0.2


class _ReportedProgress(Progress):
    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._last = 0.0
        self.is_cancelled = threading.Event()

    def report(
        self,
        stage: str,
        iteration: int,
        total: int,
        loss: float | None = None,  # noqa: ARG002  # such work has none
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


def work_on_order(work: Callable[[dict[str, Any], Progress], dict[str, Any]]) -> NoReturn:
    """Do what the first request says and tell what came of it; any further request cancels.

    Args:
        work: Does it; what it returns is the task's result.
    """

    def begin(channel: Channel) -> None:
        os.nice(_POLITENESS)
        requests = channel.requests()
        order: dict[str, Any] = next(requests)
        progress = _ReportedProgress(channel)

        def hear() -> None:
            for _ in requests:
                progress.is_cancelled.set()

        threading.Thread(target=hear, daemon=True).start()
        channel.tell(result=work(order, progress))

    run_child(begin)
