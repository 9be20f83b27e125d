"""Recordings that are imported while the server runs, and the example to try it on."""

import threading
from dataclasses import asdict, dataclass
from typing import Any

from app.jobs.catalog import Catalog, NotFoundError
from app.jobs.recordings.background import BackgroundTask, BackgroundTasks, Work
from app.jobs.recordings.captures import CaptureFolders
from app.jobs.scheduler import require_unread
from app.settings import ServerSettings
from physhandi.child import Child
from physhandi.errors import UsageError

_WORKER = "app.jobs.recordings.importer"
_SURVEY_S = 120.0
"""Time that a look at a recording may take [s]."""
EXAMPLE = "example"
"""Name of the folder of the example."""


@dataclass(frozen=True, kw_only=True)
class ImportOrder:
    """A recording and what it does not say itself; see `CaptureOptions`."""

    source: str
    """Place of the recording, as `CaptureFolders` names it."""
    name: str
    """Name of the new sequence."""
    depth_scale: float | None
    intrinsics: str
    """Place of a file; empty for what is in the recording."""
    charuco: str
    april_grid: str
    by_table: bool = False
    start: int
    stop: int | None
    every: int
    frame_rate: float | None
    hands: list[str]
    overwrite: bool
    """Whether a sequence of that name may be replaced."""


class Imports:
    """Looks at recordings and makes sequences of them."""

    def __init__(
        self,
        settings: ServerSettings,
        catalog: Catalog,
        tasks: BackgroundTasks,
        *,
        worker: str = _WORKER,
    ) -> None:
        """Prepare.

        Args:
            settings: Tell the folders of recordings and sequences.
            catalog: Finds sequences and the runs that read them.
            tasks: Has the work done, one piece at a time.
            worker: Module of the process.
        """
        self.folders = CaptureFolders(settings)
        self._target = settings.sequence_dir
        self._catalog = catalog
        self._tasks = tasks
        self._worker = worker
        self._looking = threading.Lock()

    def survey(
        self, source: str, *, intrinsics: str = "", depth_scale: float | None = None
    ) -> dict[str, Any]:
        """Tell what a recording holds (`CaptureSurvey`); media are only decoded in a process apart.

        Args:
            source: Place of the recording.
            intrinsics: Place of a file with the intrinsics of all cameras; empty for none.
            depth_scale: Metres per unit of depth; None as the recording says.

        Raises:
            UnknownCaptureError: If there is no such place.
        """
        order = {
            "work": "survey",
            "source": str(self.folders.find(source)),
            "options": self._options(intrinsics) | {"depth_scale": depth_scale},
        }
        result: dict[str, Any] = {}
        with self._looking, Child(self._worker, time_limit_s=_SURVEY_S) as child:
            child.send(order)
            for message in child.messages():
                result = message.get("result", result)
        return result

    def start(self, order: ImportOrder) -> BackgroundTask:
        """Begin an import; one that was stopped goes on where it was.

        Raises:
            UnknownCaptureError: If there is no such recording.
            UsageError: If the name is that of a sequence that came with the program, or of one that
                must not be replaced.
            RunError: If something is worked on already, or a fit reads what would be replaced.
        """
        source = self.folders.find(order.source)
        self._require_free(order.name, overwrite=order.overwrite)
        options = asdict(order) | self._options(order.intrinsics)
        for name in ("source", "name", "overwrite"):
            del options[name]
        work = Work("import", order.name, f"'{order.name}' is being imported.")
        return self._tasks.start(
            work,
            self._worker,
            {
                "work": "import",
                "source": str(source),
                "out": str(self._target / order.name),
                "options": options,
                "overwrite": order.overwrite,
            },
        )

    def job(self, name: str) -> BackgroundTask:
        """Tell how far the import of a sequence is."""
        return self._tasks.task("import", name)

    def cancel(self, name: str) -> None:
        """Stop an import; does nothing if it is not at work."""
        self._tasks.cancel("import", name)

    def make_example(self) -> BackgroundTask:
        """Begin to write the example into the folder of recordings.

        Raises:
            RunError: If something is worked on already.
        """
        work = Work("example", EXAMPLE, "The example is being made.")
        order = {"work": "example", "out": str(self.folders.own / EXAMPLE)}
        return self._tasks.start(work, self._worker, order)

    def example(self) -> BackgroundTask:
        """Tell how far the example is."""
        return self._tasks.task("example", EXAMPLE)

    def cancel_example(self) -> None:
        """Stop making the example; does nothing if it is not being made."""
        self._tasks.cancel("example", EXAMPLE)

    def _options(self, intrinsics: str) -> dict[str, Any]:
        return {"intrinsics": str(self.folders.find(intrinsics)) if intrinsics else None}

    def _require_free(self, name: str, *, overwrite: bool) -> None:
        try:
            item = self._catalog.sequence_item(name)
        except NotFoundError:
            return
        if item.is_bundled:
            raise UsageError(
                f"Sequence '{name}' came with the program, which yours would hide. Choose another "
                "name."
            )
        if not overwrite:
            raise UsageError(
                f"There is a sequence '{name}' already. Choose another name, or allow to replace "
                "it."
            )
        require_unread(self._catalog, item.folder)
