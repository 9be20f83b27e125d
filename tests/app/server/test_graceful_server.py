"""A server that stops does not wait for who connected at that moment."""

import asyncio
import socket
from threading import Thread

import uvicorn
from support.waiting import LIMIT_S, until
from uvicorn.protocols.http.h11_impl import H11Protocol

from app.graceful_server import GracefulServer


def test_a_connection_that_is_accepted_while_the_server_stops_is_closed(caplog) -> None:
    stops: list[asyncio.Task[None]] = []

    class StopsWhenAccepted(H11Protocol):
        """Lets the server stop between the moments in which it accepts and knows a connection."""

        def __init__(self, *about, **more) -> None:
            super().__init__(*about, **more)
            stop = asyncio.get_running_loop().create_task(server.shutdown())
            stop.add_done_callback(lambda _: setattr(server, "should_exit", True))
            stops.append(stop)

    async def app(scope, receive, send) -> None:
        raise AssertionError("nothing is asked")

    config = uvicorn.Config(
        app,
        port=0,
        http=StopsWhenAccepted,
        lifespan="off",
        log_config=None,
        timeout_graceful_shutdown=int(LIMIT_S),
    )
    server = GracefulServer(config)
    thread = Thread(target=server.run)
    thread.start()
    until(lambda: server.started)
    with socket.create_connection(server.servers[0].sockets[0].getsockname(), LIMIT_S) as line:
        assert line.recv(1) == b""
        thread.join(LIMIT_S)
    assert not thread.is_alive()
    assert len(stops) == 1
    assert server.server_state.connections == set()
    assert "timeout graceful shutdown exceeded" not in caplog.text
