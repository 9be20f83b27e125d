"""Leftovers of killed processes in a data folder, and their removal."""

import os
import shutil
import socket
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from app.settings import ServerSettings
from physhandi.data.files import is_abandoned, sweep_temporary
from physhandi.data.lease import live_holder, locked
from physhandi.data.run_folder import LEASE, LeaseFile, read_record
from physhandi.data.sequence_writer import can_be_gone_on_with, interrupted_replacements
from physhandi.errors import RunError


@dataclass(frozen=True)
class LeftBehind:
    """Leftovers of ended processes in a data folder."""

    temporaries: tuple[Path, ...] = ()
    """Files and folders that were never finished, and runs that were only half deleted."""
    claims: tuple[Path, ...] = ()
    """Runs that a process of this machine claimed that is gone."""
    replaced: tuple[Path, ...] = ()
    """Sequences that were moved out of the way of a new one that never came."""
    imports: tuple[Path, ...] = ()
    """Hidden folders of imports that can be gone on with; they stay."""


def find_left_behind(settings: ServerSettings) -> LeftBehind:
    """Look through a data folder; what a live process writes, or one of another host, is not told.

    Args:
        settings: Tells the data folder.
    """
    unfinished = [path for path in _temporaries(settings) if is_abandoned(path)]
    imports = [path for path in unfinished if can_be_gone_on_with(path)]
    half_deleted = settings.run_dir.glob(".*.deleted")
    return LeftBehind(
        tuple(sorted({*unfinished, *half_deleted} - {*imports})),
        tuple(folder for folder in _runs(settings) if _is_claim_void(folder)),
        tuple(interrupted_replacements(settings.sequence_dir)),
        tuple(sorted(imports)),
    )


def tidy(left: LeftBehind) -> None:
    """Remove what was left behind, and put sequences back whose replacement never came.

    Raises:
        OSError: If the disk does not allow it.
    """
    sweep_temporary(iter(left.temporaries))
    for path in left.temporaries:
        if path.name.endswith(".deleted"):
            shutil.rmtree(path, ignore_errors=True)
    for folder in left.claims:
        try:
            with locked(folder):
                if _is_claim_void(folder):  # Somebody may have claimed it since.
                    (folder / LEASE).unlink(missing_ok=True)
        except RunError:
            continue  # It was deleted since.
    for folder in left.replaced:
        if not folder.exists():
            folder.with_name(f".{folder.name}.replaced").rename(folder)


def _temporaries(settings: ServerSettings) -> Iterator[Path]:
    """Find everything that is named as being written, but for what lies within it."""
    if settings.data_dir.is_dir():
        yield from settings.data_dir.glob(".*.tmp*")
    roots = (settings.run_dir, settings.sequence_dir, settings.suite_dir, settings.damaged_dir)
    for root in (*roots, *(settings.data_dir / name for name in ("cache", "presets", "shares"))):
        for folder, folders, files in os.walk(root):
            hidden = [name for name in folders if name.startswith(".")]
            folders[:] = [name for name in folders if not name.startswith(".")]
            named = (name for name in (*hidden, *files) if name.startswith(".") and ".tmp" in name)
            yield from (Path(folder) / name for name in named)


def _runs(settings: ServerSettings) -> Iterator[Path]:
    for path in settings.run_dir.glob(f"[!.]*/{LEASE}"):
        yield path.parent


def _is_claim_void(folder: Path) -> bool:
    """Tell whether the process of this machine that claimed a run is gone."""
    try:
        claim = read_record(folder / LEASE, LeaseFile)
    except RunError:
        return True
    is_own = claim is not None and claim["host"] == socket.gethostname()
    return is_own and live_holder(folder) is None
