"""The hand-written adjoint of one frame: a tape of its substeps, walked backwards."""

from typing import Any

import warp as wp

from physhandi.simulation.engines.frame_sums import FrameSums
from physhandi.simulation.engines.graph import LaunchGraph
from physhandi.simulation.engines.tape import Tape, TapeLayout
from physhandi.simulation.kernels.adjoint import gather_nodes, nodes_adjoint, springs_adjoint
from physhandi.simulation.kernels.self_collision.adjoint import collisions_adjoint, ground_adjoint
from physhandi.simulation.self_collision import SelfCollision
from physhandi.simulation.simulator import Simulator


def graph_tape_layout(nodes: int, substeps: int, *, collides: bool) -> TapeLayout:
    """Shape the tape of a frame: positions, velocities, and velocities before each contact."""
    states, steps = ((substeps + 1, nodes), wp.vec3), ((substeps, nodes), wp.vec3)
    return (states, states, steps, steps) if collides else (states, states, steps)


class GraphAdjoint:
    """Simulates frames and propagates a loss's derivatives from a frame's end to its start.

    An attribute ``x_bar`` holds the derivative of the loss by ``x``. The captured launches work on
    one tape; those of other frames are copied from and to it.
    """

    def __init__(self, simulator: Simulator) -> None:
        """Allocate the tape.

        Args:
            simulator: Its controls, material and world are read, its state is advanced.
        """
        self._simulator = simulator
        model, device = simulator.model, simulator.device
        substeps = simulator.parameters.substeps_per_frame
        nodes, springs = model.node_count, len(model.spring_nodes)
        collides = simulator.collision is not None

        def zeros(shape: int | tuple[int, ...], dtype: Any) -> Any:
            return wp.zeros(shape, dtype=dtype, device=device)

        self.layout = graph_tape_layout(nodes, substeps, collides=collides)
        self._tape = tuple(zeros(shape, dtype) for shape, dtype in self.layout)
        rows = [[whole[row] for row in range(whole.shape[0])] for whole in self._tape]
        self._position, self._velocity, self._free_velocity, *contact = rows
        self._contact_velocity = contact[0] if contact else [None] * substeps
        self._copied: Tape | None = None
        self.position_bar, self.velocity_bar = zeros(nodes, wp.vec3), zeros(nodes, wp.vec3)
        self._force_bar, self._gain_bar = zeros(nodes, wp.vec3), zeros(nodes, wp.vec3)
        self._offset_bar, self._stretch_bar = zeros(springs, wp.vec3), zeros(springs, wp.vec3)
        self._row_offset_bar = simulator.sums.scratch()
        self._row_stretch_bar = simulator.sums.scratch()
        self.sums = FrameSums.zeros(model, device, collides=collides)
        self._fill = LaunchGraph(self._launch_fill, device)
        self._adjoint = LaunchGraph(self._launch_adjoint, device)

    def record(self, tape: Tape) -> None:
        """Advance the simulator by one frame and record its substeps in `tape`."""
        simulator = self._simulator
        state = simulator.position, simulator.velocity
        for rows, value in zip((self._position, self._velocity), state, strict=True):
            wp.copy(rows[0], value)
        self._fill.replay(simulator.find_candidates(self._position[0]))
        for rows, value in zip((self._position, self._velocity), state, strict=True):
            wp.copy(value, rows[-1])
        for stored, own in zip(tape, self._tape, strict=True):
            wp.copy(stored, own)
        self._copied = tape

    def backward(self, tape: Tape) -> None:
        """Propagate `position_bar` and `velocity_bar` from the frame's end to its start.

        The simulator must have the frame's controls and material. The derivatives by these are
        written to `sums`.
        """
        if tape is not self._copied:
            for stored, own in zip(tape, self._tape, strict=True):
                wp.copy(own, stored)
            self._copied = tape
        for value in self.sums:
            value.zero_()
        version = self._simulator.find_candidates(self._position[0])
        if self._simulator.hand_contact is not None:
            self._simulator.hand_contact.list_corners()
        self._adjoint.replay(version)

    def _launch_fill(self) -> None:
        for substep, tapes in enumerate(
            zip(self._free_velocity, self._contact_velocity, strict=True)
        ):
            self._simulator.launch_substep(
                substep,
                (self._position[substep], self._velocity[substep]),
                (self._position[substep + 1], self._velocity[substep + 1]),
                *tapes,
            )

    def _launch_adjoint(self) -> None:
        simulator, model = self._simulator, self._simulator.model
        collision = simulator.collision
        ground = [simulator.world, simulator.clearance]
        state_bars = [self.position_bar, self.velocity_bar]
        for substep in reversed(range(len(self._free_velocity))):
            state = self._position[substep], self._velocity[substep]
            fraction = (substep + 1) / len(self._free_velocity)
            if collision is None:
                wp.launch(
                    nodes_adjoint,
                    dim=model.node_count,
                    inputs=[*ground, state[0], self._free_velocity[substep]],
                    outputs=[*state_bars, self.sums.drag, *self.sums.ground, self._force_bar],
                    device=simulator.device,
                )
            else:
                self._launch_contacts(substep, collision)
            if simulator.hand_contact is not None:
                simulator.hand_contact.launch_adjoint(
                    fraction,
                    simulator.launch_springs(fraction, state),
                    state,
                    simulator.controls,
                    [*state_bars, self._force_bar],
                    self.sums.controls,
                )
            wp.launch(
                springs_adjoint,
                dim=len(model.spring_nodes),
                inputs=[*simulator.spring_inputs(fraction, state), self._force_bar],
                outputs=[*self.sums.material, self._offset_bar, self._stretch_bar],
                device=simulator.device,
            )
            start, entry, offset_bar = simulator.sums.of(self._offset_bar, self._row_offset_bar)
            *_, stretch_bar = simulator.sums.of(self._stretch_bar, self._row_stretch_bar)
            wp.launch(
                gather_nodes,
                dim=model.node_count + model.control_count,
                inputs=[fraction, simulator.world, start, entry, offset_bar, stretch_bar],
                outputs=[*state_bars, *self.sums.controls],
                device=simulator.device,
            )

    def _launch_contacts(self, substep: int, collision: SelfCollision) -> None:
        """Launch the equivalent of `nodes_adjoint`, with collisions between ground and drag."""
        simulator = self._simulator
        state_bars = [self.position_bar, self.velocity_bar]
        inputs = [collision.start, collision.candidate]
        inputs += [self._position[substep], self._free_velocity[substep]]
        ground = [simulator.world, simulator.clearance]
        wp.launch(
            ground_adjoint,
            dim=simulator.model.node_count,
            inputs=[*ground, *inputs, self._contact_velocity[substep]],
            outputs=[*state_bars, *self.sums.ground, self._gain_bar],
            device=simulator.device,
        )
        wp.launch(
            collisions_adjoint,
            dim=simulator.model.node_count,
            inputs=[simulator.world, *inputs, self._gain_bar],
            outputs=[*state_bars, self.sums.drag, *self.sums.collision, self._force_bar],
            device=simulator.device,
        )
