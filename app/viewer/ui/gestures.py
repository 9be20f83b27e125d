"""Boundaries between gestures of a user."""

from collections.abc import Callable
from typing import Any

import viser

END_KEY = ("insert", "cmd/ctrl+alt+shift")
"""Key by which the page tells that a gesture ends, which people have no use for."""


class Gestures:
    """Numbers the gestures by which users move controls: drags, held keys, typed numbers.

    The page says where a gesture ends, by a command of viser's: it comes over the same websocket as
    the values, behind the last of them. Both are counted on viser's event loop, in their order;
    what else is done with a value is done later, in threads.
    """

    def __init__(self, gui: viser.GuiApi) -> None:
        """Listen to the page; web_assets/scene.js presses this key where a gesture ends.

        Args:
            gui: Where the controls are.
        """
        self._number = 0
        self._command = gui.add_command(
            "Begin another step of undo",
            description="What is changed next is taken back by itself",
            hotkey=END_KEY[0],
            modifier=END_KEY[1],
        )
        self._command.on_trigger(self._end)

    def follow(self, handle: Any) -> Callable[[], int]:
        """Follow a control, before anybody else listens to it.

        Args:
            handle: The control as viser gave it.

        Returns:
            Gives the number of the gesture that its newest value belongs to.
        """
        newest = [self._number]

        async def arrive(_: Any) -> None:
            newest[0] = self._number

        handle.on_update(arrive)
        return lambda: newest[0]

    def remove(self) -> None:
        """Stop listening to the page."""
        self._command.remove()

    async def _end(self, _: Any) -> None:
        self._number += 1
