"""What the server tells of the machine, of a fit at work, and to whom."""

import json
import os
import time
from collections.abc import Iterator
from http.client import HTTPConnection
from typing import Any

import numpy as np
import pytest
from support.server.queue_world import HOSTILE, QueueWorld, serving
from support.server.server_world import World
from support.waiting import LIMIT_S, until

from physhandi.data.attempt import PREVIEW, PreviewFile
from physhandi.progress import Preview

ROUTES = (
    "/system",
    "/launch",
    "/api/v1/system",
    "/api/v1/system/events",
    "/api/v1/settings",
    "/api/v1/runs/fitted/preview",
)


def shown(height: float) -> Preview:
    node = np.zeros((3, 5, 3), np.float32)
    node[..., 2] = height * np.arange(5)
    return Preview(stage="s", sequence="sheet", loss=1.0, frame_rate=30.0, points={"object": node})


def events(port: int, token: str, path: str) -> Iterator[tuple[str, Any]]:
    connection = HTTPConnection("127.0.0.1", port, timeout=LIMIT_S)
    connection.request("GET", path, headers={"Authorization": f"Bearer {token}"})
    response = connection.getresponse()
    kind = ""
    try:
        while line := response.readline().decode():
            key, _, value = line.strip().partition(": ")
            kind = value if key == "event" else kind
            if key == "data":
                yield kind, json.loads(value)
    finally:
        response.close()
        connection.close()


@pytest.mark.parametrize("path", ROUTES)
def test_nobody_without_the_token_learns_anything(still_world: World, path: str) -> None:
    stranger = still_world.client()
    assert stranger.get(path).status_code == 401
    checked = stranger.post("/api/v1/runs/check", json={"sequences": ["sheet"]})
    assert checked.status_code == 401


def test_the_machine_the_queue_and_the_program_are_told(world: QueueWorld) -> None:
    idle = world.client.get("/api/v1/system").json()
    assert idle["slots"] == {"used": 0, "total": 1}
    assert (idle["running"], idle["waiting"]) == ([], [])
    first = world.launch("wait " + HOSTILE)
    world.until(first, "running")
    second = world.launch("wait")
    until(lambda: world.client.get("/api/v1/system").json()["waiting"])
    busy = world.client.get("/api/v1/system").json()
    assert busy["slots"] == {"used": 1, "total": 1}
    (running,), (waiting,) = busy["running"], busy["waiting"]
    assert (running["id"], running["state"]) == (first, "running")
    assert running["load"]["memory"] > 5 * 2**20
    assert running["load"]["processes"] == 2
    assert (waiting["id"], waiting["place"]) == (second, 1)
    assert "one fit runs at a time" in waiting["reason"]
    assert 0 < busy["machine"]["memory"]["used"] < busy["machine"]["memory"]["total"]
    assert busy["program"]["packages"]["numpy"] == np.__version__
    assert busy["data_dir"] == str(world.data_dir)
    page = world.client.get("/system").text
    assert "<img src=x" not in page
    assert np.__version__ in page


def test_a_preview_is_handed_on_and_a_link_is_not_followed(world: QueueWorld) -> None:
    run_id = world.launch("wait")
    world.until_reported(run_id, "second")
    address = f"/api/v1/runs/{run_id}/preview"
    assert world.client.get(address).status_code == 404
    assert world.client.get("/api/v1/runs/nobody/preview").status_code == 404
    PreviewFile(world.folder(run_id)).write(lambda: shown(0.1))
    path = world.folder(run_id) / PREVIEW
    answer = world.client.get(address)
    assert answer.content == path.read_bytes()
    assert answer.headers["cache-control"] == "no-store"
    path.rename(world.data_dir / "secret")
    path.symlink_to(world.data_dir / "secret")
    assert world.client.get(address).status_code == 404


def test_a_runs_one_stream_also_tells_previews_and_load(world: QueueWorld) -> None:
    run_id = world.launch("wait")
    world.until_reported(run_id, "second")
    seen: list[str] = []
    numbers: list[int] = []
    with serving(world) as port:
        for kind, data in events(port, world.token, f"/api/v1/runs/{run_id}/events"):
            seen.append(kind)
            if kind == "load" and not numbers:
                assert data["run"]["memory"] > 5 * 2**20
                assert 0.0 <= data["machine"]["disk"]["share"] <= 1.0
                PreviewFile(world.folder(run_id)).write(lambda: shown(0.1))
            if kind == "preview":
                numbers.append(data["number"])
                preview = PreviewFile(world.folder(run_id))
                preview.write(lambda: shown(0.2))
                # Its number is its time, and this machine's disk may tell only coarse times.
                later = time.time() + 10.0
                os.utime(world.folder(run_id) / PREVIEW, (later, later))
            if len(numbers) == 2:
                break
    assert numbers[0] < numbers[1]
    assert {"run", "load", "preview"} <= set(seen)


def test_the_systems_stream_tells_what_begins_and_ends(world: QueueWorld) -> None:
    run_id = world.launch("wait")
    world.until(run_id, "running")
    with serving(world) as port:
        stream = events(port, world.token, "/api/v1/system/events")
        kind, first = next(stream)
        assert kind == "system"
        assert [run["id"] for run in first["running"]] == [run_id]
        (world.folder(run_id) / "go").touch()
        assert any(data["slots"]["used"] == 0 for _, data in stream)
