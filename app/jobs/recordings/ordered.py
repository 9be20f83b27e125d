"""The other end of `BackgroundTasks`: reads the order, tells how far it is, hears of a cancel."""

import os
import threading
from collections.abc import Callable
from typing import Any, NoReturn

from physhandi.child import Channel, run_child
from physhandi.errors import CancelledError
from physhandi.progress import Progress, ToldProgress

_POLITENESS = 5
_LEAST_PAUSE_S = 0.2


class _ReportedProgress(ToldProgress):
    def __init__(self, channel: Channel) -> None:
        super().__init__(channel.tell, _LEAST_PAUSE_S)
        self.is_cancelled = threading.Event()

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
