"""Disks that are full or fail while a run is written, and memory that runs out."""

import errno
import io
import os
import subprocess
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from support.server import job_worker
from support.waiting import until

from app.jobs.processes import processes_of
from app.jobs.scheduler import ENDED
from app.jobs.ticket import note_end
from app.jobs.views import explain
from physhandi.errors import PhysHandiError
from physhandi.run import Run
from reliability import Case, Report
from reliability.jobs import is_damaged, queue_in, state_of

CALLS: tuple[tuple[Any, str], ...] = (
    *((os, name) for name in ("fsync", "replace", "write", "mkdir", "link")),
    (io, "open"),
)
"""Calls of the system by which a run is written."""

_STRIDE = 23
"""Calls between two that fail, so that few of them lie everywhere, and many are all of them."""

_DISK = 2**21
"""Size of a real disk [bytes]."""
_MOST_PAGES = 24
"""Pages that it may have left, besides none; a run that goes on takes about a dozen."""


class Disk:
    """Counts the calls that write, and lets one of them fail, or all from one on."""

    def __init__(self, number: int | None = None, code: int = 0, *, stays: bool = False) -> None:
        self.calls = 0
        self._number, self._code, self._stays = number, code, stays

    def look(self) -> None:
        self.calls += 1
        if self._number is None:
            return
        if self.calls == self._number or (self._stays and self.calls > self._number):
            raise OSError(self._code, os.strerror(self._code))

    @contextmanager
    def used(self) -> Iterator["Disk"]:
        """Let this process write on it."""
        before = [(place, name, getattr(place, name)) for place, name in CALLS]

        def tried(do: Callable[..., Any], *args: Any, **kinds: Any) -> Any:
            mode = str(args[1]) if len(args) > 1 else ""
            if do is not io_open or "w" in mode or "a" in mode:
                self.look()
            return do(*args, **kinds)

        io_open = io.open
        for place, name, do in before:
            setattr(place, name, partial(tried, do))
        try:
            yield self
        finally:
            for place, name, do in before:
                setattr(place, name, do)


def _fill(run: Run) -> None:
    with run.begin_attempt() as attempt:
        attempt.save_array("numbers.npy", np.arange(1000.0))
        job_worker.publish(run, attempt)


def _fail(codes: tuple[int, ...], count: int, folder: Path) -> Report:
    """Let a call fail at each place in turn, then fill the run on a disk that is well."""

    def new_run(name: str) -> Run:
        sequences = ["/data/sheet"]
        return Run.create(
            folder / name, name=name, kind="reconstruction", sequences=sequences, config={}
        )

    with Disk().used() as whole:
        _fill(new_run("whole"))
    counts: Counter[str] = Counter(wrong=0, lost=0, corrupt=0)
    for number in range(count):
        run = new_run(f"run{number}")
        code = codes[number % len(codes)]
        turn, place = divmod(number * _STRIDE, whole.calls)
        disk = Disk(place + 1, code, stays=(turn + number) % 2 == 1)
        with disk.used(), suppress(OSError, PhysHandiError):
            _fill(run)
        # The disk is well again when the supervisor notes that its worker has ended.
        note_end(run.folder, "The worker ended.")
        told = Run.open(run.folder)
        counts["survived"] += told.is_published
        # Half published is neither: results that are not whole, or whole ones of a failed run.
        counts["wrong"] += told.is_published != (told.state == "succeeded")
        counts["corrupt"] += told.is_published and is_damaged(told)
        if not told.is_published:
            counts["told"] += os.strerror(code) in (told.error or "")
            _fill(run)
        counts["lost"] += Run.open(run.folder).state != "succeeded"
        counts["corrupt"] += is_damaged(run) or run.json("first.json")["attempt"] not in {1, 2}
    return {"done": count, **counts}


def fill_disks(count: int, folder: Path) -> Report:
    return _fail((errno.ENOSPC, errno.EDQUOT), count, folder)


def break_disks(count: int, folder: Path) -> Report:
    return _fail((errno.EIO, errno.EROFS), count, folder)


@contextmanager
def small_disk(folder: Path) -> Iterator[Path]:
    """Mount a disk of two megabytes in a folder; only root may."""
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={_DISK}", "none", folder], check=True)
    try:
        yield folder
    finally:
        subprocess.run(["umount", folder], check=True)


def fill_a_real_disk(count: int, folder: Path) -> Report:
    """Leave a few pages of a disk while a fit is at work, and have it go on when there is room."""
    counts: Counter[str] = Counter(lost=0, corrupt=0, wrong=0, orphans=0)
    with (
        small_disk(folder / "disk") as disk,
        queue_in(disk, keep_free_gib=0.0) as scheduler,
    ):
        for number in range(count):
            run = scheduler.launch(["sheet"], "quick", "wait")
            until(lambda run=run: run.progress.get("stage") == "second", lambda run=run: run.error)
            filling = disk / "filling"
            pages = number % _MOST_PAGES
            room = os.statvfs(disk)
            filling.write_bytes(bytes(max(0, room.f_bavail - pages) * room.f_bsize))
            (run.folder / "go").touch()
            until(lambda run=run: state_of(scheduler, run) in ENDED)
            until(lambda run=run: not list(processes_of(run.folder)))
            counts["survived"] += run.is_published
            counts["wrong"] += run.is_published != (state_of(scheduler, run) == "succeeded")
            filling.unlink()
            if not run.is_published:
                is_told = os.strerror(errno.ENOSPC) in (run.error or "")
                counts["told"] += is_told
                counts["wrong"] += not is_told
                scheduler.resume(run.id)
                until(lambda run=run: state_of(scheduler, run) in ENDED)
            counts["lost"] += state_of(scheduler, run) != "succeeded"
            counts["corrupt"] += is_damaged(run)
            until(lambda run=run: not list(processes_of(run.folder)))
            scheduler.delete(run.id)
    return {"done": count, **counts}


def run_out_of_memory(count: int, folder: Path) -> Report:
    """Let fits end for want of memory or of their device, one after the other in one slot."""
    kinds = ("no_memory", "no_device_memory", "lost_device")
    wrong = orphans = 0
    with queue_in(folder) as scheduler:
        for number in range(count):
            run = scheduler.launch(["sheet"], "quick", kinds[number % len(kinds)])
            until(lambda run=run: state_of(scheduler, run) == "failed")
            until(lambda run=run: not list(processes_of(run.folder)))
            reason = run.error or ""
            failure = explain(run, reason)
            wrong += not failure.advice or ("memory" in kinds[number % len(kinds)]) != (
                "memory" in failure.message
            )
            orphans += len(list(processes_of(run.folder)))
        last = scheduler.launch(["sheet"], "quick", "publish")
        until(lambda: state_of(scheduler, last) == "succeeded")
    return {"done": count, "wrong": wrong, "orphans": orphans, "lost": is_damaged(last)}


CASES = {
    "R8": Case("The disk is full, or the quota, while a run is written", 200, 12, fill_disks),
    "R8b": Case("A real disk has few pages left while a fit is at work", 200, 0, fill_a_real_disk),
    "R9": Case("A disk fails, or is read-only, while a run is written", 200, 12, break_disks),
    "R11": Case("Memory runs out, or the device is lost", 20, 0, run_out_of_memory),
}
