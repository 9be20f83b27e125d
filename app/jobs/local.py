"""Fits as child processes of this machine."""

import os
import secrets
import subprocess
import sys
from pathlib import Path

from app.jobs.processes import COOKIE, cookie_of
from app.settings import PACKAGE_ROOT

WORKER = "app.jobs.worker"
_SECRETS = ("PHYSHANDI_TOKEN",)


def start_supervisor(
    run_folder: Path, device: str, *, worker: str = WORKER
) -> subprocess.Popen[bytes]:
    """Start the process that starts and watches a run's worker, in a session of its own.

    It outlives the server; a restarted server finds it by the lock that it holds.

    Args:
        run_folder: Folder of the run.
        device: Warp device.
        worker: Python module that does the work.

    Returns:
        The started process.
    """
    environment = {name: value for name, value in os.environ.items() if name not in _SECRETS}
    environment |= {
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
