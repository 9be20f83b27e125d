"""The real server in a process of its own, of which is counted what it holds."""

import http.client
import json
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

from app.benchmarks.served import Served
from support.viewer.viewer_client import ViewerClient


@dataclass(frozen=True)
class Held:
    """What a server holds of the machine."""

    files: int
    """Open files, sockets and pipes, but for `arrays`."""
    arrays: int
    """Memory-mapped arrays of runs; those of a scene that is gone are let go by Python's collector,
    some scenes later."""
    threads: int
    children: int
    """Processes that it has started, and theirs."""
    megabytes: float
    """Memory of its own process."""
    scenes: int
    """Live scenes that are open."""

    def is_no_more_than(self, before: "Held") -> bool:
        """Tell whether files and children are no more than before; those that end take a while."""
        return self.files <= before.files and self.children <= before.children


class MeasuredServer(Served):
    """Answers like a server, however it answers, and counts what it holds."""

    requests = 0
    """How often it was asked."""

    def ask(self, method: str, path: str, body: Any = None) -> tuple[int, bytes]:
        """Ask for something; gives status and content. What is no `bytes` is sent as JSON."""
        self.requests += 1
        content = body if body is None or isinstance(body, bytes) else json.dumps(body)
        kind = {"Content-Type": "application/json"} if isinstance(content, str) else {}
        connection = http.client.HTTPConnection(self._host, timeout=300)
        try:
            connection.request(method, path, content, self._headers | kind)
            answer = connection.getresponse()
            return answer.status, answer.read()
        finally:
            connection.close()

    def told(self, method: str, path: str, body: Any = None) -> Any:
        """Ask for something that has to be granted; gives the answer."""
        status, content = self.ask(method, path, body)
        assert 200 <= status < 300, f"{method} {path}: {status} {content[:500]!r}"
        return json.loads(content) if content else None

    def viewer(self, session: str) -> ViewerClient:
        """Connect a client to a live scene."""
        url = f"ws://{self._host}/viewer/{session}"
        return ViewerClient(url, additional_headers=self._headers)

    def connections(self) -> int:
        """Count its connections, also those from its gate to its scenes."""
        lines = psutil.Process(self.process_id).net_connections("tcp")
        return sum(line.status != psutil.CONN_LISTEN for line in lines)

    def held(self) -> Held:
        """Count what it holds now."""
        process = psutil.Process(self.process_id)
        names = _open_files(self.process_id)  # Before there is another connection.
        status, content = self.ask("GET", "/metrics")
        assert status == 200, content
        figures: Iterable[list[str]] = (line.split() for line in content.decode().splitlines())
        scenes = next(line[1] for line in figures if line[0] == "physhandi_live_scenes")
        arrays = sum(name.endswith(".npy") for name in names)
        return Held(
            len(names) - arrays,
            arrays,
            process.num_threads(),
            len(process.children(recursive=True)),
            process.memory_info().rss / 2**20,
            int(float(scenes)),
        )


def _open_files(process: int) -> list[str]:
    names: list[str] = []
    for entry in Path(f"/proc/{process}/fd").iterdir():
        with suppress(FileNotFoundError):  # It was closed since.
            names.append(str(entry.readlink()))
    return names
