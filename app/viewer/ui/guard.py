"""Callbacks whose errors reach the log and the person who clicked."""

import logging
import re
from collections.abc import Callable
from typing import Any

import viser

from physhandi.errors import PhysHandiError

logger = logging.getLogger(__name__)

_UNSAFE = re.compile(r"[^\w .,:()+\-/]")


def without_markup(text: str) -> str:
    """Strip a name of everything that HTML could give a meaning.

    Args:
        text: A name chosen by a user, such as that of a run.

    Returns:
        The name made of letters, digits, blanks and harmless punctuation, at most 80 characters.
    """
    return _UNSAFE.sub(" ", text).strip()[:80]


def notify(
    target: viser.ViserServer | viser.ClientHandle | None,
    title: str,
    body: str,
    *,
    color: Any = "red",
    seconds: float | None = 8.0,
) -> None:
    """Show a notification to one client, or to all clients of a server.

    Args:
        target: Who sees it; nobody if None.
        title: Bold first line.
        body: What happened and what to do.
        color: A colour name of viser.
        seconds: Time until it goes away; None to stay.
    """
    if target is None:
        return
    clients = [target] if isinstance(target, viser.ClientHandle) else target.get_clients().values()
    for client in clients:
        client.add_notification(title, body, color=color, auto_close_seconds=seconds)


class Guard:
    """Wraps the callbacks of one viewer server."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server

    def __call__(self, callback: Callable[[Any], None]) -> Callable[[Any], None]:
        """Wrap a callback: log its error with traceback and show the first line to the user."""

        def guarded(event: Any) -> None:
            try:
                callback(event)
            except PhysHandiError as error:
                logger.warning("%s was refused: %s", callback.__qualname__, error)
                self._notify(event, "Not possible", error)
            except Exception as error:
                logger.exception("%s failed", callback.__qualname__)
                self._notify(event, "Something went wrong", error)

        return guarded

    def by_user(self, callback: Callable[[Any], None]) -> Callable[[Any], None]:
        """Wrap a callback like `__call__`, ignoring values that the program itself assigned."""

        def by_user(event: Any) -> None:
            if event.client is not None:
                callback(event)

        by_user.__qualname__ = callback.__qualname__
        return self(by_user)

    def on_event_loop(self, action: Callable[[], None]) -> None:
        """Do something on the event loop, where no message of a user comes between.

        What is handed in first is done first; after the server has stopped nothing is done.
        """
        try:
            self._server.get_event_loop().call_soon_threadsafe(action)
        except RuntimeError:  # Its event loop is closed, and nobody looks any more.
            logger.debug("%r came after the server had stopped", action)

    def _notify(self, event: Any, title: str, error: Exception) -> None:
        lines = str(error).splitlines() or [type(error).__name__]
        target = event if isinstance(event, viser.ClientHandle) else event.client
        notify(target or self._server, title, lines[0])
