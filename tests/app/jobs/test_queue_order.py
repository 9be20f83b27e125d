"""Whose turn it is in the queue, in made-up time and without processes."""

import io
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support.server.server_world import World, make_world

from app.jobs import scheduler as scheduler_module
from app.jobs.catalog import Catalog
from app.jobs.engines.local_engine import LocalEngine
from app.jobs.scheduler import QueueFullError, Scheduler
from app.jobs.ticket import STARTED, Priority, note_end, read_ticket
from app.settings import ServerSettings
from physhandi.data.files import write_json
from physhandi.run import Run

HOUR = 3600.0


class Queue:
    """Schedulers of one data folder, whose fits are only noted to have begun."""

    def __init__(self, data_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 1_800_000_000.0
        self.begun: list[str] = []
        self._data_dir = data_dir
        monkeypatch.setattr("time.time", lambda: self.now)

        def begin(_: LocalEngine, folder: Path, _ticket: object) -> None:
            self.begun.append(Run.open(folder).name)

        monkeypatch.setattr(LocalEngine, "start", begin)

    def server(self, **settings: Any) -> Scheduler:
        made = ServerSettings(data_dir=self._data_dir, **settings)
        return Scheduler(made, Catalog(made))

    def launch(
        self, scheduler: Scheduler, name: str, priority: Priority = "normal", who: str = ""
    ) -> Run:
        self.now += 1.0  # Nobody is as early as somebody else.
        return scheduler.launch(["sheet"], "quick", name, priority=priority, who=who)

    def end(self, run: Run) -> None:
        note_end(run.folder, "It was ended.")


@pytest.fixture
def queue(data_dir: Path, monkeypatch: pytest.MonkeyPatch) -> Queue:
    return Queue(data_dir, monkeypatch)


def test_a_high_priority_passes_what_came_up_to_a_day_before_and_nothing_older(
    queue: Queue,
) -> None:
    first, start = queue.server(), queue.now
    runs: dict[str, Run] = {}
    wishes: tuple[tuple[str, float, Priority], ...] = (
        ("a", 0.0, "normal"),
        ("b", 10.0, "normal"),
        ("c", 20.0, "high"),  # counts as come 4 h before "a"
        ("d", 21.0, "low"),  # counts as come at 45 h
        ("e", 30.0, "normal"),
        ("f", 30.0, "high"),  # counts as come at 6 h: "a" has waited for longer
        ("g", 46.0, "normal"),
    )
    for name, hours, priority in wishes:
        queue.now = start + hours * HOUR
        runs[name] = queue.launch(first, name, priority)
    # Priorities are kept in the folders, so another server does the same, whenever it starts.
    queue.now = start + 1000 * HOUR
    later = queue.server()
    for name in ("c", "a", "f", "b", "e", "d", "g"):
        later._step()
        assert queue.begun[-1] == name
        queue.end(runs[name])
    assert len(queue.begun) == 7


def test_within_a_priority_who_came_first_is_first(queue: Queue) -> None:
    server = queue.server()
    names = [f"fit {number}" for number in range(5)]
    runs = [queue.launch(server, name, "high") for name in names]
    for run in runs:
        server._step()
        queue.end(run)
    assert queue.begun == names


def test_a_run_that_lost_its_process_keeps_its_place_and_its_priority(queue: Queue) -> None:
    server = queue.server()
    lost = queue.launch(server, "lost", "high", who="Ada")
    queue.launch(server, "other", "high")
    server._step()
    assert queue.begun == ["lost"]
    server._sweep()  # Nobody works on it: it is put back in line.
    server._step()
    assert queue.begun == ["lost", "lost"]
    ticket = read_ticket(lost.folder / STARTED)
    assert ticket is not None
    assert (ticket.priority, ticket.who, ticket.starts) == ("high", "Ada", 2)


def test_further_fits_of_one_client_let_those_of_others_pass(queue: Queue) -> None:
    server = queue.server(parallel_fits=2, running_fits_each=1)
    first, second, third, fourth = (
        queue.launch(server, name, who=name[0]) for name in ("A1", "A2", "B1", "B2")
    )
    server._step()
    assert queue.begun == ["A1", "B1"]
    told = server.view(server._catalog.run_item(second.id))
    assert (told.place, "Waits for a free place" in told.reason) == (1, True)
    queue.end(third)
    server._step()
    assert queue.begun == ["A1", "B1", "B2"]
    queue.end(fourth)
    server._step()  # A place is free, but who waits for it has his share.
    told = server.view(server._catalog.run_item(second.id))
    assert "fewer fits of the same client run: 1 at a time (PHYSHANDI_RUNNING" in told.reason
    queue.end(first)
    server._step()
    assert queue.begun == ["A1", "B1", "B2", "A2"]


def test_one_client_may_put_only_so_many_in_line(queue: Queue) -> None:
    server = queue.server(waiting_fits_each=2, waiting_fits=3)
    mine = [queue.launch(server, f"mine {number}", who="A") for number in range(2)]
    with pytest.raises(QueueFullError, match="2 fits of yours wait already, of at most 2"):
        queue.launch(server, "a third", who="A")
    queue.launch(server, "another's", who="B")
    with pytest.raises(QueueFullError, match="3 fits wait already, of at most 3"):
        queue.launch(server, "a fourth", who="C")
    assert len(list((queue._data_dir / "runs").iterdir())) == 3
    server.cancel(mine[0].id)  # Its place is free at once.
    queue.launch(server, "a third", who="A")
    with pytest.raises(QueueFullError):
        server.resume(mine[0].id, who="A")


def test_only_what_can_move_is_looked_at_all_the_time(
    queue: Queue, data_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(40):
        run = Run.create(
            data_dir / "runs" / f"ended{number}",
            name="ended",
            kind="reconstruction",
            sequences=["/data/sheet"],
            config={},
        )
        write_json(run.folder / "exit.json", {"state": "failed", "error": "It was ended."})
    server, seconds = queue.server(), [0.0]
    monkeypatch.setattr("time.monotonic", lambda: seconds[0])
    running, waiting = queue.launch(server, "running"), queue.launch(server, "waiting")
    server._step()
    assert queue.begun == ["running"]

    asked, asker = list[str](), threading.current_thread()
    names: tuple[tuple[Any, str], ...] = ((os, "stat"), (os, "open"), (os, "listdir"), (io, "open"))
    for module, name in names:
        do: Callable[..., Any] = getattr(module, name)

        def counted(path: Any, *args: Any, do: Callable[..., Any] = do, **kinds: Any) -> Any:
            if threading.current_thread() is asker:  # Threads of others may open what they like.
                asked.append(str(path))
            return do(path, *args, **kinds)

        monkeypatch.setattr(module, name, counted)
    for _ in range(20):  # Five seconds of the queue, but for the last look.
        server._step()
        seconds[0] += 0.249
    assert asked
    assert not any("ended" in path or path.endswith("/runs") for path in asked)
    assert any(running.id in path for path in asked)
    assert any(waiting.id in path for path in asked)
    before = len(asked)
    seconds[0] = scheduler_module._SURVEY_INTERVAL_S
    server._step()
    assert sum("ended" in path for path in asked[before:]) >= 40


def test_a_run_that_another_program_put_into_the_folder_is_found(
    queue: Queue, data_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seconds = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: seconds[0])
    server, other = queue.server(), queue.server()
    server._step()
    queue.launch(other, "of another program")
    server._step()
    assert queue.begun == []
    seconds[0] = scheduler_module._SURVEY_INTERVAL_S
    server._step()
    assert queue.begun == ["of another program"]


def test_priorities_are_asked_for_shown_and_changed_while_a_fit_waits(world: World) -> None:
    client, page = world.script(), world.browser()
    ids = [
        client.post(
            "/api/v1/runs", json={"sequences": ["sheet"], "name": name, "priority": priority}
        ).json()["id"]
        for name, priority in (("first", "normal"), ("second", "low"))
    ]

    def places() -> list[tuple[str, int, str]]:
        runs = client.get("/api/v1/runs?state=queued").json()["runs"]
        return sorted((run["name"], run["place"], run["priority"]) for run in runs)

    assert places() == [("first", 1, "normal"), ("second", 2, "low")]
    address = f"/api/v1/runs/{ids[1]}/priority"
    assert client.post(address, json={"priority": "high"}).json()["place"] == 1
    assert places() == [("first", 2, "normal"), ("second", 1, "high")]
    assert "High priority." in page.get(f"/runs/{ids[1]}").text
    listed = page.get("/runs").text
    assert 'aria-label="Normal priority for second"' in listed
    assert 'aria-label="High priority for first"' in listed
    assert 'aria-label="Low priority for first"' in listed
    assert client.post(address, json={"priority": "urgent"}).status_code == 422
    # It is kept in the folder, where a server that is started anew reads it.
    again = make_world(world.settings.data_dir)
    again.scheduler._line = {}
    told = again.script().get(f"/api/v1/runs/{ids[1]}").json()
    assert (told["state"], told["priority"]) == ("queued", "high")
    client.post(f"/api/v1/runs/{ids[1]}/cancel")
    refused = client.post(address, json={"priority": "low"})
    assert refused.status_code == 409
    assert "does not wait" in refused.json()["error"]["message"]
    assert client.get("/api/v1/runs/fitted").json()["priority"] is None


def test_a_fit_is_started_once_more_however_often_that_is_asked_for(world: World) -> None:
    client = world.script()
    run_id = client.post("/api/v1/runs", json={"sequences": ["sheet"]}).json()["id"]
    client.post(f"/api/v1/runs/{run_id}/cancel")
    run, address = world.catalog.run(run_id), f"/api/v1/runs/{run_id}/resume"
    with run.begin_attempt() as attempt:
        attempt.save_json("first.json", {"attempt": 1})
        attempt.finish_stage("first", {"before": 2.0, "after": 1.0})
        attempt.fail("It went wrong.")

    def again(key: str, **body: Any) -> Any:
        return client.post(address, json=body, headers={"Idempotency-Key": key})

    for _ in range(3):
        assert client.post(address).json()["state"] == "queued"
    assert again("k-1").json()["state"] == "queued"
    client.post(f"/api/v1/runs/{run_id}/cancel")
    # Whoever was answered before starts nothing, however late he comes.
    late = again("k-1")
    assert (late.json()["state"], late.headers["Idempotency-Replayed"]) == ("failed", "true")
    assert again("k-1", afresh=True).status_code == 422
    assert again("k-2").json()["state"] == "queued"
    # It goes on where it was …
    with run.begin_attempt() as attempt:
        assert attempt.stage_done("first")
        attempt.fail("It went wrong again.")
    (run.folder / "queued.json").unlink()
    # … or begins anew, with the same settings, and takes nothing from earlier attempts.
    assert again("k-3", afresh=True, priority="high").json()["priority"] == "high"
    assert again("k-3", afresh=True, priority="high").headers["Idempotency-Replayed"] == "true"
    with run.begin_attempt() as attempt:
        assert not attempt.stage_done("first")
        assert list(attempt.out.iterdir()) == []
    finished = client.post("/api/v1/runs/fitted/resume")
    assert finished.status_code == 409
    assert "is succeeded; only a failed" in finished.json()["error"]["message"]
