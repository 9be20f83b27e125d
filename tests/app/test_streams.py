"""Event streams, read from a real server."""

import json
import re
import time
from collections.abc import Callable, Iterator
from http.client import HTTPConnection, HTTPResponse
from pathlib import Path
from threading import Thread
from typing import Any

import pytest
import uvicorn
from queue_world import QueueWorld, queue_world


class Stream:
    """A reader of server-sent events."""

    def __init__(self, port: int, token: str, path: str, **headers: str) -> None:
        self.connection = HTTPConnection("127.0.0.1", port, timeout=10)
        self.connection.request("GET", path, headers={"Authorization": f"Bearer {token}"} | headers)
        self.response: HTTPResponse = self.connection.getresponse()

    def events(self, until: Callable[[dict[str, Any]], bool]) -> list[dict[str, Any]]:
        seen: list[dict[str, Any]] = []
        event: dict[str, Any] = {}
        while line := self.response.readline().decode():
            key, _, value = line.strip().partition(": ")
            if key:
                event[key] = value
            elif "data" in event:
                event["data"] = json.loads(event["data"])
                seen.append(event)
                if until(event):
                    break
                event = {}
        self.close()
        return seen

    def close(self) -> None:
        self.response.close()
        self.connection.close()


@pytest.fixture
def world(data_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[QueueWorld]:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent.parent))
    (tmp_path / "bundled").mkdir()
    with queue_world(data_dir, tmp_path / "bundled") as world:
        yield world


@pytest.fixture
def port(world: QueueWorld) -> Iterator[int]:
    config = uvicorn.Config(
        world.app, port=0, lifespan="off", log_level="error", timeout_graceful_shutdown=2
    )
    server = uvicorn.Server(config)
    thread = Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        time.sleep(0.01)
    yield server.servers[0].sockets[0].getsockname()[1]
    world.app.state.stopping.set()
    server.should_exit = True
    thread.join(timeout=5)
    assert not thread.is_alive()


def test_a_page_follows_a_run_through_one_stream_without_gap_or_repetition(
    world: QueueWorld, port: int
) -> None:
    cursor = re.search(r'data-since="([^"]+)"', world.client.get("/").text)
    assert cursor is not None
    run_id = world.launch("wait")
    stream = Stream(port, world.token, f"/api/v1/events?since={cursor[1]}")
    assert stream.response.headers["content-type"].startswith("text/event-stream")
    first = stream.events(lambda event: event["data"]["state"] == "running")
    assert first[0]["data"]["id"] == run_id
    assert first[0]["data"]["state"] in {"queued", "starting", "running"}
    (world.folder(run_id) / "go").touch()
    world.until(run_id, "succeeded")
    last = {"Last-Event-ID": first[-1]["id"]}
    again = Stream(port, world.token, "/api/v1/events", **last)
    second = again.events(lambda event: event["data"]["state"] == "succeeded")
    numbers = [int(event["id"].partition("-")[2]) for event in [*first, *second]]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert {event["event"] for event in [*first, *second]} == {"run"}


def test_a_runs_own_stream_goes_on_after_the_last_event_seen(world: QueueWorld, port: int) -> None:
    run_id = world.launch("publish")
    world.until(run_id, "succeeded")
    path = f"/api/v1/runs/{run_id}/events"
    events = Stream(port, world.token, path).events(lambda event: event["id"] == "1")
    assert [event["data"]["stage"] for event in events] == ["first", "second"]
    later = Stream(port, world.token, path, **{"Last-Event-ID": "0"})
    assert [event["id"] for event in later.events(lambda _: True)] == ["1"]


def test_of_too_many_streams_the_oldest_ends(world: QueueWorld, port: int) -> None:
    streams = [Stream(port, world.token, "/api/v1/events") for _ in range(13)]
    assert streams[0].events(lambda _: False) == []
    assert streams[1].response.readline().startswith(b"retry")
    for stream in streams[1:]:
        stream.close()
