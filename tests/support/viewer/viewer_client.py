"""A viewer client for tests, which makes the most of the order in which messages come."""

from collections import deque
from typing import Any

from app.benchmarks.viewer_client import PROTOCOL as PROTOCOL
from app.benchmarks.viewer_client import ViewerClient as Client


class ViewerClient(Client):
    """Takes in one message at a time, however many come in one websocket frame.

    How many that are is chance. A test that waits for one message and then looks at what the next
    one brings would fail now and then; here it fails always.
    """

    def __init__(self, url: str, **options: Any) -> None:
        self._waiting = deque[dict[str, Any]]()
        super().__init__(url, **options)

    def take_in(self, seconds: float) -> list[dict[str, Any]]:
        if not self._waiting:
            self._waiting.extend(self._receive(seconds))
        if not self._waiting:
            return []
        self._keep(self._waiting[0])
        return [self._waiting.popleft()]

    def is_told(self, text: str, *, since: int = 0) -> bool:
        """Whether a notice with a text came; all other messages as text would be much to write."""
        messages = self.messages[since:]
        return any("Notification" in m["type"] and text in str(m) for m in messages)
