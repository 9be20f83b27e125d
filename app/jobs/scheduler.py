"""The queue of fits: one thread starts them, watches them and ends cancelled ones."""

import json
import logging
import subprocess
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from app.jobs.catalog import Catalog, RunItem
from app.jobs.local import WORKER, end_processes, processes_of, start_worker
from app.settings import Settings
from physhandi.data.atomic import write_json
from physhandi.data.lease import live_holder
from physhandi.data.run import Run, new_run_id
from physhandi.errors import PhysHandiError, RunError, UsageError
from physhandi.fitting.profile import config_to_dict, load_profile

logger = logging.getLogger(__name__)

QUEUED = "queued.json"
"""File in a run's folder that puts it into the queue; the queue survives a restart."""
_INTERVAL_S = 0.3


@dataclass(frozen=True)
class JobView:
    """How far a run is, for people."""

    state: str
    """queued, starting, running, stopping, succeeded, failed or cancelled."""
    place: int | None
    """Place in the queue, counted from 1."""
    reason: str
    """Why it waits or how it ended."""
    progress: Mapping[str, Any]
    """The latest report of the worker."""


class Scheduler:
    """Starts queued runs while slots are free; folders hold all state that must not be lost."""

    def __init__(self, settings: Settings, catalog: Catalog, *, worker: str = WORKER) -> None:
        """Prepare; `start` begins.

        Args:
            settings: Slots, device and grace of a cancel.
            catalog: Finds runs.
            worker: Module of the worker process.
        """
        self._settings = settings
        self._catalog = catalog
        self._worker = worker
        self._lock = threading.RLock()
        self._children: dict[str, subprocess.Popen[bytes]] = {}
        self._stopping: dict[str, threading.Thread] = {}
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="scheduler", daemon=True)

    def start(self) -> None:
        """Begin to work through the queue."""
        self._thread.start()

    def shutdown(self) -> None:
        """Stop watching; running fits go on and are found again by the next server."""
        self._closed.set()
        if self._thread.is_alive():
            self._thread.join(timeout=5)

    def launch(self, sequence_ids: list[str], profile: str, name: str = "") -> Run:
        """Make a run of one or several sequences and queue it.

        Raises:
            UsageError: If there is no sequence or no such profile.
            SequenceError: If a sequence is unknown or damaged.
        """
        if not sequence_ids:
            raise UsageError("Name at least one sequence to fit.")
        config = {"profile": config_to_dict(load_profile(profile))}
        sequences = [self._catalog.sequence(sequence_id) for sequence_id in sequence_ids]
        run = Run.create(
            self._settings.run_dir / new_run_id(),
            name=name.strip() or f"{sequences[0].name} · {profile}",
            kind="reconstruction",
            sequences=[str(sequence.folder) for sequence in sequences],
            config=config,
        )
        self._enqueue(run)
        return run

    def resume(self, run_id: str) -> None:
        """Queue a failed or cancelled run again; it goes on after its last finished stage.

        Raises:
            RunError: If the run is unknown, bundled, finished or at work.
        """
        with self._lock:
            item = self._own(run_id)
            state = self.view(item).state
            if state not in {"failed", "cancelled"}:
                raise RunError(
                    f"Run '{run_id}' is {state}; only a failed or cancelled run is resumed."
                )
            run = Run.open(item.folder)
            run.clear_cancel()
            self._enqueue(run)

    def cancel(self, run_id: str) -> None:
        """Take a run out of the queue, or end its process and all that it started.

        Raises:
            RunError: If the run is unknown or not at work.
        """
        with self._lock:
            item = self._own(run_id)
            state = self.view(item).state
            if state not in {"queued", "starting", "running", "stopping"}:
                raise RunError(f"Run '{run_id}' is {state}; there is nothing to cancel.")
            Run.open(item.folder).request_cancel()
            (item.folder / QUEUED).unlink(missing_ok=True)
            if state in {"starting", "running"} and run_id not in self._stopping:
                thread = threading.Thread(target=self._end, args=(run_id,), daemon=True)
                self._stopping[run_id] = thread
                thread.start()

    def delete(self, run_id: str) -> None:
        """Remove a run that is not at work.

        Raises:
            RunError: If the run is unknown, bundled or at work.
        """
        with self._lock:
            item = self._own(run_id)
            if self.view(item).state in {"queued", "starting", "running", "stopping"}:
                raise RunError(f"Run '{run_id}' is at work. Cancel it before you delete it.")
            Run.open(item.folder).delete()

    def view(self, item: RunItem) -> JobView:
        """Tell how far a run is and why it waits."""
        if item.run is None:
            return JobView("failed", None, str(item.error), {})
        run = item.run
        if item.id in self._stopping and self._is_at_work(item):
            return JobView("stopping", None, "Ending its process.", run.progress)
        if live_holder(item.folder) is not None:
            return JobView("running", None, "", run.progress)
        if item.id in self._children and self._children[item.id].poll() is None:
            return JobView("starting", None, "Loading the program.", {})
        if (item.folder / QUEUED).is_file():
            place = [other.id for other in self._queue()].index(item.id) + 1 if item.run else None
            slots = self._settings.parallel_fits
            reason = f"{slots} fit(s) may run at a time; {place} in line." if place else ""
            return JobView("queued", place, reason, {})
        state = run.state
        reason = str(run.error) if state == "failed" else ""
        return JobView(state, None, reason, run.progress)

    def _own(self, run_id: str) -> RunItem:
        item = self._catalog.run_item(run_id)
        if item.is_bundled:
            raise RunError(f"Run '{run_id}' came with the program and stays as it is.")
        return item

    def _enqueue(self, run: Run) -> None:
        write_json(run.folder / QUEUED, {"time": time.time()})

    def _queue(self) -> list[RunItem]:
        waiting: list[tuple[float, str, RunItem]] = []
        for item in self._catalog.runs():
            path = item.folder / QUEUED
            if item.run is None or item.is_bundled or not path.is_file():
                continue
            waiting.append((_queued_at(path), item.id, item))
        return [item for _, _, item in sorted(waiting, key=lambda entry: entry[:2])]

    def _is_at_work(self, item: RunItem) -> bool:
        child = self._children.get(item.id)
        is_alive = child is not None and child.poll() is None
        return is_alive or live_holder(item.folder) is not None

    def _watch(self) -> None:
        while not self._closed.wait(_INTERVAL_S):
            try:
                self._step()
            except (PhysHandiError, OSError):
                logger.exception("the queue could not go on; it tries again")

    def _step(self) -> None:
        with self._lock:
            for run_id, child in list(self._children.items()):
                if child.poll() is not None:
                    del self._children[run_id]
            queue = self._queue()
            if not queue:
                return
            busy = sum(1 for item in self._catalog.runs() if self._is_at_work(item))
            for item in queue[: max(0, self._settings.parallel_fits - busy)]:
                self._children[item.id] = start_worker(
                    item.folder, self._settings.device, module=self._worker
                )
                (item.folder / QUEUED).unlink(missing_ok=True)

    def _end(self, run_id: str) -> None:
        """Wait for the worker to stop by itself, then make sure that nothing of it is left."""
        end = time.monotonic() + self._settings.cancel_grace_s
        while time.monotonic() < end and any(True for _ in processes_of(run_id)):
            self._reap(run_id)
            time.sleep(0.1)
        end_processes(run_id, grace_s=2.0)
        self._reap(run_id)
        self._stopping.pop(run_id, None)

    def _reap(self, run_id: str) -> None:
        child = self._children.get(run_id)
        if child is not None:
            child.poll()


def _queued_at(path: Path) -> float:
    try:
        return float(json.loads(path.read_text(encoding="utf-8"))["time"])
    except (OSError, ValueError, KeyError, TypeError):
        return 0.0
