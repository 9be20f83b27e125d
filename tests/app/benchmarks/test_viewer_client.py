"""The client that speaks viser's wire format without a browser."""

import queue
import threading
from contextlib import suppress
from typing import cast

from support.waiting import LIMIT_S
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve
from websockets.typing import Subprotocol

from app.benchmarks.viewer_client import PROTOCOL, ViewerClient


def test_a_client_that_has_not_read_all_waits_for_no_answer_to_its_goodbye() -> None:
    has_sent, ended = threading.Event(), queue.Queue[int | None]()

    def talk(connection: ServerConnection) -> None:
        for _ in range(100):  # More than is kept for a client that takes none.
            connection.send(b"")
        has_sent.set()
        with suppress(ConnectionClosed):
            while True:
                connection.recv()
        ended.put(connection.close_code)

    with serve(talk, "127.0.0.1", 0, subprotocols=[cast("Subprotocol", PROTOCOL)]) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        address = f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        with ViewerClient(address, close_timeout=None) as client:
            assert has_sent.wait(LIMIT_S)
        assert client.connection.close_code == 1000
        assert ended.get(timeout=LIMIT_S) == 1000
        server.shutdown()
        thread.join()
