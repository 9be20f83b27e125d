"""A control that program and user both set: a list, a field or a slider; the user prevails."""

import threading
from typing import Any

from app.viewer.ui.guard import Guard


class FollowedChoice:
    """A list, a field or a slider that both the program and a user set.

    Viser stores a user's choice on its event loop before it calls anybody, so a value that was not
    the last one written or read here is a user's that is about to be heard. The program writes on
    the same loop: no user's choice can come between looking and writing.

    Attributes:
        handle: The control; its value and its options belong to this class.
    """

    def __init__(self, handle: Any, guard: Guard) -> None:
        """Follow a control.

        Args:
            handle: The control as viser gave it, with its first value.
            guard: Knows the event loop.
        """
        self.handle = handle
        self._guard = guard
        self._lock = threading.Lock()
        self._last: Any = handle.value
        self._read_count = 0

    def show(self, value: Any) -> None:
        """Set the control, unless a user's choice waits for its callback or was read meanwhile."""
        read_count = self._read_count

        def write() -> None:
            with self._lock:
                is_latest = read_count == self._read_count
                if is_latest and self.handle.value == self._last != value:
                    self._last = value
                    self.handle.value = value

        self._guard.on_event_loop(write)

    def offer(self, options: tuple[str, ...]) -> None:
        """Change what a list offers; what it no longer offers is no longer chosen."""

        def write() -> None:
            with self._lock:
                if tuple(self.handle.options) != options:
                    is_heard = self.handle.value == self._last
                    self.handle.options = options
                    if is_heard:
                        self._last = self.handle.value

        self._guard.on_event_loop(write)

    def read(self) -> Any:
        """Read the control, whoever has set it."""
        with self._lock:
            self._read_count += 1
            self._last = self.handle.value
            return self._last
