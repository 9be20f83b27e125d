"""The machine, its queue and the program, as plain data."""

from collections.abc import Iterable, Iterator
from contextlib import suppress
from typing import Any

from app.jobs.catalog import Catalog, UnknownRunError
from app.jobs.machine import Machine
from app.jobs.scheduler import Scheduler
from app.jobs.views import describe_run
from app.settings import ServerSettings
from physhandi.data.environment import describe_environment
from physhandi.run import Run


class Overview:
    """Describes the machine, its queue and the program."""

    def __init__(
        self, settings: ServerSettings, catalog: Catalog, scheduler: Scheduler, machine: Machine
    ) -> None:
        """Prepare.

        Args:
            settings: Settings of the server.
            catalog: Finds runs and sequences.
            scheduler: Knows what is at work and in line.
            machine: Measures the load.
        """
        self._settings = settings
        self._catalog = catalog
        self._scheduler = scheduler
        self._machine = machine
        about = describe_environment(settings.live_device)
        self._program = {
            name: about[name] for name in ("packages", "python", "system", "commit", "started")
        }

    def whole(self) -> dict[str, Any]:
        """Describe everything: `moving`, and what stays.

        Returns:
            `moving` with ``program`` (``packages python system commit started``), ``device`` or
            cluster of fits and ``data_dir``.
        """
        return self.moving() | {
            "program": self._program,
            "device": self._scheduler.place,
            "data_dir": str(self._settings.data_dir),
        }

    def moving(self) -> dict[str, Any]:
        """Describe what changes all the time.

        Returns:
            ``machine`` (see `Machine.load`), ``slots`` (``used total``), and the runs ``running``
            and ``waiting`` (see `describe_run`), the running ones with ``load`` (see
            `Machine.of_run`).
        """
        running = [
            described | {"load": self._machine.of_run(run.folder)}
            for run, described in self._described(self._scheduler.at_work())
        ]
        waiting = [described for _, described in self._described(self._scheduler.in_line())]
        return {
            "machine": self._machine.load(),
            "slots": {"used": len(running), "total": self._scheduler.slots},
            "running": running,
            "waiting": waiting,
        }

    def _described(self, runs: Iterable[Run]) -> Iterator[tuple[Run, dict[str, Any]]]:
        """Describe runs, but for those that were deleted since the queue saw them last."""
        for run in runs:
            with suppress(UnknownRunError):
                yield run, describe_run(self._catalog.run_item(run.id), self._scheduler)
