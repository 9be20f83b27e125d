"""Recovery of the server's data folder, for its page and the API."""

import logging
import threading
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from app.jobs.catalog import Catalog
from app.jobs.recordings.background import BackgroundTasks
from app.jobs.recovery.aside import ItemKind, MovedFolder, move_aside, moved_folders
from app.jobs.recovery.left_behind import LeftBehind, find_left_behind, tidy
from app.jobs.scheduler import Scheduler, require_unread
from app.settings import ServerSettings
from physhandi.data.run_folder import now
from physhandi.errors import RunError, describe

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class DamagedFolder:
    """A run or sequence that cannot be read."""

    kind: ItemKind
    """Its kind."""
    id: str
    """Name of its folder."""
    why: str
    """Its defect; names file and field."""


def damaged_folders(catalog: Catalog, scheduler: Scheduler) -> list[DamagedFolder]:
    """List the runs and sequences of the data folder that cannot be read."""
    runs = ((item, scheduler.view(item)) for item in catalog.runs() if not item.is_bundled)
    damaged_runs = [DamagedFolder("runs", i.id, v.reason) for i, v in runs if v.state == "damaged"]
    return damaged_runs + [
        DamagedFolder("sequences", item.id, item.error)
        for item in catalog.sequences()
        if item.error is not None and not item.is_bundled
    ]


class Recovery:
    """Tidies a data folder when the server starts, and moves aside what cannot be read."""

    def __init__(
        self,
        settings: ServerSettings,
        catalog: Catalog,
        scheduler: Scheduler,
        tasks: BackgroundTasks,
    ) -> None:
        """Prepare; `start` looks.

        Args:
            settings: Tells the data folder.
            catalog: Finds runs and sequences.
            scheduler: Knows what is at work.
            tasks: Knows which recordings are worked on.
        """
        self._settings = settings
        self._catalog = catalog
        self._scheduler = scheduler
        self._tasks = tasks
        self._left = LeftBehind()
        self._problem = ""
        self._looked = ""
        self._thread = threading.Thread(target=self._tidy, name="recovery", daemon=True)

    def start(self) -> None:
        """Begin to tidy; of thousands of runs that takes seconds, which nobody waits for."""
        self._thread.start()

    def set_sequence_aside(self, sequence_id: str) -> MovedFolder:
        """Move the folder of a sequence that cannot be read out of the way.

        Raises:
            UnknownSequenceError: If there is no such sequence.
            RunError: If it came with the program, can be read, or is worked on.
        """
        item = self._catalog.sequence_item(sequence_id)
        if item.is_bundled:
            raise RunError(f"Sequence '{sequence_id}' came with the program and stays as it is.")
        if item.error is None:
            raise RunError(
                f"Sequence '{sequence_id}' can be read; only a damaged one is moved aside."
            )
        self._tasks.require_settled([sequence_id])
        require_unread(self._catalog, item.folder)
        return move_aside(item.folder, "sequences", self._settings.damaged_dir, item.error)

    def describe(self) -> dict[str, Any]:
        """Tell what was found.

        Returns:
            ``looked`` (when all had been tidied, ISO 8601; empty while it is not), ``problem``
            (why it could not be), what was removed or put back (``temporaries claims replaced``,
            names in the data folder), ``imports`` that can be gone on with, ``restarted`` (``time
            run why`` of runs that had lost their process), ``damaged`` (``kind id why``) and
            ``aside`` (``kind name time why``).
        """
        left = self._left
        damaged = damaged_folders(self._catalog, self._scheduler)
        return {
            "looked": self._looked,
            "problem": self._problem,
            "temporaries": self._named(left.temporaries),
            "claims": self._named(left.claims),
            "replaced": self._named(left.replaced),
            "imports": self._named(left.imports),
            "restarted": [asdict(restart) for restart in self._scheduler.restarts],
            "damaged": [asdict(folder) for folder in damaged],
            "aside": [asdict(moved) for moved in moved_folders(self._settings.damaged_dir)],
        }

    def _named(self, paths: tuple[Path, ...]) -> list[str]:
        return [path.relative_to(self._settings.data_dir).as_posix() for path in paths]

    def _tidy(self) -> None:
        try:
            left = find_left_behind(self._settings)
            tidy(left)
            self._left = left
        except OSError as error:
            logger.warning("the data folder is not tidied: %s", describe(error))
            self._problem = describe(error)
        self._looked = now()
