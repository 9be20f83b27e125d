"""Fits as child processes of this machine: started, found again, and ended for sure."""

import os
import secrets
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import psutil

COOKIE = "PHYSHANDI_RUN"
WORKER = "app.jobs.worker"


def start_worker(run_folder: Path, device: str, *, module: str = WORKER) -> subprocess.Popen[bytes]:
    """Start the process that works on a run, in a session of its own.

    It outlives the server: a restarted server finds it by the run's lease. Everything that it prints
    goes to the run's ``log.txt``.

    Args:
        run_folder: Folder of the run.
        device: Warp device.
        module: Python module to run.

    Returns:
        The started process.
    """
    cookie = f"{run_folder.name}.{secrets.token_hex(8)}"
    environment = os.environ | {COOKIE: cookie, "PYTHONUNBUFFERED": "1"}
    with (run_folder / "log.txt").open("ab") as log:
        return subprocess.Popen(
            [sys.executable, "-m", module, "--run-dir", str(run_folder), "--device", device],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            env=environment,
        )


def processes_of(run_id: str) -> Iterator[psutil.Process]:
    """Find every process that belongs to a run: its environment carries the run's cookie.

    A child that moved to another session or lost its parent is found too.
    """
    prefix = f"{run_id}."
    for process in psutil.process_iter():
        try:
            if process.environ().get(COOKIE, "").startswith(prefix):
                yield process
        except (psutil.NoSuchProcess, psutil.AccessDenied, psutil.ZombieProcess):
            continue


def end_processes(run_id: str, *, grace_s: float) -> int:
    """End all processes of a run, gently at first.

    Args:
        run_id: The run.
        grace_s: Seconds between the polite signal and the hard one.

    Returns:
        How many had to be killed.
    """
    _signal_all(run_id, signal.SIGTERM)
    end = time.monotonic() + grace_s
    while time.monotonic() < end and any(True for _ in processes_of(run_id)):
        time.sleep(0.1)
    killed = 0
    while count := _signal_all(run_id, signal.SIGKILL):
        killed += count
        time.sleep(0.05)
    return killed


def _signal_all(run_id: str, number: signal.Signals) -> int:
    count = 0
    for process in processes_of(run_id):
        try:
            if process.status() != psutil.STATUS_ZOMBIE:
                process.send_signal(number)
                count += 1
        except psutil.NoSuchProcess:
            continue
    return count
