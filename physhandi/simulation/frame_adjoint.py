"""The hand-written adjoint of one frame: a tape of its substeps, walked backwards."""

from typing import Any

import warp as wp

from physhandi.simulation.kernels.adjoint import gather_nodes, retract_nodes, retract_springs
from physhandi.simulation.kernels.self_collision_adjoint import retract_collisions, retract_ground
from physhandi.simulation.recording import Recording
from physhandi.simulation.self_collision import SelfCollision
from physhandi.simulation.simulator import Simulator


class FrameAdjoint:
    """Simulates a frame again and carries a loss's derivatives from its end to its start.

    The attributes named after a value and `bar` hold the derivative of the loss by it.
    """

    def __init__(self, simulator: Simulator) -> None:
        """Make the tape.

        Args:
            simulator: Whose frames; its controls, material and world are read.
        """
        self._simulator = simulator
        model, device = simulator.model, simulator.device
        substeps = simulator.parameters.substeps_per_frame
        nodes, springs = model.node_count, len(model.spring_nodes)
        collides = simulator.collision is not None

        def zeros(count: int, dtype: Any) -> wp.array:
            return wp.zeros(count, dtype=dtype, device=device)

        def tape(length: int) -> list[Any]:
            whole = wp.zeros((length, nodes), dtype=wp.vec3, device=device)
            return [whole[index] for index in range(length)]

        self._position, self._velocity = tape(substeps + 1), tape(substeps + 1)
        self._free_velocity = tape(substeps)
        self._contact_velocity = tape(substeps) if collides else [None] * substeps
        self.position_bar, self.velocity_bar = zeros(nodes, wp.vec3), zeros(nodes, wp.vec3)
        self._force_bar, self._gain_bar = zeros(nodes, wp.vec3), zeros(nodes, wp.vec3)
        self._offset_bar, self._stretch_bar = zeros(springs, wp.vec3), zeros(springs, wp.vec3)
        self._row_offset_bar = simulator.sums.scratch()
        self._row_stretch_bar = simulator.sums.scratch()
        self._control_bars = [zeros(model.control_count, wp.vec3) for _ in range(2)]
        self._material_bars = [zeros(springs, wp.float32) for _ in range(2)]
        self._scalar_bars = [zeros(nodes, wp.float32) for _ in range(3)]
        self._self_bars = [zeros(nodes if collides else 0, wp.float32) for _ in range(2)]
        self._fill = Recording(self._launch_fill, device)
        self._walk_back = Recording(self._launch_walk_back, device)

    @property
    def start(self) -> tuple[wp.array, wp.array]:
        """State at the start of the frame: positions and velocities, to be filled in."""
        return self._position[0], self._velocity[0]

    @property
    def sums(self) -> list[wp.array]:
        """Derivatives that the last frame gave.

        In this order: start and end of the control nodes, logarithm of each spring's stiffness,
        its damping, and each node's share of drag, restitution, friction, and restitution and
        friction of self-collision (empty without it).
        """
        return [*self._control_bars, *self._material_bars, *self._scalar_bars, *self._self_bars]

    def carry(self) -> None:
        """Carry `position_bar` and `velocity_bar` from the frame's end to its start."""
        for value in self.sums:
            value.zero_()
        version = self._simulator.find_candidates(self._position[0])
        self._fill.replay(version)
        self._walk_back.replay(version)

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

    def _launch_walk_back(self) -> None:
        simulator, model = self._simulator, self._simulator.model
        collision = simulator.collision
        state_bars = [self.position_bar, self.velocity_bar]
        for substep in reversed(range(len(self._free_velocity))):
            state = self._position[substep], self._velocity[substep]
            fraction = (substep + 1) / len(self._free_velocity)
            if collision is None:
                wp.launch(
                    retract_nodes,
                    dim=model.node_count,
                    inputs=[simulator.world, state[0], self._free_velocity[substep]],
                    outputs=[*state_bars, *self._scalar_bars, self._force_bar],
                    device=simulator.device,
                )
            else:
                self._launch_contacts(substep, collision)
            wp.launch(
                retract_springs,
                dim=len(model.spring_nodes),
                inputs=[*simulator.spring_inputs(fraction, state), self._force_bar],
                outputs=[*self._material_bars, self._offset_bar, self._stretch_bar],
                device=simulator.device,
            )
            start, entry, offset_bar = simulator.sums.of(self._offset_bar, self._row_offset_bar)
            *_, stretch_bar = simulator.sums.of(self._stretch_bar, self._row_stretch_bar)
            wp.launch(
                gather_nodes,
                dim=model.node_count + model.control_count,
                inputs=[fraction, simulator.world, start, entry, offset_bar, stretch_bar],
                outputs=[*state_bars, *self._control_bars],
                device=simulator.device,
            )

    def _launch_contacts(self, substep: int, collision: SelfCollision) -> None:
        """Launch what `retract_nodes` does, with the collisions between ground and drag."""
        simulator = self._simulator
        drag_bar, *ground_bars = self._scalar_bars
        state_bars = [self.position_bar, self.velocity_bar]
        candidates = [simulator.world, collision.start, collision.candidate]
        inputs = [*candidates, self._position[substep], self._free_velocity[substep]]
        wp.launch(
            retract_ground,
            dim=simulator.model.node_count,
            inputs=[*inputs, self._contact_velocity[substep]],
            outputs=[*state_bars, *ground_bars, self._gain_bar],
            device=simulator.device,
        )
        wp.launch(
            retract_collisions,
            dim=simulator.model.node_count,
            inputs=[*inputs, self._gain_bar],
            outputs=[*state_bars, drag_bar, *self._self_bars, self._force_bar],
            device=simulator.device,
        )
