"""Who asks again with the same key gets the same run."""

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient
from support.server.server_world import World, make_world

from app.jobs.launch_keys import KeyedRequest, LaunchKeys


def keyed(client: TestClient, key: str, **body: Any) -> Any:
    wanted = {"sequences": ["sheet"]} | body
    return client.post("/api/v1/runs", json=wanted, headers={"Idempotency-Key": key})


def test_whoever_asks_again_with_the_same_key_gets_the_same_run(world: World) -> None:
    client = world.script()
    with ThreadPoolExecutor(8) as pool:
        answers = list(pool.map(lambda _: keyed(client, "k-1", name="once"), range(20)))
    assert {answer.status_code for answer in answers} == {201}
    (run_id,) = {answer.json()["id"] for answer in answers}
    # Order and defaults are no other words, also for a server that was started since.
    again = make_world(world.settings.data_dir).script()
    replay = keyed(again, "k-1", profile="quick", name="once")
    assert (replay.json()["id"], replay.headers["Idempotency-Replayed"]) == (run_id, "true")
    assert keyed(again, "k-2", name="once").json()["id"] != run_id
    refused = keyed(again, "k-1", name="twice")
    assert refused.status_code == 422
    assert run_id in refused.json()["error"]["message"]
    assert keyed(again, "two words").status_code == 422
    assert len(list(world.settings.run_dir.glob("0*"))) == 2
    # A run that was deleted does not come back.
    again.post(f"/api/v1/runs/{run_id}/cancel")
    assert again.delete(f"/api/v1/runs/{run_id}").status_code == 204
    late = keyed(again, "k-1", name="once")
    assert late.status_code == 409
    assert "was deleted since" in late.json()["error"]["message"]


def test_a_server_killed_while_it_launched_makes_the_run_when_it_is_asked_again(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = world.script()
    for victim in ("Run.create", "put_in_line"):
        with monkeypatch.context() as patch:
            patch.setattr(f"app.jobs.scheduler.{victim}", lambda *_, **__: 1 / 0)
            with pytest.raises(ZeroDivisionError):
                keyed(client, victim)
        made = keyed(make_world(world.settings.data_dir).script(), victim).json()
        assert made["state"] == "queued"
    assert len(list(world.settings.run_dir.glob("0*"))) == 2


def test_keys_are_forgotten_in_order_and_a_damaged_file_forgets_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.jobs.launch_keys.MOST_LAUNCH_KEYS", 3)
    path = tmp_path / "launches.json"
    requests = [KeyedRequest.of(f"key {number}", {}) for number in range(5)]
    for number, request in enumerate(requests):
        LaunchKeys(path).note(request, f"run{number}")
    known = [LaunchKeys(path).run_of(request) for request in requests]
    assert known == [None, None, "run2", "run3", "run4"]
    content = json.loads(path.read_text())
    content["launches"][requests[3].key] = ["x", 1]
    path.write_text(json.dumps(content))
    assert [LaunchKeys(path).run_of(request) for request in requests[3:]] == [None, "run4"]
    for text in ("{torn", "[" * 9999, '{"launches": [1]}'):
        path.write_text(text)
        assert LaunchKeys(path).run_of(requests[4]) is None
