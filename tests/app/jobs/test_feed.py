from types import SimpleNamespace
from typing import Any

import pytest

from app.jobs import watch as feed_module
from app.jobs.watch import Feed


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    monkeypatch.setattr(feed_module, "_LOOK_INTERVAL_S", 0.0)
    monkeypatch.setattr(feed_module, "_LOOK_SHARE", float("inf"))
    return [{"id": "a", "state": "queued"}]


def seen(feed: Feed, cursor: str) -> list[tuple[str, Any]]:
    return [(change.event, dict(change.data)) for change in feed.since(cursor)]


def test_each_reader_gets_every_change_once_from_where_it_was(runs: list[dict[str, Any]]) -> None:
    feed = Feed(lambda: [dict(run) for run in runs])
    start = feed.cursor()
    assert feed.since(start) == []
    runs[0]["state"] = "running"
    first = feed.since(start)
    assert [(c.event, c.data["state"]) for c in first] == [("run", "running")]
    runs.append({"id": "b", "state": "queued"})
    assert seen(feed, first[-1].id) == [("run", {"id": "b", "state": "queued"})]
    assert len(seen(feed, start)) == 2
    del runs[0]
    assert seen(feed, feed.since(start)[1].id) == [("gone", {"id": "a"})]


@pytest.mark.parametrize("cursor", [None, "", "0000-0", "x", "abc-99999999999999999999", "-1"])
def test_a_reader_from_before_a_restart_is_told_to_reload(
    runs: list[dict[str, Any]], cursor: str | None
) -> None:
    feed = Feed(lambda: runs)
    changes = feed.since(cursor)
    assert [change.event for change in changes] == ["reset"]
    assert feed.since(changes[0].id) == []


def test_a_reader_that_was_away_too_long_is_told_to_reload(
    runs: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(feed_module, "_KEPT_EVENTS", 3)
    feed = Feed(lambda: [dict(run) for run in runs])
    start = feed.cursor()
    for number in range(3):
        runs[0]["state"] = str(number)
        feed.cursor()
    assert [data["state"] for _, data in seen(feed, start)] == ["0", "1", "2"]
    runs[0]["state"] = "3"
    assert [event for event, _ in seen(feed, start)] == ["reset"]


def test_many_readers_cost_one_look(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(feed_module, "_LOOK_INTERVAL_S", 60.0)
    looks: list[int] = []

    def look() -> list[dict[str, Any]]:
        looks.append(1)
        return []

    feed = Feed(look)
    start = feed.cursor()
    for _ in range(100):
        feed.since(start)
    assert len(looks) == 1


def test_a_slow_look_is_not_repeated_at_once_but_a_page_sees_what_is_there(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(feed_module, "_LOOK_INTERVAL_S", 0.0)
    monkeypatch.setattr(feed_module, "_LOOK_SHARE", 1e-4)
    clock = SimpleNamespace(now=1.0)
    clock.monotonic = lambda: clock.now
    monkeypatch.setattr(feed_module, "time", clock)
    runs = [{"id": "a", "state": "queued"}]
    looks: list[int] = []

    def look() -> list[dict[str, Any]]:
        looks.append(1)
        clock.now += 0.01
        return [dict(run) for run in runs]

    feed = Feed(look)
    start, shown = feed.snapshot()
    assert shown == runs
    runs[0]["state"] = "running"
    clock.now += 99.0
    assert feed.since(start) == []
    assert len(looks) == 1
    changed, shown = feed.snapshot()
    assert shown == runs
    assert changed != start
    assert seen(feed, start) == [("run", {"id": "a", "state": "running"})]
    assert len(looks) == 2
    clock.now += 101.0
    feed.since(start)
    assert len(looks) == 3
