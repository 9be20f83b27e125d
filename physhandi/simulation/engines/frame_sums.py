"""Derivatives by everything that is constant over the substeps of a frame."""

from typing import Any, NamedTuple

import warp as wp

from physhandi.simulation.model import SpringMassModel


class FrameSums(NamedTuple):
    """Derivatives of the loss, summed over the substeps of one frame.

    The order is that of the arguments of `differentiable.rollout`. Per node means each node's
    share; the derivative is the sum of all.
    """

    control_start: wp.array
    """By where each control node is at the frame's start, one vector each."""
    control_end: wp.array
    """By where each control node is at the frame's end, one vector each."""
    log_stiffness: wp.array
    """By the logarithm of each spring's stiffness."""
    damping: wp.array
    """By each spring's damping."""
    drag: wp.array
    """Per node."""
    restitution: wp.array
    """Per node, of the ground."""
    friction: wp.array
    """Per node, of the ground."""
    self_restitution: wp.array
    """Per node, of self-collision; empty without it."""
    self_friction: wp.array
    """Per node, of self-collision; empty without it."""

    @classmethod
    def zeros(cls, model: SpringMassModel, device: Any, *, collides: bool = False) -> "FrameSums":
        """Allocate them for a model, those of self-collision only if nodes collide."""
        nodes, springs = model.node_count, len(model.spring_nodes)
        collided = nodes if collides else 0
        counts = (*[model.control_count] * 2, *[springs] * 2, *[nodes] * 3, *[collided] * 2)
        dtypes = (*[wp.vec3] * 2, *[wp.float32] * 7)
        return cls(
            *(
                wp.zeros(count, dtype=dtype, device=device)
                for count, dtype in zip(counts, dtypes, strict=True)
            )
        )

    @property
    def controls(self) -> tuple[wp.array, wp.array]:
        """Those by the control nodes."""
        return self.control_start, self.control_end

    @property
    def material(self) -> tuple[wp.array, wp.array]:
        """Those by the springs' material."""
        return self.log_stiffness, self.damping

    @property
    def ground(self) -> tuple[wp.array, wp.array]:
        """Those by the coefficients of the ground."""
        return self.restitution, self.friction

    @property
    def collision(self) -> tuple[wp.array, wp.array]:
        """Those by the coefficients of self-collision."""
        return self.self_restitution, self.self_friction


SCALARS = FrameSums._fields[4:]
"""Parameters that all nodes share."""
