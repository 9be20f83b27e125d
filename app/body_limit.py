"""The size that a request's body may have."""

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send


class BodyLimit:
    """ASGI middleware: who reads a body that is too large meets an HTTP error 413.

    It is raised where the body is read, so that the application's own handler answers, in the one
    shape that all errors have; Starlette's limit answers in plain text. What a client announces is
    refused before any of it is read. A connection whose body was not read to its end is closed.
    """

    def __init__(self, app: ASGIApp, *, most_bytes: int) -> None:
        self._app = app
        self._most = most_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, with its body counted."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        announced = Headers(scope=scope).get("content-length", "")
        is_refused = announced.isdecimal() and int(announced[:20]) > self._most
        count = 0

        async def receive_counted() -> Message:
            nonlocal count
            if is_refused:
                raise self._error()
            message = await receive()
            count += len(message.get("body", b""))
            if count > self._most:
                raise self._error()
            return message

        await self._app(scope, receive_counted, send)

    def _error(self) -> HTTPException:
        most = f"{self._most / 2**20:g} MiB"
        message = f"The request is too large: at most {most} are read."
        return HTTPException(413, message, {"Connection": "close"})
