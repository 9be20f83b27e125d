"""Checks of recordings, kept as long as their files stay the same."""

from functools import lru_cache
from pathlib import Path

from app.jobs.catalog import SequenceItem
from physhandi.data.files import files_by_age
from physhandi.fitting.checks.recording_check import RecordingCheck, check_recording


def check_item(item: SequenceItem) -> RecordingCheck:
    """Read a whole listed recording, usable or not, unless it was read as it is before."""
    if item.sequence is None:
        return check_recording(item.folder)
    return _checked(item.folder, tuple(files_by_age(item.folder.rglob("*"))))


@lru_cache(maxsize=64)
def _checked(folder: Path, _state: tuple[tuple[float, int, Path], ...]) -> RecordingCheck:
    return check_recording(folder)
