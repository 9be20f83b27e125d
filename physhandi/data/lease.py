"""The right to write into a run, held by one process at a time and fenced by a nonce."""

import fcntl
import math
import os
import secrets
import socket
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path

import psutil

from physhandi.data.files import write_json
from physhandi.data.run_folder import LEASE, LeaseFile, read_record
from physhandi.errors import RunError

REMOTE_TIMEOUT_S = 120.0
_LOCK = ".lease.lock"
_CLOCK_TOLERANCE_S = 2.0
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
_watched: dict[str, tuple[object, float]] = {}
"""Of each claim of another host that was looked at: what it said, and since when [s]."""


class Lease:
    """One process's claim on a run; a later claim makes it void.

    The holder proves itself by the nonce in ``lease.json``. Whoever finds another nonce there has
    been replaced and must not publish.
    """

    def __init__(self, folder: Path, nonce: str) -> None:
        self.folder = folder
        self.nonce = nonce

    @classmethod
    def acquire(cls, folder: Path, *, take_over: bool = False) -> "Lease":
        """Claim a run.

        Args:
            folder: The run's folder.
            take_over: Whether to replace a holder that is alive.

        Raises:
            RunError: If another process that is alive holds the run.
        """
        with locked(folder):
            holder = live_holder(folder)
            if holder is not None and not take_over:
                raise RunError(
                    f"Run '{folder.name}' is being written by process {holder['pid']} on "
                    f"{holder['host']}. Wait for it or cancel it first."
                )
            lease = cls(folder, secrets.token_hex(16))
            lease._write()
        return lease

    def is_held(self) -> bool:
        """Tell whether this claim is still the valid one."""
        claim = read_record(self.folder / LEASE, LeaseFile)
        return claim is not None and claim["nonce"] == self.nonce

    def check(self) -> None:
        """Make sure that this claim is still the valid one.

        Raises:
            RunError: If another process took the run over.
        """
        if not self.is_held():
            raise RunError(
                f"Run '{self.folder.name}' was taken over by another process, so this one must "
                "stop without publishing. Look at the later attempt for the result."
            )

    def heartbeat(self) -> None:
        """Renew the claim.

        Raises:
            RunError: If another process took the run over.
        """
        with locked(self.folder):
            self.check()
            self._write()

    def release(self) -> None:
        """Give the claim up; the caller holds `locked`."""
        self.check()
        (self.folder / LEASE).unlink()

    def _write(self) -> None:
        claim = {
            "nonce": self.nonce,
            "pid": os.getpid(),
            "process": process_identity(os.getpid()),
            "host": socket.gethostname(),
            "time": time.time(),
        }
        write_json(self.folder / LEASE, claim, is_durable=False)


@contextmanager
def locked(folder: Path) -> Generator[None]:
    """Hold the run's lock for a moment, so that claims and publications do not mix."""
    try:
        descriptor = _open_lock(folder / _LOCK)
    except FileNotFoundError:
        raise RunError(f"Run folder {folder} is gone; it was deleted or moved.") from None
    with _held(descriptor):
        yield


@contextmanager
def locked_file(path: Path, waits: Callable[[str], None] | None = None) -> Generator[None]:
    """Hold a lock that other processes wait for; it is let go of however this one ends.

    Args:
        path: The file that stands for it, and names its holder; made if missing, and left.
        waits: Is told who holds the lock, before it is waited for.
    """
    descriptor = _open_lock(path)
    if waits is not None and not _is_free(descriptor):
        waits(path.read_text(encoding="utf-8", errors="replace")[:80] or "another process")
    with _held(descriptor):
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"process {os.getpid()} on {socket.gethostname()}".encode(), 0)
        yield


def _is_free(descriptor: int) -> bool:
    """Tell whether a lock would be had at once; if so, it is held from now on."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _open_lock(path: Path) -> int:
    return os.open(path, os.O_RDWR | os.O_CREAT, 0o644)


@contextmanager
def _held(descriptor: int) -> Generator[None]:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def process_identity(pid: int) -> str | None:
    """Tell one process from every other that has or had its number, whatever the clock is set to.

    Returns:
        The start of the machine and, counted from there, of the process; none if it has ended.
    """
    try:
        # The name of the program, in brackets, may hold anything.
        status = Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()
        boot = _BOOT_ID.read_text().strip()
    except FileNotFoundError:
        return _identity_by_clock(pid)
    except OSError:
        return None
    return None if status[0] in {"Z", "X"} else f"{boot}.{status[19]}"


def _identity_by_clock(pid: int) -> str | None:
    """Do so without Linux's files, where only the time of its start is known."""
    try:
        process = psutil.Process(pid)
        return None if process.status() == psutil.STATUS_ZOMBIE else f"{process.create_time():.0f}"
    except psutil.Error:
        return None


def live_holder(folder: Path) -> LeaseFile | None:
    """Give the claim on a run, or None if there is none or its process is gone.

    On this host the process itself decides; on another host a claim that was not renewed for
    `REMOTE_TIMEOUT_S` seconds is void.
    """
    path = folder / LEASE
    try:
        claim = read_record(path, LeaseFile)
    except RunError:
        return None  # A damaged claim protects nobody.
    if claim is None:
        return None
    try:
        if claim["host"] != socket.gethostname():
            return claim if _is_renewed(path, claim) else None
        if "process" in claim:
            return claim if process_identity(claim["pid"]) == claim["process"] else None
        # Written by version 0.1.0 before November 2026: the clock tells when the process began.
        process, created = psutil.Process(claim["pid"]), claim.get("process_created", math.inf)
        is_same = abs(process.create_time() - created) < _CLOCK_TOLERANCE_S
        return claim if is_same and process.status() != psutil.STATUS_ZOMBIE else None
    except psutil.Error:
        return None


def _is_renewed(path: Path, claim: LeaseFile) -> bool:
    """Tell whether another host still renews its claim.

    Whoever has looked before goes by what changed since; only the first look trusts the clocks.
    """
    content, clock = (claim["nonce"], claim["time"]), time.monotonic()
    seen = _watched.get(str(path))
    if seen is not None and seen[0] == content:
        return clock - seen[1] < REMOTE_TIMEOUT_S
    age = 0.0 if seen is not None else min(max(0.0, time.time() - claim["time"]), REMOTE_TIMEOUT_S)
    _watched[str(path)] = (content, clock - age)
    return age < REMOTE_TIMEOUT_S
