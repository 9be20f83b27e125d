"""The surface of hands pushes object nodes: finds who touches what, and launches the push."""

from typing import Any

import numpy as np
import warp as wp
from jaxtyping import Float
from numpy import ndarray

from physhandi.simulation.kernels.hand_contact import (
    find_faces,
    gather_corners,
    mark_held,
    push_adjoint,
    push_nodes,
)
from physhandi.simulation.model import SpringMassModel

_Pair = tuple[wp.array, wp.array]
ForceRows = tuple[wp.array, wp.array, wp.array]
"""Arguments of `kernels.integration.spring_sum`: start, entry, value."""


class HandContact:
    """Finds the triangle of the hands beside each node in each frame, and launches the push.

    A node is beside the triangle that is nearest at the frame's start, if it is not farther away
    than a few edges of it. Nodes that a virtual spring holds are not pushed.
    """

    def __init__(self, model: SpringMassModel, world: wp.array, frame_rate: float) -> None:
        """Make room for a model's nodes.

        Args:
            model: Has the triangles of the hands (`hand_face`).
            world: The simulator's `World`, whose device is used.
            frame_rate: Frames in a second of simulated time [Hz].
        """
        self._model, self._world, self._frame_rate = model, world, frame_rate
        self._device = world.device
        nodes = model.node_count
        self._face = self._array(model.hand_face, wp.vec3i)
        self._spring_nodes = self._array(model.spring_nodes, wp.vec2i)
        self._is_held = self._zeros(nodes, wp.int32)
        self.face = self._zeros(nodes, wp.int32)
        """Triangle beside each node in this frame; -1 for none."""
        self._weight = self._zeros(nodes, wp.vec3)
        self._shift = self._zeros(model.control_count, wp.vec3)
        self._force = self._zeros(nodes, wp.vec3)
        self._row = self._array(np.arange(nodes + 1), wp.int32)
        self._corner_bar = self._zeros((nodes, 3), wp.vec3)
        self._corner_rate_bar = self._zeros((nodes, 3), wp.vec3)
        self._corner_start = self._zeros(model.control_count + 1, wp.int32)
        self._corner = self._zeros(3 * nodes, wp.int32)

    def shift(self, by: Float[ndarray, "control 3"] | None) -> None:
        """Say by how much the control nodes are beside the hand's surface [m]; None for nothing."""
        if by is None:
            self._shift.zero_()
        else:
            self._shift.assign(np.asarray(by, np.float32))

    def find(self, position: wp.array, control: wp.array, stiffness: wp.array) -> None:
        """Find the triangles for the frame that starts at `position`.

        Args:
            position: Object nodes [m].
            control: Control nodes at the frame's start [m].
            stiffness: Of all springs in this frame [N].
        """
        model = self._model
        self._is_held.zero_()
        if model.virtual_spring_count:
            wp.launch(
                mark_held,
                dim=model.virtual_spring_count,
                inputs=[model.object_spring_count, self._spring_nodes, stiffness],
                outputs=[self._is_held],
                device=self._device,
            )
        wp.launch(
            find_faces,
            dim=model.node_count,
            inputs=[self._face, self._shift, self._is_held, position, control],
            outputs=[self.face, self._weight],
            device=self._device,
        )

    def launch_push(
        self, fraction: float, rows: ForceRows, state: _Pair, controls: _Pair
    ) -> ForceRows:
        """Launch the push on top of what springs do; see `push_nodes`.

        Args:
            fraction: Part of the frame at whose end the hands are.
            rows: Sums of the springs' forces.
            state: Positions and velocities of the object nodes.
            controls: Control nodes at the frame's start and end.

        Returns:
            Sums of all these forces.
        """
        wp.launch(
            push_nodes,
            dim=self._model.node_count,
            inputs=self._inputs(fraction, rows, state, controls),
            outputs=[self._force],
            device=self._device,
        )
        return self._row, self._row, self._force

    def list_corners(self) -> None:
        """List, for the adjoint of this frame, which nodes each control node pushes; waits."""
        face = self.face.numpy()
        node = np.flatnonzero(face >= 0)
        corner = (3 * node[:, None] + np.arange(3)).ravel()
        control = self._model.hand_face[face[node]].ravel()
        entry = np.zeros(len(self._corner), np.int32)
        entry[: len(corner)] = corner[np.argsort(control, kind="stable")]
        count = np.bincount(control, minlength=self._model.control_count)
        self._corner.assign(entry)
        self._corner_start.assign(np.concatenate([[0], np.cumsum(count)]).astype(np.int32))

    def launch_adjoint(  # noqa: PLR0917  (the arguments of `launch_push`, then what it changes)
        self,
        fraction: float,
        rows: ForceRows,
        state: _Pair,
        controls: _Pair,
        node_bars: list[wp.array],
        control_bars: _Pair,
    ) -> None:
        """Launch the adjoint of the push; see `push_adjoint`.

        Args:
            fraction: As in `launch_push`, as are the next three.
            rows: Sums of the springs' forces.
            state: Positions and velocities of the object nodes.
            controls: Control nodes at the frame's start and end.
            node_bars: Adjoints of positions, velocities and forces, which are changed.
            control_bars: Adjoints of the control nodes at the frame's start and end, likewise.
        """
        wp.launch(
            push_adjoint,
            dim=self._model.node_count,
            inputs=self._inputs(fraction, rows, state, controls),
            outputs=[*node_bars, self._corner_bar, self._corner_rate_bar],
            device=self._device,
        )
        bars = [self._corner_bar.flatten(), self._corner_rate_bar.flatten()]
        wp.launch(
            gather_corners,
            dim=self._model.control_count,
            inputs=[fraction, self._frame_rate, self._corner_start, self._corner, *bars],
            outputs=list(control_bars),
            device=self._device,
        )

    def _inputs(self, fraction: float, rows: ForceRows, state: _Pair, controls: _Pair) -> list[Any]:
        start, entry, pull = rows
        model = [self._world, start, entry, self._face, self._shift, self.face, self._weight]
        return [fraction, self._frame_rate, *model, *state, pull, *controls]

    def _array(self, value: ndarray, dtype: Any) -> wp.array:
        return wp.array(np.ascontiguousarray(value, np.int32), dtype=dtype, device=self._device)

    def _zeros(self, count: int | tuple[int, int], dtype: Any) -> wp.array:
        return wp.zeros(count, dtype=dtype, device=self._device)
