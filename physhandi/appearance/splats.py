"""Gaussian splats: what an object looks like, as a cloud of soft balls.

Source: B. Kerbl et al., 3D Gaussian Splatting for Real-Time Radiance Field Rendering, 2023; as
PhysTwin takes them, equally wide in all directions (H. Jiang et al., 2025). Theirs change color
with the direction from which they are seen; these do not.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float32
from numpy import ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class Splats:
    """Isotropic Gaussians in frame 0 of a run's first sequence, and the nodes that carry them."""

    center: Float32[ndarray, "splat 3"]
    """Their middles in the world [m]."""
    scale: Float32[ndarray, " splat"]
    """Standard deviation [m]."""
    color: Float32[ndarray, "splat 3"]
    """Red, green and blue of sRGB, from 0 to 1."""
    opacity: Float32[ndarray, " splat"]
    """How much of what is behind its middle a splat covers, from 0 to 1."""
    rest_node: Float32[ndarray, "node 3"]
    """The object's nodes in the same frame [m]."""

    def __post_init__(self) -> None:
        """Raise `ValueError` if an array is wrong; names it."""
        for name, value in self.to_tensors().items():
            if not np.isfinite(value).all():
                raise ValueError(f"{name} is not finite at {_first(~np.isfinite(value))}.")
        if len(self.rest_node) == 0:
            raise ValueError("rest_node is empty; splats need a node that carries them.")
        if (self.scale <= 0.0).any():
            raise ValueError(f"scale is not positive at splat {_first(self.scale <= 0.0)}.")
        for name in ("color", "opacity"):
            value = getattr(self, name)
            if (is_outside := (value < 0.0) | (value > 1.0)).any():
                raise ValueError(f"{name} is not from 0 to 1 at {_first(is_outside)}.")

    def to_tensors(self) -> dict[str, ndarray]:
        """Return every field as an array, ready for safetensors."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, ndarray]) -> "Splats":
        """Rebuild splats from the arrays of `to_tensors`.

        Raises:
            ValueError: If an array is missing, unknown or wrong; names it.
        """
        names = {field.name for field in fields(cls)}
        if set(tensors) != names:
            raise ValueError(
                f"Splats need the arrays {', '.join(sorted(names))}; "
                f"got {', '.join(sorted(tensors)) or 'none'}."
            )
        count = tensors["center"].shape[:1]
        for name, value in tensors.items():
            shape = value.shape[:1] if name == "rest_node" else count
            shape = shape if name in {"scale", "opacity"} else (*shape, 3)
            if value.dtype != np.float32 or value.shape != shape:
                raise ValueError(
                    f"{name} is {value.dtype} {value.shape}; expected float32 {shape}."
                )
        return cls(**tensors)


def _first(is_wrong: ndarray) -> str:
    """Name the first place at which an array is wrong."""
    return ", ".join(str(number) for number in np.argwhere(is_wrong)[0])
