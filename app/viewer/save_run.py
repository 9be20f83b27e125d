"""Keeping what sliders have found as a run of its own, which a worker simulates and measures."""

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from app.viewer.presets import changes_of
from physhandi.data.run import Run, new_run_id
from physhandi.data.sequence import Sequence
from physhandi.errors import UsageError
from physhandi.simulation.model import SimulationParameters

_POLL_S = 0.3
_MOST_LETTERS = 80


class RunCatalog(Protocol):
    """Finds runs, and the recordings behind them."""

    def run(self, run_id: str, /) -> Run:
        """Open a run."""
        ...

    def sequences_of(self, run: Run) -> list[Sequence]:
        """Open the sequences of a run; raises `SequenceError` if one is gone."""
        ...


@dataclass(frozen=True, kw_only=True)
class SavedRun:
    """How far a run is that was saved from a live scene."""

    id: str
    """Its id; its page is ``/runs/<id>``."""
    name: str
    """What the user calls it."""
    state: str
    """``"queued"`` or ``"running"``, in the end ``"succeeded"``, ``"failed"``, ``"cancelled"``."""
    error: str | None = None
    """Why it failed, if it did."""

    @property
    def is_over(self) -> bool:
        """Whether nothing more will happen to it."""
        return self.state in {"succeeded", "failed", "cancelled"}


class RunSaver:
    """Makes runs of kind ``simulation``, as `physhandi simulate` does, and has them worked on.

    A worker process simulates again and measures, so that a long object stalls nobody; the same
    parameters give the same motion.
    """

    def __init__(self, catalog: RunCatalog, folder: Path, start: Callable[[Run], None]) -> None:
        """Prepare.

        Args:
            catalog: Finds the run that was shown, and its recordings.
            folder: Where runs are made.
            start: Has a worker begin with a run at once.
        """
        self._catalog = catalog
        self._folder = folder
        self._start = start

    def save(self, source_id: str, sequence: str, name: str, changes: Mapping[str, Any]) -> Run:
        """Make a run and have it worked on.

        Args:
            source_id: Id of the run whose object was simulated.
            sequence: Which of its sequences.
            name: What the user calls the new run.
            changes: Parameters that differ from the source's; see `run_changes`.

        Raises:
            UsageError: If the name is empty or too long.
            SequenceError: If the recording is gone, without which nothing can be measured.
            OSError: If the run cannot be written.
        """
        name = " ".join(name.split())
        if not name or len(name) > _MOST_LETTERS:
            raise UsageError(f"Type a name of 1 to {_MOST_LETTERS} letters for the run first.")
        source = self._catalog.run(source_id)
        recordings = self._catalog.sequences_of(source)
        recording = recordings[source.sequence_names.index(sequence)]
        run = Run.create(
            self._folder / new_run_id(),
            name=name,
            kind="simulation",
            sequences=[str(recording.folder)],
            config={"source": str(source.folder.resolve()), "parameters": dict(changes)},
        )
        self._start(run)
        return run

    def follow(
        self, run: Run, tell: Callable[[SavedRun], None], is_over: threading.Event
    ) -> threading.Thread:
        """Tell how far a run is whenever that changes, until it ends or nobody listens.

        Args:
            run: A run that `save` made.
            tell: Is told, in a thread of its own.
            is_over: Set when nobody listens any more.
        """

        def watch() -> None:
            told: SavedRun | None = None
            while not is_over.is_set() and not (told is not None and told.is_over):
                now = SavedRun(id=run.id, name=run.name, state=run.state, error=run.error)
                if now != told:
                    tell(now)
                    told = now
                time.sleep(_POLL_S)

        thread = threading.Thread(target=watch, name=f"saving-{run.id}", daemon=True)
        thread.start()
        return thread


def run_changes(
    source: Run, fitted: SimulationParameters, now: SimulationParameters, *, is_automatic: bool
) -> dict[str, Any]:
    """Find what `physhandi simulate` must be told so that it simulates what is on the screen.

    Args:
        source: The run that is shown; its stored parameters are the ones that are changed.
        fitted: What the scene began with: those parameters in the world of its recording.
        now: What is on the screen.
        is_automatic: Whether its substeps are chosen automatically.
    """
    changes = changes_of(fitted, now, is_automatic=is_automatic)
    stored = SimulationParameters.from_dict(source.yaml("object/parameters.yaml"))
    # A ground or gravity other than the recording's must not be taken from it again.
    for field, switch in (
        ("ground_height", "uses_sequence_ground"),
        ("gravity", "uses_sequence_gravity"),
    ):
        if field in changes and getattr(stored, switch):
            changes[switch] = False
    return changes
