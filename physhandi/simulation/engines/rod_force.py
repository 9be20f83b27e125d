"""Launches what bends a rope, beside its springs."""

from typing import Any

import numpy as np
import warp as wp

from physhandi.simulation.kernels.rod import RodMaterial, bend_rod
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.rod import Rod

_MATERIAL: Any = RodMaterial


class RodForce:
    """The rod of a model on a device."""

    def __init__(self, model: SpringMassModel, device: Any) -> None:
        """Copy the rod of a model, which must have one."""
        rod = model.rod
        if rod is None:
            raise ValueError("The model has no rod.")
        count = len(rod.node)
        self._device = device
        self._first = len(model.spring_nodes)
        self._held_by = model.node_count + rod.held_by
        self._values = wp.zeros(1, dtype=_MATERIAL, device=device)
        self._natural_curvature = wp.zeros(count, dtype=wp.vec2, device=device)
        self._inputs = [
            self._values,
            wp.array(rod.node, dtype=wp.int32, device=device),
            wp.array(rod.length, dtype=wp.float32, device=device),
            self._natural_curvature,
        ]
        self.assign(rod)
        self._angle = wp.zeros(count, dtype=wp.float32, device=device)
        kinds = (wp.vec3, wp.vec3, wp.vec2, wp.float32, wp.float32, wp.float32)
        self._scratch = [wp.zeros(count, dtype=kind, device=device) for kind in kinds]

    def assign(self, rod: Rod) -> None:
        """Take over the stiffness, damping and natural curvature of a rod of the same nodes."""
        values: Any = np.zeros(1, dtype=_MATERIAL.numpy_dtype())
        values["held_by"] = self._held_by
        for name in ("stiffness", "damping", "twist_stiffness"):
            values[name] = getattr(rod, name)
        self._values.assign(values)
        self._natural_curvature.assign(rod.natural_curvature)

    def reset(self) -> None:
        """Take all twist out of the rope."""
        self._angle.zero_()

    def launch(
        self, fraction: float, world: wp.array, state: list[wp.array], pull: wp.array
    ) -> None:
        """Write the force on each vertex behind the springs' forces.

        Args:
            fraction: Part of the frame at whose end the control nodes are.
            world: The simulator's `World`.
            state: Positions, velocities, and the control nodes at the frame's start and end.
            pull: Receives the forces [N].
        """
        wp.launch(
            bend_rod,
            dim=1,
            inputs=[fraction, world, *self._inputs, *state],
            outputs=[self._angle, *self._scratch, self._first, pull],
            device=self._device,
        )
