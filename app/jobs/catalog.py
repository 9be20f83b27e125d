"""Which sequences and runs there are: the bundled ones and those of the data folder."""

from dataclasses import dataclass
from pathlib import Path

import sequences as bundled_package
from app.settings import Settings
from physhandi.data.run import Run, find_runs
from physhandi.data.sequence import Sequence, find_sequences
from physhandi.errors import PhysHandiError, RunError, SequenceError

BUNDLED = Path(bundled_package.__file__).parent


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
    """Finds sequences and runs by id; the folders are the truth and are read each time.

    An id of the data folder hides the same id among the bundled ones.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings

    def sequences(self) -> list[SequenceItem]:
        """List the data folder's sequences, then the bundled ones."""
        items: dict[str, SequenceItem] = {}
        for folder, is_bundled in ((self._settings.sequence_dir, False), (BUNDLED, True)):
            for entry in find_sequences(folder):
                name = entry.folder.name
                items.setdefault(
                    name, SequenceItem(name, entry.folder, is_bundled, entry.sequence, entry.error)
                )
        return list(items.values())

    def runs(self) -> list[RunItem]:
        """List the runs, the newest of the data folder first and the bundled ones last."""
        items: dict[str, RunItem] = {}
        for folder, is_bundled in ((self._settings.run_dir, False), (BUNDLED / "runs", True)):
            found = [
                RunItem(entry.folder.name, entry.folder, is_bundled, entry.run, entry.error)
                for entry in find_runs(folder)
            ]
            found.sort(key=lambda item: item.run.created if item.run else "", reverse=True)
            for item in found:
                items.setdefault(item.id, item)
        return list(items.values())

    def sequence(self, sequence_id: str, /) -> Sequence:
        """Open a sequence by id.

        Raises:
            SequenceError: If there is no such sequence, or it is damaged.
        """
        for item in self.sequences():
            if item.id == sequence_id:
                if item.sequence is None:
                    raise SequenceError(str(item.error))
                return item.sequence
        raise SequenceError(f"There is no sequence '{sequence_id}'.")

    def run_item(self, run_id: str) -> RunItem:
        """Find a usable run by id.

        Raises:
            RunError: If there is no such run, or it is damaged.
        """
        for item in self.runs():
            if item.id == run_id:
                if item.run is None:
                    raise RunError(str(item.error))
                return item
        raise RunError(f"There is no run '{run_id}'.")

    def run(self, run_id: str, /) -> Run:
        """Open a run by id.

        Raises:
            RunError: If there is no such run, or it is damaged.
        """
        return Run.open(self.run_item(run_id).folder)

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
