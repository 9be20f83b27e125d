"""Frames in one launch each on CUDA, for blocks that need dynamic shared memory."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import warp as wp

from physhandi.simulation.columns import arrange_columns
from physhandi.simulation.kernels.dataflow_large import (
    FLOATS_OF_A_LOCAL,
    make_large_frame_kernel,
    pack_half_edges,
)
from physhandi.simulation.partition import Partition
from physhandi.simulation.stage import Stage

BLOCK_SIZES = {512: 14, 768: 6}
"""Threads of a block, and the most half-edges for which each has registers."""
LANES = (8, 4, 2, 1)
"""Threads that may sum one node's springs."""
LOCALS_STEP = 512
"""Room for nodes grows by so many, so that few sizes are compiled."""
_BYTES_OF_A_LOCAL = 4 * FLOATS_OF_A_LOCAL
_BYTES_OF_A_THREAD = 4
"""What Warp's own bookkeeping takes of shared memory."""

large_frame_kernel = lru_cache(maxsize=None)(make_large_frame_kernel)


def most_large_locals(device: Any) -> int:
    """Return how many nodes, its own and its halo, a block of a device has room for."""
    free = int(device.max_shared_memory_per_block) - _BYTES_OF_A_THREAD * max(BLOCK_SIZES)
    return max(0, free // _BYTES_OF_A_LOCAL)


@dataclass(frozen=True)
class LargeLayout:
    """How many threads do what."""

    lanes: int
    """Threads that sum one node's springs."""
    kept: int
    """Half-edges that each of them keeps in registers."""
    threads: int
    """Threads of a block."""
    locals: int
    """Nodes that a block has room for."""

    @classmethod
    def of(cls, partition: Partition, most_locals: int) -> "LargeLayout":
        """Use as many lanes as leave no node waiting for a turn.

        Args:
            partition: Blocks of nodes.
            most_locals: Nodes for which the device has room.
        """
        own = partition.most_own
        lanes = next((n for n in LANES if own * n <= max(BLOCK_SIZES)), LANES[-1])
        threads = next((n for n in BLOCK_SIZES if own * lanes <= n), max(BLOCK_SIZES))
        kept = max(1, min(BLOCK_SIZES[threads], -(-partition.most_entries // lanes)))
        steps = -(-partition.most_locals // LOCALS_STEP)
        return cls(lanes, kept, threads, min(steps * LOCALS_STEP, most_locals))


class LargeFrames:
    """The half-edges of one model as the large frame kernel reads them."""

    def __init__(self, simulator: Stage, partition: Partition) -> None:
        """Place half-edges on the device.

        Args:
            simulator: Whose state, controls, material and world are read and written.
            partition: Of its model; its blocks must fit the device.
        """
        self._simulator = simulator
        self._block_count = partition.block_count
        self.layout = LargeLayout.of(partition, most_large_locals(simulator.device))
        columns = arrange_columns(partition, self.layout.lanes, self.layout.threads)
        self._chunk_count = columns.chunk_count
        self._start = simulator.array(columns.start, wp.int32)
        self._place = simulator.array(columns.place, wp.int32)
        self._spring = simulator.array(columns.spring, wp.int32)
        self._packed = wp.zeros(len(columns.place), dtype=wp.vec4, device=simulator.device)

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
            blocks: The partition's `own_start`, `local_start`, `local_node` and `model_node`.
            relay: Where blocks publish their nodes.
            tag: First of as many unused tags as substeps, and one more.
            before: State at its start.
            after: Where the state at its end goes; may be the same arrays.
        """
        simulator, layout = self._simulator, self.layout
        # Material and world may have changed on the device, unseen from here; a frame costs more.
        wp.launch(
            pack_half_edges,
            dim=len(self._place),
            inputs=[simulator.world, self._place, self._spring, *simulator.material],
            outputs=[self._packed],
            device=simulator.device,
        )
        inputs: list[Any] = [self._chunk_count, simulator.parameters.substeps_per_frame, tag]
        inputs += [simulator.world, *blocks, self._start, self._packed]
        wp.launch(
            large_frame_kernel(layout.lanes, layout.kept, layout.threads, layout.locals),
            dim=self._block_count * layout.threads,
            inputs=[*inputs, *simulator.controls, *before],
            outputs=[relay, *after, simulator.first_divergence],
            block_dim=layout.threads,
            device=simulator.device,
        )
