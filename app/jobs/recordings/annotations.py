"""Masks and tracks that are found for recordings while the server runs, one recording at a time."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

from app.jobs.catalog import Catalog, SequenceItem
from app.jobs.recordings.background import BackgroundTask, BackgroundTasks, Work
from app.jobs.scheduler import require_unread
from physhandi.errors import UsageError

_WORKER = "app.jobs.recordings.annotator"


@dataclass(frozen=True)
class ClickedPlace:
    """A place on the object that somebody clicked on."""

    view: str
    """View."""
    frame: int
    """Frame."""
    x: float
    """Column [px]."""
    y: float
    """Row [px]."""


class Annotations:
    """Has masks and tracks found for recordings of the data folder."""

    def __init__(self, catalog: Catalog, tasks: BackgroundTasks, *, worker: str = _WORKER) -> None:
        """Prepare.

        Args:
            catalog: Finds sequences and the runs that read them.
            tasks: Has the work done, one piece at a time.
            worker: Module of the process.
        """
        self._catalog = catalog
        self.tasks = tasks
        """Has the work done."""
        self._worker = worker

    def start(
        self, sequence_id: str, clicks: Sequence[ClickedPlace], *, overwrite: bool
    ) -> BackgroundTask:
        """Begin to find masks and tracks of a recording.

        Args:
            sequence_id: The recording.
            clicks: Places on its object; none finds hands alone.
            overwrite: Whether masks and tracks may be replaced that came from elsewhere.

        Raises:
            SequenceError: If there is no such recording, or it is damaged.
            UsageError: If it came with the program.
            RunError: If something is worked on already, or a fit reads this one.
        """
        self._require_own(sequence_id)
        sequence = self._catalog.sequence(sequence_id)
        require_unread(self._catalog, sequence.folder)
        order = {
            "folder": str(sequence.folder),
            "clicks": [asdict(click) for click in clicks],
            "overwrite": overwrite,
        }
        work = Work(
            "annotation", sequence_id, f"Masks and tracks of '{sequence_id}' are being found."
        )
        return self.tasks.start(work, self._worker, order)

    def job(self, sequence_id: str) -> BackgroundTask:
        """Tell how far a recording is; of one that nobody asked for, that there is nothing.

        Raises:
            SequenceError: If there is no such recording.
        """
        self._catalog.sequence_item(sequence_id)
        return self.tasks.task("annotation", sequence_id)

    def cancel(self, sequence_id: str) -> None:
        """Stop the work on a recording, which stays as it was; does nothing if none is worked on.

        Raises:
            SequenceError: If there is no such recording.
        """
        self._catalog.sequence_item(sequence_id)
        self.tasks.cancel("annotation", sequence_id)

    def _require_own(self, sequence_id: str) -> SequenceItem:
        item = self._catalog.sequence_item(sequence_id)
        if item.is_bundled:
            raise UsageError(
                f"Sequence '{sequence_id}' came with the program and stays as it is. Copy its "
                "folder into the data folder to change it."
            )
        return item
