"""One data folder, one server."""

import fcntl
import os
from pathlib import Path

from physhandi.errors import RunError

_LOCK = ".server.lock"


def claim_folder(data_dir: Path) -> int:
    """Become the one server of a data folder until the returned descriptor is closed.

    Raises:
        RunError: If another server works on it.
    """
    data_dir.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(data_dir / _LOCK, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = os.read(descriptor, 32).decode(errors="replace") or "unknown"
        os.close(descriptor)
        raise RunError(
            f"Another server (process {holder}) works on {data_dir}. "
            "Stop it, or choose another --data-dir."
        ) from None
    os.ftruncate(descriptor, 0)
    os.write(descriptor, str(os.getpid()).encode())
    return descriptor
