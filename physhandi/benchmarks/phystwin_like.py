"""The baseline of the rollout benchmark: springs as PhysTwin's published simulator runs them.

Five launches a substep, forces summed by float atomics, one set of states per substep for the
backward pass, which Warp derives from the kernels. Everything is in captured graphs. The
bits of the result depend on thread order.
"""

from typing import Any

import numpy as np
import warp as wp

from physhandi.simulation.kernels.baseline import (
    add_spring_forces,
    integrate,
    place_controls,
    sum_heights,
    update_velocity,
)
from physhandi.simulation.model import SimulationParameters, SpringMassModel


class PhysTwinLike:
    """One frame of the baseline, forward, or forward and backward."""

    def __init__(
        self, model: SpringMassModel, parameters: SimulationParameters, device: str
    ) -> None:
        self.model, self.parameters, self.device = model, parameters, device
        self.dashpot = float(model.damping[0]) if len(model.damping) else 0.0
        self.spring_nodes = wp.array(model.spring_nodes, dtype=wp.vec2i, device=device)
        self.rest_length = wp.array(model.rest_length, dtype=float, device=device)
        self.log_stiffness = wp.array(
            np.log(model.stiffness), dtype=float, device=device, requires_grad=True
        )
        contact = {"dtype": float, "device": device, "requires_grad": True}
        self.restitution = wp.array([parameters.restitution], **contact)
        self.friction = wp.array([parameters.friction], **contact)
        self.control_start = wp.zeros(model.control_count, dtype=wp.vec3, device=device)
        self.control_end = wp.zeros(model.control_count, dtype=wp.vec3, device=device)
        self.control = wp.zeros(model.control_count, dtype=wp.vec3, device=device)

    def capture_forward(self, control_start: np.ndarray, control_end: np.ndarray) -> wp.Graph:
        """Capture one frame that ends where it began in memory, so that it can be replayed."""
        self._place(control_start, control_end)
        self.position = wp.array(self.model.object_node, dtype=wp.vec3, device=self.device)
        self.velocity = wp.array(self.model.initial_velocity, dtype=wp.vec3, device=self.device)
        # A captured graph does not keep its arrays alive.
        self.scratch = (wp.zeros_like(self.velocity), wp.zeros_like(self.velocity))

        def launch() -> None:
            for substep in range(self.parameters.substeps_per_frame):
                state = (self.position, self.velocity)
                self._substep(substep, state, self.scratch, state)

        return self._capture(launch)

    def capture_backward(self, control_start: np.ndarray, control_end: np.ndarray) -> wp.Graph:
        """Capture one frame forward and backward; the gradient lands in `log_stiffness.grad`."""
        self._place(control_start, control_end)

        def state(value: np.ndarray) -> wp.array:
            return wp.array(value, dtype=wp.vec3, device=self.device, requires_grad=True)

        zero = np.zeros_like(self.model.object_node)
        substeps = self.parameters.substeps_per_frame
        states: list[Any] = [(state(self.model.object_node), state(self.model.initial_velocity))]
        states += [(state(zero), state(zero)) for _ in range(substeps)]
        scratch = [(state(zero), state(zero)) for _ in range(substeps)]
        loss = wp.zeros(1, dtype=float, device=self.device, requires_grad=True)
        tape = wp.Tape()

        def launch() -> None:
            with tape:
                for substep in range(substeps):
                    self._substep(substep, states[substep], scratch[substep], states[substep + 1])
                position = states[-1][0]
                wp.launch(
                    sum_heights, len(zero), inputs=[position], outputs=[loss], device=self.device
                )
            tape.backward(loss)

        self._kept = (states, scratch, loss, tape)
        return self._capture(launch)

    def _place(self, control_start: np.ndarray, control_end: np.ndarray) -> None:
        if self.model.control_count:
            self.control_start.assign(np.asarray(control_start, dtype=np.float32))
            self.control_end.assign(np.asarray(control_end, dtype=np.float32))

    def _capture(self, launch: Any) -> wp.Graph:
        with wp.ScopedCapture(device=self.device, force_module_load=True) as capture:
            launch()
        if capture.graph is None:
            raise RuntimeError(f"Warp captured no graph on {self.device}.")
        return capture.graph

    def _substep(self, substep: int, before: Any, scratch: Any, after: Any) -> None:
        force, velocity = scratch
        parameters, nodes = self.parameters, self.model.node_count
        ground = -1e9 if parameters.ground_height is None else parameters.ground_height
        fraction = (substep + 1) / parameters.substeps_per_frame
        force.zero_()
        launches = (
            (
                place_controls,
                self.model.control_count,
                [fraction, self.control_start, self.control_end],
                [self.control],
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
                    self.control,
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
