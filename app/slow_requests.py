"""Connections on which a request does not arrive are closed, however slowly it drips in.

Whoever sends half a request holds a connection, and uvicorn waits for the rest for ever. Here the
head of a request (its first line and headers) has a time from its first byte on, or from the
beginning of the connection; a body has to keep up a rate. Both are watched where bytes arrive, so
that it does not matter whether somebody waits for the body, or who it is that sends it.
"""

import asyncio
import json
from typing import ClassVar, Literal

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

_Part = Literal["head", "body"]


class ImpatientProtocol(H11Protocol):
    """Uvicorn's HTTP/1.1, which hangs up on clients that are too slow to ask."""

    head_s: ClassVar[float] = 20.0
    """Time that the head of a request may take [s]."""
    body_s: ClassVar[float] = 30.0
    """Time in which a body has to advance by `body_s * body_rate` [s]."""
    body_rate: ClassVar[float] = 1024.0
    """Rate that a body has to keep up [byte/s]."""

    _part: _Part | None = None
    _timer: asyncio.TimerHandle | None = None
    _received = 0
    _received_then = 0
    _is_handed_over = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as uvicorn
        """Begin to wait for the first request."""
        super().connection_made(transport)
        self._follow()

    def data_received(self, data: bytes) -> None:
        """Take what a client sends."""
        self._received += len(data)
        super().data_received(data)
        self._follow()

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        """Hand the connection over: what comes from now on is no part of a request."""
        super().handle_websocket_upgrade(event)
        self._is_handed_over = True

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the time."""
        self._wait_for(None)
        super().connection_lost(exc)

    def _follow(self) -> None:
        """Find out what is missing of a request, and give that its time if it is something new."""
        state = None if self._is_handed_over else self.conn.their_state
        part: _Part | None = (
            "head" if state is h11.IDLE else "body" if state is h11.SEND_BODY else None
        )
        if part != self._part:
            self._wait_for(part)

    def _wait_for(self, part: _Part | None) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._part, self._timer, self._received_then = part, None, self._received
        if part is not None:
            time = self.head_s if part == "head" else self.body_s
            self._timer = self.loop.call_later(time, self._judge)

    def _judge(self) -> None:
        """Hang up, unless a body has advanced or it is the server that does not read it."""
        advance = self._received - self._received_then
        is_fast = advance >= self.body_s * self.body_rate or self.flow.read_paused
        if self._part == "body" and is_fast:
            self._wait_for("body")
        elif self._part is not None and not self.transport.is_closing():
            self._hang_up(self._part)

    def _hang_up(self, part: _Part) -> None:
        cycle = self.cycle
        is_answered = part == "body" and cycle.response_started
        if not is_answered:
            message = f"The {part} of the request did not arrive in time."
            content = json.dumps({"error": {"code": "too_slow", "message": message}}).encode()
            headers = [
                ("content-type", "application/json"),
                ("content-length", str(len(content))),
                ("connection", "close"),
            ]
            for event in (
                h11.Response(status_code=408, headers=headers, reason=b"Request Timeout"),
                h11.Data(data=content),
                h11.EndOfMessage(),
            ):
                self.transport.write(self.conn.send(event) or b"")
        if part == "body":
            cycle.disconnected = True  # Before it answers, too.
            cycle.message_event.set()
        self.transport.close()
