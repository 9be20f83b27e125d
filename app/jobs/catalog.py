"""Which sequences and runs there are: the bundled ones and those of the data folder."""

import os
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from app.jobs.run_index import RunIndex, Stamp
from app.settings import BUNDLED, Settings
from physhandi.data.run import Run
from physhandi.data.run_files import JOB, RUN
from physhandi.data.sequence import Sequence
from physhandi.data.sequence_schema import FILE
from physhandi.errors import PhysHandiError, RunError, SequenceError

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
    """Where it lies."""
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
    """Where it lies."""
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

    def __init__(self, settings: Settings, *, bundled: Path = BUNDLED) -> None:
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
            found = [
                RunItem(folder.name, folder, is_bundled, run, error)
                for folder, (run, error) in self._runs.list(root)
            ]
            found.sort(key=lambda item: item.run.created if item.run else "", reverse=True)
            for item in found:
                items.setdefault(item.id, item)
        self._index.save(lambda: self._runs.paths)
        return list(items.values())

    def sequence_item(self, sequence_id: str) -> SequenceItem:
        """Find a sequence by id, usable or not.

        Raises:
            UnknownSequenceError: If there is no such sequence.
        """
        for root, is_bundled in self._sequence_dirs:
            found = self._sequences.find(root, sequence_id)
            if found is not None:
                return SequenceItem(sequence_id, root / sequence_id, is_bundled, *found)
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
            found = self._runs.find(root, run_id)
            if found is not None:
                return RunItem(run_id, root / run_id, is_bundled, *found)
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
        found: list[Sequence] = []
        for folder, name in zip(run.sequences, run.sequence_names, strict=True):
            try:
                found.append(
                    Sequence.load(folder) if Path(folder).is_dir() else self.sequence(name)
                )
            except PhysHandiError as error:
                raise SequenceError(
                    f"Run '{run.id}' needs sequence '{name}', which cannot be opened: {error}"
                ) from error
        return found


class _Folders(Generic[T]):
    """Opened folders, kept until one of the watched entries changes."""

    def __init__(self, load: Callable[[Path, Stamp], T], watched: tuple[str, ...]) -> None:
        self._load = load
        self._watched = watched
        self._lock = threading.Lock()
        self._known: dict[str, tuple[object, Path, tuple[T | None, str | None]]] = {}

    @property
    def paths(self) -> set[str]:
        """Folders that were opened."""
        with self._lock:
            return set(self._known)

    def list(self, root: Path) -> list[tuple[Path, tuple[T | None, str | None]]]:
        """Open all folders directly below a root; what cannot be opened says why."""
        # Plain texts, since a list of thousands is asked for several times a second.
        listed = [entry for name in _names_in(root) if (entry := self._look(f"{root}/{name}"))]
        with self._lock:
            prefix = f"{root}/"
            if sum(path.startswith(prefix) for path in self._known) > len(listed):
                present = {str(folder) for folder, _ in listed}
                for path in [p for p in self._known if p.startswith(prefix) and p not in present]:
                    del self._known[path]
        return listed

    def find(self, root: Path, name: str) -> tuple[T | None, str | None] | None:
        """Open the folder of that name directly below a root; None if there is none."""
        if not name or name.startswith(".") or {"/", "\\", "\0"} & set(name):
            return None
        found = self._look(f"{root}/{name}")
        return None if found is None else found[1]

    def _look(self, path: str) -> tuple[Path, tuple[T | None, str | None]] | None:
        stamp = self._stamp(path)
        if stamp is None:
            return None
        known = self._known.get(path)
        if known is None or known[0] != stamp:
            folder = Path(path)
            known = (stamp, folder, self._open(folder, stamp))
            with self._lock:
                self._known[path] = known
        return known[1], known[2]

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
            return None, str(error)


def _names_in(root: Path) -> Iterator[str]:
    """Name what lies in a folder, in order; nothing if there is no such folder."""
    try:
        names = os.listdir(root)  # noqa: PTH208  # see `_Folders.list`
    except (FileNotFoundError, NotADirectoryError):
        return
    yield from sorted(name for name in names if not name.startswith("."))


def _open_sequence(folder: Path, _stamp: Stamp) -> Sequence:
    return Sequence.load(folder)
