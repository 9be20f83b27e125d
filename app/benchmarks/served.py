"""The real server in a process of its own, with its own data, for as long as it is measured."""

import http.client
import json
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self
from urllib.parse import parse_qs, urlsplit

import psutil

from app.benchmarks.viewer_client import ViewerClient
from physhandi.errors import PhysHandiError
from physhandi.viewer_process import ServerProcess

_PATIENCE = 120.0


class ServerFailedError(PhysHandiError):
    """The server that was to be measured did not do what it was asked."""


class Served:
    """A server on a free loopback port; a context manager that ends it.

    Attributes:
        url: Address that it printed, with the token.
        start_seconds: Time from its start until it printed that [s].
    """

    def __init__(
        self, data_dir: Path, *, device: str = "cpu", environment: Mapping[str, str] | None = None
    ) -> None:
        """Start it and wait until it answers.

        Args:
            data_dir: Its data folder.
            device: Warp device of its live simulation.
            environment: More environment variables.

        Raises:
            RunError: If it does not start; says what it wrote.
        """
        start = time.perf_counter()
        self._server = ServerProcess(data_dir, "--device", device, environment=environment)
        self.start_seconds = time.perf_counter() - start
        self.url = self._server.url
        address = urlsplit(self.url)
        self._host = f"{address.hostname}:{address.port}"
        self._headers = {"Authorization": f"Bearer {parse_qs(address.query)['token'][0]}"}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._server.stop()

    @property
    def process_id(self) -> int:
        """Process id of the server."""
        return self._server.process_id

    def cpu_seconds(self) -> float:
        """Time that the server and its child processes have kept a processor busy [s]."""
        server = psutil.Process(self.process_id)
        times = [process.cpu_times() for process in (server, *server.children(recursive=True))]
        return sum(t.user + t.system for t in times)

    def get(self, path: str) -> tuple[float, bytes]:
        """Fetch a page or an answer of the API.

        Returns:
            Time to the last byte [s], and the content.

        Raises:
            ServerFailedError: If the answer is not 200.
        """
        return self._ask("GET", path)

    def open(self, kind: str, target: str) -> str:
        """Open a live scene of a run or a sequence; returns its id."""
        _, answer = self._ask("POST", "/api/v1/sessions", {"kind": kind, "id": target})
        return str(json.loads(answer)["id"])

    def shut(self, session: str) -> None:
        """Close a live scene."""
        self._ask("DELETE", f"/api/v1/sessions/{session}")

    def watch(self, session: str, *, remembers: bool = False) -> ViewerClient:
        """Connect a client without a browser to a live scene."""
        return ViewerClient(
            f"ws://{self._host}/viewer/{session}",
            remembers=remembers,
            additional_headers=self._headers,
        )

    def _ask(
        self, method: str, path: str, body: Mapping[str, Any] | None = None
    ) -> tuple[float, bytes]:
        content = None if body is None else json.dumps(body)
        headers = self._headers | ({"Content-Type": "application/json"} if body else {})
        connection = http.client.HTTPConnection(self._host, timeout=_PATIENCE)
        try:
            start = time.perf_counter()
            connection.request(method, path, content, headers)
            answer = connection.getresponse()
            received = answer.read()
            seconds = time.perf_counter() - start
        finally:
            connection.close()
        if not 200 <= answer.status < 300:
            raise ServerFailedError(f"{method} {path} was answered with {answer.status}.")
        return seconds, received
