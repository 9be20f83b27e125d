"""Fits on this machine: processes that outlive the server and are found again by their locks."""

import os
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from app.jobs.engines.device_choice import DeviceChoice
from app.jobs.processes import (
    cookie_of,
    end_processes,
    marked_processes,
    processes_of,
    start_supervisor,
    supervisor_command,
    supervisor_of,
)
from app.jobs.ticket import Ticket, nonce_of
from app.settings import ServerSettings
from physhandi.data.lease import live_holder
from physhandi.devices import ONLY_CARD

_LOST = "It lost its process, which something outside ended."


class LocalEngine:
    """Runs fits on this machine; see `Engine`."""

    name = ""
    trouble = ""

    def __init__(self, settings: ServerSettings, choice: DeviceChoice, worker: str) -> None:
        """Prepare.

        Args:
            settings: How many fits run side by side, and when one hangs.
            choice: Chooses the devices of fits.
            worker: Module of the worker process.
        """
        self._settings = settings
        self._choice = choice
        self._worker = worker
        self.started: dict[str, subprocess.Popen[str]] = {}
        """Supervisors that this process has started, by run."""

    @property
    def slots(self) -> int:
        """See `Engine`."""
        return self._settings.slots

    @property
    def full(self) -> str:
        """See `Engine`."""
        at_a_time = "one fit runs" if self.slots == 1 else f"{self.slots} fits run"
        return f"Waits for a free place: {at_a_time} at a time."

    @property
    def shortage(self) -> str:
        """See `Engine`."""
        return self._choice.shortage

    def refresh(self) -> None:
        """Forget supervisors that have ended."""
        for run_id, process in list(self.started.items()):
            if process.poll() is not None:
                self.started.pop(run_id, None)

    def choose(self, busy: Sequence[str]) -> str | None:
        """See `Engine`."""
        return self._choice.choose(busy)

    def start(self, run_folder: Path, ticket: Ticket) -> None:
        """See `Engine`."""
        card = self._choice.card(ticket.device)
        command = supervisor_command(
            run_folder,
            ticket.device if card is None else ONLY_CARD,
            self._worker,
            self._settings.hung_after_s,
        )
        self.started[run_folder.name] = start_supervisor(
            command,
            cookie_of(run_folder, nonce_of(run_folder, ticket)),
            card=card,
            threads=None if self.slots == 1 else max(1, (os.cpu_count() or 1) // self.slots),
            store=self._settings.store,
        )

    def is_at_work(self, run_folder: Path) -> bool:
        """See `Engine`."""
        # One that was started a moment ago does not have its lock yet.
        started = self.started.get(run_folder.name)
        is_started = started is not None and started.poll() is None
        return is_started or supervisor_of(run_folder) is not None

    def waits_for(self, run_folder: Path) -> str:  # noqa: ARG002  # the same for all
        """See `Engine`."""
        return "Loading the program."

    def loss(self, run_folder: Path) -> str:  # noqa: ARG002  # nobody tells who killed it
        """See `Engine`."""
        return _LOST

    def end(self, run_folder: Path) -> None:
        """See `Engine`."""
        if any(True for _ in processes_of(run_folder)):
            end_processes(run_folder, grace_s=2.0, spare=supervisor_of(run_folder))
            # The supervisor notes the end.
            self._wait(lambda: supervisor_of(run_folder) is None, 5.0)
        end_processes(run_folder, grace_s=0.0)
        self._wait(lambda: live_holder(run_folder) is None, 5.0)

    def end_rest(self, run_folder: Path) -> None:
        """End at once what a supervisor that is gone has left of a run."""
        end_processes(run_folder, grace_s=0.0)

    def strays(self, run_dir: Path) -> Iterator[Path]:
        """List the folders of the runs of a folder that have processes, one for each process."""
        for _, cookie in list(marked_processes()):
            folder = Path(cookie.rpartition(":")[0])
            if folder.parent == run_dir:
                yield folder

    def _wait(self, is_over: Callable[[], bool], seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end and not is_over():
            time.sleep(0.05)
