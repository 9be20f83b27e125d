"""How a rope bends: a discrete elastic rod beside the springs that keep its length."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from jaxtyping import Float32, Int32
from numpy import ndarray

PREFIX = "rod_"
"""Begins the names of a rod's arrays among those of a model."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Rod:
    """Bending of a chain of nodes whose first edge a gripper holds, twist included.

    The law is that of `kernels.rod`: the axes of the first edge are held, those of the others turn
    as moments balance, and the curvature about them is pulled to the natural one.
    """

    node: Int32[ndarray, " vertex"]
    """Object nodes along the rope, from the gripper that holds its axes."""
    held_by: int
    """Control node beside the first vertex: the first axis there points at it."""
    length: Float32[ndarray, " vertex"]
    """Mean rest length of the two edges at each vertex [m]; those of the two ends are not used."""
    natural_curvature: Float32[ndarray, "vertex 2"]
    """Curvature at rest about the second axis and minus the first [1/m]; not used at the ends."""
    stiffness: float
    """Bending stiffness B of a rope whose nodes weigh 1 kg each [N·m²]."""
    damping: float
    """Time τ by which a change of curvature counts as bending: moments are B (κ + τ dκ/dt) [s]."""
    twist_stiffness: float
    """Twist stiffness G, likewise [N·m²]."""

    def check(self, node_count: int, control_count: int) -> None:
        """Refuse a rod that does not fit a model's nodes.

        Raises:
            ValueError: If an array is of another shape, a node does not exist, or a value is not
                finite or negative.
        """
        count = len(self.node)
        is_known = np.all((self.node >= 0) & (self.node < node_count))
        if count < 3 or len(np.unique(self.node)) < count or not is_known:
            raise ValueError(
                f"rod_node must name at least three different nodes from 0 to {node_count - 1}."
            )
        if not 0 <= self.held_by < control_count:
            raise ValueError(
                f"rod_held_by is {self.held_by}, but there are {control_count} control nodes."
            )
        for name, shape in (("length", (count,)), ("natural_curvature", (count, 2))):
            value = getattr(self, name)
            if value.shape != shape or not np.all(np.isfinite(value)):
                raise ValueError(
                    f"rod_{name} has shape {value.shape} or values that are not finite; "
                    f"expected {shape}."
                )
        if float(self.length.min()) <= 0.0:
            raise ValueError("rod_length must be positive.")
        for name in ("stiffness", "damping", "twist_stiffness"):
            value = getattr(self, name)
            if not 0.0 <= value < np.inf:
                raise ValueError(f"rod_{name} is {value}; expected a number from 0 on.")

    def to_tensors(self) -> dict[str, ndarray]:
        """Return every field as an array, under its name with `PREFIX`."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        kinds = {"held_by": np.int32}
        return {
            PREFIX + name: value
            if isinstance(value, np.ndarray)
            else np.array([value], dtype=kinds.get(name, np.float32))
            for name, value in values.items()
        }

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, ndarray]) -> "Rod | None":
        """Rebuild a rod from the arrays of `to_tensors`; None if there are none of a rod.

        Raises:
            ValueError: If an array is missing or unknown.
        """
        stored = {name: np.asarray(a) for name, a in tensors.items() if name.startswith(PREFIX)}
        names = {PREFIX + field.name for field in fields(cls)}
        if not stored:
            return None
        if set(stored) != names:
            raise ValueError(
                f"A rod needs the arrays {', '.join(sorted(names))}; "
                f"got {', '.join(sorted(stored))}."
            )
        values: dict[str, Any] = {
            name.removeprefix(PREFIX): array.item() if array.size == 1 else array
            for name, array in stored.items()
        }
        return cls(**values)
