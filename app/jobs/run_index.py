"""What was read of runs before, kept beside the data so that a server with many starts at once.

Parsing the YAML of a run takes milliseconds, which a thousand runs make seconds. The index only
repeats what the runs' own files say, and only while those are unchanged; it can be deleted.
"""

import json
import logging
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from physhandi.data.atomic import named_fields, write_atomically
from physhandi.data.run import Run

logger = logging.getLogger(__name__)

_FORMAT = "physhandi-run-index/1"
_WORTH_SAVING = 50

Stamp = tuple[int, ...]


class RunIndex:
    """Opens runs, from memory of an earlier server where their files are still the same."""

    def __init__(self, path: Path) -> None:
        """Prepare; the file is read when the first run is opened.

        Args:
            path: File of the index; made when enough runs were read.
        """
        self._path = path
        self._lock = threading.Lock()
        self._entries: dict[str, dict[str, Any]] | None = None
        self._unsaved = 0

    def open(self, folder: Path, stamp: Stamp) -> Run:
        """Open a run.

        Args:
            folder: The run.
            stamp: Times and sizes of its files.

        Raises:
            RunError: As `Run.open`.
        """
        with self._lock:
            if self._entries is None:
                self._entries = self._read()
            entry = self._entries.get(str(folder))
        if entry is not None and entry.get("stamp") == list(stamp):
            try:
                return Run(folder, entry["job"], entry["about"])
            except (KeyError, TypeError):
                logger.warning("%s is damaged at run %s; it is read anew", self._path, folder.name)
        run = Run.open(folder)
        job = {
            "kind": run.kind,
            "sequences": run.sequences,
            "sequence_names": run.sequence_names,
            "config": run.config,
        }
        about = {"name": run.name, "label": run.label, "created": run.created}
        with self._lock:
            self._entries[str(folder)] = {"stamp": list(stamp), "job": job, "about": about}
            self._unsaved += 1
        return run

    def save(self, present: Callable[[], set[str]]) -> None:
        """Write the index if that is worth it by now.

        Args:
            present: Gives the folders of the runs that there are; others are forgotten.
        """
        with self._lock:
            if self._unsaved < _WORTH_SAVING or self._entries is None:
                return
            self._unsaved = 0
            folders = present()
            self._entries = {k: v for k, v in self._entries.items() if k in folders}
            try:
                content = json.dumps({"format": _FORMAT, "runs": self._entries}).encode()
                self._path.parent.mkdir(parents=True, exist_ok=True)
                write_atomically(self._path, lambda file: file.write(content), is_durable=False)
            except (OSError, TypeError, ValueError) as error:
                logger.warning("the index of runs is not kept: %s", error)

    def _read(self) -> dict[str, dict[str, Any]]:
        try:
            content = named_fields(json.loads(self._path.read_bytes())) or {}
        except FileNotFoundError:
            return {}
        except (OSError, ValueError, RecursionError) as error:
            logger.warning("%s cannot be read, so runs are read anew: %s", self._path, error)
            return {}
        runs = named_fields(content.get("runs")) if content.get("format") == _FORMAT else None
        found = {folder: named_fields(entry) for folder, entry in (runs or {}).items()}
        return {folder: entry for folder, entry in found.items() if entry is not None}
