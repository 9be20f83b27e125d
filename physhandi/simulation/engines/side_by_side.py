"""Simulates a few candidates of one object as bodies side by side: one launch a frame for all.

Each body has blocks of its own, which wait for each other within a frame as those of a single
model do (`engines.cuda`). For tens of candidates of hundreds of nodes that is two to four times as
fast as one launch a substep (`engines.batch.Population`). Where more than `FEW_OWN` nodes come to a
block, blocks that several candidates share are faster (`engines.batch_blocks`).
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
import warp as wp
from jaxtyping import Bool, Float32, Int, Int32
from numpy import ndarray

from physhandi.simulation.engines.cuda import LEAST_OWN, CudaEngine, most_large_locals
from physhandi.simulation.engines.partition import Partition, bisect_nodes
from physhandi.simulation.kernels.batch.substep import (
    hold_springs,
    interleave_states,
    note_first_divergence,
)
from physhandi.simulation.kernels.cuda_frame import FORWARD_LOCALS
from physhandi.simulation.kernels.world import World
from physhandi.simulation.master_topology import MasterTopology
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.simulator import NO_DIVERGENCE, world_array

_WORLD: Any = World
LEAST_BLOCKS, FEW_OWN, MOST_OWN = 2, 512, 1024
"""Fewest blocks of a body, nodes of a block up to which nothing is faster, and most nodes of one;
beyond, interleaved candidates are faster."""


class MasterHalfEdges:
    """The half-edges of a master topology, cut into the blocks of a body."""

    def __init__(self, master: MasterTopology, blocks: int) -> None:
        """Sort all half-edges once; each candidate takes its part of them.

        Args:
            master: Springs of all candidates.
            blocks: Blocks of each body.
        """
        count = len(master.object_node)
        self.model_node, self.own_start = bisect_nodes(master.object_node, blocks)
        number = np.arange(count + master.control_count)
        number[self.model_node] = np.arange(count)
        ends = number[master.spring_nodes]
        source, other = np.concatenate([ends, ends[:, ::-1]]).T
        spring = np.tile(np.arange(len(ends)), 2)
        own = np.flatnonzero(source < count)
        own = own[np.lexsort((other[own], source[own]))]
        self._source, self._other, self._spring = source[own], other[own], spring[own]
        block = np.repeat(np.arange(blocks), np.diff(self.own_start))
        self._block = block[self._source]
        is_inner = self._other < count
        is_inner[is_inner] = block[self._other[is_inner]] == self._block[is_inner]
        self._is_beyond = ~is_inner
        width = len(number)
        keys, pair = np.unique(
            (self._block * width + self._other)[self._is_beyond], return_inverse=True
        )
        self._pair = np.full(len(own), -1)
        self._pair[self._is_beyond] = pair.reshape(-1)
        self._halo_block, self._halo_node = np.divmod(keys, width)
        self._count = count

    def of(self, exists: Bool[ndarray, " spring"]) -> Partition:
        """Cut a candidate into blocks, as `partition_model` does; none speaks for its springs.

        Args:
            exists: The springs that it has.
        """
        present = np.flatnonzero(exists[self._spring])
        source, other, block = self._source[present], self._other[present], self._block[present]
        beyond, pair = self._is_beyond[present], self._pair[present]
        used = np.zeros(len(self._halo_block), dtype=bool)
        used[pair[beyond]] = True
        blocks = len(self.own_start) - 1
        halo_count = np.bincount(self._halo_block[used], minlength=blocks)
        halo_start = np.concatenate([[0], np.cumsum(halo_count)])
        own_count = np.diff(self.own_start)
        local = other - self.own_start[block]
        rank = np.append(np.cumsum(used) - 1, 0)
        local[beyond] = (own_count[block] - halo_start[block] + rank[pair])[beyond]
        local_start = self.own_start + halo_start
        local_node = np.empty(local_start[-1], dtype=np.int64)
        is_own = np.zeros(len(local_node), dtype=bool)
        for begin, size in zip(local_start, own_count, strict=False):
            is_own[begin : begin + size] = True
        local_node[is_own] = np.arange(self._count)
        local_node[~is_own] = self._halo_node[used]
        number = np.cumsum(exists) - 1
        return Partition(
            own_start=self.own_start.astype(np.int32),
            model_node=self.model_node.astype(np.int32),
            local_start=local_start.astype(np.int32),
            local_node=local_node.astype(np.int32),
            entry_start=np.searchsorted(source, np.arange(self._count + 1)).astype(np.int32),
            entry=np.stack([local, number[self._spring[present]]], axis=1).astype(np.int32),
            is_first=np.zeros(len(present), dtype=np.int32),
        )


def join_partitions(parts: list[Partition], node_count: int, spring_counts: list[int]) -> Partition:
    """Number the blocks, nodes and springs of bodies one after the other; controls are shared.

    Args:
        parts: Partition of each body.
        node_count: Nodes of each body.
        spring_counts: Springs of each.
    """

    def starts(name: str) -> Int32[ndarray, " start"]:
        counts = [np.diff(getattr(part, name)) for part in parts]
        return np.concatenate([[0], np.cumsum(np.concatenate(counts))]).astype(np.int32)

    nodes = node_count * len(parts)
    springs = np.cumsum([0, *spring_counts])
    local, entry = [], []
    for body, part in enumerate(parts):
        is_control = part.local_node >= node_count
        local.append(part.local_node + np.where(is_control, nodes - node_count, body * node_count))
        entry.append(part.entry + np.array([0, springs[body]]))
    models = [part.model_node + body * node_count for body, part in enumerate(parts)]
    return Partition(
        own_start=starts("own_start"),
        model_node=np.concatenate(models).astype(np.int32),
        local_start=starts("local_start"),
        local_node=np.concatenate(local).astype(np.int32),
        entry_start=starts("entry_start"),
        entry=np.concatenate(entry).astype(np.int32),
        is_first=np.concatenate([part.is_first for part in parts]),
    )


class SideBySide:
    """Candidates on a CUDA device as bodies that one launch moves by a frame."""

    def __init__(  # noqa: PLR0917  (what `of` is given, then what it found)
        self,
        master: MasterTopology,
        parameters: tuple[SimulationParameters, ...],
        substeps: int,
        device: Any,
        partition: Partition,
        springs: list[Int[ndarray, " spring"]],
    ) -> None:
        """Copy the bodies to the device; see `of`."""
        self.device = device
        self.parameters = parameters[0].replace(substeps_per_frame=substeps)
        self._count = len(parameters)
        worlds = [p.replace(substeps_per_frame=substeps, stiffness_scale=1.0) for p in parameters]
        self.world = wp.array(world_array(worlds), dtype=_WORLD, device=device)
        self.clearance = self.array(np.tile(master.clearance, self._count), wp.float32)
        self.first_divergence = wp.zeros(self._count, dtype=wp.int32, device=device)
        self.nodes = len(master.object_node)
        self._start = [
            self.array(np.tile(value, (self._count, 1)), wp.vec3)
            for value in (master.object_node, master.initial_velocity)
        ]
        self._state = [wp.zeros_like(value) for value in self._start]
        self._controls = [
            wp.zeros(master.control_count, dtype=wp.vec3, device=device) for _ in range(2)
        ]
        rest_length = master.rest_length(parameters[0])
        stiffness, damping, attached = [], [], []
        for each, part in zip(parameters, springs, strict=True):
            is_object = part < master.object_spring_count
            force = np.where(is_object, each.stiffness, each.virtual_stiffness)
            stiffness.append(each.stiffness_scale * force)
            damping.append(np.where(force > 0.0, each.damping, 0.0))
            interval = np.tile(np.array([-1, NO_DIVERGENCE]), (len(part), 1))
            interval[~is_object] = master.attached[part[~is_object] - master.object_spring_count]
            attached.append(interval)
        self._full = [
            self.array(np.concatenate(value).astype(np.float32), wp.float32)
            for value in (stiffness, damping)
        ]
        self._material = [wp.clone(value) for value in self._full]
        self._rest_length = self.array(rest_length[np.concatenate(springs)], wp.float32)
        self._attached = self.array(np.concatenate(attached).astype(np.int32), wp.vec2i)
        blocks = partition.block_count // self._count
        self._engine = CudaEngine(self, partition, np.repeat(np.arange(self._count), blocks))

    @classmethod
    def of(
        cls,
        master: MasterTopology,
        parameters: tuple[SimulationParameters, ...],
        substeps: int,
        device: Any,
        *,
        most_own: int = MOST_OWN,
    ) -> "SideBySide | None":
        """Create one; None if the bodies are too many or too large for the device.

        Args:
            master: Springs of all candidates.
            parameters: The candidates.
            substeps: Of a frame, for all.
            device: Warp device.
            most_own: Most nodes of a block.
        """
        nodes = len(master.object_node)
        blocks = min(int(device.sm_count) // len(parameters), max(1, nodes // LEAST_OWN))
        if blocks < LEAST_BLOCKS or nodes > most_own * blocks:
            return None
        edges = MasterHalfEdges(master, blocks)
        exists = [master.has(each) for each in parameters]
        springs = [np.flatnonzero(each) for each in exists]
        parts = [edges.of(each) for each in exists]
        joined = join_partitions(parts, nodes, [len(part) for part in springs])
        if joined.most_locals > max(FORWARD_LOCALS, most_large_locals(device)):
            return None
        return cls(master, parameters, substeps, device, joined, springs)

    @property
    def material(self) -> tuple[wp.array, wp.array, wp.array]:
        """Rest length, stiffness and damping of every spring."""
        return self._rest_length, self._material[0], self._material[1]

    @property
    def controls(self) -> tuple[wp.array, wp.array]:
        """Positions of the control nodes at the start and the end of the frame [m]."""
        return self._controls[0], self._controls[1]

    def array(self, value: ndarray, dtype: Any) -> wp.array:
        """Copy an array to the device."""
        return wp.array(np.ascontiguousarray(value), dtype=dtype, device=self.device)

    def frames(
        self, control: Float32[ndarray, "frame control 3"]
    ) -> Iterator[tuple[int, wp.array, wp.array]]:
        """Simulate frame by frame, without waiting for the device.

        Args:
            control: Positions of the control nodes [m].

        Yields:
            Frame, the states of all bodies as `kernels.batch.substep` interleaves groups of one,
            and the frame in which each diverged, -1 for none.
        """
        path = self.array(control.reshape(-1, 3), wp.vec3)
        state = wp.zeros(6 * self._count * self.nodes, dtype=wp.float32, device=self.device)
        diverged = wp.full(self._count, -1, dtype=wp.int32, device=self.device)
        self.first_divergence.fill_(NO_DIVERGENCE)
        for target, source in zip(self._state, self._start, strict=True):
            wp.copy(target, source)
        position, velocity = self._state
        for frame in range(len(control)):
            if frame > 0:
                for place, source in zip(self._controls, (frame - 1, frame), strict=True):
                    if len(place):
                        count = len(place)
                        wp.copy(place, path, src_offset=source * count, count=count)
                inputs = [frame, self._attached, *self._full]
                self._launch(hold_springs, len(self._attached), inputs, self._material)
                self._engine.advance((position, velocity), (position, velocity))
                inputs = [frame, NO_DIVERGENCE, self.first_divergence]
                self._launch(note_first_divergence, self._count, inputs, [diverged])
            inputs = [position, velocity]
            self._launch(interleave_states, len(position), inputs, [state])
            yield frame, state, diverged

    def _launch(self, kernel: Any, dim: int, inputs: list[Any], outputs: list[Any]) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)
