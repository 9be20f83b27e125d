"""What may go of a data folder: nothing by itself, and never what is needed."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support.hostile.bad_input_world import Terminal
from support.server.server_world import World, make_world

from app.jobs.recordings.background import BackgroundTasks
from app.jobs.recordings.uploads import Uploads
from app.jobs.storage.retention import Expendable, Retention, freed_by
from app.settings import ServerSettings
from physhandi.data.attempt import PREVIEW
from physhandi.run import Run

DAY = 86_400.0
NOW = 1_800_000_000.0


class Kept:
    """A data folder whose runs ended ten days ago, and what a server may remove of it."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.noted: list[dict[str, Any]] = []

    def rules(self, **days: Any) -> Retention:
        settings = ServerSettings(data_dir=self.world.settings.data_dir, **days)
        return Retention(
            settings,
            self.world.catalog,
            self.world.scheduler,
            Uploads(settings, BackgroundTasks()),
            lambda told: self.noted.append(dict(told)),
            clock=lambda: NOW,
        )

    def run(self, name: str, end: Callable[[Any], None]) -> Run:
        """Make a run with two attempts, of which the second goes on from the first."""
        run = Run.create(
            self.world.settings.run_dir / name,
            name=name,
            kind="reconstruction",
            sequences=[str(self.world.settings.sequence_dir / "sheet")],
            config={},
        )
        with run.begin_attempt() as attempt:
            attempt.save_json("first.json", {"numbers": [0] * 500})
            attempt.finish_stage("first", {})
            attempt.save_json("half.json", {"numbers": [0] * 200})
            attempt.fail("It went wrong.")
        with run.begin_attempt() as attempt:
            attempt.save_json("second.json", {"numbers": [0] * 100})
            end(attempt)
        (run.folder / "log.txt").write_text("It said something.\n")
        (run.folder / PREVIEW).write_bytes(bytes(300))
        ended_at(run.folder / "exit.json", NOW - 10 * DAY)
        return run


def ended_at(path: Path, moment: float) -> None:
    os.utime(path, (moment, moment))


def told(items: list[Expendable]) -> list[tuple[str, str, str]]:
    return sorted((item.kind, item.name, item.rule) for item in items)


@pytest.fixture
def kept(world: World) -> Kept:
    kept = Kept(world)
    ended_at(world.settings.run_dir / "fitted" / "exit.json", NOW - 10 * DAY)
    return kept


def tree(folder: Path) -> dict[str, int]:
    return {str(p.relative_to(folder)): p.stat().st_size for p in folder.rglob("*") if p.is_file()}


def test_nothing_goes_unless_that_is_set(kept: Kept) -> None:
    kept.run("failed", lambda attempt: attempt.fail("It went wrong again."))
    cache = kept.world.settings.data_dir / "cache" / "previews"
    cache.mkdir(parents=True)
    (cache / "run-a.jpg").write_bytes(bytes(10))
    before = tree(kept.world.settings.data_dir)
    retention = kept.rules()
    assert retention.listed() == []
    assert retention.remove() == []
    assert tree(kept.world.settings.data_dir) == before
    assert kept.noted == []


def test_attempts_go_after_their_time_and_results_never(kept: Kept) -> None:
    failed = kept.run("failed", lambda attempt: attempt.fail("It went wrong again."))
    succeeded = kept.run("succeeded", lambda attempt: attempt.publish())
    waits = kept.run("waits", lambda attempt: attempt.cancelled())
    kept.world.scheduler.resume("waits")
    damaged = kept.run("damaged", lambda attempt: attempt.publish())
    (damaged.folder / "current").write_bytes(b"\xff")
    fitted = tree(kept.world.settings.run_dir / "fitted")
    untouched = tree(waits.folder), tree(damaged.folder)
    assert kept.rules(keep_attempts_days=10.1).listed() == []

    retention = kept.rules(keep_attempts_days=9.9)
    rule = "PHYSHANDI_KEEP_ATTEMPTS_DAYS"
    listed = retention.listed()
    assert told(listed) == [
        ("attempts", "runs/failed/attempts", rule),
        ("attempts", "runs/succeeded/attempts", rule),
    ]
    assert {round(item.days, 3) for item in listed} == {10.0}
    # What the published attempt shares with the one before stays on the disk.
    before = {p: p.stat() for p in (succeeded.folder / "attempts" / "1").rglob("*.json")}
    lone = sum(status.st_size for status in before.values() if status.st_nlink == 1)
    assert 0 < lone < sum(status.st_size for status in before.values())
    assert {item.id: item.bytes for item in listed}["succeeded"] == lone
    assert retention.remove() == listed
    assert retention.remove() == []

    again = Run.open(succeeded.folder)
    again.verify()
    assert [path.name for path in (succeeded.folder / "attempts").iterdir()] == ["2"]
    assert again.json("first.json") == {"numbers": [0] * 500}
    assert tree(kept.world.settings.run_dir / "fitted") == fitted
    assert (tree(waits.folder), tree(damaged.folder)) == untouched
    # A failed run stays in the list, with its reason, and begins afresh when it is resumed.
    item = kept.world.catalog.run_item("failed")
    view = kept.world.scheduler.view(item)
    assert (view.state, view.reason) == ("failed", "It went wrong again.")
    assert freed_by([failed.folder / "attempts"]) == 0
    assert kept.world.script().get("/api/v1/runs/failed").json()["state"] == "failed"
    assert kept.world.browser().get("/runs/failed").status_code == 200
    kept.world.scheduler.resume("failed")
    with failed.begin_attempt() as attempt:
        assert not attempt.stage_done("first")
    assert [(line["what"], line["run_id"], line["rule"]) for line in kept.noted] == [
        ("remove attempts", item.id, rule) for item in listed
    ]


def test_logs_go_and_losses_stay(kept: Kept) -> None:
    run = kept.run("failed", lambda attempt: attempt.fail("It went wrong again."))
    retention = kept.rules(keep_logs_days=3.0)
    (item,) = [item for item in retention.listed() if item.id == "failed"]
    assert (item.kind, item.bytes) == ("log", len("It said something.\n") + 300)
    retention.remove()
    assert not (run.folder / "log.txt").exists()
    assert not (run.folder / PREVIEW).exists()
    assert len(list((run.folder / "attempts").iterdir())) == 2


def test_the_cache_shrinks_from_its_oldest_and_keeps_the_index(kept: Kept) -> None:
    cache = kept.world.settings.data_dir / "cache"
    for place in ("previews", "exports"):
        (cache / place).mkdir(parents=True)
    sizes = {"exports/old": 40, "previews/middle": 30, "exports/new": 20, "exports/.making": 99}
    for number, (name, size) in enumerate(sizes.items()):
        (cache / name).write_bytes(bytes(size * 2**10))
        ended_at(cache / name, NOW - (9 - number) * DAY)
    (cache / "previews" / "vanished").symlink_to("nowhere")  # It is listed, and then is not there.
    kept.world.catalog.reindex()
    ended_at(cache / "runs.json", NOW - 90 * DAY)
    by_size = kept.rules(cache_gib=55 / 2**20)  # 55 KiB of 90
    assert told(by_size.listed()) == [("cache", "cache/exports/old", "PHYSHANDI_CACHE_GIB")]
    by_age = kept.rules(keep_cache_days=7.5, cache_gib=25 / 2**20)
    assert told(by_age.listed()) == [
        ("cache", "cache/exports/old", "PHYSHANDI_KEEP_CACHE_DAYS"),
        ("cache", "cache/previews/middle", "PHYSHANDI_KEEP_CACHE_DAYS"),
    ]
    assert len(by_size.remove()) == 1
    left = sorted(path.name for path in cache.rglob("*") if path.is_file())
    assert left == [".making", "middle", "new", "runs.json"]


def test_uploads_go_that_nobody_finishes(kept: Kept) -> None:
    client = kept.world.script()
    announced = {"name": "new", "files": [{"path": "a.npy", "size": 1000}]}
    old, new = (client.post("/api/v1/uploads", json=announced).json()["id"] for _ in range(2))
    folder = kept.world.settings.data_dir / "incoming"
    for upload_id, days in ((old, 8), (new, 6)):
        for path in (folder / upload_id, *(folder / upload_id).rglob("*")):
            ended_at(path, NOW - days * DAY)
        (folder / upload_id / "vanished").symlink_to("nowhere")
        ended_at(folder / upload_id, NOW - days * DAY)
    assert kept.rules(keep_uploads_days=None).listed() == []
    (item,) = kept.rules().remove()
    assert (item.kind, item.id, item.name) == ("upload", old, f"incoming/{old}")
    assert [path.name for path in folder.iterdir()] == [new]


def test_what_may_go_is_listed_on_a_page_and_by_the_doctor_and_noted_when_it_goes(
    data_dir: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PHYSHANDI_KEEP_LOGS_DAYS", "1")
    world = make_world(data_dir)
    kept = Kept(world)
    run = kept.run("failed", lambda attempt: attempt.fail("It went wrong again."))
    ended_at(run.folder / "exit.json", 1_700_000_000.0)
    client, page = world.script(), world.browser().get("/recovery").text
    assert "<code>runs/failed/log.txt</code>" in page
    assert "PHYSHANDI_KEEP_LOGS_DAYS" in page
    shown = client.get("/api/v1/retention").json()
    assert [(item["id"], item["bytes"]) for item in shown["items"]] == [("failed", 319)]
    code, out, _ = Terminal(data_dir.parent, capsys)("doctor", "--data-dir", data_dir)
    assert "1 would be removed by a server, 0.0 MiB (PHYSHANDI_KEEP_LOGS_DAYS=1)" in out
    assert code == 0
    assert (run.folder / "log.txt").exists()
    assert client.post("/api/v1/retention").json()["bytes"] == 319
    assert not (run.folder / "log.txt").exists()
    told = (data_dir / "audit" / "audit.jsonl").read_text().splitlines()
    lines = [json.loads(line) for line in told]
    noted = [(line["who"], line["what"], line.get("run_id")) for line in lines]
    assert noted == [
        ("server", "remove log", "failed"),
        ("bearer", "POST /api/v1/retention", None),
    ]
    assert "Nothing. Results" in world.browser().get("/recovery").text
