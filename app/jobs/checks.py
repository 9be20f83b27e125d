"""Checks of recordings, kept as long as their files stay the same."""

from functools import lru_cache
from pathlib import Path

from app.jobs.catalog import SequenceItem
from physhandi.fitting.checks.recording_check import RecordingCheck, check_recording


def check_item(item: SequenceItem) -> RecordingCheck:
    """Read a whole listed recording, usable or not, unless it was read as it is before."""
    if item.sequence is None:
        return check_recording(item.folder)
    return _checked(item.folder, _state(item.folder))


@lru_cache(maxsize=64)
def _checked(folder: Path, _state: tuple[tuple[str, int, int], ...]) -> RecordingCheck:
    return check_recording(folder)


def _state(folder: Path) -> tuple[tuple[str, int, int], ...]:
    """Give name, size and time of every file."""
    files = ((path, path.stat()) for path in sorted(folder.rglob("*")) if path.is_file())
    return tuple((str(path), status.st_size, status.st_mtime_ns) for path, status in files)
