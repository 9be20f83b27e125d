"""The small process between server and worker: ``python -m app.jobs.supervise``.

It loads no heavy library, writes the log, ends a worker that hangs, notes how the worker ended if
the worker could not, and leaves no process behind.
"""

import os
import re
import signal
import threading
import time
from contextlib import suppress
from pathlib import Path

import psutil

from app.jobs.processes import COOKIE, adopt_orphans, claim_supervision, end_processes
from app.jobs.ticket import begin_start, note_end, start_again_or_end
from app.jobs.vigil import Vigil
from physhandi.child import Channel, Child, ChildEndedError, run_child
from physhandi.data.run_folder import LOG
from physhandi.errors import PhysHandiError

_BEATS = 6.0
"""Signs of life in the time after which a silent worker hangs."""


def supervise(run_folder: Path, device: str, worker: str, hung_after_s: float) -> None:
    """Run the worker of a run until it ends.

    Nothing happens if the run has a supervisor, or this start of it is not valid any more.

    Args:
        run_folder: The run.
        device: Warp device.
        worker: Python module that does the work.
        hung_after_s: See `Vigil`.
    """
    claim = claim_supervision(run_folder)
    if claim is None:
        return
    nonce = os.environ.get(COOKIE, "").rpartition(":")[2]
    if not begin_start(run_folder, nonce):
        return
    adopt_orphans()
    # On another machine no server sees what a killed supervisor of this run has left.
    end_processes(run_folder, grace_s=0.0, spare=os.getpid())
    killed_before = count_memory_kills()
    beat_s = str(hung_after_s / _BEATS)
    with Child(worker, str(run_folder), device, beat_s, log=run_folder / LOG) as child:
        signal.signal(signal.SIGTERM, lambda _number, _frame: child.terminate())
        watch = _Watch(child, hung_after_s)
        error, kind = watch.hear()
        end_processes(run_folder, grace_s=0.0, spare=os.getpid(), nonce=nonce)
    if watch.hung is not None:
        start_again_or_end(run_folder, watch.hung)
    elif kind == _KILLED and count_memory_kills() > killed_before:
        reason = "The system killed the worker because memory had run out."
        note_end(run_folder, reason, MemoryError.__name__)
    elif kind == _KILLED:
        start_again_or_end(run_folder, error)
    else:
        note_end(run_folder, error, kind)


def count_memory_kills(root: Path = Path("/")) -> int:
    """Count the processes that the kernel has killed because memory ran out (Linux).

    They are those of this process's control group, or where that cannot be read, of the machine.

    Args:
        root: Where the kernel's files are.
    """
    try:
        groups = (root / "proc/self/cgroup").read_text()
    except OSError:
        return 0
    tried: list[tuple[Path, str]] = []
    for line in groups.splitlines():
        _, kinds, path = line.split(":", 2)
        place = path.lstrip("/")
        if not kinds:
            tried.append((root / "sys/fs/cgroup" / place, "memory.events"))
        elif "memory" in kinds.split(","):
            tried.append((root / "sys/fs/cgroup/memory" / place, "memory.oom_control"))
            tried.append((root / "sys/fs/cgroup/memory", "memory.oom_control"))
    for file in (*(folder / name for folder, name in tried), root / "proc/vmstat"):
        with suppress(OSError):
            match = re.search(r"^oom_kill (\d+)$", file.read_text(), re.MULTILINE)
            if match:
                return int(match[1])
    return 0


_KILLED = "killed"


class _Watch:
    """Hears a worker until it ends, and ends it if it hangs."""

    def __init__(self, child: Child, hung_after_s: float) -> None:
        self._child = child
        self._vigil = Vigil(hung_after_s, now=time.monotonic())
        self._is_over = threading.Event()
        self.hung: str | None = None
        """Why it was ended, if it hung."""

    def hear(self) -> tuple[str, str]:
        """Wait for the worker's end; returns what went wrong and the name of the error's class."""
        thread = threading.Thread(target=self._look, daemon=True)
        thread.start()
        try:
            for message in self._child.messages():
                if isinstance(beat := message.get("beat"), int):
                    self._vigil.hear(beat)
        except ChildEndedError as error:
            return _explain(error.code)
        except PhysHandiError as error:
            return str(error), type(error).__name__
        finally:
            self._is_over.set()
            thread.join()
        return _explain(0)

    def _look(self) -> None:
        process = psutil.Process(self._child.pid)
        while not self._is_over.wait(self._vigil.interval_s):
            why = self._vigil.look(time.monotonic(), _computed(process))
            if why is not None:
                self.hung = why
                self._child.kill()
                return


def _computed(process: psutil.Process) -> float:
    """Give what a process and all that it started have computed [s]."""
    total = 0.0
    with suppress(psutil.Error):
        for one in (process, *process.children(recursive=True)):
            with suppress(psutil.Error):
                total += sum(one.cpu_times()[:4])
    return total


def _explain(code: int) -> tuple[str, str]:
    if code == -signal.SIGKILL:
        return (
            "It lost its process: something outside killed the worker (signal 9), and memory had "
            "not run out.",
            _KILLED,
        )
    if code < 0:
        return f"The worker died of {signal.Signals(-code).name}. Its log may tell why.", ""
    return f"The worker ended with code {code} before it could say why. Its log may tell.", ""


def _work(channel: Channel) -> None:
    run_folder, device, worker, hung_after_s = channel.arguments
    supervise(Path(run_folder), device, worker, float(hung_after_s))


if __name__ == "__main__":
    run_child(_work)
