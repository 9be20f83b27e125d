"""The baseline of all benchmarks: springs as PhysTwin's published simulator runs them.

Five launches a substep, forces summed by float atomics, one set of states per substep for the
backward pass, which Warp derives from the kernels. A frame is one captured graph, and gradients
reach back one frame. The bits of the result depend on thread order.
"""

from typing import Any

import numpy as np
import warp as wp
from jaxtyping import Float
from numpy import ndarray

from physhandi.simulation.engines.graph import LaunchGraph
from physhandi.simulation.kernels.baseline import (
    add_spring_forces,
    integrate,
    place_baseline_controls,
    sum_heights,
    update_velocity,
)
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters


class PhysTwinLike:
    """Rolls one object out, forward, or forward and backward frame by frame.

    It knows one damping for all springs and no velocity of control nodes.
    """

    def __init__(
        self, model: SpringMassModel, parameters: SimulationParameters, device: str
    ) -> None:
        """Place a model on a device.

        Args:
            model: Nodes and springs; the first spring's damping is that of all.
            parameters: Global parameters; `stiffness_scale` is not looked at.
            device: Warp device.
        """
        self.model, self.parameters, self.device = model, parameters, device
        self.dashpot = float(model.damping[0]) if len(model.damping) else 0.0
        self.spring_nodes = wp.array(model.spring_nodes, dtype=wp.vec2i, device=device)
        self.rest_length = wp.array(model.rest_length, dtype=float, device=device)
        self.log_stiffness: Any = wp.array(
            np.log(model.stiffness), dtype=float, device=device, requires_grad=True
        )
        contact = {"dtype": float, "device": device, "requires_grad": True}
        self.restitution = wp.array([parameters.restitution], **contact)
        self.friction = wp.array([parameters.friction], **contact)
        self.controls = [
            wp.zeros(model.control_count, dtype=wp.vec3, device=device) for _ in range(2)
        ]
        self.position = wp.array(model.object_node, dtype=wp.vec3, device=device)
        self.velocity = wp.array(model.initial_velocity, dtype=wp.vec3, device=device)
        control = wp.zeros(model.control_count, dtype=wp.vec3, device=device)
        self._scratch = wp.zeros_like(self.velocity), wp.zeros_like(self.velocity), control
        # A captured graph does not keep its arrays alive.
        self._kept: list[Any] = []
        self._forward = LaunchGraph(self._launch_forward, wp.get_device(device))
        self._both: LaunchGraph | None = None

    def rollout(self, control: Float[ndarray, "frame control 3"]) -> None:
        """Simulate all frames from the initial state; `position` is where they end."""
        self._replay(self._forward, control)

    def rollout_with_gradient(self, control: Float[ndarray, "frame control 3"]) -> None:
        """Simulate all frames and add up each frame's derivative of the nodes' heights.

        `log_stiffness.grad` is the derivative of the sum of all heights in all frames, if each
        frame's start is taken as given.
        """
        if self._both is None:
            self._both = LaunchGraph(self._launch_both(), wp.get_device(self.device))
        learned: tuple[Any, ...] = (self.log_stiffness, self.restitution, self.friction)
        for value in learned:
            value.grad.zero_()
        self._replay(self._both, control)

    def _replay(self, graph: LaunchGraph, control: Float[ndarray, "frame control 3"]) -> None:
        self.position.assign(self.model.object_node)
        self.velocity.assign(self.model.initial_velocity)
        for frame in range(1, len(control)):
            if self.model.control_count:
                self.controls[0].assign(control[frame - 1])
                self.controls[1].assign(control[frame])
            graph.replay()

    def _launch_forward(self) -> None:
        state = self.position, self.velocity
        for substep in range(self.parameters.substeps_per_frame):
            self._substep(substep, state, self._scratch, state)

    def _launch_both(self) -> Any:
        substeps, nodes = self.parameters.substeps_per_frame, self.model.node_count
        shape = (substeps + 1, nodes)
        # Position, velocity, force and velocity before contact of every substep.
        tables: list[Any] = [
            wp.zeros(shape, dtype=wp.vec3, device=self.device, requires_grad=True) for _ in range(4)
        ]
        rows: list[list[Any]] = [[table[row] for table in tables] for row in range(substeps + 1)]
        # The backward pass reads the control nodes again where each substep had them.
        count = self.model.control_count
        controls: Any = wp.zeros((substeps, count), dtype=wp.vec3, device=self.device)
        for substep in range(substeps):
            rows[substep].append(controls[substep] if count else self._scratch[-1])
        loss = wp.zeros(1, dtype=float, device=self.device, requires_grad=True)
        tape = wp.Tape()
        self._kept += [tables, controls, rows, loss, tape]

        def launch() -> None:
            for table in tables:
                table.grad.zero_()
            loss.zero_()
            wp.copy(rows[0][0], self.position)
            wp.copy(rows[0][1], self.velocity)
            with tape:
                for substep in range(substeps):
                    position, velocity, *scratch = rows[substep]
                    after = rows[substep + 1][:2]
                    self._substep(substep, (position, velocity), scratch, after)
                wp.launch(
                    sum_heights, nodes, inputs=[rows[-1][0]], outputs=[loss], device=self.device
                )
            tape.backward(loss)
            wp.copy(self.position, rows[-1][0])
            wp.copy(self.velocity, rows[-1][1])

        return launch

    def _substep(self, substep: int, before: Any, scratch: Any, after: Any) -> None:
        force, velocity, control = scratch
        parameters, nodes = self.parameters, self.model.node_count
        ground = -1e9 if parameters.ground_height is None else parameters.ground_height
        fraction = (substep + 1) / parameters.substeps_per_frame
        force.zero_()
        launches = (
            (
                place_baseline_controls,
                self.model.control_count,
                [fraction, *self.controls],
                [control],
            ),
            (
                add_spring_forces,
                len(self.model.spring_nodes),
                [
                    self.spring_nodes,
                    self.rest_length,
                    self.log_stiffness,
                    self.dashpot,
                    *before,
                    control,
                ],
                [force],
            ),
            (
                update_velocity,
                nodes,
                [parameters.dt, parameters.drag, parameters.gravity, before[1], force],
                [velocity],
            ),
            (
                integrate,
                nodes,
                [parameters.dt, ground, self.restitution, self.friction, before[0], velocity],
                list(after),
            ),
        )
        for kernel, count, inputs, outputs in launches:
            if count:
                wp.launch(kernel, count, inputs=inputs, outputs=outputs, device=self.device)
