"""The CPU engine: frames and their adjoints by vector units, on one or two threads.

`CpuEngine` simulates, `CpuAdjoint` differentiates; `SubstepLoop` launches their kernels with the
number of threads that `Pace` measures to be faster.
"""

import ctypes
import os
import sys
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import fields
from functools import lru_cache
from threading import Lock
from typing import Any

import numpy as np
import warp as wp

from physhandi.simulation.engines.frame_sums import FrameSums
from physhandi.simulation.engines.host import EngineHost
from physhandi.simulation.engines.partition import SpringParts, group_springs
from physhandi.simulation.engines.tape import Tape, TapeLayout
from physhandi.simulation.kernels.barrier import ABORT, NO_STOP
from physhandi.simulation.kernels.cpu_adjoint import parts_adjoint
from physhandi.simulation.kernels.cpu_frame import advance_parts
from physhandi.simulation.kernels.simd import LANES, Bars, Parts, Record, SpringMaterial

TRIAL = 64
"""Substeps of one measurement of a number of threads."""
FIRST_PAUSE, LONGEST_PAUSE = 0.25, 8.0
"""Time until the slower number of threads is measured again, at first and at most [s]."""
PART_COUNTS = 2
"""Parts of an object; the same on every processor, because they determine the order of sums."""
LEAST_SPRINGS = 512
"""Springs from which a second thread can pay for the synchronisation."""
_RECORD: Any = Record
_PARTS: Any = Parts
_MATERIAL: Any = SpringMaterial
_BARS: Any = Bars
PartState = tuple[wp.array, wp.array]
"""Positions and velocities."""


class Pace:
    """Chooses one or two threads by repeated measurement.

    On a busy machine two threads are slower, because each waits until the other gets a processor.
    """

    def __init__(
        self, processors: int | None = None, clock: Callable[[], float] = time.perf_counter
    ) -> None:
        """Start without measurements.

        Args:
            processors: Processors available to this process; None asks the system.
            clock: Current time [s].
        """
        self._choices = (1, 2) if (processors or processor_count()) > 1 else (1,)
        self._clock = clock
        self._cost: dict[int, float] = {}
        self._pause = FIRST_PAUSE
        self._next_trial = 0.0

    def choose(self, left: int) -> tuple[int, int]:
        """Return the number of threads, and for how many of the remaining substeps."""
        for threads in self._choices:
            if threads not in self._cost:
                return threads, left if len(self._choices) == 1 else min(left, TRIAL)
        best = self._best()
        if len(self._choices) == 1 or self._clock() < self._next_trial:
            return best, left
        return (best, left - TRIAL) if left > TRIAL else (3 - best, left)

    def learn(self, threads: int, seconds: float) -> None:
        """Record the time of a substep with a number of threads."""
        is_new = threads not in self._cost
        best = None if is_new else self._best()
        # The current choice is averaged; of the other one the latest measurement counts.
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


class SubstepLoop:
    """A kernel of `kernels.threaded` with its arguments."""

    def __init__(self, kernel: Any, substeps: int, inputs: list[Any], device: Any) -> None:
        """Record its launches.

        Args:
            kernel: Its first arguments are thread, number of threads, number of substeps, the
                address of a function that yields the processor, `job` and `meeting`.
            substeps: Substeps of a frame.
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
        """Replace the kernel's array arguments of these names."""
        for name, array in arrays.items():
            if self._aims.get(name) is array:
                continue
            self._aims[name] = array
            for launch in (self._alone, *self._together):
                launch.set_param_by_name(name, array)

    def run(self, threads: int | None = None) -> None:
        """Simulate all substeps with 1 or 2 threads; None for whichever is faster."""
        done = 0
        while done < self._substeps:
            remaining = self._substeps - done
            chosen, count = (
                self._pace.choose(remaining) if threads is None else (threads, remaining)
            )
            start = time.perf_counter()
            reached, used = self._launch(chosen, done, done + count)
            if threads is None:
                self._pace.learn(used, (time.perf_counter() - start) / max(1, reached - done))
            done = reached

    def _launch(self, threads: int, first: int, last: int) -> tuple[int, int]:
        """Simulate substeps; return the next substep, and the number of threads used."""
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
            # Otherwise the other thread would wait for this one forever.
            meeting[1] = ABORT
            raise
        finally:
            wait(others)
            companion.lock.release()
        others[0].result()
        return int(job[2]), 2


class _Companion:
    """A second thread of this process, for one launch at a time."""

    def __init__(self) -> None:
        self.lock = Lock()
        self.pool = ThreadPoolExecutor(1, thread_name_prefix="physhandi-part")


@lru_cache(maxsize=1)
def _companion(process: int) -> _Companion:  # noqa: ARG001  (a fork has none of the threads)
    return _Companion()


def _give_way() -> int:
    """Return the address of the system function that yields the processor."""
    if sys.platform == "win32":
        function = ctypes.windll.kernel32.SwitchToThread
    else:
        function = ctypes.CDLL(None).sched_yield
    return ctypes.cast(function, ctypes.c_void_p).value or 0


def processor_count() -> int:
    """Count the processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class CpuEngine:
    """The arrays of one model for the CPU kernels."""

    def __init__(self, simulator: EngineHost, parts: SpringParts) -> None:
        """Allocate the arrays.

        Args:
            simulator: Its controls, material and world are read.
            parts: Parts of its model.
        """
        self._simulator = simulator
        self.partition = parts
        self.threads: int | None = None if len(parts.spring) >= LEAST_SPRINGS else 1
        """Threads of a launch; None for whichever is faster. The bits are the same."""
        self.parts = _PARTS()
        for field in fields(parts):
            dtype = wp.vec2i if field.name == "ends" else wp.int32
            setattr(self.parts, field.name, simulator.array(getattr(parts, field.name), dtype))
        self.material = _MATERIAL()
        for name in ("rest", "elastic", "dashpot"):
            setattr(self.material, name, self.zeros(len(parts.spring), wp.float32))
        self.state = self.zeros((2, parts.place_count), _RECORD)
        """States of two alternating substeps, used when no tape is written."""
        self._force = self.zeros(parts.place_count, wp.vec4)
        self.no_tape = self.zeros((0, 0), wp.vec4)
        self._first = self.zeros(len(parts.own_start) - 1, wp.int32)
        self._loops: dict[bool, SubstepLoop] = {}

    @staticmethod
    def of(simulator: EngineHost) -> "CpuEngine | None":
        """Create one for a simulator; None on a GPU, or without nodes."""
        if simulator.device.is_cuda or simulator.model.node_count == 0:
            return None
        return CpuEngine(simulator, group_springs(simulator.model, PART_COUNTS, LANES))

    def zeros(self, shape: int | tuple[int, ...], dtype: Any) -> wp.array:
        """Make an array of zeros in the processor's memory."""
        return wp.zeros(shape, dtype=dtype, device=self._simulator.device)

    def advance(self, before: PartState, after: PartState, tape: Tape | None = None) -> None:
        """Simulate one frame, from one state to another.

        Args:
            before: State at its start.
            after: Receives the state at its end; may be the same arrays.
            tape: Receives each substep's state and velocity before contact.
        """
        simulator = self._simulator
        loop = self._loops.get(tape is None)
        if loop is None:
            loop = self._loops[tape is None] = self.substep_loop(
                advance_parts,
                [simulator.world, simulator.clearance, self.parts, *simulator.material],
                [*simulator.controls, *before],
                [self.material, self.state, self._force, self.no_tape, *after, self._first],
            )
        state, free_tape = (self.state, self.no_tape) if tape is None else tape
        loop.aim(
            position=before[0],
            velocity=before[1],
            state_out=state,
            free_tape_out=free_tape,
            position_out=after[0],
            velocity_out=after[1],
        )
        loop.run(self.threads)
        first = simulator.first_divergence.numpy()
        first[0] = min(first[0], *self._first.numpy())

    def substep_loop(self, kernel: Any, *arguments: list[Any]) -> SubstepLoop:
        """Prepare the launches of a kernel over the substeps of a frame."""
        simulator = self._simulator
        inputs = [value for part in arguments for value in part]
        return SubstepLoop(
            kernel, simulator.parameters.substeps_per_frame, inputs, simulator.device
        )


def cpu_tape_layout(places: int, nodes: int, substeps: int) -> TapeLayout:
    """Shape the tape of a frame: states in all places, and velocities before contact.

    Args:
        places: Nodes, and control nodes once for each part that they hold.
        nodes: Object nodes.
        substeps: Substeps of a frame.
    """
    return ((substeps + 1, places), _RECORD), ((substeps, nodes), wp.vec4)


class CpuAdjoint:
    """Simulates frames and propagates derivatives back; `GraphAdjoint` on the CPU engine."""

    def __init__(self, simulator: EngineHost, engine: CpuEngine) -> None:
        """Allocate the derivatives.

        Args:
            simulator: Its controls, material and world are read, its state is advanced.
            engine: Engine of the simulator.
        """
        self._engine = engine
        model, parts = simulator.model, engine.partition
        nodes, held_count = model.node_count, len(parts.control)
        substeps = simulator.parameters.substeps_per_frame
        self.layout = cpu_tape_layout(parts.place_count, nodes, substeps)
        self._state = simulator.position, simulator.velocity
        self.position_bar = engine.zeros(nodes, wp.vec3)
        self.velocity_bar = engine.zeros(nodes, wp.vec3)
        self.sums = FrameSums.zeros(model, simulator.device)
        self._bars = _BARS()
        for name, shape, dtype in (
            ("state", parts.place_count, _RECORD),
            ("force", (2, parts.place_count), wp.vec4),
            ("log_stiffness", len(parts.spring), wp.float32),
            ("damping", len(parts.spring), wp.float32),
            ("coefficients", nodes, wp.vec3),
            ("start", held_count, wp.vec3),
            ("end", held_count, wp.vec3),
        ):
            setattr(self._bars, name, engine.zeros(shape, dtype))
        self._adjoint = engine.substep_loop(
            parts_adjoint,
            [simulator.world, simulator.clearance, engine.parts, *simulator.material],
            [engine.material],
            [engine.state, engine.no_tape, self._bars, self.position_bar, self.velocity_bar],
            [*self.sums.material, self.sums.drag, *self.sums.ground],
        )

    @staticmethod
    def of(simulator: EngineHost, engine: Any) -> "CpuAdjoint | None":
        """Create one for a simulator; None with another engine or with self-collision."""
        if not isinstance(engine, CpuEngine) or simulator.has_contacts:
            return None
        return CpuAdjoint(simulator, engine)

    def record(self, tape: Tape) -> None:
        """Advance the simulator by one frame and record its substeps in `tape`."""
        self._engine.advance(self._state, self._state, tape)

    def backward(self, tape: Tape) -> None:
        """Propagate `position_bar` and `velocity_bar` back; see `GraphAdjoint.backward`."""
        engine = self._engine
        state, free_tape = tape
        self._adjoint.aim(state=state, free_tape=free_tape)
        self._adjoint.run(engine.threads)
        # A control node has a place in each part that it holds.
        for bar, held in zip(self.sums.controls, (self._bars.start, self._bars.end), strict=True):
            bar.zero_()
            np.add.at(bar.numpy(), engine.partition.control, held.numpy())
