"""Engines, on which the processes of fits run: this machine, or a cluster."""

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from app.jobs.ticket import Ticket


class Engine(Protocol):
    """Starts the supervisors of runs, knows which are at work, and ends them.

    What a run does is told by its folder, wherever it runs. An engine adds what a folder cannot
    tell: whether anybody still works on it. All but `refresh`, `start` and `end` answer at once.
    """

    @property
    def name(self) -> str:
        """Name by which a run's ticket tells who has started it; empty for this machine."""
        ...

    @property
    def slots(self) -> int:
        """Number of fits that it runs side by side."""
        ...

    @property
    def full(self) -> str:
        """Why a run waits while all places are taken, as a sentence."""
        ...

    @property
    def trouble(self) -> str:
        """Why nothing can be started or asked, as a sentence; empty if it can."""
        ...

    @property
    def shortage(self) -> str:
        """Why `choose` has found no device, as a sentence."""
        ...

    def refresh(self) -> None:
        """Find out how the runs are that were asked about; takes seconds where it must ask."""
        ...

    def choose(self, busy: Sequence[str]) -> str | None:
        """Choose the device of the next fit.

        Args:
            busy: Devices of its fits at work, one for each of them.

        Returns:
            A Warp device; None if no fit can be started now.
        """
        ...

    def start(self, run_folder: Path, ticket: Ticket) -> None:
        """Start the supervisor of a run; once, even if it is called again with the same ticket.

        Args:
            run_folder: The run.
            ticket: This start of it, as noted in its folder.

        Raises:
            OSError: If it cannot be started now.
            RunError: If it cannot be started now.
        """
        ...

    def is_at_work(self, run_folder: Path) -> bool:
        """Tell whether a run's supervisor lives; what cannot be found out counts as alive."""
        ...

    def waits_for(self, run_folder: Path) -> str:
        """Tell of a run whose supervisor lives, but not its worker, what it waits for."""
        ...

    def loss(self, run_folder: Path) -> str:
        """Tell how a run lost its supervisor, as a sentence."""
        ...

    def end(self, run_folder: Path) -> None:
        """End all processes of a run, and return when none is left; may take minutes."""
        ...
