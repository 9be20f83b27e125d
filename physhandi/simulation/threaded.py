"""Frames and their adjoints on a CPU: springs by its vector units, parts by its threads."""

from dataclasses import fields
from typing import Any

import numpy as np
import warp as wp

from physhandi.simulation.frame_sums import FrameSums
from physhandi.simulation.kernels.lanes import LANES, Bars, Material, Parts, Record
from physhandi.simulation.kernels.threaded import advance_parts
from physhandi.simulation.kernels.threaded_adjoint import retract_parts
from physhandi.simulation.partition import SpringParts, group_springs
from physhandi.simulation.stage import Stage
from physhandi.simulation.trajectory import Layout, Tape
from physhandi.simulation.walk import Walk

PARTS = 2
"""Parts of an object, on every processor the same, because they decide the order of sums."""
LEAST_SPRINGS = 512
"""Fewer are not worth it that threads meet."""
_NEVER = np.iinfo(np.int32).max
_RECORD: Any = Record
_PARTS: Any = Parts
_MATERIAL: Any = Material
_BARS: Any = Bars

State = tuple[wp.array, wp.array]
"""Positions and velocities."""


class Threaded:
    """The arrays of one model that a CPU's threads work on."""

    def __init__(self, simulator: Stage, parts: SpringParts) -> None:
        """Place a partition in memory.

        Args:
            simulator: Whose controls, material and world are read.
            parts: Of its model.
        """
        self._simulator = simulator
        self.partition = parts
        self.threads: int | None = None if len(parts.spring) >= LEAST_SPRINGS else 1
        """Threads of a launch; if none, as many as measurement finds best. The bits are equal."""
        self.parts = _PARTS()
        for field in fields(parts):
            dtype = wp.vec2i if field.name == "ends" else wp.int32
            setattr(self.parts, field.name, simulator.array(getattr(parts, field.name), dtype))
        self.material = _MATERIAL()
        for name in ("rest", "elastic", "dashpot"):
            setattr(self.material, name, self.zeros(len(parts.spring), wp.float32))
        self.state = self.zeros((2, parts.place_count), _RECORD)
        """States of two substeps in turn, while no tape is written."""
        self._force = self.zeros(parts.place_count, wp.vec4)
        self.no_tape = self.zeros((0, 0), wp.vec4)
        self._first = self.zeros(len(parts.own_start) - 1, wp.int32)
        self._walks: dict[bool, Walk] = {}

    @staticmethod
    def of(simulator: Stage) -> "Threaded | None":
        """Make one for a simulator; none on a GPU, or if there is no node."""
        if simulator.device.is_cuda or simulator.model.node_count == 0:
            return None
        return Threaded(simulator, group_springs(simulator.model, PARTS, LANES))

    def zeros(self, shape: int | tuple[int, ...], dtype: Any) -> wp.array:
        """Make an array of zeros in the processor's memory."""
        return wp.zeros(shape, dtype=dtype, device=self._simulator.device)

    def advance(self, before: State, after: State, tape: Tape | None = None) -> None:
        """Simulate one frame, from one state to another.

        Args:
            before: State at its start.
            after: Where the state at its end goes; may be the same arrays.
            tape: Where each substep's state and velocity before contact go.
        """
        simulator = self._simulator
        walk = self._walks.get(tape is None)
        if walk is None:
            walk = self._walks[tape is None] = self.walk(
                advance_parts,
                [simulator.world, self.parts, *simulator.material, *simulator.controls, *before],
                [self.material, self.state, self._force, self.no_tape, *after, self._first],
            )
        state, free_tape = (self.state, self.no_tape) if tape is None else tape
        walk.aim(
            position=before[0],
            velocity=before[1],
            state_out=state,
            free_tape_out=free_tape,
            position_out=after[0],
            velocity_out=after[1],
        )
        walk.run(self.threads)
        told = simulator.first_divergence.numpy()
        told[0] = min(told[0], *self._first.numpy())

    def walk(self, kernel: Any, *arguments: list[Any]) -> Walk:
        """Prepare the launches of a kernel over the substeps of a frame."""
        simulator = self._simulator
        inputs = [value for part in arguments for value in part]
        return Walk(kernel, simulator.parameters.substeps_per_frame, inputs, simulator.device)


def tape_layout(places: int, nodes: int, substeps: int) -> Layout:
    """Say what is kept of a frame: states in all places, and velocities before contact.

    Args:
        places: Nodes, and control nodes once for each part that they hold.
        nodes: Object nodes.
        substeps: In a frame.
    """
    return ((substeps + 1, places), _RECORD), ((substeps, nodes), wp.vec4)


class ThreadedAdjoint:
    """Simulates frames and carries derivatives back; as `FrameAdjoint`, by threads."""

    def __init__(self, simulator: Stage, engine: Threaded) -> None:
        """Make room for the derivatives.

        Args:
            simulator: Whose frames; its controls, material and world are read, its state moved.
            engine: The simulator's.
        """
        self._engine = engine
        model, parts = simulator.model, engine.partition
        nodes, held = model.node_count, len(parts.control)
        substeps = simulator.parameters.substeps_per_frame
        self.layout = tape_layout(parts.place_count, nodes, substeps)
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
            ("start", held, wp.vec3),
            ("end", held, wp.vec3),
        ):
            setattr(self._bars, name, engine.zeros(shape, dtype))
        self._walk_back = engine.walk(
            retract_parts,
            [simulator.world, engine.parts, *simulator.material, engine.material],
            [engine.state, engine.no_tape, self._bars, self.position_bar, self.velocity_bar],
            [*self.sums.material, self.sums.drag, *self.sums.ground],
        )

    @staticmethod
    def of(simulator: Stage, engine: Any) -> "ThreadedAdjoint | None":
        """Make one for a simulator; none if its engine is another, or nodes collide."""
        if not isinstance(engine, Threaded) or simulator.parameters.self_collision:
            return None
        return ThreadedAdjoint(simulator, engine)

    def record(self, tape: Tape) -> None:
        """Advance the simulator by one frame and keep its substeps in `tape`."""
        self._engine.advance(self._state, self._state, tape)

    def carry(self, tape: Tape) -> None:
        """Carry `position_bar` and `velocity_bar` back; see `FrameAdjoint.carry`."""
        engine = self._engine
        state, free_tape = tape
        self._walk_back.aim(state=state, free_tape=free_tape)
        self._walk_back.run(engine.threads)
        # A control node has a place in each part that it holds.
        for bar, held in zip(self.sums.controls, (self._bars.start, self._bars.end), strict=True):
            bar.zero_()
            np.add.at(bar.numpy(), engine.partition.control, held.numpy())
