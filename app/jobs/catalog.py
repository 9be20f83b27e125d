"""Which sequences and runs there are: the bundled ones and those of the data folder."""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

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
        self._sequences = _Folders(_open_sequence, (FILE, "views"))
        self._runs = _Folders(_open_run, (JOB, RUN))

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
        return list(items.values())

    def sequence_item(self, sequence_id: str) -> SequenceItem:
        """Find a sequence by id, usable or not.

        Raises:
            UnknownSequenceError: If there is no such sequence.
        """
        for item in self.sequences():
            if item.id == sequence_id:
                return item
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
        """Find a run by id, usable or not.

        Raises:
            UnknownRunError: If there is no such run.
        """
        for item in self.runs():
            if item.id == run_id:
                return item
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

    def __init__(self, load: Callable[[Path], T], watched: tuple[str, ...]) -> None:
        self._load = load
        self._watched = watched
        self._lock = threading.Lock()
        self._known: dict[Path, tuple[object, tuple[T | None, str | None]]] = {}

    def list(self, root: Path) -> list[tuple[Path, tuple[T | None, str | None]]]:
        """Open all folders directly below a root; what cannot be opened says why."""
        if not root.is_dir():
            return []
        found: list[tuple[Path, tuple[T | None, str | None]]] = []
        for folder in sorted(root.iterdir()):
            stamp = self._stamp(folder)
            if folder.name.startswith(".") or stamp is None:
                continue
            with self._lock:
                known = self._known.get(folder)
            if known is None or known[0] != stamp:
                known = (stamp, self._open(folder))
                with self._lock:
                    self._known[folder] = known
            found.append((folder, known[1]))
        with self._lock:
            listed = {folder for folder, _ in found}
            for folder in [f for f in self._known if f.parent == root and f not in listed]:
                del self._known[folder]
        return found

    def _stamp(self, folder: Path) -> tuple[tuple[int, int], ...] | None:
        """Summarise what would change with the folder; None if it is not one of the kind."""
        stamps: list[tuple[int, int]] = []
        for name in self._watched:
            try:
                status = (folder / name).stat()
                stamps.append((status.st_mtime_ns, status.st_size))
            except OSError:
                stamps.append((0, 0))
        return tuple(stamps) if any(stamp != (0, 0) for stamp in stamps) else None

    def _open(self, folder: Path) -> tuple[T | None, str | None]:
        try:
            return self._load(folder), None
        except (PhysHandiError, OSError) as error:
            return None, str(error)


def _open_sequence(folder: Path) -> Sequence:
    return Sequence.load(folder)


def _open_run(folder: Path) -> Run:
    return Run.open(folder)
