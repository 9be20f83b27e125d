"""The arrays of many candidates on a CUDA device."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import warp as wp
from jaxtyping import Float, Float32, Int
from numpy import ndarray

from physhandi.simulation.batch_losses import LossSum, MotionTarget
from physhandi.simulation.kernels.batch import (
    FIELDS,
    block_threads,
    make_batch_kernel,
    note_divergence,
    place_batch,
    take_batch,
)
from physhandi.simulation.master import MasterTopology
from physhandi.simulation.model import SimulationParameters
from physhandi.simulation.partition import bisect_nodes
from physhandi.simulation.recording import Recording
from physhandi.simulation.simulator import SPEED_LIMIT

_BUSY_WARPS = 24
"""Warps that a multiprocessor needs to be busy."""
BLOCK_NODES = 4
"""Nodes are ordered so that so many neighbours in memory are neighbours in space."""

batch_kernel = lru_cache(maxsize=None)(make_batch_kernel)


@dataclass(frozen=True, eq=False)
class BatchRollout:
    """The motion of every candidate."""

    position: Float32[ndarray, "candidate frame node 3"]
    """Positions of the object nodes [m]; not finite or far away after a divergence."""
    diverged_frame: Int[ndarray, " candidate"]
    """First frame in which a node was not finite or too fast; -1 where none was."""


@dataclass(frozen=True, eq=False)
class BatchLosses:
    """How far every candidate's motion is from what was observed."""

    loss: Float[ndarray, " candidate"]
    """Mean over the frames after frame 0 [m²]; infinite where the candidate diverged."""
    diverged_frame: Int[ndarray, " candidate"]
    """First frame in which a node was not finite or too fast; -1 where none was."""


class Population:
    """The arrays of a batch of candidates on a CUDA device, where one launch moves them all."""

    def __init__(
        self,
        master: MasterTopology,
        parameters: tuple[SimulationParameters, ...],
        substeps: int,
        device: Any,
    ) -> None:
        self._device = device
        self._substeps = substeps
        self._count = len(parameters)
        self._nodes = len(master.object_node)
        # More candidates a thread share more of the reading, but small batches need all threads.
        self._each = 1 if self._count <= 64 else 2
        self._width = 32 * self._each
        self._groups = -(-self._count // self._width)
        # A few candidates of a small object leave most of the device idle: more warps a node then.
        wanted = _BUSY_WARPS * device.sm_count / (self._groups * max(self._nodes, 1))
        self._parts = next((parts for parts in (1, 8, 16) if parts >= wanted), 32)
        # Candidates with like reach share a group, so that few of them wait for others.
        reach = np.array([(p.connection_radius, p.virtual_connection_radius) for p in parameters])
        self._order = np.lexsort(reach.T[::-1])
        lanes = np.full(self._groups * self._width, self._order[-1])
        lanes[: self._count] = self._order
        numbers = [[_number(parameters[i], name, substeps) for i in lanes] for name in FIELDS]
        table = np.array(numbers, dtype=np.float32).reshape(len(FIELDS), self._groups, self._width)
        group_reach = reach[lanes].reshape(self._groups, self._width, 2).max(axis=1)
        limit = np.array([(p.connection_radius, p.max_neighbors) for p in parameters])
        group_limit = limit[lanes].reshape(self._groups, self._width, 2).min(axis=1)
        blocks = max(1, self._nodes // BLOCK_NODES)
        self._model_node = bisect_nodes(master.object_node, blocks)[0]
        rest_length = master.rest_length(parameters[0])
        self._inputs = [
            self._array(table.swapaxes(0, 1).ravel(), wp.float32),
            self._array(group_reach.T.astype(np.float32), wp.float32),
            *self._entries(master, rest_length, group_reach[:, 0], group_limit),
            *self._held(master, rest_length),
        ]
        self._node_of = self._array(self._model_node.astype(np.int32), wp.int32)
        size = len(lanes) * self._nodes * 6
        self._state = [wp.zeros(size, dtype=wp.float32, device=device) for _ in range(2)]
        self._controls = [
            wp.zeros(master.control_count, dtype=wp.vec3, device=device) for _ in range(2)
        ]
        self._start = [
            self._array(value, wp.vec3) for value in (master.object_node, master.initial_velocity)
        ]
        self._diverged = wp.zeros(len(lanes), dtype=wp.int32, device=device)
        self._diverged_frame = wp.zeros(len(lanes), dtype=wp.int32, device=device)
        self._frame = Recording(self._launch_frame, device)

    def rollout(self, control: Float32[ndarray, "frame control 3"]) -> BatchRollout:
        """Simulate all frames; the host waits once, at the end."""
        shape = (len(control), self._count, self._nodes)
        found = wp.zeros(shape, dtype=wp.vec3, device=self._device)
        for frame in self._frames(control):
            self._launch(
                take_batch,
                (self._nodes, self._count),
                [self._width, self._node_of, self._state[0]],
                [found[frame]],
            )
        position = np.empty((self._count, len(control), self._nodes, 3), dtype=np.float32)
        position[self._order] = found.numpy().swapaxes(0, 1)
        return BatchRollout(position, self._by_candidate(self._diverged_frame))

    def losses(
        self, control: Float32[ndarray, "frame control 3"], target: MotionTarget
    ) -> BatchLosses:
        """Simulate the frames that were observed and compare; the host waits once, at the end."""
        number = np.empty(self._nodes, dtype=np.int64)
        number[self._model_node] = np.arange(self._nodes)
        lanes = len(self._diverged)
        losses = LossSum(target, number, lanes=lanes, width=self._width, device=self._device)
        for frame in self._frames(control[: target.frame_count]):
            losses.add(frame, self._state[0], self._diverged_frame)
        return BatchLosses(
            self._by_candidate(losses.loss), self._by_candidate(self._diverged_frame)
        )

    def _frames(self, control: Float32[ndarray, "frame control 3"]) -> Iterator[int]:
        """Simulate frame by frame, without waiting for the device."""
        path = self._array(control.reshape(-1, 3), wp.vec3)
        self._diverged_frame.fill_(-1)
        self._diverged.zero_()
        self._launch(
            place_batch,
            (self._nodes, len(self._diverged)),
            [self._width, self._node_of, *self._start],
            [self._state[0]],
        )
        for frame in range(len(control)):
            if frame > 0:
                for place, source in zip(self._controls, (frame - 1, frame), strict=True):
                    count = len(place)
                    if count:
                        wp.copy(place, path, src_offset=source * count, count=count)
                self._frame.replay()
                self._launch(
                    note_divergence,
                    len(self._diverged),
                    [frame, self._diverged],
                    [self._diverged_frame],
                )
            yield frame

    def _by_candidate(self, value: wp.array) -> ndarray:
        found = value.numpy()[: self._count]
        ordered = np.empty_like(found)
        ordered[self._order] = found
        return ordered

    def _launch_frame(self) -> None:
        threads = 32 * self._parts * self._groups * self._nodes
        for substep in range(self._substeps):
            before, after = self._state[substep % 2], self._state[(substep + 1) % 2]
            fraction = (substep + 1) / self._substeps
            self._launch(
                batch_kernel(self._each, self._parts),
                threads,
                [self._groups, fraction, *self._inputs, *self._controls, before],
                [after, self._diverged],
            )
        if self._substeps % 2:
            wp.copy(self._state[0], self._state[1])

    def _launch(self, kernel: Any, dim: Any, inputs: list[Any], outputs: list[Any]) -> None:
        wp.launch(
            kernel,
            dim=dim,
            inputs=inputs,
            outputs=outputs,
            block_dim=block_threads(self._parts),
            device=self._device,
        )

    def _entries(
        self,
        master: MasterTopology,
        rest_length: ndarray,
        reach: Float[ndarray, " group"],
        limit: Float[ndarray, "group 2"],
    ) -> list[wp.array]:
        """List object half-edges, the nearest neighbor of a node first, and where groups end.

        Up to a certain one every candidate of a group has all of them: those before the first
        that is beyond the group's smallest radius or neighbor limit.
        """
        ends = self._numbered(master.spring_nodes[: master.object_spring_count])
        spring = np.tile(np.arange(len(ends)), 2)
        source, other = np.concatenate([ends, ends[:, ::-1]]).T
        start, order = self._sorted(source, master.length[spring])
        other, spring, source = other[order], spring[order], source[order]
        length, rank = master.length[spring], master.rank[spring]
        end, certain = [], []
        for far, (radius, most) in zip(reach, limit, strict=True):
            end.append(start[:-1] + np.bincount(source[length < far], minlength=self._nodes))
            doubtful = np.flatnonzero((length >= radius) | (rank >= most))
            first = end[-1].copy()
            np.minimum.at(first, source[doubtful], doubtful)
            certain.append(first)
        return [
            self._array(start.astype(np.int32), wp.int32),
            self._array(np.array(certain, dtype=np.int32), wp.int32),
            self._array(np.array(end, dtype=np.int32), wp.int32),
            *self._springs(master, rest_length, other, spring),
        ]

    def _held(self, master: MasterTopology, rest_length: ndarray) -> list[wp.array]:
        """List virtual springs by object node, the nearest control node first."""
        spring = np.arange(master.object_spring_count, len(master.length))
        ends = np.sort(master.spring_nodes[spring], axis=1)
        source, control = self._numbered(ends[:, 0]), ends[:, 1] - self._nodes
        start, order = self._sorted(source, master.length[spring])
        lists = self._springs(master, rest_length, control[order], spring[order])
        return [self._array(start.astype(np.int32), wp.int32), *lists]

    def _numbered(self, node: Int[ndarray, "*ends"]) -> Int[ndarray, "*ends"]:
        """Turn the model's numbers of object nodes into those of the batch."""
        number = np.empty(self._nodes, dtype=np.int64)
        number[self._model_node] = np.arange(self._nodes)
        return number[node]

    def _sorted(
        self, source: Int[ndarray, " entry"], length: Float[ndarray, " entry"]
    ) -> tuple[Int[ndarray, " node_1"], Int[ndarray, " entry"]]:
        """Order entries by node and length; return where each node's entries begin."""
        order = np.lexsort((length, source))
        return np.searchsorted(source[order], np.arange(self._nodes + 1)), order

    def _springs(
        self, master: MasterTopology, rest_length: ndarray, other: ndarray, spring: ndarray
    ) -> list[wp.array]:
        """List length, rest length, its inverse and the bits of the other end; then ranks."""
        rows = np.empty((len(spring), 4), dtype=np.float32)
        rows[:, 0] = master.length[spring]
        rows[:, 1] = rest_length[spring]
        rows[:, 2] = 1.0 / rest_length[spring]
        rows[:, 3] = other.astype(np.int32).view(np.float32)
        return [self._array(rows, wp.vec4), self._array(master.rank[spring], wp.int32)]

    def _array(self, value: ndarray, dtype: Any) -> wp.array:
        return wp.array(np.ascontiguousarray(value), dtype=dtype, device=self._device)


def _number(parameters: SimulationParameters, name: str, substeps: int) -> float:
    """Give one of the kernel's numbers of a candidate."""
    duration = 1.0 / parameters.simulated_frame_rate
    height = parameters.ground_height
    scale = parameters.stiffness_scale
    derived = {
        "dt": duration / substeps,
        "velocity_loss": replace(parameters, substeps_per_frame=substeps).velocity_loss(),
        "has_ground": float(height is not None),
        "ground_height": 0.0 if height is None else height,
        "control_rate": parameters.simulated_frame_rate * parameters.use_control_velocity,
        "speed_limit": SPEED_LIMIT,
        "stiffness": scale * parameters.stiffness,
        "virtual_stiffness": scale * parameters.virtual_stiffness,
        "damping": parameters.damping * (parameters.stiffness > 0.0),
        "virtual_damping": parameters.damping * (parameters.virtual_stiffness > 0.0),
    }
    return float(derived.get(name, getattr(parameters, name, 0.0)))
