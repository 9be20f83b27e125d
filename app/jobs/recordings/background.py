"""Work that the server has done in a child process, one piece at a time, and told about."""

import threading
from dataclasses import dataclass, field
from typing import Any, Literal

from physhandi.child import Child
from physhandi.errors import CancelledError, PhysHandiError, RunError, describe

_LONGEST_S = 4 * 3600.0
"""Time after which a process is not waited for any longer [s]."""


@dataclass
class BackgroundTask:
    """How far a piece of work is."""

    state: Literal["none", "running", "done", "cancelled", "failed"] = "none"
    reason: str = ""
    """Why it failed."""
    progress: dict[str, Any] = field(default_factory=dict[str, Any])
    """The latest report: ``stage iteration total message``."""
    result: dict[str, Any] = field(default_factory=dict[str, Any])
    """What the process told about what it has made."""


class BackgroundTasks:
    """Starts the process that works, listens to it, and ends it with the server."""

    def __init__(self, module: str, busy: str) -> None:
        """Prepare.

        Args:
            module: What runs in the process: calls `work_on_order`.
            busy: Sentence that says what is at work; ``{}`` stands for its key.
        """
        self._module = module
        self._busy = busy
        self._lock = threading.Lock()
        self._tasks: dict[str, BackgroundTask] = {}
        self._child: Child | None = None
        self._listener: threading.Thread | None = None

    def start(self, key: str, order: dict[str, Any]) -> BackgroundTask:
        """Begin a piece of work.

        Args:
            key: What it is asked for by.
            order: What the process is told.

        Raises:
            RunError: If another piece is at work.
        """
        with self._lock:
            running = self.running
            if running is not None:
                raise RunError(
                    f"{self._busy.format(running)} Wait until that is done, or cancel it."
                )
            task = self._tasks[key] = BackgroundTask("running")
            self._child = child = Child(self._module, time_limit_s=_LONGEST_S)
            child.send(order)
            self._listener = threading.Thread(
                target=self._listen, args=(child, task), name=self._module, daemon=True
            )
            self._listener.start()
        return task

    @property
    def running(self) -> str | None:
        """Key of the work that is going on."""
        tasks = list(self._tasks.items())
        return next((key for key, task in tasks if task.state == "running"), None)

    def task(self, key: str) -> BackgroundTask:
        """Tell how far a piece of work is; of one that nobody asked for, that there is none."""
        return self._tasks.get(key, BackgroundTask())

    def cancel(self, key: str) -> None:
        """Stop a piece of work; does nothing if it is not at work."""
        if self.running == key and self._child is not None:
            self._child.send("cancel")

    def shutdown(self) -> None:
        """End what is at work."""
        child, listener = self._child, self._listener
        if child is not None:
            child.kill()
        if listener is not None:
            listener.join(timeout=5)

    @staticmethod
    def _listen(child: Child, task: BackgroundTask) -> None:
        with child:
            try:
                for message in child.messages():
                    if "result" in message:
                        task.result = message["result"]
                    else:
                        task.progress = message
                task.state = "done"
            except CancelledError:
                task.state = "cancelled"
            except (PhysHandiError, OSError) as error:
                task.reason = describe(error)
                task.state = "failed"
