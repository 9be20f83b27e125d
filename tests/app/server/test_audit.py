"""The log of who changed what."""

import errno
import json
import os
import stat
from pathlib import Path
from typing import Any

import pytest
from support.server.server_world import HOST, ORIGIN, TOKEN, World

from app import audit
from app.audit import KEPT, MOST_REFUSED, AuditLog


class Clock:
    now = 1_700_000_000.25

    def __call__(self) -> float:
        return self.now


def lines(folder: Path, name: str = "audit.jsonl") -> list[dict[str, Any]]:
    path = folder / name
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def test_each_line_is_whole_has_its_time_and_is_its_owners(tmp_path: Path) -> None:
    log = AuditLog(tmp_path / "audit", clock=Clock())
    log.write({"who": "a\nb\u202e"})
    log.write({"who": "c"})
    path = tmp_path / "audit" / "audit.jsonl"
    assert path.read_bytes().isascii()
    told = lines(tmp_path / "audit")
    assert told[0] == {"time": "2023-11-14T22:13:20.250+00:00", "who": "a\nb\u202e"}
    assert len(told) == 2
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700


def test_old_files_are_kept_and_then_dropped(tmp_path: Path) -> None:
    log = AuditLog(tmp_path, most_bytes=200)
    for number in range(40):
        log.write({"number": number})
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == [*(f"audit.{n}.jsonl" for n in range(1, KEPT + 1)), "audit.jsonl"]
    assert all(path.stat().st_size <= 200 for path in tmp_path.iterdir())
    numbers = [
        line["number"]
        for name in [*names[KEPT - 1 :: -1], names[-1]]
        for line in lines(tmp_path, name)
    ]
    assert numbers == list(range(numbers[0], 40))
    assert len(numbers) > 3 * KEPT


def test_who_is_refused_cannot_fill_it(tmp_path: Path) -> None:
    clock = Clock()
    log = AuditLog(tmp_path, clock=clock)
    for _ in range(MOST_REFUSED + 7):
        log.write({"status": 403}, is_refused=True)
    log.write({"status": 200})
    told = lines(tmp_path)
    assert len(told) == MOST_REFUSED + 1
    assert told[-1]["left_out_before"] == 7
    clock.now += 60
    log.write({"status": 403}, is_refused=True)
    assert len(lines(tmp_path)) == MOST_REFUSED + 2
    assert "left_out_before" not in lines(tmp_path)[-1]


def test_what_is_kept_from_a_scene_is_noted_without_a_request(tmp_path: Path) -> None:
    log = AuditLog(tmp_path, clock=Clock())
    log.note_scene("3f0c", "keep a run", "01K")
    log.note_scene("3f0c", "delete a preset", None)
    told = lines(tmp_path)
    assert (told[0]["who"], told[0]["what"], told[0]["run_id"]) == ("3f0c", "keep a run", "01K")
    assert "run_id" not in told[1]


def test_a_full_disk_is_told_and_stops_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(_descriptor: int, _content: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    log = AuditLog(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(os, "write", full)
        log.write({"who": "a"})
    assert "a line of the audit log was lost" in caplog.text
    log.write({"who": "b"})
    assert [line["who"] for line in lines(tmp_path)] == ["b"]


def test_requests_that_change_something_are_noted_with_who_what_and_outcome(world: World) -> None:
    folder = world.settings.data_dir / "audit"
    browser, script = world.client(Origin=ORIGIN), world.script()
    browser.get("/", params={"token": TOKEN})
    browser.get("/runs")
    browser.patch("/api/v1/runs/fitted", json={"name": "a secret name"})
    made = script.post("/api/v1/runs", json={"sequences": ["sheet"]}).json()["id"]
    script.post(f"/api/v1/runs/{made}/cancel")
    script.post("/api/v1/runs/check", json={})
    script.delete("/api/v1/runs/no%20id")
    script.put("/nothing/of/the%0akind?x=1")
    browser.delete(f"/api/v1/runs/{made}", headers={"Origin": "http://evil.example"})
    world.client().delete(f"/api/v1/runs/{made}")
    told = lines(folder)
    name = told[0]["who"]
    assert [(line["who"], line["what"], line.get("run_id"), line["status"]) for line in told] == [
        (name, "sign in", None, 303),
        (name, "PATCH /api/v1/runs/{run_id}", "fitted", 200),
        ("bearer", "POST /api/v1/runs", made, 201),
        ("bearer", "POST /api/v1/runs/{run_id}/cancel", made, 200),
        ("bearer", "DELETE /api/v1/runs/{run_id}", "", 422),
        ("bearer", "PUT", None, 404),
        (name, "DELETE", None, 403),
    ]
    assert len(name) == 16
    assert {line["client"] for line in told} == {"tester"}
    text = (folder / "audit.jsonl").read_text()
    for secret in (TOKEN, "a secret name", HOST, "kind", "%", world.security.cookie):
        assert secret not in text


def test_addresses_that_are_secrets_are_noted_by_their_hash(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = world.script()
    secret = "s" * 32
    script.delete(f"/api/v1/shares/{secret}")
    script.delete(f"/api/v1/sessions/{secret}")
    told = lines(world.settings.data_dir / "audit")
    assert [line["what"] for line in told] == ["DELETE /api/v1/shares/{share_id}"]
    assert told[0]["share_id"] == audit._shown("share_id", secret) != secret
    assert len(told[0]["share_id"]) == 12
