"""Fits as child processes of this machine."""

import secrets
import subprocess
from pathlib import Path

from app.child_modules import start_module
from app.jobs.processes import COOKIE, cookie_of

WORKER = "app.jobs.worker"


def start_supervisor(
    run_folder: Path, device: str, *, worker: str = WORKER, threads: int | None = None
) -> "subprocess.Popen[str]":
    """Start the process that starts and watches a run's worker, in a session of its own.

    It outlives the server; a restarted server finds it by the lock that it holds.

    Args:
        run_folder: Folder of the run.
        device: Warp device.
        worker: Python module that does the work.
        threads: How many threads its libraries may start; none for one each processor.

    Returns:
        The started process.
    """
    return start_module(
        "app.jobs.supervise",
        *("--run-dir", str(run_folder), "--device", device, "--worker", worker),
        threads=threads,
        environment={
            COOKIE: cookie_of(run_folder, secrets.token_hex(8)),
            "PYTHONUNBUFFERED": "1",
        },
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
