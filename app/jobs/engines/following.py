"""Starting a run on an engine, and following it to its end in the place of a server."""

import time
from contextlib import ExitStack, suppress
from pathlib import Path
from types import TracebackType

from app.jobs.engines.cluster import ClusterError
from app.jobs.engines.engine import Engine
from app.jobs.processes import following
from app.jobs.ticket import (
    QUEUED,
    STARTED,
    Ticket,
    is_lost,
    note_end,
    note_start,
    put_in_line,
    read_ticket,
    start_again_or_end,
)
from physhandi.child import error_of
from physhandi.data.files import write_bytes
from physhandi.data.lease import live_holder
from physhandi.data.run_folder import CANCEL, EXIT, PROGRESS, EventLine, ExitFile, read_record
from physhandi.errors import CancelledError, RunError, describe
from physhandi.progress import Progress

_INTERVAL_S = 0.2


def start_on(engine: Engine, run_folder: Path, device: str) -> None:
    """Start a run that is in line; whoever calls this is the only one who may (`following`).

    Raises:
        OSError: If it cannot be started now; it stays in line.
        RunError: If it cannot be started now; it stays in line.
    """
    ticket = note_start(run_folder, device, engine.name)
    (run_folder / EXIT).unlink(missing_ok=True)
    engine.start(run_folder, ticket)
    (run_folder / QUEUED).unlink(missing_ok=True)


class FollowedRun:
    """A run that this process has an engine compute; use it as a context manager.

    Servers leave it alone meanwhile. If this process is killed the run goes on, and whoever follows
    it next, a server or the same command, finds it at work.
    """

    def __init__(self, folder: Path, engine: Engine, *, patience_s: float = 15.0) -> None:
        """Take a run over; one that is neither at work nor lost is put in line.

        Args:
            folder: The run.
            engine: Where it is computed.
            patience_s: How long to wait for a server that starts or ends the run now [s].

        Raises:
            RunError: If another process follows the run, it was started on another engine, or a
                process that no engine has started works on it.
        """
        self.folder = folder
        self._engine = engine
        self._hindrance = ""
        self._claim = ExitStack()
        if not self._claim.enter_context(following(folder, patience_s)):
            raise RunError(f"Run '{folder.name}' is followed by another process. Wait for its end.")
        ticket = read_ticket(folder / STARTED)
        holder = live_holder(folder)
        if ticket is None and holder is not None:
            self._claim.close()
            raise RunError(
                f"Run '{folder.name}' is being written by process {holder['pid']} on "
                f"{holder['host']}. Wait for it or cancel it first."
            )
        if ticket is None or (folder / EXIT).is_file():
            (folder / CANCEL).unlink(missing_ok=True)
            put_in_line(folder, Ticket(time=time.time()))
        elif ticket.engine != engine.name:
            self._claim.close()
            where = ticket.engine or "this machine"
            raise RunError(f"Run '{folder.name}' was started on {where} and has not ended there.")

    def __enter__(self) -> "FollowedRun":
        return self

    def __exit__(
        self,
        _kind: type[BaseException] | None,
        _error: BaseException | None,
        _trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Leave the run to others; what works on it goes on."""
        self._claim.close()

    def look(self) -> bool:
        """Start the run if it is in line, or again if it is lost; tell whether it has ended."""
        if self.is_at_work():
            return False
        if (self.folder / QUEUED).is_file():
            self._start()
        elif is_lost(self.folder):
            start_again_or_end(self.folder, self._engine.loss(self.folder))
        else:
            return True
        return False

    def is_at_work(self) -> bool:
        """Tell whether anybody works on the run."""
        return self._engine.is_at_work(self.folder) or live_holder(self.folder) is not None

    def report(self) -> EventLine:
        """Give the latest report; while nobody works on the run, its stage says what it awaits."""
        if live_holder(self.folder) is not None:
            with suppress(RunError):  # A damaged report costs no more than the report.
                latest = read_record(self.folder / PROGRESS, EventLine)
                if latest is not None:
                    return latest
        ticket = read_ticket(self.folder / STARTED) or Ticket()
        engine = self._engine
        waits = self._hindrance or engine.trouble or engine.waits_for(self.folder)
        return {"stage": " ".join(part for part in (ticket.remark, waits) if part).rstrip(".")}

    def end(self) -> None:
        """End the run; returns when its engine has confirmed that nothing of it is left."""
        self.ask_to_end()
        self._engine.end(self.folder)
        note_end(self.folder, "Cancelled.")

    def ask_to_end(self) -> None:
        """Ask the run to end by itself, and void a start that still waits for a place."""
        write_bytes(self.folder / CANCEL, b"")
        (self.folder / QUEUED).unlink(missing_ok=True)

    def check_end(self) -> None:
        """Raise what kept a run that has ended from its success.

        Raises:
            CancelledError: If it was cancelled.
            PhysHandiError: If it failed.
        """
        end = read_record(self.folder / EXIT, ExitFile)
        if end is None or end["state"] == "cancelled":
            raise CancelledError(f"Run '{self.folder.name}' was cancelled.")
        if end["state"] == "failed":
            reason = end.get("error") or "It failed without a reason."
            raise error_of({"error": reason, "kind": end.get("error_type")})

    def _start(self) -> None:
        device = self._engine.choose(())
        if device is None:
            return  # The engine's trouble says why.
        try:
            start_on(self._engine, self.folder, device)
            self._hindrance = ""
        except (OSError, ClusterError) as error:
            self._hindrance = describe(error)


def follow_to_end(run: FollowedRun, engine: Engine, progress: Progress, grace_s: float) -> None:
    """Follow a run to its end.

    Args:
        run: The run.
        engine: Where it is computed.
        progress: Is told how far it is, and may ask to stop.
        grace_s: Time that a run has to end by itself when it is to stop [s].

    Raises:
        PhysHandiError: If it failed or was cancelled.
        KeyboardInterrupt: If the user asked to stop; nothing of the run is left then.
    """
    try:
        while not run.look():
            report = run.report()
            count, total = int(report.get("iteration", 0)), int(report.get("total", 0))
            loss, message = report.get("loss"), report.get("message", "")
            progress.report(report["stage"], count, total, loss, message)
            progress.check_cancelled()
            time.sleep(_INTERVAL_S)
            engine.refresh()
    except (CancelledError, KeyboardInterrupt):
        end_all([run], engine, progress, grace_s)
        raise
    run.check_end()


def end_all(runs: list[FollowedRun], engine: Engine, progress: Progress, grace_s: float) -> None:
    """End runs; returns when their engine has confirmed that nothing of them is left.

    Args:
        runs: The runs.
        engine: Where they are computed.
        progress: Is told what is waited for.
        grace_s: Time that they have to end by themselves [s].
    """
    what = f"{len(runs)} jobs" if len(runs) > 1 else "the job"
    progress.report(f"ends {what} on {engine.name}", 0, 0)
    for run in runs:
        run.ask_to_end()
    end = time.monotonic() + grace_s
    while time.monotonic() < end and any(run.is_at_work() for run in runs):
        time.sleep(_INTERVAL_S)
        engine.refresh()
    for run in runs:
        run.end()
    progress.report(f"{what} on {engine.name} ended, nothing is left", 0, 0)
