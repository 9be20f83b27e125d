"""The queue of fits: one thread starts them, watches them and ends cancelled ones."""

import fcntl
import logging
import os
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from app.jobs.catalog import DEFECT, Catalog, RunItem, UnknownRunError
from app.jobs.engines.cluster import ClusterError
from app.jobs.engines.device_choice import DeviceChoice
from app.jobs.engines.engine import Engine
from app.jobs.engines.following import start_on
from app.jobs.engines.local_engine import LocalEngine
from app.jobs.engines.ray_engine import RayEngine
from app.jobs.eta import Forecast
from app.jobs.launch_keys import KeyedRequest, LaunchKeys
from app.jobs.machine import Cards
from app.jobs.order import default_name, fit_config, require_agreement
from app.jobs.processes import WORKER, following, process_with_lock
from app.jobs.recovery.aside import MovedFolder, move_aside
from app.jobs.storage.room import Room
from app.jobs.ticket import (
    QUEUED,
    STARTED,
    Priority,
    Ticket,
    change_priority,
    is_begun,
    is_lost,
    note_end,
    put_in_line,
    read_ticket,
    start_again_or_end,
)
from app.settings import LOCAL, ServerSettings
from physhandi.data.lease import live_holder
from physhandi.data.run import not_whole
from physhandi.data.run_folder import CANCEL, EXIT, new_run_id, now
from physhandi.errors import PhysHandiError, RunError, UsageError, describe
from physhandi.run import Run

_LOCK = ".server.lock"


def claim_folder(data_dir: Path) -> int:
    """Become the one server of a data folder until the returned descriptor is closed.

    Raises:
        RunError: If another server works on it.
    """
    data_dir.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(data_dir / _LOCK, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = os.read(descriptor, 32).decode(errors="replace") or "unknown"
        os.close(descriptor)
        raise RunError(
            f"Another server (process {holder}) works on {data_dir}. "
            "Stop it, or choose another --data-dir."
        ) from None
    os.ftruncate(descriptor, 0)
    os.write(descriptor, str(os.getpid()).encode())
    return descriptor


def server_of(data_dir: Path) -> int | None:
    """Give the process id of the server that works on a data folder; None if there is none."""
    return process_with_lock(data_dir / _LOCK)


logger = logging.getLogger(__name__)

AT_WORK = frozenset({"starting", "running", "stopping"})
ENDED = frozenset({"succeeded", "failed", "cancelled", "damaged"})
_INTERVAL_S = 0.25
_IDLE_INTERVAL_S = 1.0
_SWEEP_INTERVAL_S = 5.0
_SURVEY_INTERVAL_S = 5.0
"""Time between two looks at all runs, of which most have ended and do not move [s]."""
_SURVEY_SHARE = 0.02
"""Most of the time that these looks may take."""
_KEPT_RESTARTS = 100


class QueueFullError(PhysHandiError):
    """No further fit can be put in line."""


@dataclass(frozen=True)
class JobView:
    """State and progress of a run, for people."""

    state: str
    """queued, starting, running, stopping, succeeded, failed, cancelled or damaged."""
    place: int | None = None
    """Place in the queue, counted from 1."""
    reason: str = ""
    """Why it waits or how it ended."""
    progress: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """The latest report of the worker."""
    is_published: bool = False
    """Whether there are results to look at."""
    priority: Priority | None = None
    """Priority of a run that waits."""


@dataclass(frozen=True)
class LostRun:
    """A run that had lost its process, and what was done with it."""

    time: str
    """Time, ISO 8601."""
    run: str
    """Id of the run."""
    why: str
    """The loss, and its consequence for the run."""


class Scheduler:
    """Starts queued runs while slots are free; folders hold all state that must not be lost."""

    def __init__(
        self,
        settings: ServerSettings,
        catalog: Catalog,
        *,
        choice: DeviceChoice | None = None,
        worker: str = WORKER,
    ) -> None:
        """Prepare; `start` begins.

        Args:
            settings: Engine, slots, devices and grace of a cancel.
            catalog: Finds runs.
            choice: Chooses the devices of fits here; none chooses among those of the settings.
            worker: Module of the worker process.
        """
        self._settings = settings
        self._catalog = catalog
        self._local = LocalEngine(settings, choice or DeviceChoice(settings, Cards()), worker)
        self._engine: Engine = self._local
        if settings.engine != LOCAL:
            self._engine = RayEngine.of(settings, worker)
        self._is_short = False
        self.room = Room(settings)
        """Tells whether the data folder has room for anything new."""
        self.forecast = Forecast(catalog, settings.devices[0])
        """Estimates how long fits still take."""
        self._lock = threading.RLock()
        self._keys = LaunchKeys(settings.launches_path)
        self._stopping: dict[str, threading.Thread] = {}
        self._ended: dict[str, tuple[int, JobView]] = {}
        self._hindered: dict[str, str] = {}
        self._put_off: frozenset[str] = frozenset()
        self._restarts: deque[LostRun] = deque(maxlen=_KEPT_RESTARTS)
        self._line: dict[str, Ticket] = {}
        """Tickets of the runs that wait, the next one first; replaced, never changed."""
        self._next_survey = 0.0
        self._busy: tuple[str, ...] = ()
        self._moving: dict[str, Run] = {}
        self._claim: int | None = None
        self._closed = threading.Event()
        self._wake = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="scheduler", daemon=True)

    def start(self) -> None:
        """Begin to work through the queue; a second call changes nothing.

        Raises:
            RunError: If another server works on the same data folder.
        """
        if self._claim is None:
            self._claim = claim_folder(self._settings.data_dir)
            self._settings.run_dir.mkdir(exist_ok=True)
            self._settings.sequence_dir.mkdir(exist_ok=True)
            self._engine.refresh()
            self._step()
            for run in self.at_work():
                if (run.folder / CANCEL).exists():  # The server before did not come to its end.
                    self._begin_end(run)
            self._thread.start()

    @property
    def is_working(self) -> bool:
        """Whether queued runs are started."""
        return self._thread.is_alive() and not self._closed.is_set()

    def shutdown(self) -> None:
        """Stop watching; running fits go on and are found again by the next server."""
        self._closed.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(timeout=5)
        if self._claim is not None:
            os.close(self._claim)
            self._claim = None

    def launch(
        self,
        sequence_ids: list[str],
        profile: str,
        name: str = "",
        *,
        overrides: Mapping[str, Any] | None = None,
        parent: str | None = None,
        accepts_missing: bool = False,
        request: KeyedRequest | None = None,
        priority: Priority = "normal",
        who: str = "",
    ) -> Run:
        """Make a run of one or several sequences and queue it.

        Args:
            sequence_ids: What to fit.
            profile: Name of the settings.
            name: What the user calls it; empty for a name of the program's.
            overrides: Settings that differ from the profile, by their paths.
            parent: Id of the run that it was made from.
            accepts_missing: Whether the object may be left out although depth was recorded.
            request: The request that asks for it, if it may come again; then it is made once.
            priority: How urgent it is; see `Ticket.turn`.
            who: Who asks for it, as `Visitor.name`; empty if that is not known.

        Raises:
            UsageError: If there is no sequence or no such profile.
            SettingsError: If settings are unknown or wrong.
            UnknownRunError: If there is no such parent.
            SequenceError: If a sequence is unknown or damaged.
            MissingInputError: If there is nothing to fit, or the object would be left out.
            QueueFullError: If too many runs wait already, of all or of whoever asks.
            NoRoomError: If the data folder or its disk is too full.
        """
        if not sequence_ids:
            raise UsageError("Name at least one sequence to fit.")
        if parent is not None:
            self._catalog.run_item(parent)
        config = fit_config(profile, overrides, parent)
        sequences = [self._catalog.sequence(sequence_id) for sequence_id in sequence_ids]
        require_agreement(sequences, accepts_missing=accepts_missing)
        with self._lock:
            run_id = None
            if request is not None:
                if (launched := self.launched_by(request, priority, who)) is not None:
                    return launched
                run_id = self._keys.run_of(request)
            self._require_place(who)
            run_id = run_id or new_run_id()
            if request is not None:
                # Before the run: who is killed now makes the same run when it is asked again.
                self._keys.note(request, run_id)
            run = Run.create(
                self._settings.run_dir / run_id,
                name=name.strip() or default_name(sequences[0].name, config),
                kind="reconstruction",
                sequences=[str(sequence.folder) for sequence in sequences],
                config=config,
            )
            self._enqueue(run, priority, who)
        return run

    def launched_by(
        self, request: KeyedRequest, priority: Priority = "normal", who: str = ""
    ) -> Run | None:
        """Give the run that a request has launched already; None if it has not.

        Args:
            request: The request.
            priority: As in `launch`, for a run that was made and not put in line.
            who: Alike.

        Raises:
            UsageError: If another request had its key.
            RunError: If its run was deleted since.
        """
        with self._lock:
            run_id = self._keys.run_of(request)
            if run_id is None or not (self._settings.run_dir / run_id).is_dir():
                return None
            run = self._catalog.run(run_id)
            marks = (QUEUED, STARTED, EXIT)
            if run.attempt is None and not any((run.folder / mark).is_file() for mark in marks):
                self._enqueue(run, priority, who)  # The server was killed before it did so.
            return run

    def start_now(self, make: Callable[[], Run]) -> Run:
        """Make a run and start it beside the line, for what takes seconds while somebody waits."""
        with self._lock:
            run = make()
            # It takes seconds, so it may be where memory is short.
            device = self._local.choose(self._devices_of(self._local)) or self._settings.devices[0]
            self._start(run.folder, self._local, device)
        return run

    def resume(
        self,
        run_id: str,
        *,
        afresh: bool = False,
        request: KeyedRequest | None = None,
        priority: Priority = "normal",
        who: str = "",
    ) -> bool:
        """Queue a run that did not succeed again, with the same settings.

        Whoever asks twice gets one start: a run that waits or is at work already stays as it is.

        Args:
            run_id: The run.
            afresh: Whether it begins anew; else it goes on where it was.
            request: The request that asks for it, if it may come again, however late.
            priority: How urgent it is; see `Ticket.turn`.
            who: Who asks for it, as `Visitor.name`; empty if that is not known.

        Returns:
            Whether the same request was answered before.

        Raises:
            UsageError: If another request had its key.
            RunError: If the run is unknown, bundled, finished or being ended.
            QueueFullError: If too many runs wait already, of all or of whoever asks.
            NoRoomError: If the data folder or its disk is too full.
        """
        with self._lock:
            run, view = self._own(run_id)
            if request is not None and self._keys.run_of(request) is not None:
                return True
            if view.state in {"succeeded", "stopping"}:
                raise RunError(
                    f"Run '{run_id}' is {view.state}; only a failed or cancelled run is resumed."
                )
            if view.state in {"failed", "cancelled", "damaged"}:
                self._require_place(who)
                if afresh:
                    run.start_over()
                run.clear_cancel()
                self._enqueue(run, priority, who)
            if request is not None:
                self._keys.note(request, run_id)
            return False

    def set_priority(self, run_id: str, priority: Priority) -> None:
        """Change how urgent a run is that waits; see `Ticket.turn`.

        Raises:
            RunError: If the run is unknown, bundled or does not wait.
        """
        with self._lock:
            run, view = self._own(run_id)
            changed = change_priority(run.folder, priority) if view.state == "queued" else None
            if changed is None:
                raise RunError(
                    f"Run '{run_id}' does not wait (any more); only the priority of a run in line "
                    "can be changed."
                )
            self._line = _in_order({**self._line, run_id: changed})
            self._wake.set()

    def cancel(self, run_id: str) -> None:
        """Take a run out of the queue, or end its process and all that it started.

        Raises:
            RunError: If the run is unknown or not at work.
        """
        with self._lock:
            run, view = self._own(run_id)
            if view.state == "queued":
                run.request_cancel()
                (run.folder / QUEUED).unlink(missing_ok=True)
                note_end(run.folder, "Cancelled.")
                self._leave_line(run_id)
            elif view.state not in AT_WORK:
                raise RunError(f"Run '{run_id}' is {view.state}; there is nothing to cancel.")
            elif run_id not in self._stopping:
                if self._engine_of(run.folder) is None:
                    raise RunError(f"Run '{run_id}' cannot be ended here. {_elsewhere(run.folder)}")
                run.request_cancel()
                self._begin_end(run)

    def delete(self, run_id: str) -> None:
        """Remove a run that is not at work.

        Raises:
            RunError: If the run is unknown, bundled or at work.
        """
        with self._lock:
            run, view = self._own(run_id)
            if view.state not in ENDED:
                raise RunError(
                    f"Run '{run_id}' is {view.state}. Cancel it and wait until it has stopped "
                    "before you delete it."
                )
            run.delete()
            self._keys.note_deleted(run_id)

    def has_ended(self, item: RunItem) -> bool:
        """Tell whether a run has ended, and can be read."""
        return self.view(item).state in ENDED - {"damaged"}

    def do_if_ended(self, run_id: str, do: Callable[[Run], None]) -> bool:
        """Do something with a run that has ended, while nobody starts it again.

        Returns:
            Whether it was done; False if the run is gone, damaged or not at its end.
        """
        with self._lock:
            try:
                item = self._catalog.run_item(run_id)
            except UnknownRunError:
                return False
            if item.run is None or item.is_bundled or not self.has_ended(item):
                return False
            with following(item.folder) as is_mine:
                if is_mine:
                    do(item.run)
            return is_mine

    def set_aside(self, run_id: str) -> MovedFolder:
        """Move the folder of a damaged run out of the way.

        Raises:
            RunError: If the run is unknown, bundled, of a suite, at work, or not damaged.
        """
        with self._lock:
            item = self._catalog.run_item(run_id)
            if item.folder.parent != self._settings.run_dir:
                whose = "came with the program" if item.is_bundled else "belongs to a suite"
                raise RunError(f"Run '{run_id}' {whose} and stays as it is.")
            view = self.view(item)
            if view.state != "damaged":
                raise RunError(
                    f"Run '{run_id}' is {view.state}; only a damaged one is moved aside."
                )
            is_watched = self._is_supervised(item.folder) or run_id in self._stopping
            if is_watched or live_holder(item.folder) is not None:
                raise RunError(
                    f"Run '{run_id}' is damaged, but processes work on it. Wait until they have "
                    "ended before you move it aside."
                )
            self._hindered.pop(run_id, None)
            return move_aside(item.folder, "runs", self._settings.damaged_dir, view.reason)

    @property
    def slots(self) -> int:
        """Number of fits that run side by side."""
        return self._engine.slots

    @property
    def place(self) -> str:
        """Name of the place where fits run: devices of this machine, or a cluster."""
        return self._engine.name or ", ".join(self._settings.devices)

    @property
    def restarts(self) -> list[LostRun]:
        """The runs that had lost their process, as far as this server saw it; the latest last."""
        return list(self._restarts)

    def at_work(self) -> list[Run]:
        """List the runs that have a place, as the queue saw them last."""
        return [self._moving[run_id] for run_id in self._busy if run_id in self._moving]

    def in_line(self) -> list[Run]:
        """List the runs that wait, the next one first."""
        return [self._moving[run_id] for run_id in self._line if run_id in self._moving]

    def view(self, item: RunItem) -> JobView:
        """Tell how far a run is and why it waits."""
        if item.run is None:
            return JobView("damaged", reason=str(item.error))
        try:
            stamp = item.folder.stat().st_mtime_ns
            entry = self._ended.get(item.id)
            if entry is not None and entry[0] == stamp:
                return entry[1]
            view = self._look(item.run)
            if view.state == "failed" and item.run.state == "queued":
                with self._lock:  # Under it runs are made; this one may just have been.
                    view = self._look(self._catalog.run(item.id))
        except (PhysHandiError, OSError) as error:
            return JobView("damaged", reason=describe(error))
        except Exception as error:  # One folder must never stop the queue.
            logger.exception("run %s cannot be looked at", item.id)
            return JobView("damaged", reason=f"It cannot be looked at: {DEFECT} ({error!r}).")
        # Every change of state makes or removes a file of the folder, which changes its time.
        if view.state in ENDED - {"damaged"} and time.time_ns() - stamp > 2e9:
            self._ended[item.id] = (stamp, view)
        return view

    def _look(self, run: Run) -> JobView:
        is_running = live_holder(run.folder) is not None
        if run.id in self._stopping:
            # Until nothing is left: what is started meanwhile would be ended with the rest.
            progress, _ = _progress_of(run)
            trouble = self._trouble_of(run.folder)
            return JobView(
                "stopping", reason=_sentences("Ending its processes.", trouble), progress=progress
            )
        if is_running:
            progress, problem = _progress_of(run)
            reason = _sentences(_remark(run.folder) or problem, self._trouble_of(run.folder))
            return JobView("running", reason=reason, progress=progress)
        if (run.folder / QUEUED).is_file():
            return self._look_in_line(run)
        if not (run.folder / EXIT).is_file() and self._is_supervised(run.folder):
            engine = self._engine_of(run.folder)
            waits = _elsewhere(run.folder) if engine is None else engine.waits_for(run.folder)
            return JobView("starting", reason=_sentences(_remark(run.folder), waits))
        return self._look_back(run)

    def _engine_of(self, folder: Path) -> Engine | None:
        """Give the engine that a run was started with; None if this server does not use it."""
        ticket = read_ticket(folder / STARTED)
        if ticket is None or ticket.engine == self._engine.name:
            return self._engine
        return self._local if ticket.engine == self._local.name else None

    def _is_supervised(self, folder: Path) -> bool:
        """Tell whether a run's supervisor lives; what cannot be found out counts as alive."""
        engine = self._engine_of(folder)
        return engine is None or engine.is_at_work(folder)

    def _trouble_of(self, folder: Path) -> str:
        engine = self._engine_of(folder)
        return "" if engine is None else engine.trouble

    def _look_back(self, run: Run) -> JobView:
        """Tell how a run ended that is neither in line nor at work."""
        if is_lost(run.folder):
            hindrance = self._hindered.get(run.id, "What is left of it is being ended.")
            return JobView("stopping", reason=f"{self._loss(run.folder)} {hindrance}")
        state = run.state
        if state == "queued":
            return JobView("failed", reason="It was never started. Resume starts it.")
        if state == "succeeded" and not run.is_published:
            return JobView("damaged", reason=not_whole(run.id))
        progress, problem = _progress_of(run)
        reason = run.error or problem
        return JobView(state, reason=reason, progress=progress, is_published=run.is_published)

    def _look_in_line(self, run: Run) -> JobView:
        line = self._line
        ticket = line.get(run.id)
        if ticket is None:
            ticket = read_ticket(run.folder / QUEUED) or Ticket()
            return JobView("queued", reason="It was just put in line.", priority=ticket.priority)
        place = list(line).index(run.id) + 1
        reason = self._why_it_waits(run, place)
        return JobView("queued", place, reason, priority=ticket.priority)

    def _why_it_waits(self, run: Run, place: int) -> str:
        engine = self._engine
        if engine.trouble:
            return engine.trouble
        if run.id in self._hindered:
            return f"It cannot be started: {self._hindered[run.id]}"
        if len(self._busy) >= engine.slots:
            return engine.full
        if run.id in self._put_off:
            most = self._settings.running_fits_each
            return (
                f"Waits until fewer fits of the same client run: {most} at a time "
                "(PHYSHANDI_RUNNING_FITS_EACH)."
            )
        if self._is_short:
            return engine.shortage
        return "It starts next." if place == 1 else engine.full

    def _own(self, run_id: str) -> tuple[Run, JobView]:
        item = self._catalog.run_item(run_id)
        if item.is_bundled:
            raise RunError(f"Run '{run_id}' came with the program and stays as it is.")
        return self._catalog.run(run_id), self.view(item)

    def _leave_line(self, run_id: str) -> None:
        self._line = {k: ticket for k, ticket in self._line.items() if k != run_id}

    def _require_place(self, who: str) -> None:
        """Refuse a further run in line where there is no place or no room for it."""
        self.room.require("A fit")
        most, each = self._settings.waiting_fits, self._settings.waiting_fits_each
        if len(self._line) >= most:
            raise QueueFullError(
                f"{len(self._line)} fits wait already, of at most {most} "
                "(PHYSHANDI_WAITING_FITS). Cancel some of them first."
            )
        own = sum(ticket.who == who for ticket in self._line.values())
        if each is not None and who and own >= each:
            raise QueueFullError(
                f"{own} fits of yours wait already, of at most {each} of one client "
                "(PHYSHANDI_WAITING_FITS_EACH). Wait until one has started, or cancel some."
            )

    def _enqueue(self, run: Run, priority: Priority, who: str) -> None:
        ticket = Ticket(time=time.time(), priority=priority, who=who)
        put_in_line(run.folder, ticket)
        self._line = _in_order({**self._line, run.id: ticket})
        self._wake.set()

    def _watch(self) -> None:
        swept = time.monotonic()
        while True:
            is_idle = not (self._busy or self._line)
            self._wake.wait(_IDLE_INTERVAL_S if is_idle else _INTERVAL_S)
            self._wake.clear()
            if self._closed.is_set():
                return
            try:
                self._local.refresh()
                self._engine.refresh()
                self._step()
                if time.monotonic() - swept > _SWEEP_INTERVAL_S:
                    swept = time.monotonic()
                    self._sweep()
            except Exception:
                logger.exception("the queue could not go on; it tries again")

    def _look_around(self) -> dict[str, RunItem]:
        """See which runs wait and which are at work; gives what was looked at, by their ids."""
        begin = time.monotonic()
        is_survey = begin >= self._next_survey
        listed = self._catalog.runs() if is_survey else self._moving_runs()
        items = {item.id: item for item in listed if not item.is_bundled}
        tickets = {
            item.id: ticket
            for item in items.values()
            if item.run and (ticket := read_ticket(item.folder / QUEUED)) is not None
        }
        views = {item.id: self.view(item) for item in items.values()}
        if is_survey:
            took = time.monotonic() - begin
            self._next_survey = begin + max(_SURVEY_INTERVAL_S, took / _SURVEY_SHARE)
        busy = {run_id for run_id, view in views.items() if view.state in AT_WORK}
        # One may have left the line, or come into it, since its ticket was read.
        moving = {run_id for run_id, view in views.items() if view.state not in ENDED} | {*tickets}
        runs = {i.id: i.run for i in items.values() if i.run and i.id in moving}
        newest = sorted(runs.values(), key=lambda run: run.created, reverse=True)
        self._busy = tuple(run.id for run in newest if run.id in busy)
        self._moving = runs
        self._line = _in_order(tickets)
        return items

    def _step(self) -> None:
        """Start as many runs as have room."""
        with self._lock:
            items = self._look_around()
            self._is_short = False
            at_work = self._tickets_at_work(self._engine)
            free = self._engine.slots - len(at_work)
            fits_of = Counter(ticket.who for ticket in at_work)
            put_off: set[str] = set()
            for run_id, ticket in self._line.items():
                if free <= 0:
                    break
                folder = items[run_id].folder
                if self._has_its_share(ticket.who, fits_of):
                    put_off.add(run_id)
                    continue
                # A supervisor that put its run back in line has still to end.
                if not is_begun(folder) and self._is_supervised(folder):
                    continue
                device = self._engine.choose(self._devices_of(self._engine))
                if device is None:
                    self._is_short = True
                    break
                free -= 1
                with self._hindering(run_id), following(folder) as is_mine:
                    # A command that follows it starts it itself.
                    if is_mine and (folder / QUEUED).is_file():
                        self._start(folder, self._engine, device)
                        fits_of[ticket.who] += 1
            self._put_off = frozenset(put_off)

    def _moving_runs(self) -> Iterator[RunItem]:
        """List the runs that wait or are at work, as they were seen last.

        What has ended moves again only if somebody resumes it, and then it was put in line here.
        What another program puts into the folder is found when all runs are looked at.
        """
        for run_id in dict.fromkeys((*self._moving, *self._busy, *self._line)):
            with suppress(UnknownRunError):  # It was deleted since.
                yield self._catalog.run_item(run_id)

    def _has_its_share(self, who: str, fits_of: Counter[str]) -> bool:
        """Tell whether a client has as many fits at work as one may have."""
        most = self._settings.running_fits_each
        return most is not None and who != "" and fits_of[who] >= most

    @contextmanager
    def _hindering(self, run_id: str) -> Generator[None]:
        """Remember what the disk keeps from being done with a run; it is tried again later."""
        try:
            yield
            self._hindered.pop(run_id, None)
        except (OSError, ClusterError) as error:
            if run_id not in self._hindered:
                logger.warning("run %s cannot go on: %s", run_id, describe(error))
            self._hindered[run_id] = describe(error)

    def _tickets_at_work(self, engine: Engine) -> list[Ticket]:
        """Read the tickets of the runs that have a place with an engine."""
        tickets = (read_ticket(self._settings.run_dir / run_id / STARTED) for run_id in self._busy)
        return [t for t in tickets if t is not None and t.engine == engine.name]

    def _devices_of(self, engine: Engine) -> list[str]:
        return [ticket.device for ticket in self._tickets_at_work(engine)]

    def _start(self, folder: Path, engine: Engine, device: str) -> None:
        start_on(engine, folder, device)
        self._busy = (*self._busy, folder.name)
        self._leave_line(folder.name)
        logger.info("run %s started on %s", folder.name, engine.name or device)

    def _sweep(self) -> None:
        """End what is left of runs whose supervisor was killed."""
        for folder in self._local.strays(self._settings.run_dir):
            with self._lock:  # A run that is being started has a process before it is noted.
                is_left = not self._is_supervised(folder)
            if is_left:
                logger.warning("a process of run %s lost its supervisor", folder.name)
                self._local.end_rest(folder)
        for folder in self._lost_runs():
            with self._hindering(folder.name), following(folder) as is_mine:
                if is_mine and self._is_lost(folder):
                    self._start_again(folder)

    def _start_again(self, folder: Path) -> None:
        logger.warning("run %s lost its process", folder.name)
        loss = self._loss(folder)
        if self._engine_of(folder) is self._local:
            self._local.end_rest(folder)
        start_again_or_end(folder, loss)
        is_again = (folder / QUEUED).is_file()
        did = "It was put back in line." if is_again else "It has failed."
        self._restarts.append(LostRun(now(), folder.name, f"{loss} {did}"))
        self._wake.set()

    def _loss(self, folder: Path) -> str:
        return (self._engine_of(folder) or self._local).loss(folder)

    def _lost_runs(self) -> list[Path]:
        """Find the runs that were started, have not ended and are worked on by nobody."""
        with self._lock:
            folders = [run.folder for run in self.at_work()]
            return [folder for folder in folders if self._is_lost(folder)]

    def _is_lost(self, folder: Path) -> bool:
        return (
            folder.name not in self._stopping
            and is_lost(folder)
            and not self._is_supervised(folder)
            and live_holder(folder) is None
        )

    def _begin_end(self, run: Run) -> None:
        """End a run that is to be cancelled, in a thread of its own."""
        engine = self._engine_of(run.folder)
        if engine is not None:
            thread = threading.Thread(target=self._end, args=(run.folder, engine), daemon=True)
            self._stopping[run.id] = thread
            thread.start()

    def _end(self, folder: Path, engine: Engine) -> None:
        """Wait for the worker to stop by itself, then make sure that nothing of it is left."""
        try:
            end = time.monotonic() + self._settings.cancel_grace_s
            while time.monotonic() < end and (
                engine.is_at_work(folder) or live_holder(folder) is not None
            ):
                time.sleep(0.05)
            engine.end(folder)
            note_end(folder, "Cancelled.")
        except Exception:
            logger.exception("run %s could not be ended", folder.name)
        finally:
            self._stopping.pop(folder.name, None)


def _in_order(tickets: Mapping[str, Ticket]) -> dict[str, Ticket]:
    """Sort runs in line, the next one first; ids, which tell the time, decide between equals."""
    return dict(sorted(tickets.items(), key=lambda entry: (entry[1].turn, entry[0])))


def require_unread(catalog: Catalog, sequence: Path) -> None:
    """Refuse to change a recording that a run reads, or waits to read.

    Args:
        catalog: Finds runs.
        sequence: Folder of the recording.

    Raises:
        RunError: If there is such a run; names it.
    """
    folder = sequence.resolve()
    for item in catalog.runs():
        if item.run is None or not any(_is_at(path, folder) for path in item.run.sequences):
            continue
        is_at_work = live_holder(item.folder) is not None or is_lost(item.folder)
        if is_at_work or (item.folder / QUEUED).is_file():
            does = "is being fitted by" if is_at_work else "waits to be fitted by"
            raise RunError(
                f"Sequence '{folder.name}' {does} run '{item.run.name}' ({item.id}), which would "
                "read it half old and half new. Wait until that has ended, or cancel it."
            )


def _is_at(path: str, folder: Path) -> bool:
    return Path(path).name == folder.name and Path(path).resolve() == folder


def _progress_of(run: Run) -> tuple[dict[str, Any], str]:
    """Give a run's latest report; if it is damaged, which costs no more than the report, why."""
    try:
        return run.progress, ""
    except RunError as error:
        return {}, str(error)


def _sentences(*sentences: str) -> str:
    return " ".join(sentence for sentence in sentences if sentence)


def _elsewhere(folder: Path) -> str:
    """Tell of a run that was started with an engine that this server does not use."""
    ticket = read_ticket(folder / STARTED) or Ticket()
    return f"It was started on {ticket.engine}; a server with that --engine follows it."


def _remark(folder: Path) -> str:
    """Tell of a run at work if it was not started for the first time."""
    ticket = read_ticket(folder / STARTED)
    return "" if ticket is None else ticket.remark
