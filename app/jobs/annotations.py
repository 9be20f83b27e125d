"""Masks and tracks that are found for recordings while the server runs, one recording at a time."""

import threading
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from app.jobs.catalog import Catalog
from physhandi.child import Child
from physhandi.errors import CancelledError, PhysHandiError, RunError, UsageError, describe

_WORKER = "app.jobs.annotator"
_LONGEST_S = 4 * 3600.0
"""Time after which a process is not waited for any longer [s]."""


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


@dataclass
class AnnotationJob:
    """How far the work on one recording is."""

    state: Literal["none", "running", "done", "cancelled", "failed"] = "none"
    reason: str = ""
    """Why it failed."""
    progress: dict[str, Any] = field(default_factory=dict[str, Any])
    """The latest report: ``stage iteration total message``."""


class Annotations:
    """Starts the process that annotates, listens to it, and ends it with the server."""

    def __init__(self, catalog: Catalog, *, worker: str = _WORKER) -> None:
        """Prepare.

        Args:
            catalog: Finds sequences.
            worker: Module of the process.
        """
        self._catalog = catalog
        self._worker = worker
        self._lock = threading.Lock()
        self._jobs: dict[str, AnnotationJob] = {}
        self._child: Child | None = None
        self._listener: threading.Thread | None = None

    def start(
        self, sequence_id: str, clicks: Sequence[ClickedPlace], *, overwrite: bool
    ) -> AnnotationJob:
        """Begin to find masks and tracks of a recording.

        Args:
            sequence_id: The recording.
            clicks: Places on its object; none finds hands alone.
            overwrite: Whether masks and tracks may be replaced that came from elsewhere.

        Raises:
            SequenceError: If there is no such recording, or it is damaged.
            UsageError: If it came with the program.
            RunError: If one is worked on already.
        """
        item = self._catalog.sequence_item(sequence_id)
        if item.is_bundled:
            raise UsageError(
                f"Sequence '{sequence_id}' came with the program and stays as it is. Copy its "
                "folder into the data folder to change it."
            )
        sequence = self._catalog.sequence(sequence_id)
        with self._lock:
            busy = next((name for name, job in self._jobs.items() if job.state == "running"), None)
            if busy is not None:
                raise RunError(
                    f"Masks of '{busy}' are being found. Wait until that is done, or cancel it."
                )
            job = self._jobs[sequence_id] = AnnotationJob("running")
            self._child = child = Child(self._worker, time_limit_s=_LONGEST_S)
            child.send(
                {
                    "folder": str(sequence.folder),
                    "clicks": [asdict(click) for click in clicks],
                    "overwrite": overwrite,
                }
            )
            self._listener = threading.Thread(
                target=self._listen, args=(child, job), name="annotations", daemon=True
            )
            self._listener.start()
        return job

    def job(self, sequence_id: str) -> AnnotationJob:
        """Tell how far a recording is; of one that nobody asked for, that there is nothing.

        Raises:
            SequenceError: If there is no such recording.
        """
        self._catalog.sequence_item(sequence_id)
        return self._jobs.get(sequence_id, AnnotationJob())

    def cancel(self, sequence_id: str) -> None:
        """Stop the work on a recording, which stays as it was; does nothing if none is worked on.

        Raises:
            SequenceError: If there is no such recording.
        """
        if self.job(sequence_id).state == "running" and self._child is not None:
            self._child.send("cancel")

    def shutdown(self) -> None:
        """End what is at work."""
        child, listener = self._child, self._listener
        if child is not None:
            child.kill()
        if listener is not None:
            listener.join(timeout=5)

    @staticmethod
    def _listen(child: Child, job: AnnotationJob) -> None:
        with child:
            try:
                for message in child.messages():
                    job.progress = message
                job.state = "done"
            except CancelledError:
                job.state = "cancelled"
            except (PhysHandiError, OSError) as error:
                job.reason = describe(error)
                job.state = "failed"
