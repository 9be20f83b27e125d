"""Event streams, read from a real server."""

import json
import re
from collections.abc import Callable, Iterator
from http.client import HTTPConnection, HTTPResponse
from pathlib import Path
from typing import Any

import pytest
from support.server.queue_world import QueueWorld, queue_world, serving
from support.waiting import LIMIT_S


class Stream:
    """A reader of server-sent events."""

    def __init__(self, port: int, token: str, path: str, **headers: str) -> None:
        self.connection = HTTPConnection("127.0.0.1", port, timeout=LIMIT_S)
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
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    (tmp_path / "bundled").mkdir()
    with queue_world(data_dir, tmp_path / "bundled") as world:
        yield world


@pytest.fixture
def port(world: QueueWorld) -> Iterator[int]:
    with serving(world) as port:
        yield port


def test_a_page_follows_a_run_through_one_stream_without_gap_or_repetition(
    world: QueueWorld, port: int
) -> None:
    cursor = re.search(r'data-since="([^"]+)"', world.client.get("/runs").text)
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
    events = Stream(port, world.token, path).events(lambda event: event["event"] == "run")
    reports = [event for event in events if event["event"] == "progress"]
    assert [event["data"]["stage"] for event in reports] == ["first", "second"]
    assert [event["data"]["seq"] for event in reports] == [0, 1]
    assert [stage["name"] for stage in events[-1]["data"]["stages"]] == ["first"]
    for since in ({"Last-Event-ID": reports[0]["id"]}, {"Last-Event-ID": "0"}):
        later = Stream(port, world.token, path, **since).events(lambda e: e["event"] == "run")
        assert [event["data"]["seq"] for event in later if event["event"] == "progress"] == [1]
    shown = Stream(port, world.token, f"{path}?since={events[-1]['id']}")
    assert [event["event"] for event in shown.events(lambda e: e["event"] == "run")] == ["run"]


def test_a_runs_stream_tells_its_stages_its_log_and_its_end(world: QueueWorld, port: int) -> None:
    run_id = world.launch("script")
    world.until(run_id, "running")
    stream = Stream(port, world.token, f"/api/v1/runs/{run_id}/events")
    world.tell(
        run_id,
        ["log", "one", "two"],
        ["report", "hand_reconstruction", 5, 10, 3.0],
        ["finish", "hand_reconstruction", {"before": 4.0, "after": 2.0}],
        ["report", "observation", 1, 2],
        ["fail", "'sheet' lacks <b>markers</b>."],
    )
    # The log is copied by another process: what was said before the end may come after it.
    ends: list[dict[str, Any]] = []
    told: list[str] = []

    def is_told(event: dict[str, Any]) -> bool:
        if event["event"] == "log":
            told.append(event["data"]["text"])
        if event["event"] == "run" and event["data"]["state"] == "failed":
            ends.append(event["data"])
        return bool(ends) and "one\ntwo\n" in "".join(told)

    events = stream.events(is_told)
    assert "one\ntwo\n" in "".join(told)
    assert "Traceback" not in "".join(told)
    last = ends[-1]
    states = {stage["name"]: stage["state"] for stage in last["stages"]}
    assert states["hand_reconstruction"] == "done"
    assert states["observation"] == "failed"
    assert set(states.values()) == {"done", "failed", "to-come"}
    assert last["failure"]["message"] == "'sheet' lacks <b>markers</b>."
    assert last["failure"]["advice"]
    again = Stream(
        port, world.token, f"/api/v1/runs/{run_id}/events", **{"Last-Event-ID": events[-1]["id"]}
    )
    assert world.client.delete(f"/api/v1/runs/{run_id}").status_code == 204
    rest = again.events(lambda e: e["event"] == "gone")
    # At most what the log still had to tell, and nothing again.
    assert rest[-1]["event"] == "gone"
    assert {event["event"] for event in rest} <= {"run", "log", "gone"}
    assert not any("two" in event["data"]["text"] for event in rest if event["event"] == "log")


def test_of_too_many_streams_the_oldest_ends(world: QueueWorld, port: int) -> None:
    streams: list[Stream] = []
    for _ in range(13):
        streams.append(Stream(port, world.token, "/api/v1/events"))
        # An answer begins before its stream is counted.
        assert streams[-1].response.readline().startswith(b"retry")
    assert streams[0].events(lambda _: False) == []
    world.launch("publish")
    seen = streams[1].events(lambda event: event["event"] == "run")
    assert [event["event"] for event in seen] == ["run"]
    for stream in streams[1:]:
        stream.close()
