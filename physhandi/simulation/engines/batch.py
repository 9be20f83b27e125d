"""Simulates many candidates of one object together: on CUDA, one launch a substep for all.

`BatchSimulator` is the entry; `Population` holds the candidates on the device, `LossSum` their
losses. Few candidates are moved in one launch a frame instead: side by side
(`engines.side_by_side`), or those of larger objects several to a block (`engines.batch_blocks`).
"""

from collections.abc import Callable, Iterator
from collections.abc import Sequence as Many
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np
import warp as wp
from jaxtyping import Float, Float32, Int
from numpy import ndarray

from physhandi.errors import SimulationDivergedError, UsageError
from physhandi.simulation.contact_intervals import NEVER, acts_in, always
from physhandi.simulation.engines.batch_blocks import BatchBlocks
from physhandi.simulation.engines.cpu import CpuEngine
from physhandi.simulation.engines.graph import LaunchGraph
from physhandi.simulation.engines.partition import bisect_nodes
from physhandi.simulation.engines.side_by_side import FEW_OWN, SideBySide
from physhandi.simulation.kernels.batch.frame import GROUP_WIDTH
from physhandi.simulation.kernels.batch.losses import (
    NODES,
    POINTS_PER_THREAD,
    add_losses,
    find_nearest,
    sum_accelerations,
    sum_chamfer,
    sum_tracks,
)
from physhandi.simulation.kernels.batch.substep import (
    BLOCK_NODES,
    CANDIDATE_FIELDS,
    NO_GROUND,
    block_threads,
    make_batch_kernel,
    note_divergence,
    place_batch,
    take_batch,
)
from physhandi.simulation.master_topology import MasterTopology
from physhandi.simulation.model import checked_control
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.simulator import Simulator

_BUSY_WARPS = 24
"""Warps that keep a multiprocessor busy."""
_BUSY_THREADS, _MOST_SLICES = 2**18, 64
"""Threads that keep a GPU busy, and most slices of an object's surface to get as many."""
_CACHED_BYTES = 40e6
"""States that stay in a GPU's second-level cache, out of 50 MB; what does not waits for memory."""
batch_kernel = lru_cache(maxsize=None)(make_batch_kernel)
_COMMON = ("rest_length_floor", "virtual_rest_length_floor", "frame_rate", "frame_duration")


@dataclass(frozen=True, kw_only=True, eq=False)
class MotionTarget:
    """Weighted observations of an object.

    The loss of a frame is the weighted sum over points of the squared distance to the nearest
    surface node (Chamfer, one way), plus the weighted sum over tracks of the squared distance
    to their simulated positions, plus the weighted acceleration term (physics.md §4.1).
    The loss of a motion is the mean over the frames after frame 0.
    """

    cloud: Float[ndarray, "frame point 3"]
    """Observed points; finite also where the weight is 0 [m]."""
    cloud_weight: Float[ndarray, "frame point"]
    """Weight of each point; 0 on padding."""
    surface_count: int | None
    """Leading nodes that the points are compared with; None for all."""
    track: Float[ndarray, "frame track 3"]
    """Observed tracks; finite also where the weight is 0 [m]."""
    track_weight: Float[ndarray, "frame track"]
    """Weight of each track; 0 where it is not valid."""
    carrier: Int[ndarray, "track carrier"]
    """Nodes that carry each track."""
    carrier_weight: Float[ndarray, "track carrier"]
    """Weight of each carrier; rows sum to one."""
    track_offset: Float[ndarray, "track 3"]
    """Position of a track less the weighted mean of its carriers [m]."""
    acceleration_weight: float = 0.0
    """Weight of PhysTwin's acceleration term."""

    @property
    def frame_count(self) -> int:
        """Number of frames, frame 0 included."""
        return len(self.cloud)


class LossSum:
    """Sums the losses of candidates whose states are interleaved on a device."""

    def __init__(
        self,
        target: MotionTarget,
        node_number: Int[ndarray, " node"],
        *,
        lanes: int,
        width: int,
        device: Any,
    ) -> None:
        """Copy the observations to the device.

        Args:
            target: Observations.
            node_number: Index in the states of each of the model's nodes.
            lanes: Candidates in the states, padding included.
            width: Candidates of a group; see `kernels.batch.substep`.
            device: Warp device.
        """
        self._device, self._lanes = device, lanes
        self._share = 1.0 / max(target.frame_count - 1, 1)
        self._acceleration_weight = target.acceleration_weight
        nodes = len(node_number)
        self._layout = [width, nodes]
        surface = node_number[: target.surface_count]
        points = 0 if len(surface) == 0 else target.cloud.shape[1]
        chunks = -(-points // POINTS_PER_THREAD)
        more = chunks * POINTS_PER_THREAD - points
        padding = np.array([[0, 0], [0, more], [0, 0]])
        cloud = np.pad(target.cloud[:, :points], padding)
        weight = np.pad(target.cloud_weight[:, :points], padding[:2])
        self._cloud = [self._array(surface, wp.int32), self._array(cloud, wp.vec3)]
        self._cloud_weight = self._array(weight, wp.float32)
        # A few candidates keep a GPU busy only if several threads walk over the nodes.
        threads = _BUSY_THREADS if wp.get_device(device).is_cuda else 1
        slices = min(max(threads // max(chunks * lanes, 1), 1), _MOST_SLICES)
        shape = (slices, chunks * POINTS_PER_THREAD, lanes)
        self._nearest = wp.zeros(shape, dtype=wp.float32, device=device)
        self._track = [
            self._array(target.track, wp.vec3),
            self._array(target.track_weight, wp.float32),
            self._array(node_number[target.carrier], wp.int32),
            self._array(target.carrier_weight, wp.float32),
            self._array(target.track_offset, wp.vec3),
        ]
        tracks = target.track.shape[1]
        rest = -(-nodes // NODES) if self._acceleration_weight > 0.0 else 0
        self._parts = wp.zeros((chunks + tracks + rest, lanes), dtype=wp.float32, device=device)
        self._rows = np.cumsum([0, chunks, tracks, rest])
        size = lanes * nodes * 6 if rest else 0
        self._past = [wp.zeros(size, dtype=wp.float32, device=device) for _ in range(2)]
        self.loss = wp.zeros(lanes, dtype=wp.float32, device=device)
        """Loss of each candidate so far [m²]; infinite once it diverged."""

    def add(self, frame: int, state: wp.array, diverged_frame: wp.array) -> None:
        """Add the losses of a frame.

        Args:
            frame: Number of the frame; frame 0 only provides velocities for later differences.
            state: Positions and velocities of all candidates at the end of the frame.
            diverged_frame: Frame in which each candidate diverged; -1 for none.
        """
        if frame > 0:
            slices, points, _ = self._nearest.shape
            wp.launch(
                find_nearest,
                dim=(points // POINTS_PER_THREAD, slices, self._lanes),
                inputs=[frame, *self._layout, slices, *self._cloud, state],
                outputs=[self._nearest],
                device=self._device,
            )
            self._launch(sum_chamfer, 0, [frame, self._cloud_weight, self._nearest])
            self._launch(sum_tracks, 1, [frame, *self._layout, *self._track, state])
            if frame > 1:
                inputs = [self._acceleration_weight, *self._layout, *self._past, state]
                self._launch(sum_accelerations, 2, inputs)
            wp.launch(
                add_losses,
                dim=self._lanes,
                inputs=[self._share, self._parts, diverged_frame],
                outputs=[self.loss],
                device=self._device,
            )
        if len(self._past[0]):
            self._past = self._past[::-1]
            wp.copy(self._past[1], state)

    def _launch(self, kernel: Any, term: int, inputs: list[Any]) -> None:
        begin, end = (int(row) for row in self._rows[term : term + 2])
        if begin < end:
            wp.launch(
                kernel,
                dim=(end - begin, self._lanes),
                inputs=inputs,
                outputs=[self._parts[begin:end]],
                device=self._device,
            )

    def _array(self, value: ndarray, dtype: Any) -> wp.array:
        flat = np.int32 if dtype is wp.int32 else np.float32
        return wp.array(np.ascontiguousarray(value, dtype=flat), dtype=dtype, device=self._device)


@dataclass(frozen=True, eq=False)
class BatchRollout:
    """The motion of every candidate."""

    position: Float32[ndarray, "candidate frame node 3"]
    """Positions of the object nodes [m]; not finite or far away after a divergence."""
    diverged_frame: Int[ndarray, " candidate"]
    """First frame in which a node was not finite or too fast; -1 where none was."""


@dataclass(frozen=True, eq=False)
class BatchLosses:
    """Loss of every candidate."""

    loss: Float[ndarray, " candidate"]
    """Mean over the frames after frame 0 [m²]; infinite where the candidate diverged."""
    diverged_frame: Int[ndarray, " candidate"]
    """First frame in which a node was not finite or too fast; -1 where none was."""


class Population:
    """The arrays of a batch of candidates on a CUDA device; one launch advances them all.

    It advances them by a substep, or by a frame if there are few enough for `BatchBlocks`.
    """

    def __init__(
        self,
        master: MasterTopology,
        parameters: tuple[SimulationParameters, ...],
        substeps: int,
        device: Any,
        *,
        in_blocks: bool = False,
    ) -> None:
        """Copy candidates to the device.

        Args:
            master: Springs of all candidates.
            parameters: The candidates.
            substeps: Of a frame, for all.
            device: Warp device.
            in_blocks: Whether one launch advances them by a frame, if they fit the device so.
        """
        self._device = device
        self._substeps = substeps
        self._count = len(parameters)
        self._nodes = len(master.object_node)
        # Candidates with similar radii share a group, so that few of them wait for others.
        reach = np.array([(p.connection_radius, p.virtual_connection_radius) for p in parameters])
        self._order = np.lexsort(reach.T[::-1])
        self._model_node = _in_blocks(master.object_node)
        self.blocks: BatchBlocks | None = None
        if in_blocks:
            sharing = [parameters[i] for i in self._lanes(GROUP_WIDTH)]
            self.blocks = BatchBlocks.of(master, sharing, self._node_number(), device)
        # More candidates a thread share more memory reads, but small batches need all threads.
        self._each = 1 if self._count <= 64 else 2
        self._width = 32 * self._each if self.blocks is None else GROUP_WIDTH
        lanes = self._lanes(self._width)
        self._groups = len(lanes) // self._width
        self._parts = _warps_of_a_node(self._groups * self._nodes, device)
        table = np.array(
            [[_number(parameters[i], name, substeps) for i in lanes] for name in CANDIDATE_FIELDS],
            dtype=np.float32,
        ).reshape(len(CANDIDATE_FIELDS), self._groups, self._width)
        group_reach = reach[lanes].reshape(self._groups, self._width, 2).max(axis=1)
        limit = np.array([(p.connection_radius, p.max_neighbors) for p in parameters])
        group_limit = limit[lanes].reshape(self._groups, self._width, 2).min(axis=1)
        rest_length = master.rest_length(parameters[0])
        self._inputs = [
            self._array(master.clearance[self._model_node], wp.float32),
            self._array(table.swapaxes(0, 1).ravel(), wp.float32),
            self._array(group_reach.T.astype(np.float32), wp.float32),
        ]
        virtual, start = self._virtual(master)
        if self.blocks is None:
            limits = group_reach[:, 0], group_limit
            self._inputs += self._entries(master, rest_length, *limits, np.diff(start))
        control = master.spring_nodes[virtual].max(axis=1) - self._nodes
        self._inputs += [
            self._array(start.astype(np.int32), wp.int32),
            *self._springs(master, rest_length, control, virtual),
        ]
        self._held_rank = self._inputs[-1]
        self._rank = master.rank[virtual]
        self._attached = master.attached[virtual - master.object_spring_count]
        self._node_of = self._array(self._model_node.astype(np.int32), wp.int32)
        size = len(lanes) * self._nodes * 6
        self._state = [wp.zeros(size, dtype=wp.float32, device=device) for _ in range(2)]
        self._controls = [
            wp.zeros(master.control_count, dtype=wp.vec3, device=device) for _ in range(2)
        ]
        self._start = [
            self._array(value, wp.vec3) for value in (master.object_node, master.initial_velocity)
        ]
        self._diverged, self._diverged_frame = (
            wp.zeros(len(lanes), dtype=wp.int32, device=device) for _ in range(2)
        )
        self._stream = wp.Stream(device)
        self._frame_graphs = self._graphs_of_groups()

    def rollout(self, control: Float32[ndarray, "frame control 3"]) -> BatchRollout:
        """Simulate all frames; the host waits once, at the end."""
        shape = (len(control), self._count, self._nodes)
        positions = wp.zeros(shape, dtype=wp.vec3, device=self._device)
        for frame in self._frames(control):
            self._launch(
                take_batch,
                (self._nodes, self._count),
                [self._width, self._node_of, self._state[0]],
                [positions[frame]],
            )
        position = np.empty((self._count, len(control), self._nodes, 3), dtype=np.float32)
        position[self._order] = positions.numpy().swapaxes(0, 1)
        return BatchRollout(position, self._by_candidate(self._diverged_frame))

    def start_losses(
        self, control: Float32[ndarray, "frame control 3"], target: MotionTarget
    ) -> Callable[[], "BatchLosses"]:
        """Let the device simulate the observed frames and compare; what is given waits for it."""
        lanes, number = len(self._diverged), self._node_number()
        losses = LossSum(target, number, lanes=lanes, width=self._width, device=self._device)
        for frame in self._frames(control[: target.frame_count]):
            losses.add(frame, self._state[0], self._diverged_frame)
        return lambda: BatchLosses(
            self._by_candidate(losses.loss), self._by_candidate(self._diverged_frame)
        )

    def _frames(self, control: Float32[ndarray, "frame control 3"]) -> Iterator[int]:
        """Simulate frame by frame, without waiting for the device."""
        path = self._array(control.reshape(-1, 3), wp.vec3)
        ranks = self._acting_ranks(len(control))
        held = len(self._rank)
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
                if ranks is not None:
                    wp.copy(self._held_rank, ranks, src_offset=frame * held, count=held)
                self._advance()
                self._launch(
                    note_divergence,
                    len(self._diverged),
                    [frame, self._diverged],
                    [self._diverged_frame],
                )
            yield frame

    def _advance(self) -> None:
        """Advance all candidates by a frame."""
        if self.blocks is None:
            # Of two streams each has work while the other one begins or ends a launch.
            streams = [self._device.stream, self._stream]
            streams[1].wait_stream(streams[0])
            for turn, frame in enumerate(self._frame_graphs):
                with wp.ScopedStream(streams[turn % 2], sync_enter=False):
                    frame.replay()
            streams[0].wait_stream(streams[1])
            return
        self.blocks.advance(
            self._substeps,
            *self._state,
            model=self._inputs[:3],
            held=self._inputs[-3:],
            controls=self._controls,
            diverged=self._diverged,
        )
        self._state.reverse()

    def _acting_ranks(self, frame_count: int) -> wp.array | None:
        """List the rank of every virtual spring for every frame; None if all act in all frames.

        One that does not act on the way to a frame has a rank that no limit reaches.
        """
        if np.all(self._attached == always(1)):
            return None
        acts = np.stack([acts_in(self._attached, frame) for frame in range(frame_count)])
        return self._array(np.where(acts, self._rank, NEVER).astype(np.int32).ravel(), wp.int32)

    def _by_candidate(self, value: wp.array) -> ndarray:
        by_lane = value.numpy()[: self._count]
        ordered = np.empty_like(by_lane)
        ordered[self._order] = by_lane
        return ordered

    def _graphs_of_groups(self) -> list[LaunchGraph]:
        """Divide the groups into parts that take a whole frame one after the other.

        Their states stay in the second-level cache then.
        """
        at_once = self._groups
        if self._parts == 1:
            of_group = 2 * self._state[0].capacity / self._groups
            at_once = max(1, int(_CACHED_BYTES / of_group) // 2)
        return [
            LaunchGraph(
                partial(self._launch_frame, first, min(first + at_once, self._groups)),
                self._device,
            )
            for first in range(0, self._groups, at_once)
        ]

    def _launch_frame(self, first: int, end: int) -> None:
        """Launch all substeps of a frame for some groups."""
        places = self._nodes
        if self._parts == 1:
            places = -(-self._nodes // BLOCK_NODES) * BLOCK_NODES
        for substep in range(self._substeps):
            before, after = self._state[substep % 2], self._state[(substep + 1) % 2]
            fraction = (substep + 1) / self._substeps
            self._launch(
                batch_kernel(self._each, self._parts),
                32 * self._parts * (end - first) * places,
                [first, places, fraction, *self._inputs, *self._controls, before],
                [after, self._diverged],
            )
        if self._substeps % 2:
            of_group = 6 * self._width * self._nodes
            place, count = first * of_group, (end - first) * of_group
            wp.copy(*self._state, dest_offset=place, src_offset=place, count=count)

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
        held: Int[ndarray, " node"],
    ) -> list[wp.array]:
        """List object half-edges, the nearest neighbor of a node first, and which a group has.

        For each group and node: where its half-edges begin, where those end that every candidate
        has, where all end, and how many virtual springs hold the node. Every candidate has those
        before the first that is beyond the group's smallest radius or neighbor limit. A half-edge
        says how many bytes after the state of a group's first node that of its other end is, and
        one over the rest length. Then its length and rank.
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
        half_edge = np.empty((len(spring), 2), dtype=np.int32)
        half_edge[:, 0] = 4 * 6 * self._width * other
        half_edge[:, 1] = (1.0 / rest_length[spring]).astype(np.float32).view(np.int32)
        place = np.stack(np.broadcast_arrays(start[:-1], certain, end, held), axis=-1)
        return [
            self._array(place.reshape(-1, 4).astype(np.int32), wp.vec4i),
            self._array(half_edge, wp.vec2i),
            self._array(np.stack([length, rank], axis=1).astype(np.float32), wp.vec2),
        ]

    def _virtual(
        self, master: MasterTopology
    ) -> tuple[Int[ndarray, " virtual"], Int[ndarray, " node_1"]]:
        """Order virtual springs by object node, the shortest first; and where each node's begin."""
        spring = np.arange(master.object_spring_count, len(master.length))
        node = self._numbered(master.spring_nodes[spring].min(axis=1))
        start, order = self._sorted(node, master.length[spring])
        return spring[order], start

    def _numbered(self, node: Int[ndarray, "*ends"]) -> Int[ndarray, "*ends"]:
        """Turn the model's numbers of object nodes into those of the batch."""
        return self._node_number()[node]

    def _node_number(self) -> Int[ndarray, " node"]:
        """Return the index in the states of each of the model's nodes."""
        number = np.empty(self._nodes, dtype=np.int64)
        number[self._model_node] = np.arange(self._nodes)
        return number

    def _lanes(self, width: int) -> Int[ndarray, " lane"]:
        """Return the candidates in groups of a width; the last one fills the last group."""
        lanes = np.full(-(-self._count // width) * width, self._order[-1])
        lanes[: self._count] = self._order
        return lanes

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


def _in_blocks(node: Float32[ndarray, "node 3"]) -> Int[ndarray, " node"]:
    """Order nodes so that each block of `BLOCK_NODES` is compact; the last one may be shorter."""
    blocks = -(-len(node) // BLOCK_NODES)
    # What fills the last block lies beyond all others along every axis.
    filling = np.tile(node.max(axis=0), (blocks * BLOCK_NODES - len(node), 1))
    order = bisect_nodes(np.concatenate([node, filling]), blocks)[0]
    return order[order < len(node)]


def _warps_of_a_node(tasks: int, device: Any) -> int:
    """Return how many warps share a node.

    A few candidates of a small object leave most of the device idle, so nodes get more warps.
    """
    needed = _BUSY_WARPS * device.sm_count / max(tasks, 1)
    return next((parts for parts in (1, 8, 16) if parts >= needed), 32)


def _number(parameters: SimulationParameters, name: str, substeps: int) -> float:
    """Look up one of the kernel's parameters of a candidate."""
    duration = 1.0 / parameters.simulated_frame_rate
    height = parameters.ground_height
    scale = parameters.stiffness_scale
    derived = {
        "dt": duration / substeps,
        "velocity_loss": parameters.replace(substeps_per_frame=substeps).velocity_loss(),
        "ground_height": NO_GROUND if height is None else height,
        "control_rate": parameters.simulated_frame_rate * parameters.use_control_velocity,
        "stiffness": scale * parameters.stiffness,
        "virtual_stiffness": scale * parameters.virtual_stiffness,
        "damping": parameters.damping * (parameters.stiffness > 0.0),
        "virtual_damping": parameters.damping * (parameters.virtual_stiffness > 0.0),
    }
    return float(derived.get(name, getattr(parameters, name, 0.0)))


class BatchSimulator:
    """Rolls out many candidates that differ in parameters and in topology.

    On CUDA they share every launch and take the substeps of the one that needs most; on a CPU they
    take turns. Self-collision is not simulated.
    """

    def __init__(
        self,
        master: MasterTopology,
        parameters: Many[SimulationParameters],
        device: str = "cpu",
        *,
        threads: int | None = None,
        side_by_side: bool = True,
    ) -> None:
        """Copy candidates to a device.

        Args:
            master: Springs of all candidates; see `MasterTopology.of`.
            parameters: The candidates, at least one.
            device: Warp device.
            threads: Threads of a candidate on a CPU, 1 or 2; None for whichever is faster. The
                bits are the same.
            side_by_side: Whether few candidates are moved in one launch a frame on CUDA, each in
                blocks of its own or four to a block, or interleaved as many are.

        Raises:
            UsageError: If there is no candidate, or candidates differ in what must be common:
                rest length floors and frame rate.
        """
        if not parameters:
            raise UsageError("A batch needs at least one candidate.")
        for name in _COMMON:
            if len({getattr(p, name) for p in parameters}) > 1:
                raise UsageError(f"All candidates of a batch must have the same {name}.")
        if any(p.has_contacts for p in parameters):
            raise UsageError(
                "Neither self-collision nor hands that push are simulated in a batch; switch off "
                "self_collision and hand_pushes."
            )
        self.master = master
        self.parameters = tuple(parameters)
        self.substeps = max(p.substeps_per_frame for p in parameters)
        self.device = wp.get_device(device)
        self._threads = threads
        self._side_by_side = side_by_side
        self._population: Population | SideBySide | None = None

    def rollout(self, control: Float[ndarray, "frame control 3"]) -> BatchRollout:
        """Simulate all frames of a control trajectory.

        Args:
            control: Positions of the control nodes in every frame [m].

        Raises:
            ValueError: If the trajectory does not fit the master topology or is not finite.
        """
        control = checked_control(control, self.master.control_count)
        population = self._on_device()
        if isinstance(population, SideBySide):
            return self._side_by_side_rollout(population, control)
        if population is not None:
            return population.rollout(control)
        shape = (len(self.parameters), len(control), len(self.master.object_node), 3)
        position = np.full(shape, np.nan, dtype=np.float32)
        diverged = np.full(len(self.parameters), -1)
        for candidate, parameters in enumerate(self.parameters):
            try:
                for frame, state, _ in self._alone(parameters, control):
                    position[candidate, frame] = state
            except SimulationDivergedError as error:
                diverged[candidate] = error.frame
        return BatchRollout(position, diverged)

    def losses(
        self, control: Float[ndarray, "frame control 3"], target: MotionTarget
    ) -> BatchLosses:
        """Simulate the observed frames and compare every candidate with the observations.

        Args:
            control: Positions of the control nodes, in the observed frames at least [m].
            target: Observations.

        Raises:
            ValueError: If the trajectory does not fit the master topology, is not finite, or is
                shorter than the observations.
        """
        return self.start_losses(control, target)()

    def start_losses(
        self, control: Float[ndarray, "frame control 3"], target: MotionTarget
    ) -> Callable[[], BatchLosses]:
        """Begin with `losses`, so that other devices can work at the same time.

        On CUDA the losses are summed on the device, and the host waits for it once, in what is
        given; this simulator must live until then. A CPU has finished before.

        Raises:
            ValueError: As `losses` does.
        """
        control = checked_control(control, self.master.control_count)
        if len(control) < target.frame_count:
            raise ValueError(
                f"control has {len(control)} frames, but {target.frame_count} were observed."
            )
        population = self._on_device()
        if isinstance(population, SideBySide):
            return self._side_by_side_losses(population, control[: target.frame_count], target)
        if population is not None:
            return population.start_losses(control, target)
        loss = np.full(len(self.parameters), np.inf, dtype=np.float32)
        diverged = np.full(len(self.parameters), -1)
        nodes = len(self.master.object_node)
        good = wp.full(1, -1, dtype=wp.int32, device=self.device)
        for candidate, parameters in enumerate(self.parameters):
            sums = LossSum(target, np.arange(nodes), lanes=1, width=1, device=self.device)
            try:
                for frame, *state in self._alone(parameters, control[: target.frame_count]):
                    flat = np.concatenate(state, axis=1).ravel()
                    sums.add(frame, wp.array(flat, dtype=wp.float32, device=self.device), good)
                loss[candidate] = sums.loss.numpy()[0]
            except SimulationDivergedError as error:
                diverged[candidate] = error.frame
        return lambda: BatchLosses(loss, diverged)

    def _on_device(self) -> "Population | SideBySide | None":
        if not self.device.is_cuda or len(self.master.object_node) == 0:
            return None
        if self._population is None:
            candidates = self.master, self.parameters, self.substeps, self.device
            # The fastest first, as measured (docs/benchmarks).
            if self._side_by_side:
                self._population = SideBySide.of(*candidates, most_own=FEW_OWN)
            if self._population is None:
                population = Population(*candidates, in_blocks=self._side_by_side)
                if self._side_by_side and population.blocks is None:
                    self._population = SideBySide.of(*candidates)
                self._population = self._population or population
        return self._population

    def _side_by_side_rollout(
        self, bodies: SideBySide, control: Float32[ndarray, "frame control 3"]
    ) -> BatchRollout:
        shape = (len(self.parameters), len(control), bodies.nodes, 3)
        position = np.empty(shape, dtype=np.float32)
        first = wp.full(shape[0], -1, dtype=wp.int32, device=self.device)
        for frame, state, diverged in bodies.frames(control):
            position[:, frame] = state.numpy().reshape(shape[0], shape[2], 6)[..., :3]
            first = diverged
        return BatchRollout(position, first.numpy())

    def _side_by_side_losses(
        self,
        bodies: SideBySide,
        control: Float32[ndarray, "frame control 3"],
        target: MotionTarget,
    ) -> Callable[[], BatchLosses]:
        """Sum the losses on the device."""
        lanes = len(self.parameters)
        sums = LossSum(target, np.arange(bodies.nodes), lanes=lanes, width=1, device=self.device)
        first = wp.full(lanes, -1, dtype=wp.int32, device=self.device)
        for frame, state, diverged in bodies.frames(control):
            sums.add(frame, state, diverged)
            first = diverged
        return lambda: BatchLosses(sums.loss.numpy(), first.numpy())

    def _alone(
        self, parameters: SimulationParameters, control: Float32[ndarray, "frame control 3"]
    ) -> Iterator[tuple[int, ndarray, ndarray]]:
        model = self.master.model(parameters)
        simulator = Simulator(model, parameters, device=str(self.device))
        if self._threads is not None and isinstance(simulator.engine, CpuEngine):
            simulator.engine.threads = self._threads
        return simulator.frames(control)


def shared_out(batch: Many[int], count: int) -> list[list[int]]:
    """Divide a batch into as many parts, of which none is empty or longer by more than one."""
    parts = np.array_split(np.array(batch, dtype=int), min(count, len(batch)))
    return [part.tolist() for part in parts]


def losses_at_once(
    simulators: Many[BatchSimulator],
    control: Float[ndarray, "frame control 3"],
    target: MotionTarget,
) -> BatchLosses:
    """Compute the losses of parts of a batch, each on a device of its own, at the same time.

    Args:
        simulators: One for each part.
        control: See `BatchSimulator.losses`.
        target: See `BatchSimulator.losses`.

    Returns:
        Those of all candidates, part by part.

    Raises:
        ValueError: As `BatchSimulator.losses` does.
    """
    # All of them begin before the host waits for the first one.
    begun = [simulator.start_losses(control, target) for simulator in simulators]
    parts = [finish() for finish in begun]
    return BatchLosses(
        np.concatenate([part.loss for part in parts]),
        np.concatenate([part.diverged_frame for part in parts]),
    )
