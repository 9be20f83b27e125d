"""Catalog of sequences and runs: the bundled ones and those of the data folder."""

import hashlib
import json
import logging
import os
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from app.settings import BUNDLED, ServerSettings
from physhandi.data.files import named_fields, write_atomically
from physhandi.data.run_folder import JOB, RUN, read_mapping
from physhandi.data.sequence import Sequence
from physhandi.data.sequence_meta import FILE
from physhandi.errors import PhysHandiError, RunError, SequenceError, describe
from physhandi.run import Run

logger = logging.getLogger(__name__)

_FORMAT = "physhandi-run-index/1"
_WORTH_SAVING = 50
DEFECT = "a mistake of the program, whose log tells more"
"""Cause that is named where no error of ours was expected."""

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
                job = (named_fields(entry["job"]) or {}) | {
                    "config": self._configs[entry["config"]]
                }
                return Run.of_content(folder, job, entry["about"])
            except (KeyError, RunError):
                logger.warning("%s is damaged at run %s; it is read anew", self._path, folder.name)
        run = Run.open(folder)
        job = {
            "kind": run.kind,
            "sequences": run.sequences,
            "sequence_names": run.sequence_names,
        }
        about = {"name": run.name, "label": run.label, "note": run.note, "created": run.created}
        text = json.dumps(run.config, sort_keys=True)
        # Most runs of many have the settings of another one, and settings are most of a run.
        key = hashlib.sha256(text.encode()).hexdigest()
        with self._lock:
            if self._configs.get(key) == run.config:
                run.config = self._configs[key]
            else:
                self._configs[key] = run.config
            entry = {"stamp": list(stamp), "job": job, "config": key, "about": about}
            self._entries[str(folder)] = entry
            self._unsaved += 1
        return run

    def forget(self) -> None:
        """Know no run any more; the file stays until the next `save`."""
        with self._lock:
            self._entries, self._configs, self._unsaved = {}, {}, 0

    def save(self, present: Callable[[], set[str]], *, is_asked_for: bool = False) -> None:
        """Write the index if that is worth it by now.

        Args:
            present: Gives the folders of the runs that there are; others are forgotten.
            is_asked_for: Whether it is written in any case, and an error is raised.

        Raises:
            OSError: If it was asked for and cannot be written.
        """
        with self._lock:
            is_due = is_asked_for or self._unsaved >= _WORTH_SAVING
            if not is_due or self._entries is None:
                return
            self._unsaved = 0
            folders = present()
            self._entries = {k: v for k, v in self._entries.items() if k in folders}
            used = {entry["config"] for entry in self._entries.values()}
            self._configs = {k: v for k, v in self._configs.items() if k in used}
            stored = {"format": _FORMAT, "configs": self._configs, "runs": self._entries}
            try:
                content = json.dumps(stored).encode()
                self._path.parent.mkdir(parents=True, exist_ok=True)
                write_atomically(self._path, lambda file: file.write(content), is_durable=False)
            except OSError as error:
                if is_asked_for:
                    raise
                logger.warning("the index of runs is not kept: %s", error)

    def _read(self) -> dict[str, dict[str, Any]]:
        try:
            content = read_mapping(self._path)
        except RunError as error:
            logger.warning("runs are read anew: %s", error)
            return {}
        if content.get("format") != _FORMAT:
            return {}
        runs = named_fields(content.get("runs"))
        self._configs = named_fields(content.get("configs")) or {}
        entries: dict[str, dict[str, Any]] = {}
        for folder, content_of_run in (runs or {}).items():
            entry = named_fields(content_of_run)
            if entry is not None and isinstance(entry.get("config"), str):
                entries[folder] = entry
        return entries


T = TypeVar("T")


class NotFoundError(PhysHandiError):
    """There is no run or sequence of that id."""


class UnknownRunError(RunError, NotFoundError):
    """There is no run of that id."""


class UnknownSequenceError(SequenceError, NotFoundError):
    """There is no sequence of that id."""


@dataclass(frozen=True)
class SequenceItem:
    """One listed sequence, usable or not."""

    id: str
    """Name of its folder."""
    folder: Path
    """Its folder."""
    is_bundled: bool
    """Whether it came with the program."""
    sequence: Sequence | None
    """The sequence; none if it is damaged."""
    error: str | None
    """Why it cannot be used."""


@dataclass(frozen=True)
class RunItem:
    """One listed run, usable or not."""

    id: str
    """Name of its folder."""
    folder: Path
    """Its folder."""
    is_bundled: bool
    """Whether it came with the program."""
    run: Run | None
    """The run; none if it is damaged."""
    error: str | None
    """Why it cannot be used."""


class Catalog:
    """Finds sequences and runs by id; the folders are the truth.

    An id of the data folder hides the same id among the bundled ones. A folder is read again when
    its description or its entries have changed; safe to use from several threads.
    """

    def __init__(self, settings: ServerSettings, *, bundled: Path = BUNDLED) -> None:
        """Prepare; nothing is read yet.

        Args:
            settings: Tells the data folder.
            bundled: Folder of the sequences that came with the program.
        """
        self._sequence_dirs = ((settings.sequence_dir, False), (bundled, True))
        self._run_dirs = ((settings.run_dir, False), (bundled / "runs", True))
        self._suite_dir = settings.suite_dir
        self._sequences = _Folders(_open_sequence, (FILE, "views"))
        self._index = RunIndex(settings.index_path)
        self._runs = _Folders(self._index.open, (JOB, RUN))

    def sequences(self) -> list[SequenceItem]:
        """List the data folder's sequences, then the bundled ones, each by name."""
        items: dict[str, SequenceItem] = {}
        for root, is_bundled in self._sequence_dirs:
            for folder, (sequence, error) in self._sequences.list(root):
                item = SequenceItem(folder.name, folder, is_bundled, sequence, error)
                items.setdefault(item.id, item)
        return list(items.values())

    def runs(self) -> list[RunItem]:
        """List the runs, the newest of the data folder first and the bundled ones last."""
        items: dict[str, RunItem] = {}
        for root, is_bundled in self._run_dirs:
            listed = [
                RunItem(folder.name, folder, is_bundled, run, error)
                for folder, (run, error) in self._runs.list(root)
            ]
            listed.sort(key=lambda item: item.run.created if item.run else "", reverse=True)
            for item in listed:
                items.setdefault(item.id, item)
        self._index.save(lambda: self._runs.paths)
        return list(items.values())

    def reindex(self) -> None:
        """Make the index of runs anew from their folders.

        Raises:
            OSError: If it cannot be written.
        """
        self._index.forget()
        self._runs = _Folders(self._index.open, (JOB, RUN))
        self.runs()
        self._index.save(lambda: self._runs.paths, is_asked_for=True)

    def sequence_item(self, sequence_id: str) -> SequenceItem:
        """Find a sequence by id, usable or not.

        Raises:
            UnknownSequenceError: If there is no such sequence.
        """
        for root, is_bundled in self._sequence_dirs:
            opened = self._sequences.find(root, sequence_id)
            if opened is not None:
                return SequenceItem(sequence_id, root / sequence_id, is_bundled, *opened)
        raise UnknownSequenceError(f"There is no sequence '{sequence_id}'.")

    def sequence(self, sequence_id: str, /) -> Sequence:
        """Open a sequence by id.

        Raises:
            SequenceError: If there is no such sequence, or it is damaged.
        """
        item = self.sequence_item(sequence_id)
        if item.sequence is None:
            raise SequenceError(str(item.error))
        # A fresh one: its views keep open videos, which threads must not share.
        return Sequence.load(item.folder)

    def run_item(self, run_id: str) -> RunItem:
        """Find a run by id, usable or not; those of suites too, which are not listed.

        Raises:
            UnknownRunError: If there is no such run.
        """
        cells = ((folder, False) for folder in sorted(self._suite_dir.glob("*/cells")))
        for root, is_bundled in (*self._run_dirs, *cells):
            opened = self._runs.find(root, run_id)
            if opened is not None:
                return RunItem(run_id, root / run_id, is_bundled, *opened)
        raise UnknownRunError(f"There is no run '{run_id}'.")

    def run(self, run_id: str, /) -> Run:
        """Open a run by id.

        Raises:
            RunError: If there is no such run, or it is damaged.
        """
        item = self.run_item(run_id)
        if item.run is None:
            raise RunError(str(item.error))
        return Run.open(item.folder)

    def sequences_of(self, run: Run) -> list[Sequence]:
        """Open the sequences of a run, where it was made or by name.

        Raises:
            SequenceError: If one is gone or damaged.
        """
        opened: list[Sequence] = []
        for folder, name in zip(run.sequences, run.sequence_names, strict=True):
            try:
                opened.append(
                    Sequence.load(folder) if Path(folder).is_dir() else self.sequence(name)
                )
            except PhysHandiError as error:
                raise SequenceError(
                    f"Run '{run.id}' needs sequence '{name}', which cannot be opened: {error}"
                ) from error
        return opened


class _Folders(Generic[T]):
    """Opened folders, kept until one of the watched entries changes."""

    def __init__(self, load: Callable[[Path, Stamp], T], watched: tuple[str, ...]) -> None:
        self._load = load
        self._watched = watched
        self._lock = threading.Lock()
        self._entries: dict[str, tuple[object, Path, tuple[T | None, str | None]]] = {}

    @property
    def paths(self) -> set[str]:
        """Folders that were opened."""
        with self._lock:
            return set(self._entries)

    def list(self, root: Path) -> list[tuple[Path, tuple[T | None, str | None]]]:
        """Open all folders directly below a root; what cannot be opened says why."""
        # Plain texts, since a list of thousands is asked for several times a second.
        listed = [entry for name in _names_in(root) if (entry := self._look(f"{root}/{name}"))]
        with self._lock:
            prefix = f"{root}/"
            if sum(path.startswith(prefix) for path in self._entries) > len(listed):
                present = {str(folder) for folder, _ in listed}
                for path in [p for p in self._entries if p.startswith(prefix) and p not in present]:
                    del self._entries[path]
        return listed

    def find(self, root: Path, name: str) -> tuple[T | None, str | None] | None:
        """Open the folder of that name directly below a root; None if there is none."""
        if not name or name.startswith(".") or {"/", "\\", "\0"} & set(name):
            return None
        opened = self._look(f"{root}/{name}")
        return None if opened is None else opened[1]

    def _look(self, path: str) -> tuple[Path, tuple[T | None, str | None]] | None:
        stamp = self._stamp(path)
        if stamp is None:
            return None
        entry = self._entries.get(path)
        if entry is None or entry[0] != stamp:
            folder = Path(path)
            entry = (stamp, folder, self._open(folder, stamp))
            with self._lock:
                self._entries[path] = entry
        return entry[1], entry[2]

    def _stamp(self, path: str) -> Stamp | None:
        """Summarise what would change with the folder; None if it is not one of the kind."""
        stamps: list[int] = []
        for name in self._watched:
            try:
                status = os.stat(f"{path}/{name}")  # noqa: PTH116  # see `list`
                stamps += (status.st_mtime_ns, status.st_size)
            except OSError:
                stamps += (0, 0)
        return tuple(stamps) if any(stamps) else None

    def _open(self, folder: Path, stamp: Stamp) -> tuple[T | None, str | None]:
        try:
            return self._load(folder, stamp), None
        except (PhysHandiError, OSError) as error:
            return None, describe(error)
        except Exception as error:  # One folder must never hide the others.
            logger.exception("%s cannot be opened", folder)
            return None, f"{folder} cannot be opened: {DEFECT} ({type(error).__name__}: {error})."


def _names_in(root: Path) -> Iterator[str]:
    """Name what lies in a folder, in order; nothing if there is no such folder."""
    try:
        names = os.listdir(root)  # noqa: PTH208  # see `_Folders.list`
    except (FileNotFoundError, NotADirectoryError):
        return
    yield from sorted(name for name in names if not name.startswith("."))


def _open_sequence(folder: Path, _stamp: Stamp) -> Sequence:
    return Sequence.load(folder)
