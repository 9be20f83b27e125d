"""The queue and its processes."""

import itertools
import os
import signal
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from psutil import _pslinux
from support.inputs.sheet_sequence import write_sheet
from support.server.suite_world import SETTINGS
from support.waiting import until

from app.jobs import scheduler as scheduler_module
from app.jobs.catalog import Catalog, RunItem
from app.jobs.launch_keys import KeyedRequest
from app.jobs.processes import end_processes, processes_of, supervisor_of
from app.jobs.scheduler import ENDED, Scheduler
from app.settings import ServerSettings
from physhandi.data.environment import ENVIRONMENT
from physhandi.data.lease import live_holder
from physhandi.data.run_folder import artefacts, read_events
from physhandi.errors import RunError
from physhandi.run import Run
from reliability import Case, Report

REAL = {**SETTINGS, "object_.search.generations": 4, "object_.first_order.iterations": 6}
"""Effort of a real fit: so much that it can be hit in all of its stages."""


@contextmanager
def clock_set_by(seconds: float) -> Iterator[None]:
    """Let this process see the clock as if somebody had set it."""
    now, booted = time.time, _pslinux.boot_time
    with (
        patch("time.time", lambda: now() + seconds),
        # The kernel tells when it was started by the clock as it is now.
        patch("psutil._pslinux.boot_time", lambda: booted() + seconds),
    ):
        yield


def set_clocks(count: int, folder: Path) -> Report:
    """Look at a run at work, and let it renew its lease, while the clock is set otherwise."""
    alive = Run.create(
        folder / "alive", name="alive", kind="reconstruction", sequences=["/data/sheet"], config={}
    )
    wrong = done = 0
    with alive.begin_attempt() as attempt:
        for number in range(count):
            hours = (number // 2 + 1) * (-1) ** number
            with clock_set_by(3600.0 * hours):
                holder = live_holder(alive.folder)
                wrong += holder is None or alive.state != "running"
                attempt.heartbeat()
            wrong += live_holder(alive.folder) is None
            done += 1
        attempt.publish()
    return {"done": done, "wrong": wrong}


def submit_again(count: int, folder: Path) -> Report:
    """Ask for the same fit from eight threads, with a new server after each quarter."""
    write_sheet(folder / "sequences" / "sheet")
    settings = ServerSettings(data_dir=folder)
    request = KeyedRequest.of("the key", {"sequences": ["sheet"]})
    answers: Counter[str] = Counter()

    def submit(scheduler: Scheduler) -> str:
        return scheduler.launch(["sheet"], "quick", request=request).id

    with ThreadPoolExecutor(8) as pool:
        while answers.total() < count:
            scheduler = Scheduler(settings, Catalog(settings))
            asked = min(max(1, count // 4), count - answers.total())
            answers.update(pool.map(submit, [scheduler] * asked))
    runs = [path for path in settings.run_dir.iterdir() if (path / "queued.json").is_file()]
    return {"done": answers.total(), "runs": len(runs), "wrong": len(answers) + len(runs) - 2}


@contextmanager
def queue_in(folder: Path, **settings: Any) -> Iterator[Scheduler]:
    """Work through a queue of made-up fits; when it is over, nothing of it is at work."""
    write_sheet(folder / "sequences" / "sheet")
    asked = ServerSettings(data_dir=folder, cancel_grace_s=1.0, **settings)
    scheduler = Scheduler(asked, Catalog(asked), worker="support.server.job_worker")
    with patch.object(scheduler_module, "_SWEEP_INTERVAL_S", 0.3):
        scheduler.start()
        try:
            yield scheduler
        finally:
            scheduler.shutdown()
            for run_folder in asked.run_dir.iterdir():
                end_processes(run_folder, grace_s=0.0)
            for process in scheduler._local.started.values():
                process.wait()


def state_of(scheduler: Scheduler, run: Run) -> str:
    return scheduler.view(RunItem(run.id, run.folder, False, run, None)).state


def disturb(count: int, folder: Path, deed: Callable[[Run], None], **settings: Any) -> Report:
    """Do something to a fit in the middle of each of its attempts, then let it end.

    A tenth of it is done to real fits, which have to end with the bits of an undisturbed one.
    """
    real = count // 10
    with queue_in(folder, **settings) as scheduler:
        run = scheduler.launch(["sheet"], "quick", "wait")
        resumed = 0

        def is_at_work_for_the_time(number: int) -> bool:
            told = run.progress
            is_begun = (told.get("attempt"), told.get("stage")) == (number, "second")
            return is_begun and live_holder(run.folder) is not None

        for number in range(1, count - real + 1):
            until(partial(is_at_work_for_the_time, number), lambda: run.progress)
            deed(run)
            if number % 2 == 0:
                until(lambda: state_of(scheduler, run) == "failed")
                scheduler.resume(run.id)
                resumed += 1
        until(partial(is_at_work_for_the_time, count - real + 1), lambda: run.progress)
        (run.folder / "go").touch()
        until(lambda: state_of(scheduler, run) in ENDED)
        until(lambda: supervisor_of(run.folder) is None)
        counts = Counter(
            {
                "done": count - real,
                "started again": count - real - resumed,
                "resumed": resumed,
                "lost": int(run.state != "succeeded"),
                "corrupt": int(is_damaged(run) or run.json("first.json") != {"attempt": 1}),
                "published twice": len(list(run.folder.glob("attempts/*/MANIFEST.json"))) - 1,
                "orphans": len(list(processes_of(run.folder))),
            }
        )
        if real:
            counts.update(_disturb_fits(scheduler, real, deed))
        return counts


def _disturb_fits(scheduler: Scheduler, count: int, deed: Callable[[Run], None]) -> Counter[str]:
    """Do something to real fits after random reports, until they are through."""
    chance = np.random.default_rng(count)
    counts: Counter[str] = Counter()

    def launch(number: int) -> Run:
        return scheduler.launch(["sheet"], "quick", f"real {number}", overrides=REAL)

    whole = launch(0)
    until(lambda: state_of(scheduler, whole) in ENDED)
    expected = results_of(whole)
    for number in itertools.count(1):
        if counts["done"] == count:
            return counts
        run = launch(number)
        while _await_reports(scheduler, run, int(chance.integers(1, 8))) not in ENDED:
            if counts["done"] == count:
                until(lambda run=run: state_of(scheduler, run) in ENDED)
                break
            attempt = run.attempt or 0
            deed(run)
            # As long as nobody has noticed, it counts as running.
            until(lambda run=run, n=attempt: _has_gone_on(scheduler, run, n))
            if (run.folder / "attempts" / str(attempt) / "MANIFEST.json").exists():
                break  # It had published already, so that it was not hit.
            is_failed = state_of(scheduler, run) == "failed"
            if is_failed:
                scheduler.resume(run.id)
            counts.update(("done", "of real fits", "resumed" if is_failed else "started again"))
        until(lambda run=run: supervisor_of(run.folder) is None)
        counts["lost"] += run.state != "succeeded"
        counts["corrupt"] += run.is_published and results_of(run) != expected
        counts["published twice"] += len(list(run.folder.glob("attempts/*/MANIFEST.json"))) - 1
        counts["orphans"] += len(list(processes_of(run.folder)))
    raise AssertionError("numbers have no end")


def _await_reports(scheduler: Scheduler, run: Run, count: int) -> str:
    """Wait until a fit has told more, or has ended; gives its state."""
    known = len(read_events(run.folder)[0])

    def has_told() -> bool:
        if state_of(scheduler, run) in ENDED:
            return True
        told = len(read_events(run.folder)[0]) - known
        return told >= count and None not in (live_holder(run.folder), supervisor_of(run.folder))

    until(has_told)
    return state_of(scheduler, run)


def _has_gone_on(scheduler: Scheduler, run: Run, attempt: int) -> bool:
    return (run.attempt or 0) > attempt or state_of(scheduler, run) in ENDED


def results_of(run: Run) -> dict[str, bytes]:
    """Read all published files, but the one that tells when and where it was made."""
    run.verify()
    return {rel: path.read_bytes() for rel, path in artefacts(run.out) if rel != ENVIRONMENT}


def is_damaged(run: Run) -> bool:
    try:
        run.verify()
    except RunError:
        return True
    return False


def signal_worker(run: Run, number: signal.Signals) -> None:
    holder = live_holder(run.folder)
    assert holder is not None
    os.kill(holder["pid"], number)


def kill_workers(count: int, folder: Path) -> Report:
    return disturb(count, folder, lambda run: signal_worker(run, signal.SIGKILL))


def stop_workers(count: int, folder: Path) -> Report:
    return disturb(count, folder, lambda run: signal_worker(run, signal.SIGSTOP), hung_after_s=3.0)


def kill_supervisors(count: int, folder: Path) -> Report:
    def kill(run: Run) -> None:
        supervisor = supervisor_of(run.folder)
        assert supervisor is not None
        os.kill(supervisor, signal.SIGKILL)

    return disturb(count, folder, kill)


def race_cancels(count: int, folder: Path) -> Report:
    """Cancel fits while they publish."""
    ends: Counter[str] = Counter()
    wrong = corrupt = orphans = 0
    with queue_in(folder) as scheduler:
        for number in range(count):
            run = scheduler.launch(["sheet"], "quick", "wait")
            until(lambda run=run: run.progress.get("stage") == "second")
            finish, cancel = (run.folder / "go").touch, partial(scheduler.cancel, run.id)
            for act in (finish, cancel) if number % 3 else (cancel, finish):
                with suppress(RunError):  # It has ended already: then there is nothing to cancel.
                    act()
                # Now the one wins, now the other: a step of the worker takes 20 ms and more.
                time.sleep((number * 7 % 40) / 1000.0)
            until(lambda run=run: state_of(scheduler, run) in ENDED)
            until(lambda run=run: supervisor_of(run.folder) is None)
            state = state_of(scheduler, run)
            ends[state] += 1
            wrong += run.is_published != (state == "succeeded") or run.state != state
            corrupt += run.is_published and is_damaged(run)
            orphans += len(list(processes_of(run.folder)))
    return {"done": ends.total(), **ends, "wrong": wrong, "corrupt": corrupt, "orphans": orphans}


def cancel_fits(count: int, folder: Path) -> Report:
    """Cancel fits while they load, in their first and second stage, polite ones and stubborn."""
    wrong = orphans = 0
    with queue_in(folder) as scheduler:
        for number in range(count):
            name, stage = (("wait", "second"), ("wait", ""), ("stubborn", "first"))[number % 3]
            run = scheduler.launch(["sheet"], "quick", name)
            until(lambda run=run: state_of(scheduler, run) != "queued")
            if stage:
                until(lambda run=run, stage=stage: run.progress.get("stage") == stage)
            if name == "stubborn":  # Its child, in a session of its own, is at work, too.
                until((run.folder / "pids").exists)
            scheduler.cancel(run.id)
            until(lambda run=run: state_of(scheduler, run) in ENDED)
            orphans += len(list(processes_of(run.folder)))
            until(lambda run=run: supervisor_of(run.folder) is None)
            wrong += state_of(scheduler, run) != "cancelled" or run.is_published
        last = scheduler.launch(["sheet"], "quick", "publish")
        until(lambda: state_of(scheduler, last) == "succeeded")
    return {"done": count, "wrong": wrong, "orphans": orphans, "lost": is_damaged(last)}


def start_two_servers(count: int, folder: Path) -> Report:
    wrong = done = 0
    with queue_in(folder) as scheduler:
        for _ in range(count):
            second = Scheduler(scheduler._settings, Catalog(scheduler._settings))
            done += 1
            try:
                second.start()
            except RunError as error:
                wrong += f"(process {os.getpid()})" not in str(error)
            else:
                wrong += 1
    return {"done": done, "wrong": wrong}


CASES = {
    "R1": Case("The process of a fit is killed in the middle of a stage", 200, 1, kill_workers),
    "R2": Case("The supervisor of a fit is killed", 100, 0, kill_supervisors),
    "R5": Case("A fit is cancelled, in every stage and however stubborn", 100, 0, cancel_fits),
    "R6": Case("A fit is cancelled while it publishes", 200, 2, race_cancels),
    "R12": Case("The process of a fit is stopped, so that it hangs", 40, 0, stop_workers),
    "R13": Case("The clock is set by hours, forth and back, during a fit", 100, 4, set_clocks),
    "R14": Case("A second server is started on the same data folder", 100, 1, start_two_servers),
    "R15": Case(
        "The same fit is asked for again, at once and after restarts", 1000, 40, submit_again
    ),
}
