"""Fits on a Ray cluster: the same supervisors, as jobs of its Jobs API."""

import shlex
import threading
import time
from collections.abc import Sequence
from pathlib import Path

from app.jobs.engines.cluster import Cluster, ClusterError, Demand
from app.jobs.processes import COOKIE, STORE, cookie_of, supervisor_command
from app.jobs.ticket import STARTED, Ticket, nonce_of, read_ticket
from app.settings import LOCAL, ServerSettings
from physhandi.child import thread_limits
from physhandi.data.lease import live_holder
from physhandi.errors import UsageError

_INTERVAL_S = 1.0
_UNKNOWN, _PENDING, _RUNNING = "unknown", "PENDING", "RUNNING"
_ALIVE = {_UNKNOWN, _PENDING, _RUNNING}
_GIBIBYTE = 2**30


def job_name(run_folder: Path, ticket: Ticket) -> str:
    """Name the job of one start of a run; it is the same however often it is submitted."""
    return f"{run_folder.name}-{ticket.starts}-{nonce_of(run_folder, ticket)}"


class RayEngine:
    """Runs fits on a cluster; see `Engine`.

    A run is at work until the cluster says that its job has ended, or that it knows no such job
    any more, as after its head was lost. While it does not answer nothing is taken to have ended.
    """

    def __init__(self, settings: ServerSettings, cluster: Cluster, worker: str) -> None:
        """Prepare; nothing is asked yet.

        Args:
            settings: What a fit asks of the cluster.
            cluster: The cluster.
            worker: Module of the worker process.
        """
        self._settings = settings
        self._cluster = cluster
        self._worker = worker
        self._demand = Demand(
            settings.cluster_cpus,
            settings.cluster_gpus,
            round(settings.cluster_memory_gib * _GIBIBYTE),
        )
        self._lock = threading.Lock()
        self._status: dict[str, str] = {}
        self._asked: set[str] = set()
        self._message: dict[str, str] = {}
        self._places = 0
        self._trouble = f"The cluster at {cluster.place} was not asked yet."
        self._time = -_INTERVAL_S

    @classmethod
    def of(cls, settings: ServerSettings, worker: str) -> "RayEngine":
        """Make the engine that settings name; see the class.

        Raises:
            UsageError: If they name none.
        """
        if settings.engine == LOCAL or settings.engine_token is None:
            raise UsageError(f"{settings.engine} is no cluster with a token.")
        cluster = Cluster(settings.engine, settings.engine_token.get_secret_value())
        return cls(settings, cluster, worker)

    @property
    def name(self) -> str:
        """See `Engine`."""
        return self._settings.engine

    @property
    def slots(self) -> int:
        """See `Engine`."""
        return self._settings.parallel_fits or self._places

    @property
    def full(self) -> str:
        """See `Engine`."""
        if self._places == 0:
            return "Waits for a node of the cluster that has what it asks for."
        return "Waits for a free place on the cluster."

    @property
    def trouble(self) -> str:
        """See `Engine`."""
        return self._trouble

    @property
    def shortage(self) -> str:
        """See `Engine`."""
        return self._trouble

    def refresh(self) -> None:
        """See `Engine`."""
        if time.monotonic() - self._time < _INTERVAL_S:
            return
        with self._lock:
            # Nobody asks about what has ended for good.
            for job in self._status.keys() - self._asked:
                self._status.pop(job)
                self._message.pop(job, None)
            self._asked.clear()
            alive = [job for job, status in self._status.items() if status in _ALIVE]
        try:
            # First, so that only a cluster is believed that a job is unknown.
            self._places = self._cluster.places(self._demand)
            for job in alive:
                self._look(job)
            self._trouble = ""
        except ClusterError as error:
            self._trouble = str(error)
        self._time = time.monotonic()

    def choose(self, busy: Sequence[str]) -> str | None:  # noqa: ARG002  # the cluster places them
        """See `Engine`."""
        if self._trouble:
            return None
        return "cuda:0" if self._demand.gpus else "cpu"

    def start(self, run_folder: Path, ticket: Ticket) -> None:
        """See `Engine`."""
        cookie = cookie_of(run_folder, nonce_of(run_folder, ticket))
        # Given to this command alone: the cluster's own processes are none of the run.
        marks = {COOKIE: cookie, **thread_limits(self._demand.cpus)}
        marks |= {STORE: self._settings.store} if self._settings.store else {}
        supervisor = supervisor_command(
            run_folder, ticket.device, self._worker, self._settings.hung_after_s
        )
        words = ["env", *(f"{name}={value}" for name, value in marks.items())]
        words += [self._settings.cluster_python, "-m", *supervisor]
        # In the place of the shell: what serves a job on its node ends only its own children, so a
        # shell's child would live on when the node is lost.
        command = f"exec {shlex.join(words)}"
        job = job_name(run_folder, ticket)
        try:
            about = {"run": run_folder.name, "folder": str(run_folder), "start": str(ticket.starts)}
            self._cluster.submit(job, command, self._demand, about)
        except ClusterError as error:
            # So that the next one does not wait for an answer, too.
            self._trouble = str(error)
            raise
        with self._lock:
            self._status[job] = _PENDING
            self._asked.add(job)

    def is_at_work(self, run_folder: Path) -> bool:
        """See `Engine`."""
        return self._status_of(run_folder) in _ALIVE

    def waits_for(self, run_folder: Path) -> str:
        """See `Engine`."""
        if self._trouble:
            return f"{self._trouble} Whether it still runs is known when it does."
        if self._status_of(run_folder) == _PENDING:
            return self.full
        return "Loading the program."

    def loss(self, run_folder: Path) -> str:
        """See `Engine`."""
        job = self._job(run_folder)
        status = self._status.get(job or "")
        if job is None or status not in {"FAILED", "STOPPED", "SUCCEEDED"}:
            return f"It lost its process: the cluster at {self._cluster.place} does not know it."
        message = self._message.get(job, "").strip().splitlines()
        why = f" ({message[0][:200].rstrip('.')})" if message else ""
        return f"It lost its process: its job on the cluster has ended as {status}{why}."

    def end(self, run_folder: Path) -> None:
        """See `Engine`."""
        while (job := self._job(run_folder)) is not None:
            try:
                # One that waits for a place waits on after its stop, and does nothing when it is
                # begun: its start is void as soon as the run has ended.
                self._cluster.stop(job)
                if self._look(job) not in {_UNKNOWN, _RUNNING}:
                    break
            except ClusterError as error:
                self._trouble = str(error)
            time.sleep(_INTERVAL_S)
        while live_holder(run_folder) is not None:
            time.sleep(_INTERVAL_S)

    def _job(self, run_folder: Path) -> str | None:
        ticket = read_ticket(run_folder / STARTED)
        return None if ticket is None else job_name(run_folder, ticket)

    def _status_of(self, run_folder: Path) -> str | None:
        if (job := self._job(run_folder)) is None:
            return None
        with self._lock:
            self._asked.add(job)
            return self._status.setdefault(job, _UNKNOWN)

    def _look(self, job: str) -> str:
        """Ask how a job is and keep the answer."""
        answer = self._cluster.job(job)
        with self._lock:
            self._status[job] = "LOST" if answer is None else answer.status
            self._message[job] = "" if answer is None else answer.message
            return self._status[job]


def reached_cluster(settings: ServerSettings, worker: str) -> RayEngine:
    """Make the engine that settings name, for a command whose user waits.

    Raises:
        UsageError: If they name none.
        ClusterError: If it does not answer.
    """
    engine = RayEngine.of(settings, worker)
    engine.refresh()
    if engine.trouble:
        raise ClusterError(engine.trouble)
    return engine
