"""Moving a folder that cannot be read out of the way; it is never deleted."""

import re
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Literal, get_args

from physhandi.data.files import sync_folder, write_bytes
from physhandi.data.run_folder import now
from physhandi.errors import RunError

ItemKind = Literal["runs", "sequences"]
_NOTE = "{}.txt"


@dataclass(frozen=True)
class MovedFolder:
    """A folder that was moved aside."""

    kind: ItemKind
    """Its kind."""
    name: str
    """Its name below ``damaged/<kind>/``; its old one, with a number if that was taken."""
    time: str
    """Time of the move, ISO 8601; empty if the note beside it is gone."""
    why: str
    """Its defect."""


def move_aside(folder: Path, kind: ItemKind, damaged_dir: Path, why: str) -> MovedFolder:
    """Move a folder below ``damaged/`` and note beside it why.

    Whoever mends it moves it back by hand. The caller has made sure that nobody works on it.

    Args:
        folder: Folder below ``runs/`` or ``sequences/`` of the data folder.
        kind: Which of the two.
        damaged_dir: Where it goes.
        why: What is wrong with it.

    Raises:
        RunError: If it is gone.
        OSError: If it cannot be moved; then it is where it was.
    """
    place = damaged_dir / kind
    place.mkdir(parents=True, exist_ok=True)
    names = (folder.name if n == 1 else f"{folder.name}-{n}" for n in range(1, 10_000))
    name = next(name for name in names if not (place / name).exists())
    try:
        folder.rename(place / name)
    except FileNotFoundError:
        raise RunError(f"{folder} is gone; it was deleted or moved.") from None
    sync_folder(place)
    moved = MovedFolder(kind, name, now(), why)
    with suppress(OSError):  # On a full disk the folder is moved without a note.
        write_bytes(place / _NOTE.format(name), f"{moved.time} {why}\n".encode())
    return moved


def moved_folders(damaged_dir: Path) -> list[MovedFolder]:
    """List what was moved aside, the newest first."""
    folders = [
        _read(folder, kind)
        for kind in get_args(ItemKind)
        for folder in sorted((damaged_dir / kind).glob("[!.]*/"))
    ]
    return sorted(folders, key=lambda moved: moved.time, reverse=True)


def _read(folder: Path, kind: ItemKind) -> MovedFolder:
    note = folder.with_name(_NOTE.format(folder.name))
    try:
        text = note.read_text(encoding="utf-8", errors="replace")[:10_000]
    except OSError:
        text = ""
    time, _, why = text.partition(" ")
    with suppress(ValueError):
        datetime.fromisoformat(time)
        return MovedFolder(kind, folder.name, time, re.sub(r"\s+", " ", why).strip())
    return MovedFolder(kind, folder.name, "", "")
