"""Masks and tracks that are found for recordings while the server runs, one recording at a time."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass

from app.jobs.catalog import Catalog, SequenceItem
from app.jobs.recordings.background import BackgroundTask, BackgroundTasks
from app.jobs.scheduler import require_unread
from physhandi.errors import RunError, UsageError

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
    """Finds masks and tracks, and keeps fits and changes of a recording apart."""

    def __init__(self, catalog: Catalog, *, worker: str = _WORKER) -> None:
        """Prepare.

        Args:
            catalog: Finds sequences and the runs that read them.
            worker: Module of the process.
        """
        self._catalog = catalog
        self._tasks = BackgroundTasks(worker, "Masks of '{}' are being found.")

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
            RunError: If one is worked on already, or a fit reads this one.
        """
        self._require_own(sequence_id)
        sequence = self._catalog.sequence(sequence_id)
        require_unread(self._catalog, sequence.folder)
        order = {
            "folder": str(sequence.folder),
            "clicks": [asdict(click) for click in clicks],
            "overwrite": overwrite,
        }
        return self._tasks.start(sequence_id, order)

    def job(self, sequence_id: str) -> BackgroundTask:
        """Tell how far a recording is; of one that nobody asked for, that there is nothing.

        Raises:
            SequenceError: If there is no such recording.
        """
        self._catalog.sequence_item(sequence_id)
        return self._tasks.task(sequence_id)

    def cancel(self, sequence_id: str) -> None:
        """Stop the work on a recording, which stays as it was; does nothing if none is worked on.

        Raises:
            SequenceError: If there is no such recording.
        """
        self._catalog.sequence_item(sequence_id)
        self._tasks.cancel(sequence_id)

    def require_settled(self, sequence_ids: Iterable[str]) -> None:
        """Refuse to read recordings whose masks are about to be replaced.

        Raises:
            RunError: If one of them is worked on.
        """
        running = self._tasks.running
        if running is not None and running in sequence_ids:
            raise RunError(
                f"Masks and tracks of '{running}' are being found, which a fit would read half "
                "old and half new. Wait until that is done, or cancel it."
            )

    def shutdown(self) -> None:
        """End what is at work."""
        self._tasks.shutdown()

    def _require_own(self, sequence_id: str) -> SequenceItem:
        item = self._catalog.sequence_item(sequence_id)
        if item.is_bundled:
            raise UsageError(
                f"Sequence '{sequence_id}' came with the program and stays as it is. Copy its "
                "folder into the data folder to change it."
            )
        return item
