"""What was read of runs before, kept beside the data so that a server with many starts at once.

Parsing the YAML of a run takes milliseconds, which a thousand runs make seconds. The index only
repeats what the runs' own files say, and only while those are unchanged; it can be deleted.
"""

import hashlib
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
        self._configs: dict[str, Any] = {}
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
                job = entry["job"] | {"config": self._configs[entry["config"]]}
                return Run(folder, job, entry["about"])
            except (KeyError, TypeError):
                logger.warning("%s is damaged at run %s; it is read anew", self._path, folder.name)
        run = Run.open(folder)
        job = {
            "kind": run.kind,
            "sequences": run.sequences,
            "sequence_names": run.sequence_names,
        }
        about = {"name": run.name, "label": run.label, "note": run.note, "created": run.created}
        try:
            text = json.dumps(run.config, sort_keys=True)
        except TypeError:
            return run  # Its settings hold what JSON has not, such as a date: nothing to keep.
        # Most runs of many have the settings of another one, and settings are most of a run.
        key = hashlib.sha256(text.encode()).hexdigest()
        with self._lock:
            run.config = self._configs.setdefault(key, run.config)
            entry = {"stamp": list(stamp), "job": job, "config": key, "about": about}
            self._entries[str(folder)] = entry
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
            used = {entry["config"] for entry in self._entries.values()}
            self._configs = {k: v for k, v in self._configs.items() if k in used}
            known = {"format": _FORMAT, "configs": self._configs, "runs": self._entries}
            try:
                content = json.dumps(known).encode()
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
        if content.get("format") != _FORMAT:
            return {}
        runs = named_fields(content.get("runs"))
        self._configs = named_fields(content.get("configs")) or {}
        found: dict[str, dict[str, Any]] = {}
        for folder, content_of_run in (runs or {}).items():
            entry = named_fields(content_of_run)
            if entry is not None and isinstance(entry.get("config"), str):
                found[folder] = entry
        return found
