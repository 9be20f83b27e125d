"""Masks and tracks that are found for recordings while the server runs, one recording at a time."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from app.jobs.catalog import Catalog, NotFoundError, SequenceItem
from app.jobs.recordings.background import BackgroundTask, BackgroundTasks, Work
from app.jobs.recordings.models import ModelEntry, ModelFolders
from app.jobs.scheduler import require_unread
from physhandi.errors import UsageError

_WORKER = "app.jobs.recordings.annotator"


@dataclass(frozen=True)
class ClickedPlace:
    """A place on the object that somebody clicked on, or a box around it."""

    view: str
    """View."""
    frame: int
    """Frame."""
    x: float
    """Column, of a box that of its middle [px]."""
    y: float
    """Row, of a box that of its middle [px]."""
    width: float = 0.0
    """Width of the box; 0 if only the place is known [px]."""
    height: float = 0.0
    """Height of the box; 0 if only the place is known [px]."""


@dataclass(frozen=True, kw_only=True)
class ChosenModels:
    """Networks of the user that take the place of what is built in."""

    masks: str = ""
    """Name of what finds masks; empty for what is built in."""
    tracks: str = ""
    """Name of what finds tracks; empty for what is built in."""
    trusts_code: bool = False
    """Whether the user agreed that the code of what finds tracks is executed."""


@dataclass(frozen=True)
class PaintedMask:
    """A mask that somebody painted."""

    view: str
    """View."""
    frame: int
    """Frame."""
    runs: tuple[int, ...]
    """Labels row by row, each with the number of pixels that have it: ``label, count, …``."""


_NONE = ChosenModels()


class Annotations:
    """Has masks and tracks found for recordings of the data folder."""

    def __init__(
        self,
        catalog: Catalog,
        tasks: BackgroundTasks,
        models: ModelFolders,
        *,
        worker: str = _WORKER,
    ) -> None:
        """Prepare.

        Args:
            catalog: Finds sequences and the runs that read them.
            tasks: Has the work done, one piece at a time.
            models: Finds networks of the user.
            worker: Module of the process.
        """
        self._catalog = catalog
        self._models = models
        self.tasks = tasks
        """Has the work done."""
        self._worker = worker

    def start(
        self,
        sequence_id: str,
        clicks: Sequence[ClickedPlace],
        *,
        overwrite: bool,
        chosen: ChosenModels = _NONE,
    ) -> BackgroundTask:
        """Begin to find masks and tracks of a recording.

        Args:
            sequence_id: The recording.
            clicks: Places on its object; none finds hands alone.
            overwrite: Whether masks and tracks may be replaced that came from elsewhere.
            chosen: Networks of the user; none takes what is built in.

        Raises:
            SequenceError: If there is no such recording, or it is damaged.
            UsageError: If it came with the program, there is no such network, or the user did not
                agree that code is executed.
            RunError: If something is worked on already, or a fit reads this one.
        """
        self._require_own(sequence_id)
        sequence = self._catalog.sequence(sequence_id)
        require_unread(self._catalog, sequence.folder)
        order = {
            "folder": str(sequence.folder),
            "clicks": [asdict(click) for click in clicks],
            "overwrite": overwrite,
            "models": self._folders(chosen),
        }
        work = Work(
            "annotation", sequence_id, f"Masks and tracks of '{sequence_id}' are being found."
        )
        return self.tasks.start(work, self._worker, order)

    def models(self) -> list[ModelEntry]:
        """List the networks that can be chosen."""
        return self._models.list()

    def correct(
        self, sequence_id: str, masks: Sequence[PaintedMask], *, carries_on: bool
    ) -> BackgroundTask:
        """Begin to replace masks of single frames, and to follow the object's points anew.

        Args:
            sequence_id: The recording.
            masks: The right masks.
            carries_on: Whether other frames are found anew from these.

        Raises:
            SequenceError: If there is no such recording, or it is damaged.
            UsageError: If it came with the program, or a mask does not fit its view.
            RunError: If something is worked on already, or a fit reads this one.
        """
        self._require_own(sequence_id)
        sequence = self._catalog.sequence(sequence_id)
        widths = {view.name: view.camera.width for view in sequence.views}
        sizes = {view.name: view.camera.width * view.camera.height for view in sequence.views}
        for mask in masks:
            is_known = mask.view in sizes and 0 <= mask.frame < sequence.frame_count
            if not is_known or sum(mask.runs[1::2]) != sizes[mask.view] or len(mask.runs) % 2:
                raise UsageError(
                    f"The mask of view '{mask.view}', frame {mask.frame}, does not fit recording "
                    f"'{sequence_id}', which may have changed. Load the page again."
                )
        require_unread(self._catalog, sequence.folder)
        order = {
            "folder": str(sequence.folder),
            "masks": [asdict(mask) | {"width": widths[mask.view]} for mask in masks],
            "carries_on": carries_on,
        }
        work = Work("annotation", sequence_id, f"Masks of '{sequence_id}' are being corrected.")
        return self.tasks.start(work, self._worker, order)

    def painted(self, sequence_id: str, view_name: str, frame: int) -> PaintedMask:
        """Give a stored mask for painting.

        Raises:
            SequenceError: If there is no such recording, or it is damaged.
            NotFoundError: If it has no such view or frame, or no masks in it.
        """
        sequence = self._catalog.sequence(sequence_id)
        view = next((view for view in sequence.views if view.name == view_name), None)
        if view is None or not view.has_mask or not 0 <= frame < view.frame_count:
            raise NotFoundError(f"View '{view_name}' has no mask of frame {frame}.")
        label = view.mask(frame).reshape(-1)
        start = np.concatenate([[0], np.flatnonzero(np.diff(label)) + 1])
        count = np.diff(np.append(start, label.size))
        runs = np.stack([label[start], count], axis=1).reshape(-1)
        return PaintedMask(view_name, frame, tuple(runs.tolist()))

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

    def _folders(self, chosen: ChosenModels) -> dict[str, str | bool | None]:
        """Find the networks that were chosen, as `annotate` is told them."""
        folders = {
            "mask_model": str(self._models.find(chosen.masks, "masks")) if chosen.masks else None,
            "track_model": str(self._models.find(chosen.tracks, "tracks"))
            if chosen.tracks
            else None,
        }
        if chosen.tracks and not chosen.trusts_code:
            raise UsageError(
                f"'{chosen.tracks}' is Python code of others, which can do what this server can "
                "do. Look at its folder; if you trust it, say so, and it is executed in a process "
                "of its own."
            )
        return {**folders, "trusts_model_code": chosen.trusts_code}

    def _require_own(self, sequence_id: str) -> SequenceItem:
        item = self._catalog.sequence_item(sequence_id)
        if item.is_bundled:
            raise UsageError(
                f"Sequence '{sequence_id}' came with the program and stays as it is. Copy its "
                "folder into the data folder to change it."
            )
        return item
