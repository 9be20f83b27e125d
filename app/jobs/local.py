"""Fits as child processes of this machine."""

import secrets
import subprocess
import sys
from pathlib import Path

from app.jobs.processes import COOKIE, child_environment, cookie_of
from app.settings import PACKAGE_ROOT

WORKER = "app.jobs.worker"


def start_supervisor(
    run_folder: Path, device: str, *, worker: str = WORKER, threads: int | None = None
) -> subprocess.Popen[bytes]:
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
    environment = child_environment(threads) | {
        COOKIE: cookie_of(run_folder, secrets.token_hex(8)),
        "PYTHONUNBUFFERED": "1",
    }
    command = [sys.executable, "-m", "app.jobs.supervise", "--run-dir", str(run_folder)]
    return subprocess.Popen(
        [*command, "--device", device, "--worker", worker],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
        # `-m` searches the working directory first, so it must be the one of our packages.
        cwd=PACKAGE_ROOT,
        env=environment,
    )
