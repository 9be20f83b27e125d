"""Launches of a CPU kernel over the substeps of a frame, by one thread or by two."""

import ctypes
import os
import sys
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import lru_cache
from threading import Lock
from typing import Any

import warp as wp

from physhandi.simulation.kernels.meeting import ABORT, NO_STOP

TRIAL = 64
"""Substeps by which a number of threads is judged."""
FIRST_PAUSE, LONGEST_PAUSE = 0.25, 8.0
"""How long the slower number of threads is not tried again, at first and at most [s]."""


class Pace:
    """Finds by measurement whether two threads are faster than one, and keeps looking.

    On a machine with other work they are slower, because each waits for the other until both
    have a processor.
    """

    def __init__(
        self, processors: int | None = None, clock: Callable[[], float] = time.perf_counter
    ) -> None:
        """Know nothing yet.

        Args:
            processors: How many this process may use; if left out, as the system says.
            clock: Gives the time in seconds.
        """
        self._choices = (1, 2) if (processors or _processor_count()) > 1 else (1,)
        self._clock = clock
        self._cost: dict[int, float] = {}
        self._pause = FIRST_PAUSE
        self._next_trial = 0.0

    def choose(self, left: int) -> tuple[int, int]:
        """Return with how many threads to take how many of the substeps that are left."""
        for threads in self._choices:
            if threads not in self._cost:
                return threads, left if len(self._choices) == 1 else min(left, TRIAL)
        best = self._best()
        if len(self._choices) == 1 or self._clock() < self._next_trial:
            return best, left
        return (best, left - TRIAL) if left > TRIAL else (3 - best, left)

    def learn(self, threads: int, seconds: float) -> None:
        """Hear how long a substep took with a number of threads."""
        is_new = threads not in self._cost
        best = None if is_new else self._best()
        # One slow frame does not decide, but a trial is all that is known of the other.
        is_trial = threads != best
        self._cost[threads] = seconds if is_trial else 0.5 * (seconds + self._cost[threads])
        if self._best() != best:
            self._pause = FIRST_PAUSE
        elif is_trial:
            self._pause = min(2.0 * self._pause, LONGEST_PAUSE)
        else:
            return
        self._next_trial = self._clock() + self._pause

    def _best(self) -> int:
        return min(self._cost, key=self._cost.__getitem__)


class Walk:
    """A kernel of `kernels.threaded` with its arguments."""

    def __init__(self, kernel: Any, substeps: int, inputs: list[Any], device: Any) -> None:
        """Prepare its launches.

        Args:
            kernel: Takes thread, threads, substeps, a function's address, `job`, `meeting`.
            substeps: In a frame.
            inputs: The kernel's other arguments.
            device: Warp device.
        """
        self._substeps = substeps
        self._job = wp.zeros(3, dtype=wp.int32, device=device)
        self._meeting = wp.zeros(2, dtype=wp.int32, device=device)
        self._pace = Pace()
        # A recorded launch does not keep its arrays alive.
        self._inputs = inputs
        self._aims: dict[str, wp.array] = {}
        between = [substeps, _give_way(), self._job, self._meeting]

        def record(thread: int, threads: int) -> Any:
            arguments = [thread, threads, *between, *inputs]
            return wp.launch(kernel, dim=1, inputs=arguments, device=device, record_cmd=True)

        self._alone = record(0, 1)
        self._together = record(0, 2), record(1, 2)

    def aim(self, **arrays: wp.array) -> None:
        """Let the kernel's arguments of these names be other arrays from now on."""
        for name, array in arrays.items():
            if self._aims.get(name) is array:
                continue
            self._aims[name] = array
            for launch in (self._alone, *self._together):
                launch.set_param_by_name(name, array)

    def run(self, threads: int | None = None) -> None:
        """Take all substeps.

        Args:
            threads: 1 or 2; if none, as is fastest.
        """
        done = 0
        while done < self._substeps:
            left = self._substeps - done
            chosen, count = self._pace.choose(left) if threads is None else (threads, left)
            start = time.perf_counter()
            reached, used = self._launch(chosen, done, done + count)
            if threads is None:
                self._pace.learn(used, (time.perf_counter() - start) / max(1, reached - done))
            done = reached

    def _launch(self, threads: int, first: int, last: int) -> tuple[int, int]:
        """Take substeps; return how far that came, and with how many threads."""
        job = self._job.numpy()
        job[:2] = first, last
        companion = _companion(os.getpid())
        if threads == 1 or not companion.lock.acquire(blocking=False):
            self._alone.launch()
            return int(job[2]), 1
        meeting = self._meeting.numpy()
        meeting[:] = 0, NO_STOP
        others: list[Future[None]] = []
        try:
            others.append(companion.pool.submit(self._together[1].launch))
            self._together[0].launch()
        except BaseException:
            # Otherwise the other thread would wait for this one for ever.
            meeting[1] = ABORT
            raise
        finally:
            wait(others)
            companion.lock.release()
        others[0].result()
        return int(job[2]), 2


class _Companion:
    """One more thread of this process, for one launch at a time."""

    def __init__(self) -> None:
        self.lock = Lock()
        self.pool = ThreadPoolExecutor(1, thread_name_prefix="physhandi-part")


@lru_cache(maxsize=1)
def _companion(process: int) -> _Companion:  # noqa: ARG001  (a fork has none of the threads)
    return _Companion()


def _give_way() -> int:
    """Return the address of the function that lets other threads have the processor."""
    if sys.platform == "win32":
        function = ctypes.windll.kernel32.SwitchToThread
    else:
        function = ctypes.CDLL(None).sched_yield
    return ctypes.cast(function, ctypes.c_void_p).value or 0


def _processor_count() -> int:
    """Count the processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
