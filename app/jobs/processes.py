"""The processes of a run: how they are marked, found again and ended for sure."""

import fcntl
import os
import signal
import subprocess
import time
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil

from physhandi.child import set_process_option, start_module
from physhandi.devices import only_card

STORE = "PHYSHANDI_STORE"
"""Environment variable that tells a worker where results are published, too; see `RunStore`."""
COOKIE = "PHYSHANDI_RUN"
"""Environment variable that marks a run's processes; children inherit it, wherever they move."""
_LOCK = ".supervisor.lock"
_FOLLOWER_LOCK = ".follower.lock"
_PR_SET_CHILD_SUBREAPER = 36
_LOADING_S = 5.0
"""Longest time for which a program that is being loaded is waited for [s]."""


def cookie_of(run_folder: Path, nonce: str) -> str:
    """Make the mark of one start of a run."""
    return f"{run_folder}:{nonce}"


def processes_of(run_folder: Path, nonce: str | None = None) -> Iterator[psutil.Process]:
    """Find every live process of a run, also one that lost its parent or moved away.

    Args:
        run_folder: The run.
        nonce: Only those of this start of the run; None for all.
    """
    for process, cookie in marked_processes():
        folder, _, start = cookie.rpartition(":")
        if folder == str(run_folder) and nonce in {None, start}:
            yield process


def marked_processes() -> Iterator[tuple[psutil.Process, str]]:
    """Find every live process that belongs to some run, with its mark."""
    # It remembers processes since the last look, of which some have left their number to others.
    psutil.process_iter.cache_clear()
    for process in psutil.process_iter():
        try:
            cookie = _environment(process).get(COOKIE)
            if cookie and process.status() != psutil.STATUS_ZOMBIE:
                yield process, cookie
        except (psutil.Error, OSError):
            continue  # Gone meanwhile, or of another user: then it is none of ours.


def _environment(process: psutil.Process) -> dict[str, str]:
    """Read a process's environment, which is empty for a moment after it was started.

    `Popen` returns as soon as the kernel lets go of what the caller had open, up to 30 ms before
    the new program has its environment on a busy machine.
    """
    end = time.monotonic() + _LOADING_S
    while not (environment := process.environ()):
        stat = Path(f"/proc/{process.pid}/stat").read_text()
        if not has_memory(stat):
            break  # It never gets one: there are a hundred of these and more.
        if not is_loading(stat):
            return process.environ()  # It may have got one after the look at it.
        if time.monotonic() > end:
            break
        time.sleep(0.001)
    return environment


def has_memory(stat: str) -> bool:
    """Tell from ``/proc/PID/stat`` whether a process is a program: no zombie or kernel's own."""
    return _fields(stat)[20] != "0"


def is_loading(stat: str) -> bool:
    """Tell from a process's ``/proc/PID/stat`` whether its program is only being loaded.

    It has memory then, but not yet a place of its environment.
    """
    return has_memory(stat) and _fields(stat)[47] == "0"


def _fields(stat: str) -> list[str]:
    """Take what follows the program's name, which may hold anything."""
    return stat.rpartition(")")[2].split()


def end_processes(
    run_folder: Path, *, grace_s: float, spare: int | None = None, nonce: str | None = None
) -> int:
    """End all processes of a run, politely at first.

    Args:
        run_folder: The run.
        grace_s: Seconds between the polite signal and the hard one; 0 is hard at once.
        spare: A process that is left alone.
        nonce: Only processes of this start of the run; None for all.

    Returns:
        How many had to be killed.
    """
    if grace_s > 0:
        _signal_all(run_folder, signal.SIGTERM, spare, nonce)
    end = time.monotonic() + grace_s
    while time.monotonic() < end and any(p.pid != spare for p in processes_of(run_folder, nonce)):
        time.sleep(0.05)
    killed = 0
    # A process may start another one while it is being killed, so look until none is left.
    end = time.monotonic() + 30.0
    while time.monotonic() < end and (
        count := _signal_all(run_folder, signal.SIGKILL, spare, nonce)
    ):
        killed += count
        time.sleep(0.02)
    return killed


def claim_supervision(run_folder: Path) -> int | None:
    """Become the one supervisor of a run until this process ends.

    Returns:
        The descriptor that holds the claim, or None if the run has a supervisor already.
    """
    # Whoever asks `supervisor_of` holds the lock for a moment.
    return _claim(run_folder / _LOCK, 2.0)


@contextmanager
def following(run_folder: Path, patience_s: float = 0.0) -> Generator[bool]:
    """Be the only one who starts a run, also again; what runs already runs on.

    Args:
        run_folder: The run.
        patience_s: How long to wait for another one, who may do so for a moment only [s].

    Yields:
        Whether it is so; False if another process, as of a command that follows the run, does.
    """
    claim = _claim(run_folder / _FOLLOWER_LOCK, patience_s)
    try:
        yield claim is not None
    finally:
        if claim is not None:
            os.close(claim)


def _claim(path: Path, patience_s: float) -> int | None:
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    end = time.monotonic() + patience_s
    while not _try_lock(descriptor, fcntl.LOCK_EX):
        if time.monotonic() > end:
            os.close(descriptor)
            return None
        time.sleep(0.02)
    try:
        os.ftruncate(descriptor, 0)
        os.write(descriptor, str(os.getpid()).encode())
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def supervisor_of(run_folder: Path) -> int | None:
    """Give the process id of a run's live supervisor; None if it has none."""
    return process_with_lock(run_folder / _LOCK)


def process_with_lock(path: Path) -> int | None:
    """Give the process id that whoever has locked a file wrote into it; None if nobody has.

    It is 0 while that is being written.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    except OSError:
        return None
    try:
        if _try_lock(descriptor, fcntl.LOCK_SH):
            return None
        # The kernel lets go of the lock when its process ends, however it ends.
        content = os.read(descriptor, 32)
        return int(content) if content.isdigit() else 0
    except OSError:
        return None
    finally:
        os.close(descriptor)


def adopt_orphans() -> None:
    """Become the parent of all grandchildren that lose theirs (Linux)."""
    set_process_option(_PR_SET_CHILD_SUBREAPER, 1)


def _try_lock(descriptor: int, kind: int) -> bool:
    try:
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _signal_all(
    run_folder: Path, number: signal.Signals, spare: int | None, nonce: str | None
) -> int:
    count = 0
    for process in processes_of(run_folder, nonce):
        if process.pid in {spare, os.getpid()}:
            continue
        try:
            process.send_signal(number)
            count += 1
        except psutil.Error:
            continue
    return count


WORKER = "app.jobs.worker"
_SUPERVISOR = "app.jobs.supervise"


def supervisor_command(
    run_folder: Path, device: str, worker: str, hung_after_s: float
) -> tuple[str, ...]:
    """Give what Python is called with (``-m``) to supervise a run, on whatever machine.

    Args:
        run_folder: Folder of the run.
        device: Warp device.
        worker: Python module that does the work.
        hung_after_s: Time without a sign of life after which the worker is taken to hang [s].
    """
    return (_SUPERVISOR, str(run_folder), device, worker, str(hung_after_s))


def start_supervisor(
    command: tuple[str, ...],
    cookie: str,
    *,
    card: str | None = None,
    threads: int | None = None,
    store: str = "",
) -> "subprocess.Popen[str]":
    """Start the process that starts and watches a run's worker, in a session of its own.

    It outlives the server; a restarted server finds it by the lock that it holds.

    Args:
        command: See `supervisor_command`.
        cookie: Mark of this start; see `cookie_of`.
        card: The only graphics card that it sees, as ``cuda:0``; None for whatever there is.
        threads: How many threads its libraries may start; none for one each processor.
        store: Where results are published, too; empty for nowhere.

    Returns:
        The started process.
    """
    return start_module(
        *command,
        threads=threads,
        environment={COOKIE: cookie, STORE: store, **only_card(card)},
        outlives_parent=True,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
