"""Launches that are captured as a graph and replayed."""

from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from physhandi.simulation.kernels.integration import sum_rows
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.topology import half_edges, split_rows


class LaunchGraph:
    """The launches of a function as a graph, captured on first use and when arrays have moved."""

    def __init__(self, launches: Callable[[], None], device: Any) -> None:
        """Remember what to capture.

        Args:
            launches: Launches kernels, without waiting for them.
            device: Warp device that they run on.
        """
        self._launches = launches
        self._device = device
        self._version: int | None = None
        self.graph: wp.Graph | None = None

    def replay(self, version: int = 0) -> None:
        """Run the launches.

        Args:
            version: Version of the arrays that they use; when it changes, the launches are
                captured again.
        """
        if self.graph is None or version != self._version:
            # While a GPU captures, older drivers load no module. On a CPU all modules of this
            # process, once compiled, would cost far more than the few that are launched.
            is_ahead = self._device.is_cuda
            with wp.ScopedCapture(device=self._device, force_module_load=is_ahead) as capture:
                self._launches()
            if capture.graph is None:
                raise RuntimeError(f"Warp captured no graph on {self._device}.")
            self.graph, self._version = capture.graph, version
        wp.capture_launch(self.graph)


ROW_LENGTH = 8
"""Most springs that one thread of a GPU sums."""


class SpringSums:
    """Sums over the springs of each node: directly on a CPU, in two levels of rows on a GPU.

    The bending force on a vertex of a rope counts as one more spring of that node.
    A GPU thread waits for each value that it adds, so long sums are split into rows that many
    threads sum. The order of additions is fixed in both cases.
    """

    def __init__(self, model: SpringMassModel, device: Any) -> None:
        self._device = device
        self.spring_nodes = wp.array(model.spring_nodes, dtype=wp.vec2i, device=device)
        """Both ends of each spring."""
        count = model.node_count + model.control_count
        vertex = np.zeros(0, np.int32) if model.rod is None else model.rod.node
        # What bends a rope has no other end; the row of a node that is not there takes it.
        ends = np.stack([vertex, np.full_like(vertex, count)], axis=1)
        ends = np.concatenate([model.spring_nodes, ends])
        self.pull = wp.zeros(len(ends), dtype=wp.vec3, device=device)
        """Force of each spring [N], then the bending force on each vertex of a rope."""
        start, entry = half_edges(ends, count + 1)
        start = start[:-1]
        self._half_edge = wp.array(entry, dtype=wp.int32, device=device)
        self._row_start: wp.array | None = None
        if device.is_cuda:
            row, start = split_rows(start, ROW_LENGTH)
            self._row_start = wp.array(row, dtype=wp.int32, device=device)
            entry = np.arange(len(row) - 1, dtype=np.int32)
        self._start = wp.array(start, dtype=wp.int32, device=device)
        self._entry = wp.array(entry, dtype=wp.int32, device=device)
        self.row_pull = self.scratch()
        """Sums of the forces over rows [N]."""

    def scratch(self) -> wp.array:
        """Allocate the rows of one sum."""
        count = 0 if self._row_start is None else len(self._row_start) - 1
        return wp.zeros(count, dtype=wp.vec3, device=self._device)

    def of(self, value: wp.array, scratch: wp.array) -> tuple[wp.array, wp.array, wp.array]:
        """Sum rows if needed, and return the arguments of `spring_sum`: start, entry, value."""
        if self._row_start is None:
            return self._start, self._entry, value
        wp.launch(
            sum_rows,
            dim=scratch.shape[0],
            inputs=[self._row_start, self._half_edge, value],
            outputs=[scratch],
            device=self._device,
        )
        return self._start, self._entry, scratch
