"""The CUDA engine: a frame, or its adjoint, in one launch, for models whose blocks fit.

`CudaEngine` keeps blocks in static shared memory; larger blocks use `LargeFrames`. `CudaAdjoint`
differentiates.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import warp as wp
from jaxtyping import Int32
from numpy import ndarray

from physhandi.simulation.engines.frame_sums import FrameSums
from physhandi.simulation.engines.host import EngineHost, FrameHost
from physhandi.simulation.engines.partition import Partition, partition_model
from physhandi.simulation.engines.tape import Tape
from physhandi.simulation.engines.tape import TapeLayout as TapeLayout
from physhandi.simulation.kernels.cuda_adjoint import (
    ADJOINT_LOCALS,
    make_adjoint_kernel,
    sum_controls,
)
from physhandi.simulation.kernels.cuda_frame import FORWARD_LOCALS, make_frame_kernel
from physhandi.simulation.kernels.cuda_large_frame import (
    FLOATS_OF_A_LOCAL,
    make_large_frame_kernel,
    pack_half_edges,
)
from physhandi.simulation.kernels.half_edges import WARP, arrange_half_edges

LEAST_OWN = 4
"""Nodes of a block; with fewer, synchronisation costs more than the parallel work saves."""
MOST_LANES = 576
"""Bound on a block's nodes times the threads of each."""
MOST_KEPT = 6
"""Most half-edges that a thread keeps in registers."""
BLOCK_SIZES = (256, 384, 576, 768)
"""Threads of a block; few sizes, because each is compiled separately."""
_LAST_TAG = 2**31 - 2**20
frame_kernel = lru_cache(maxsize=None)(make_frame_kernel)
adjoint_kernel = lru_cache(maxsize=None)(make_adjoint_kernel)

LARGE_BLOCK_SIZES = {512: 14, 768: 6}
"""Large frames: threads of a block, and the most half-edges for which each has registers."""
LANES_PER_NODE = (8, 4, 2, 1)
"""Large frames: threads that may sum one node's springs."""
LOCALS_STEP = 512
"""Large frames: step of the number of local nodes, so that few sizes are compiled."""
_BYTES_OF_A_LOCAL = 4 * FLOATS_OF_A_LOCAL
BYTES_OF_A_THREAD = 4
"""Shared memory that Warp itself uses for each thread [B]."""
large_frame_kernel = lru_cache(maxsize=None)(make_large_frame_kernel)


@dataclass(frozen=True, kw_only=True, eq=False)
class HalfEdgeColumns:
    """Columns of 32 half-edges, one for each thread of a warp, group by group.

    A block with more nodes than rows of threads processes them in chunks. A group is the work of
    one warp in one chunk; it has as many columns as its thread with the most half-edges.
    """

    chunk_count: int
    """Chunks of each block."""
    start: wp.array
    """Start of each group's half-edges: block by block, chunk by chunk, warp by warp; and the end
    of all. Numbers of groups and one more."""
    place: wp.array
    """Place of the other end in the block's part of `local_node`; padding ends where it begins."""
    spring: wp.array
    """Number of its spring; -1 for padding."""


def arrange_columns(
    partition: Partition, tables: list[wp.array], lanes: int, threads: int
) -> HalfEdgeColumns:
    """Assign half-edges to threads.

    Args:
        partition: Blocks and their nodes' half-edges.
        tables: Its `own_start`, `entry_start` and `entry` on the device.
        lanes: Threads that sum one node's springs; divides 32.
        threads: Threads of a block; a multiple of 32.
    """
    rows, warps = threads // lanes, threads // WARP
    chunks = -(-partition.most_own // rows)
    block = np.repeat(np.arange(partition.block_count), np.diff(partition.own_start))
    chunk, row = np.divmod(np.arange(len(block)) - partition.own_start[block], rows)
    group = (block * chunks + chunk) * warps + row * lanes // WARP
    count = np.zeros(partition.block_count * chunks * warps, dtype=np.int64)
    np.maximum.at(count, group, -(-np.diff(partition.entry_start) // lanes))
    start = WARP * np.concatenate([[0], np.cumsum(count)])
    device = tables[0].device
    starts = wp.array(start.astype(np.int32), dtype=wp.int32, device=device)
    place, spring = (wp.empty(int(start[-1]), dtype=wp.int32, device=device) for _ in range(2))
    wp.launch(
        arrange_half_edges,
        dim=(len(count), WARP),
        inputs=[chunks, warps, lanes, *tables, starts],
        outputs=[place, spring],
        device=device,
    )
    return HalfEdgeColumns(chunk_count=chunks, start=starts, place=place, spring=spring)


def most_large_locals(device: Any) -> int:
    """Return how many nodes, own and halo, fit the shared memory of a block."""
    free = int(device.max_shared_memory_per_block) - BYTES_OF_A_THREAD * max(LARGE_BLOCK_SIZES)
    return max(0, free // _BYTES_OF_A_LOCAL)


@dataclass(frozen=True)
class LargeLayout:
    """Launch configuration of a large frame."""

    lanes: int
    """Threads that sum one node's springs."""
    in_registers: int
    """Half-edges that each of them keeps in registers."""
    threads: int
    """Threads of a block."""
    locals: int
    """Nodes for which a block reserves shared memory."""

    @classmethod
    def of(cls, partition: Partition, most_locals: int) -> "LargeLayout":
        """Use the most lanes with which all nodes of a block are processed at once.

        Args:
            partition: Blocks of nodes.
            most_locals: Nodes for which the device has room.
        """
        own = partition.most_own
        lanes = next(
            (n for n in LANES_PER_NODE if own * n <= max(LARGE_BLOCK_SIZES)), LANES_PER_NODE[-1]
        )
        threads = next((n for n in LARGE_BLOCK_SIZES if own * lanes <= n), max(LARGE_BLOCK_SIZES))
        in_registers = max(1, min(LARGE_BLOCK_SIZES[threads], -(-partition.most_entries // lanes)))
        steps = -(-partition.most_locals // LOCALS_STEP)
        return cls(lanes, in_registers, threads, min(steps * LOCALS_STEP, most_locals))


class LargeFrames:
    """The half-edges of one model as the large frame kernel reads them."""

    def __init__(
        self,
        simulator: FrameHost,
        partition: Partition,
        tables: list[wp.array],
        *,
        few_kernels: bool,
    ) -> None:
        """Arrange the half-edges on the device.

        Args:
            simulator: Its state, controls, material and world are read and written.
            partition: Blocks of its model; they must fit the device.
            tables: See `arrange_columns`.
            few_kernels: Whether one kernel serves models that keep different numbers of half-edges.
        """
        self._simulator = simulator
        self._block_count = partition.block_count
        self.layout = LargeLayout.of(partition, most_large_locals(simulator.device))
        if few_kernels:
            self.layout = replace(self.layout, in_registers=MOST_KEPT)
        lanes, threads = self.layout.lanes, self.layout.threads
        self._columns = arrange_columns(partition, tables, lanes, threads)
        self._packed = wp.zeros(len(self._columns.place), dtype=wp.vec4, device=simulator.device)

    def advance(
        self,
        blocks: list[wp.array],
        relay: wp.array,
        tag: int,
        before: tuple[wp.array, wp.array],
        after: tuple[wp.array, wp.array],
    ) -> None:
        """Launch one frame, from one state (position, velocity) to another.

        Args:
            blocks: The body of each block, then the partition's `own_start`, `local_start`,
                `local_node` and `model_node`.
            relay: Where blocks publish their nodes.
            tag: First of as many unused tags as substeps, and one more.
            before: State at its start.
            after: Where the state at its end goes; may be the same arrays.
        """
        simulator, layout, columns = self._simulator, self.layout, self._columns
        # Material and world may have changed on the device; packing is cheap beside a frame.
        wp.launch(
            pack_half_edges,
            dim=len(columns.place),
            inputs=[simulator.world, columns.place, columns.spring, *simulator.material],
            outputs=[self._packed],
            device=simulator.device,
        )
        inputs: list[Any] = [columns.chunk_count, simulator.parameters.substeps_per_frame, tag]
        body, *places = blocks
        inputs += [simulator.world, body, simulator.clearance, *places]
        inputs += [columns.start, self._packed]
        wp.launch(
            large_frame_kernel(layout.lanes, layout.in_registers, layout.threads, layout.locals),
            dim=self._block_count * layout.threads,
            inputs=[*inputs, *simulator.controls, *before],
            outputs=[relay, *after, simulator.first_divergence],
            block_dim=layout.threads,
            device=simulator.device,
        )


@dataclass(frozen=True)
class BlockLayout:
    """Launch configuration of a frame."""

    lanes: int
    """Threads that sum one node's springs."""
    in_registers: int
    """Half-edges that each of them keeps in registers."""
    threads: int
    """Threads of a block."""

    @classmethod
    def of(cls, partition: Partition) -> "BlockLayout":
        """Choose by measurement (docs/benchmarks): many lanes, but few idle threads."""
        wide = (n for n in (32, 16) if partition.most_own * n <= MOST_LANES)
        lanes = next((n for n in wide if n < 2 * partition.most_entries), 8)
        in_registers = max(1, min(MOST_KEPT, -(-partition.most_entries // lanes)))
        needed = partition.most_own * lanes
        return cls(
            lanes, in_registers, next((n for n in BLOCK_SIZES if n >= needed), BLOCK_SIZES[-1])
        )

    def holds(self, partition: Partition) -> bool:
        """Tell whether every node has its own threads, and every half-edge a register."""
        has_threads = partition.most_own * self.lanes <= self.threads
        return has_threads and partition.most_entries <= self.lanes * self.in_registers


class Relay:
    """Where blocks of a launch publish values, each under a tag that it never had before."""

    def __init__(self, count: int, device: Any) -> None:
        """Allocate places for values.

        Args:
            count: Places.
            device: Warp device.
        """
        self.value = wp.zeros(count, dtype=wp.vec4, device=device)
        self._tag = 1

    def next_tags(self, count: int) -> int:
        """Reserve tags that no value has; the first of them is returned."""
        if self._tag > _LAST_TAG:
            self.value.zero_()
            self._tag = 1
        self._tag += count
        return self._tag - count


class CudaEngine:
    """The arrays of one model for the CUDA kernels."""

    def __init__(
        self,
        simulator: FrameHost,
        partition: Partition,
        body_of: Int32[ndarray, " block"] | None = None,
    ) -> None:
        """Copy a partition to the device.

        Args:
            simulator: Its state, controls, material and world are read and written.
            partition: Blocks of its model.
            body_of: The body that each block is part of, if there are several that do not touch:
                each has its own world. Their models change often, so few kernels serve all.
        """
        self._simulator = simulator
        self.partition = partition
        self.layout = layout = BlockLayout.of(partition)
        has_many = body_of is not None
        if has_many:
            self.layout = replace(
                layout, in_registers=layout.in_registers + layout.in_registers % 2
            )
        names = ("own_start", "local_start", "local_node", "model_node", "entry_start")
        self._map = [simulator.array(getattr(partition, name), wp.int32) for name in names]
        self._map.append(simulator.array(partition.entry, wp.vec2i))
        bodies = np.zeros(partition.block_count, np.int32) if body_of is None else body_of
        self._body = simulator.array(bodies, wp.int32)
        count = len(partition.model_node)
        self._relay = Relay(4 * count, simulator.device)
        self._no_tape = wp.zeros((0, 0), dtype=wp.vec4, device=simulator.device)
        is_large = partition.most_locals > FORWARD_LOCALS
        is_large = is_large or (has_many and not layout.holds(partition))
        self.large: LargeFrames | None = None
        if is_large:
            tables = [self._map[0], *self._map[4:]]
            self.large = LargeFrames(simulator, partition, tables, few_kernels=has_many)

    @staticmethod
    def of(simulator: EngineHost) -> "CudaEngine | None":
        """Create one for a simulator; None on a CPU, or if the model's blocks do not fit.

        Blocks that fit static shared memory are moved by the kernel that keeps all in registers,
        others by the one of `LargeFrames`, as far as the device has shared memory for them.
        """
        model, device = simulator.model, simulator.device
        if not device.is_cuda or model.node_count == 0:
            return None
        blocks = max(1, min(int(device.sm_count), model.node_count // LEAST_OWN))
        partition = partition_model(model, blocks)
        fits = partition.most_locals <= max(FORWARD_LOCALS, most_large_locals(device))
        return CudaEngine(simulator, partition) if fits else None

    def advance(
        self,
        before: tuple[wp.array, wp.array],
        after: tuple[wp.array, wp.array],
        tape: wp.array | None = None,
    ) -> None:
        """Launch one frame, from one state (position, velocity) to another.

        Args:
            before: State at its start.
            after: Where the state at its end goes; may be the same arrays.
            tape: Where each substep's position, velocity and velocity before contact go.

        Raises:
            ValueError: If a tape is requested for blocks whose adjoint does not fit.
        """
        simulator = self._simulator
        substeps = simulator.parameters.substeps_per_frame
        if self.large is not None:
            if tape is not None:
                raise ValueError("Blocks in dynamic shared memory keep no tape.")
            tag = self._relay.next_tags(substeps + 1)
            self.large.advance([self._body, *self._map[:4]], self._relay.value, tag, before, after)
            return
        self._launch(
            frame_kernel(self.layout.lanes, self.layout.in_registers),
            [self.layout.threads, substeps, self._relay.next_tags(substeps + 1), simulator.world],
            [self._body, simulator.clearance, *self._map, *simulator.material],
            [*simulator.controls, *before],
            [
                self._relay.value,
                self._no_tape if tape is None else tape,
                *after,
                simulator.first_divergence,
            ],
        )

    def launch_adjoint(
        self,
        tape: wp.array,
        is_first: wp.array,
        object_spring_count: int,
        state_bars: list[wp.array],
        bars: list[wp.array],
    ) -> None:
        """Launch the adjoint of one frame.

        Args:
            tape: What `advance` recorded of it.
            is_first: Which half-edges speak for their springs.
            object_spring_count: Number of leading springs that join two object nodes.
            state_bars: Adjoints of position and velocity, from the frame's end to its start.
            bars: Where the other adjoints go, in the kernel's order.
        """
        simulator = self._simulator
        substeps = simulator.parameters.substeps_per_frame
        self._launch(
            adjoint_kernel(self.layout.lanes, self.layout.in_registers),
            [self.layout.threads, substeps, self._relay.next_tags(substeps), simulator.world],
            [simulator.clearance, *self._map, is_first, object_spring_count],
            [*simulator.material, *simulator.controls, tape],
            [*state_bars, self._relay.value, *bars],
        )

    def _launch(self, kernel: Any, *arguments: list[Any]) -> None:
        *inputs, outputs = arguments
        wp.launch(
            kernel,
            dim=self.partition.block_count * self.layout.threads,
            inputs=[value for part in inputs for value in part],
            outputs=outputs,
            block_dim=self.layout.threads,
            device=self._simulator.device,
        )


def cuda_tape_layout(nodes: int, substeps: int) -> TapeLayout:
    """Shape the tape of a frame: position, velocity and velocity before contact, side by side."""
    return (((substeps, 3 * nodes), wp.vec4),)


class CudaAdjoint:
    """Simulates frames and propagates derivatives back; `GraphAdjoint` in one launch each."""

    def __init__(self, simulator: EngineHost, engine: CudaEngine) -> None:
        """Allocate the derivatives.

        Args:
            simulator: Its controls, material and world are read, its state is advanced.
            engine: Engine of the simulator.
        """
        self._engine = engine
        model, device = simulator.model, simulator.device
        nodes = model.node_count
        virtual_count = len(model.spring_nodes) - model.object_spring_count

        def zeros(count: int, dtype: Any) -> wp.array:
            return wp.zeros(count, dtype=dtype, device=device)

        self.layout = cuda_tape_layout(nodes, simulator.parameters.substeps_per_frame)
        self._state = simulator.position, simulator.velocity
        self.position_bar, self.velocity_bar = zeros(nodes, wp.vec3), zeros(nodes, wp.vec3)
        self._held_bars = [zeros(virtual_count, wp.vec3) for _ in range(2)]
        self.sums = FrameSums.zeros(model, device)
        self._is_first = simulator.array(engine.partition.is_first, wp.int32)
        self._object_spring_count = model.object_spring_count
        control = model.spring_nodes[model.object_spring_count :].max(axis=1, initial=0) - nodes
        by_control = np.argsort(control, kind="stable")
        start = np.searchsorted(control[by_control], np.arange(model.control_count + 1))
        self._held = [
            simulator.array(start.astype(np.int32), wp.int32),
            simulator.array(by_control.astype(np.int32), wp.int32),
        ]

    @staticmethod
    def of(simulator: EngineHost, engine: Any) -> "CudaAdjoint | None":
        """Create one for a simulator; None with another engine, or if its blocks do not fit."""
        if not isinstance(engine, CudaEngine) or simulator.has_contacts:
            return None
        partition, layout = engine.partition, engine.layout
        fits = partition.most_locals <= ADJOINT_LOCALS and layout.holds(partition)
        return CudaAdjoint(simulator, engine) if fits else None

    def record(self, tape: Tape) -> None:
        """Advance the simulator by one frame and record its substeps in `tape`."""
        self._engine.advance(self._state, self._state, *tape)

    def backward(self, tape: Tape) -> None:
        """Propagate `position_bar` and `velocity_bar` back; see `GraphAdjoint.backward`."""
        sums, (substeps,) = self.sums, tape
        for value in self._held_bars:
            value.zero_()
        self._engine.launch_adjoint(
            substeps,
            self._is_first,
            self._object_spring_count,
            [self.position_bar, self.velocity_bar],
            [*sums.material, sums.drag, *sums.ground, *self._held_bars],
        )
        wp.launch(
            sum_controls,
            dim=len(sums.control_start),
            inputs=[*self._held, *self._held_bars],
            outputs=[*sums.controls],
            device=sums.control_start.device,
        )
