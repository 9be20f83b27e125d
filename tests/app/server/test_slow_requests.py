"""Half-sent requests: time stands still here, and passes when a test says so."""

import json
import socket
import threading
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import IO, Any
from unittest.mock import Mock

import pytest
import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.websockets import WebSocket
from support.waiting import LIMIT_S, until
from uvicorn.server import ServerState

from app.graceful_server import GracefulServer
from app.slow_requests import ImpatientProtocol

UPGRADE = (
    b"GET / HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)
HEAD = b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: 1000000\r\n\r\n"


class Clock:
    """A loop whose timers go off by hand, and whose tasks never run."""

    def __init__(self) -> None:
        self.timers: list[SimpleNamespace] = []

    def call_later(self, delay: float, callback: Callable[[], None]) -> SimpleNamespace:
        timer = SimpleNamespace(delay=delay, callback=callback)
        timer.cancel = lambda: self.timers.remove(timer) if timer in self.timers else None
        self.timers.append(timer)
        return timer

    def create_task(self, task: Coroutine[Any, Any, None]) -> Mock:
        task.close()
        return Mock()

    def pass_by(self) -> None:
        (timer,) = self.timers
        self.timers.clear()
        timer.callback()


class Wire:
    """A transport that keeps what is written to it."""

    def __init__(self) -> None:
        self.written, self.is_closed = b"", False

    def get_extra_info(self, _name: str) -> None:
        return None

    def write(self, data: bytes) -> None:
        self.written += data

    def close(self) -> None:
        self.is_closed = True

    def is_closing(self) -> bool:
        return self.is_closed

    def pause_reading(self) -> None: ...

    def resume_reading(self) -> None: ...


class Line:
    def __init__(self) -> None:
        self.clock, self.wire = Clock(), Wire()
        self.protocol = ImpatientProtocol(
            uvicorn.Config(lambda: None, log_config=None), ServerState(), {}, self.clock
        )
        self.protocol.connection_made(self.wire)

    def told(self) -> str:
        """Which part did not come, by the answer."""
        head, _, body = self.wire.written.partition(b"\r\n\r\n")
        assert head.startswith(b"HTTP/1.1 408 ")
        assert self.wire.is_closed
        assert self.clock.timers == []
        error = json.loads(body)["error"]
        assert error["code"] == "too_slow"
        return error["message"].split(" ")[1]


@pytest.fixture
def line() -> Line:
    return Line()


def test_who_connects_and_asks_nothing_is_hung_up_on(line: Line) -> None:
    assert line.clock.timers[0].delay == 20.0
    line.clock.pass_by()
    assert line.told() == "head"


def test_a_head_that_drips_in_gets_no_more_time_by_that(line: Line) -> None:
    (timer,) = line.clock.timers
    for byte in HEAD[:-1]:
        line.protocol.data_received(bytes([byte]))
        assert line.clock.timers == [timer]
    line.clock.pass_by()
    assert line.told() == "head"


def test_a_whole_request_may_be_answered_as_late_as_it_takes(line: Line) -> None:
    line.protocol.data_received(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n")
    assert line.clock.timers == []
    assert not line.wire.is_closed


def test_a_body_has_to_keep_up_a_rate(line: Line) -> None:
    line.protocol.data_received(HEAD)
    for _ in range(2):
        assert line.clock.timers[0].delay == 30.0
        for _ in range(30):
            line.protocol.data_received(b"x" * 1024)
        line.protocol.cycle.body = b""  # The application has read it.
        line.clock.pass_by()
        assert not line.wire.is_closed
    line.protocol.data_received(b"x" * (30 * 1024 - 1))
    cycle = line.protocol.cycle
    assert not cycle.disconnected
    line.clock.pass_by()
    assert line.told() == "body"
    assert cycle.disconnected
    assert cycle.message_event.is_set()


def test_a_body_that_the_server_does_not_read_is_not_the_clients_fault(line: Line) -> None:
    line.protocol.data_received(HEAD)
    line.protocol.data_received(b"x" * 100_000)
    assert line.protocol.flow.read_paused
    line.clock.pass_by()
    line.clock.pass_by()
    assert not line.wire.is_closed
    line.protocol.flow.resume_reading()
    line.clock.pass_by()
    assert line.told() == "body"


def test_a_body_that_nobody_waits_for_any_more_is_cut_off_without_a_word(line: Line) -> None:
    line.protocol.data_received(HEAD)
    line.protocol.cycle.response_started = True
    line.clock.pass_by()
    assert line.wire.is_closed
    assert line.wire.written == b""


def test_a_lost_connection_leaves_no_timer(line: Line) -> None:
    line.protocol.data_received(b"GET")
    line.protocol.connection_lost(None)
    assert line.clock.timers == []


class Hasty(ImpatientProtocol):
    head_s, body_s = 0.1, 0.1


@contextmanager
def serving(listener: socket.socket, *routes: BaseRoute) -> Iterator[None]:
    """Serve what has connected to a socket, and what does."""
    app = Starlette(routes=routes)
    server = GracefulServer(uvicorn.Config(app, http=Hasty, log_level="critical"))
    thread = threading.Thread(target=server.run, args=([listener],))
    thread.start()
    until(lambda: server.started)
    try:
        yield
    finally:
        server.should_exit = True
        thread.join()


def hears_408(line: socket.socket) -> bool:
    with line, line.makefile("rb") as stream:
        return stream.read().startswith(b"HTTP/1.1 408 ")  # Until it is closed.


def test_a_hundred_half_requests_are_closed_and_then_others_answered(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def answer(request: Request) -> PlainTextResponse:
        return PlainTextResponse(f"{len(await request.body())} bytes")

    listener = socket.create_server(("127.0.0.1", 0), backlog=200)
    place = listener.getsockname()
    # All is sent before the server begins: what is sent to one that has hung up loses its answer.
    slow = [socket.create_connection(place, LIMIT_S) for _ in range(100)]
    for number, one in enumerate(slow):
        one.sendall((b"GET / HTTP/1.1\r\nHo", HEAD + b"x")[number % 2])
    with serving(listener, Route("/", answer, methods=["GET", "POST"])):
        assert all(hears_408(one) for one in slow)
        for part in ("head_s", "body_s"):
            monkeypatch.setattr(Hasty, part, LIMIT_S)
        with socket.create_connection(place, LIMIT_S) as good, good.makefile("rb") as stream:
            good.sendall(b"POST / HTTP/1.0\r\nHost: x\r\nContent-Length: 3\r\n\r\nabc")
            assert stream.read().endswith(b"\r\n\r\n3 bytes")


def test_a_websocket_is_no_request_that_is_late(caplog: pytest.LogCaptureFixture) -> None:
    async def echo(websocket: WebSocket) -> None:
        await websocket.accept()
        async for text in websocket.iter_text():
            await websocket.send_text(text)

    listener = socket.create_server(("127.0.0.1", 0))
    place = listener.getsockname()
    page = socket.create_connection(place, LIMIT_S)
    page.sendall(UPGRADE)  # Before the server begins: it gives a tenth of a second for it.
    with (
        serving(listener, WebSocketRoute("/", echo)),
        page,
        page.makefile("rb") as stream,
    ):
        assert stream.readline().startswith(b"HTTP/1.1 101 ")
        while stream.readline() != b"\r\n":
            pass
        assert echoed(page, stream, b"first") == b"first"
        # Whoever connects later and asks nothing is hung up on, so that the time is over.
        assert hears_408(socket.create_connection(place, LIMIT_S))
        assert echoed(page, stream, b"second") == b"second"
    told = [record.getMessage() for record in caplog.records if record.name == "asyncio"]
    assert [text for text in told if "ImpatientProtocol" in text] == []  # No time went off later.


def echoed(page: socket.socket, stream: IO[bytes], text: bytes) -> bytes:
    """Send a short text by a websocket, masked by zeros, and read the one that comes back."""
    page.sendall(bytes([0x81, 0x80 | len(text), 0, 0, 0, 0]) + text)
    assert stream.read(2) == bytes([0x81, len(text)])
    return stream.read(len(text))
