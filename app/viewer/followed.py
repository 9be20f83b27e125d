"""A control that follows what is in force, and never takes away what a user has just chosen."""

from typing import Any


class FollowedChoice:
    """A list or a field that both the program and a user set.

    Viser stores a user's choice before anybody is told of it, so a value that was not the last one
    written or taken here is a user's that is about to be heard.

    Attributes:
        handle: The control.
    """

    def __init__(self, handle: Any) -> None:
        """Follow a control.

        Args:
            handle: The control as viser gave it, with its first value.
        """
        self.handle = handle
        self._known: Any = handle.value

    def show(self, value: Any) -> None:
        """Name what is in force, unless a user's choice is about to be heard."""
        if self.handle.value == self._known != value:
            # Noted first: a user may answer before the next line of this thread runs.
            self._known = value
            self.handle.value = value

    def take(self) -> Any:
        """Read the control, whoever has set it."""
        value = self._known = self.handle.value
        return value
