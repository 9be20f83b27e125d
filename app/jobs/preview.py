"""What a running fit shows of itself, as the server hands it on."""

import os
from pathlib import Path

from physhandi.data.preview import PREVIEW

_MOST_BYTES = 2**20


def preview_number(run_folder: Path) -> int:
    """Number a run's preview; another one has another number, and 0 is none."""
    try:
        return (run_folder / PREVIEW).stat(follow_symlinks=False).st_mtime_ns // 1000
    except OSError:
        return 0


def preview_bytes(run_folder: Path) -> bytes | None:
    """Read a run's preview; a link that a job might have put there is not followed."""
    try:
        descriptor = os.open(run_folder / PREVIEW, os.O_RDONLY | os.O_NOFOLLOW)
    except OSError:
        return None
    with os.fdopen(descriptor, "rb") as stream:
        return stream.read(_MOST_BYTES)
