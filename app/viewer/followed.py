"""A list that follows what is in force, and never takes away what a user has just chosen."""

from typing import Any


class FollowedChoice:
    """A list that both the program and a user set.

    Viser stores a user's choice before anybody is told of it, so a value that was not the last one
    written or taken here is a user's that is about to be heard.
    """

    def __init__(self, handle: Any) -> None:
        """Follow a list.

        Args:
            handle: The list as viser gave it, with its first value.
        """
        self._handle = handle
        self._known: str = handle.value

    def show(self, value: str) -> None:
        """Name what is in force, unless a user's choice is about to be heard."""
        if self._handle.value == self._known != value:
            # Noted first: a user may answer before the next line of this thread runs.
            self._known = value
            self._handle.value = value

    def take(self) -> str:
        """Read the list, whoever has set it."""
        value = self._known = self._handle.value
        return value
