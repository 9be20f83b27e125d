"""Starts our modules in processes of their own, and lets these end with their parent."""

import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Collection, Mapping
from pathlib import Path

PACKAGE_ROOT = Path(__file__).resolve().parent.parent
"""Folder of the packages and, in a checkout and in a wheel alike, of the data beside them."""

_SECRETS = ("PHYSHANDI_TOKEN",)
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_PR_SET_PDEATHSIG = 1


def start_module(
    module: str,
    *arguments: str,
    threads: int | None = None,
    environment: Mapping[str, str] | None = None,
    stdin: int = subprocess.DEVNULL,
    stdout: int | None = None,
    stderr: int | None = None,
    pass_fds: Collection[int] = (),
    start_new_session: bool = False,
) -> "subprocess.Popen[str]":
    """Run ``python -m module`` in a process that is told none of our secrets.

    Args:
        module: One of our modules.
        arguments: What it is called with; paths must be absolute.
        threads: How many threads its numeric libraries may start; none for one each processor,
            which hinder each other badly where several such processes work side by side.
        environment: More variables.
        stdin: See `subprocess.Popen`; text in UTF-8, as are the others.
        stdout: See `subprocess.Popen`.
        stderr: See `subprocess.Popen`.
        pass_fds: Descriptors that it inherits.
        start_new_session: Whether it is spared what the keyboard sends to this process.

    Returns:
        The started process.
    """
    told = {name: value for name, value in os.environ.items() if name not in _SECRETS}
    limits = {} if threads is None else dict.fromkeys(_THREADS, str(threads))
    return subprocess.Popen(
        [sys.executable, "-m", module, *arguments],
        stdin=stdin,
        stdout=stdout,
        stderr=stderr,
        encoding="utf-8",
        pass_fds=pass_fds,
        start_new_session=start_new_session,
        # `-m` searches the working directory first, so it must be the one of our packages.
        cwd=PACKAGE_ROOT,
        env=told | {"PYTHONIOENCODING": "utf-8"} | limits | dict(environment or {}),
    )


def die_with_parent(parent: int) -> None:
    """Make the kernel kill this process when its parent ends (Linux); end it if that has happened.

    Args:
        parent: Process id that the parent is expected to have.
    """
    set_process_option(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        sys.exit(1)


def set_process_option(option: int, value: int) -> None:
    """Call Linux's ``prctl``; on other systems nothing happens.

    Raises:
        OSError: If the kernel refuses.
    """
    if sys.platform == "linux" and ctypes.CDLL(None, use_errno=True).prctl(option, value, 0, 0, 0):
        raise OSError(ctypes.get_errno(), "prctl failed")
