"""The queue, with real child processes."""

import errno
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil
import pytest
from support.waiting import LIMIT_S, WatchedLock, until

from app.jobs import scheduler as scheduler_module
from app.jobs.catalog import Catalog
from app.jobs.engines import following as following_module
from app.jobs.engines import local_engine
from app.jobs.engines.device_choice import DeviceChoice
from app.jobs.machine import Cards
from app.jobs.processes import end_processes, processes_of, supervisor_of
from app.jobs.scheduler import JobView, Scheduler
from app.jobs.ticket import STARTED, Ticket, read_ticket
from app.settings import ServerSettings
from physhandi.data.lease import live_holder
from physhandi.data.run_folder import read_events
from physhandi.errors import PhysHandiError, RunError, SequenceError, UsageError
from physhandi.run import Run

TESTS = Path(__file__).parents[2]
GRACE_S = 0.4


class Desk:
    """A scheduler, and shortcuts to what a test asks it."""

    def __init__(self, data_dir: Path, cards: Cards | None = None, **settings: Any) -> None:
        self.settings = ServerSettings(data_dir=data_dir, cancel_grace_s=GRACE_S, **settings)
        self.catalog = Catalog(self.settings)
        choice = cards and DeviceChoice(self.settings, cards, card_of=lambda name: f"GPU {name}")
        self.scheduler = Scheduler(
            self.settings, self.catalog, choice=choice, worker="support.server.job_worker"
        )

    def launch(self, behaviour: str) -> str:
        return self.scheduler.launch(["sheet"], "quick", behaviour).id

    def view(self, run_id: str) -> JobView:
        return self.scheduler.view(self.catalog.run_item(run_id))

    def state(self, run_id: str) -> str:
        return self.view(run_id).state

    def run(self, run_id: str) -> Run:
        return self.catalog.run(run_id)

    def until(self, run_id: str, state: str) -> JobView:
        until(lambda: self.state(run_id) == state)
        return self.view(run_id)


@pytest.fixture
def desks(data_dir: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Desk]]:
    monkeypatch.setenv("PYTHONPATH", str(TESTS))
    monkeypatch.setattr(scheduler_module, "_SWEEP_INTERVAL_S", 0.3)
    made: list[Desk] = []

    def make(cards: Cards | None = None, **settings: Any) -> Desk:
        desk = Desk(data_dir, cards, **settings)
        made.append(desk)
        desk.scheduler.start()
        return desk

    yield make
    for desk in made:
        desk.scheduler.shutdown()
    for folder in (data_dir / "runs").iterdir():
        end_processes(folder, grace_s=0.0)
    for desk in made:
        for process in desk.scheduler._local.started.values():
            process.wait()


@pytest.fixture
def desk(desks: Callable[..., Desk]) -> Desk:
    return desks()


def is_alive(pid: int) -> bool:
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def pids_of(run: Run) -> list[int]:
    until((run.folder / "pids").exists)
    return [int(pid) for pid in (run.folder / "pids").read_text().split()]


def test_a_launched_run_is_worked_on_and_published(desk: Desk) -> None:
    run_id = desk.launch("publish")
    view = desk.until(run_id, "succeeded")
    assert view.reason == ""
    assert view.progress["stage"] == "second"
    run = desk.run(run_id)
    run.verify()
    assert run.json("losses.json")["first"] == {"before": 2.0, "after": 1.0}
    until(lambda: not list(processes_of(run.folder)))


def test_what_cannot_be_launched_leaves_no_run(desk: Desk) -> None:
    with pytest.raises(SequenceError, match="'nowhere'"):
        desk.scheduler.launch(["nowhere"], "quick")
    with pytest.raises(UsageError, match="'fastest'"):
        desk.scheduler.launch(["sheet"], "fastest")
    with pytest.raises(UsageError, match="at least one"):
        desk.scheduler.launch([], "quick")
    with pytest.raises(PhysHandiError):
        desk.scheduler.launch(["sheet", "sheet"], "quick")
    assert [item for item in desk.catalog.runs() if not item.is_bundled] == []


def test_runs_wait_in_order_and_are_cancelled_there_while_the_only_slot_is_taken(
    desk: Desk,
) -> None:
    first = desk.launch("wait 1")
    desk.until(first, "running")
    cancelled, *waiting = [desk.launch(f"wait {number}") for number in (2, 3, 4)]
    until(lambda: [desk.view(r).place for r in (cancelled, *waiting)] == [1, 2, 3])
    desk.scheduler.cancel(cancelled)
    assert desk.state(cancelled) == "cancelled"
    until(lambda: [desk.view(run_id).place for run_id in waiting] == [1, 2])
    assert [desk.state(run_id) for run_id in waiting] == ["queued", "queued"]
    assert "one fit runs at a time" in desk.view(waiting[1]).reason
    desk.scheduler._step()
    assert [desk.state(run_id) for run_id in waiting] == ["queued", "queued"]
    (desk.run(first).folder / "go").touch()
    desk.until(first, "succeeded")
    desk.until(waiting[0], "running")
    assert desk.view(waiting[1]).place == 1
    (desk.run(waiting[1]).folder / "go").touch()
    (desk.run(waiting[0]).folder / "go").touch()
    desk.until(waiting[1], "succeeded")
    ends = [read_events(desk.run(r).folder)[0][-1]["time"] for r in (first, *waiting)]
    assert ends == sorted(ends)
    # It was never started, though others have passed it.
    assert desk.state(cancelled) == "cancelled"
    assert read_events(desk.run(cancelled).folder)[0] == []


def test_two_slots_run_two_fits_side_by_side_which_never_learn_the_token(
    desks: Callable[..., Desk], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PHYSHANDI_TOKEN", "do-not-tell-anybody")
    desk = desks(parallel_fits=2)
    runs = [desk.launch(f"wait {number}") for number in range(3)]
    until(lambda: [desk.state(r) for r in runs] == ["running", "running", "queued"])
    # Libraries that start a thread for every processor would hinder the other fit.
    (worker, *_) = processes_of(desk.run(runs[1]).folder)
    environment = worker.environ()
    assert environment["OMP_NUM_THREADS"] == str(max(1, (os.cpu_count() or 1) // 2))
    assert "PHYSHANDI_TOKEN" not in environment
    desk.scheduler.cancel(runs[0])
    until(lambda: [desk.state(r) for r in runs] == ["cancelled", "running", "running"])


def test_each_graphics_card_has_one_fit(desks: Callable[..., Desk]) -> None:
    desk = desks(Cards(lambda _: ""), device="cuda:0,cuda:1")
    first, second, third = (desk.launch(f"wait {number}") for number in range(3))
    until(lambda: [desk.state(r) for r in (first, second, third)] == ["running"] * 2 + ["queued"])
    assert "2 fits run at a time" in desk.view(third).reason
    assert [device_of(desk, run_id) for run_id in (first, second)] == ["cuda:0", "cuda:1"]
    (desk.run(second).folder / "go").touch()
    desk.until(third, "running")
    assert device_of(desk, third) == "cuda:1"
    (worker, *_) = processes_of(desk.run(third).folder)
    assert worker.environ()["CUDA_VISIBLE_DEVICES"] == "GPU cuda:1"
    assert "cuda:0" in worker.cmdline()


def test_a_fit_waits_for_memory_of_a_graphics_card(desks: Callable[..., Desk]) -> None:
    used = [78976]
    cards = Cards(lambda _: f"0, NVIDIA H200, 0, {used[0]}, 80000, 40, GPU cuda:0")
    cards.refresh()
    desk = desks(cards, device="cuda:0")
    run_id = desk.launch("wait")
    until(lambda: "Waits for memory of a GPU: cuda:0 has 1.0 GiB" in desk.view(run_id).reason)
    used[0] = 70_000
    cards.refresh()
    desk.until(run_id, "running")


def device_of(desk: Desk, run_id: str) -> str:
    ticket = read_ticket(desk.run(run_id).folder / STARTED)
    assert ticket is not None
    return ticket.device


def test_a_polite_worker_is_cancelled_at_its_next_report_and_resumed_later(desk: Desk) -> None:
    run_id = desk.launch("wait")
    run = desk.run(run_id)
    until(lambda: (run.progress or {}).get("stage") == "second")
    desk.scheduler.cancel(run_id)
    desk.until(run_id, "cancelled")
    until(lambda: not list(processes_of(run.folder)))
    (run.folder / "go").touch()
    desk.scheduler.resume(run_id)
    desk.until(run_id, "succeeded")
    assert run.json("first.json") == {"attempt": 1}
    assert (run.folder / "current").read_text().strip() == "2"


def test_cancelling_ends_the_whole_tree_however_stubborn(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_id = desk.launch("stubborn")
    run = desk.run(run_id)
    pids = pids_of(run)
    assert all(is_alive(pid) for pid in pids)
    assert os.getsid(pids[1]) == pids[1]
    # It is ended in a thread, which might be done before the second wish.
    told, end = threading.Event(), desk.scheduler._end

    def end_when_told(*run: Any) -> None:
        assert told.wait(LIMIT_S)
        end(*run)

    monkeypatch.setattr(desk.scheduler, "_end", end_when_told)
    for _ in range(2):
        desk.scheduler.cancel(run_id)
        assert desk.state(run_id) == "stopping"
    start = time.monotonic()
    told.set()
    desk.until(run_id, "cancelled")
    assert time.monotonic() - start > GRACE_S * 0.9
    assert list(processes_of(run.folder)) == []
    # Of what was killed the kernel has still to let go.
    until(lambda: not any(is_alive(pid) for pid in pids))
    until(lambda: supervisor_of(run.folder) is None)
    with pytest.raises(RunError, match="nothing to cancel"):
        desk.scheduler.cancel(run_id)


def test_a_fit_is_cancelled_while_its_program_is_loading(desk: Desk) -> None:
    run_id = desk.launch("wait")
    until(lambda: desk.state(run_id) != "queued")
    desk.scheduler.cancel(run_id)
    desk.until(run_id, "cancelled")
    run = desk.run(run_id)
    assert list(processes_of(run.folder)) == []
    until(lambda: supervisor_of(run.folder) is None)


def test_a_closed_server_starts_nothing_more_and_the_next_tells_how_a_run_ended_meanwhile(
    desks: Callable[..., Desk],
) -> None:
    closed = desks()
    running = closed.launch("wait")
    closed.until(running, "running")
    waiting = closed.launch("publish")
    closed.scheduler.shutdown()
    folder = closed.run(running).folder
    (folder / "go").touch()
    until(lambda: supervisor_of(folder) is None)
    assert not closed.scheduler._thread.is_alive()
    assert (closed.run(waiting).folder / "queued.json").is_file()
    assert desks().state(running) == "succeeded"


def test_a_killed_worker_fails_with_a_reason_and_takes_its_children_along(desk: Desk) -> None:
    stubborn = desk.launch("stubborn")
    run = desk.run(stubborn)
    for start in (1, 2):
        worker, child = pids_of(run)
        (run.folder / "pids").unlink()
        told = "It was started again (2 of 2)" if start == 2 else ""
        assert told in desk.view(stubborn).reason
        os.kill(worker, signal.SIGKILL)
        until(lambda child=child: not is_alive(child))
    reason = desk.until(stubborn, "failed").reason
    assert "killed the worker (signal 9), and memory had not run out" in reason
    assert "That happened twice, so it is not started again." in reason
    # Whoever resumes it has two starts again.
    desk.scheduler.resume(stubborn)
    pids_of(run)
    assert desk.view(stubborn).reason == ""


def test_a_hung_worker_is_ended_and_its_run_started_once_more(desks: Callable[..., Desk]) -> None:
    desk = desks(hung_after_s=5.0)
    run_id = desk.launch("frozen")
    run = desk.run(run_id)
    until(lambda: desk.state(run_id) == "running")
    stopped = live_holder(run.folder)
    assert stopped is not None
    desk.until(run_id, "succeeded")
    assert not is_alive(stopped["pid"])
    assert (run.folder / "current").read_text().strip() == "2"
    until(lambda: not (run.folder / "started.json").exists())


@pytest.mark.parametrize(
    ("behaviour", "reason"),
    [
        ("fail", "'sheet' lacks a <b>hand</b>."),
        ("crash", "code 7"),
        ("silent", "code 5"),
    ],
)
def test_every_way_to_fail_tells_why(desk: Desk, behaviour: str, reason: str) -> None:
    run_id = desk.launch(behaviour)
    view = desk.until(run_id, "failed")
    assert reason in view.reason
    assert desk.run(run_id).state == "failed"
    if behaviour == "crash":
        until(lambda: "the last words" in (desk.run(run_id).folder / "log.txt").read_text())


def test_a_run_that_loses_its_supervisor_is_started_once_more(desk: Desk) -> None:
    run_id = desk.launch("wait")
    run = desk.run(run_id)
    until(lambda: (run.progress or {}).get("stage") == "second")
    supervisor = supervisor_of(run.folder)
    assert supervisor is not None
    os.kill(supervisor, signal.SIGKILL)
    until(lambda: run.attempt == 2)
    told = "It lost its process, which something outside ended. It was started again (2 of 2)."
    assert told in desk.view(run_id).reason
    # It goes on after its last finished stage, but only once.
    desk.until(run_id, "running")
    again = supervisor_of(run.folder)
    assert again is not None
    os.kill(again, signal.SIGKILL)
    assert "That happened twice" in desk.until(run_id, "failed").reason
    assert run.attempt == 2
    (run.folder / "go").touch()
    desk.scheduler.resume(run_id)
    desk.until(run_id, "succeeded")
    assert run.json("first.json") == {"attempt": 1}


def test_a_restarted_server_finds_running_and_waiting_runs_again(
    desks: Callable[..., Desk],
) -> None:
    before = desks()
    running, waiting = before.launch("wait 1"), before.launch("publish 2")
    before.until(running, "running")
    holder = live_holder(before.run(running).folder)
    before.scheduler.shutdown()

    after = desks()
    assert after.state(running) == "running"
    until(lambda: after.view(waiting).place == 1)
    after.scheduler._step()
    after.scheduler._sweep()
    assert [after.state(running), after.state(waiting)] == ["running", "queued"]
    assert holder is not None
    now = live_holder(after.run(running).folder)
    assert now is not None
    assert now["pid"] == holder["pid"]
    after.scheduler.cancel(running)
    after.until(running, "cancelled")
    after.until(waiting, "succeeded")


def test_two_servers_never_share_a_data_folder(desks: Callable[..., Desk]) -> None:
    desks()
    with pytest.raises(RunError, match="Another server"):
        desks()


def test_a_run_at_work_is_neither_deleted_nor_started_once_more(desk: Desk) -> None:
    run_id = desk.launch("wait")
    for _ in range(2):
        with pytest.raises(RunError, match="Cancel it"):
            desk.scheduler.delete(run_id)
        desk.scheduler.resume(run_id)
        desk.until(run_id, "running")
    folder = desk.run(run_id).folder
    assert not (folder / "queued.json").exists()
    desk.scheduler.cancel(run_id)
    desk.until(run_id, "cancelled")
    desk.scheduler.delete(run_id)
    assert not folder.exists()
    with pytest.raises(RunError, match="no run"):
        desk.view(run_id)


def test_a_full_disk_keeps_a_run_in_line_until_there_is_room(
    desk: Desk, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def no_room(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as full:
        full.setattr(following_module, "note_start", no_room)
        run_id = desk.launch("publish")
        told = "It cannot be started: No space left on device. Free some space"
        until(lambda: told in desk.view(run_id).reason, lambda: desk.view(run_id))
        desk.scheduler._step()
        assert desk.state(run_id) == "queued"
    desk.until(run_id, "succeeded")
    assert caplog.text.count(f"run {run_id} cannot go on") == 1


def test_a_run_that_is_just_being_made_is_not_told_as_failed(
    data_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = Desk(data_dir)
    monkeypatch.setattr(
        local_engine, "start_supervisor", lambda *_, **__: SimpleNamespace(poll=lambda: None)
    )
    look, has_looked = desk.scheduler._look, threading.Event()
    seen: list[JobView] = []

    def watched(run: Run) -> JobView:
        view = look(run)
        has_looked.set()
        return view

    def make() -> Run:
        monkeypatch.setattr(desk.scheduler, "_look", watched)
        run = Run.create(
            data_dir / "runs" / "new", name="new", kind="simulation", sequences=["sheet"], config={}
        )
        looking.start()
        assert has_looked.wait(LIMIT_S)  # And nothing is there yet that says it is begun.
        return run

    looking = threading.Thread(target=lambda: seen.append(desk.view("new")))
    desk.scheduler.start_now(make)
    looking.join(LIMIT_S)
    assert [view.state for view in seen] == ["starting"]
    # One whose server was killed before it began stays what it is.
    Run.create(
        data_dir / "runs" / "old", name="old", kind="simulation", sequences=["sheet"], config={}
    )
    assert desk.view("old").state == "failed"
    assert "never started" in desk.view("old").reason


def test_a_run_that_is_not_in_line_yet_is_not_told_as_failed(
    data_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk, lock = Desk(data_dir), WatchedLock()
    monkeypatch.setattr(desk.scheduler, "_lock", lock)
    real = scheduler_module.put_in_line
    seen: list[str] = []
    visitors: list[threading.Thread] = []

    def put_in_line(folder: Path, ticket: Ticket) -> None:
        # Its folder is there. Somebody looks now, and has to wait for whoever makes it.
        visitor = threading.Thread(target=lambda: seen.append(desk.state(folder.name)))
        visitor.start()
        until(lambda: visitor.ident in lock.waiting or not visitor.is_alive())
        real(folder, ticket)
        visitors.append(visitor)

    monkeypatch.setattr(scheduler_module, "put_in_line", put_in_line)
    desk.launch("new")
    visitors[0].join(LIMIT_S)
    assert seen == ["queued"]


def test_a_sweep_spares_the_run_that_is_just_being_started(
    data_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = Desk(data_dir)
    new, lost = desk.run(desk.launch("new")), data_dir / "runs" / "lost"
    folders = (new.folder, lost, data_dir / "elsewhere" / "lost")
    ended: list[tuple[Path, bool]] = []
    reached = threading.Event()
    lock: Any = desk.scheduler._lock

    class WatchedLock:
        def __enter__(self) -> None:
            if threading.current_thread() is sweeper:
                reached.set()
            lock.acquire()

        def __exit__(self, *_: object) -> None:
            lock.release()

    def sweep() -> None:
        desk.scheduler._sweep()
        reached.set()

    def start(*_: object, **__: object) -> Any:
        # The process has its mark, but has not claimed the run yet: now it is found.
        sweeper.start()
        assert reached.wait(LIMIT_S)
        return SimpleNamespace(poll=lambda: None)

    sweeper = threading.Thread(target=sweep)
    for name, stand_in in {
        "marked_processes": lambda: [(SimpleNamespace(pid=1), f"{f}:x") for f in folders],
        "end_processes": lambda folder, **_: ended.append((folder, lock._is_owned())),
        "start_supervisor": start,
    }.items():
        monkeypatch.setattr(local_engine, name, stand_in)
    monkeypatch.setattr(desk.scheduler, "_lock", WatchedLock())
    desk.scheduler.start_now(lambda: new)
    sweeper.join(LIMIT_S)
    assert ended == [(lost, False)]  # To end them takes long, so nobody waits for it.
