"""Gaussian splats of an object as the PLY file that viewers of 3D Gaussian splatting read."""

from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.data.layout import SPLATS_FILE
from physhandi.data.run import RunFolder
from physhandi.errors import RunError

CarrySplats = Callable[[Mapping[str, ndarray], Float[ndarray, "node 3"]], Float[ndarray, "splat 3"]]
"""Finds the centers of stored splats when the nodes of their object are somewhere [m]."""
_FIELDS = (
    *("x", "y", "z", "nx", "ny", "nz"),
    *(f"f_dc_{channel}" for channel in range(3)),
    "opacity",
    *(f"scale_{axis}" for axis in range(3)),
    *(f"rot_{part}" for part in range(4)),
)
"""Properties of a splat, in the order of 3D Gaussian splatting (Kerbl et al. 2023); all float."""
_HARMONIC = 0.28209479177387814
"""Spherical harmonic of degree 0, by which colors are divided."""
_OPAQUE = 1e-4
"""Opacities this near to 0 or 1 are written as if they were this far, as logits must be finite."""


def splats_to_ply(
    splats: Mapping[str, ndarray], center: Float[ndarray, "splat 3"] | None = None
) -> bytes:
    """Encode splats as binary little-endian PLY: harmonics of degree 0, logits and log scales.

    Args:
        splats: ``center scale color opacity``, as a run stores them.
        center: Where they are; None leaves them where they were fitted [m].
    """
    center = splats["center"] if center is None else center
    vertex = np.zeros(len(center), dtype=[(name, "<f4") for name in _FIELDS])
    for axis, name in enumerate("xyz"):
        vertex[name] = center[:, axis]
    opacity = np.clip(splats["opacity"].astype(np.float64), _OPAQUE, 1.0 - _OPAQUE)
    vertex["opacity"] = np.log(opacity / (1.0 - opacity))
    for channel in range(3):
        vertex[f"f_dc_{channel}"] = (splats["color"][:, channel] - 0.5) / _HARMONIC
        vertex[f"scale_{channel}"] = np.log(splats["scale"])
    vertex["rot_0"] = 1.0  # No rotation, the real part first; they are round anyway.
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(vertex)}",
        *(f"property float {name}" for name in _FIELDS),
        "end_header",
    ]
    return ("\n".join(header) + "\n").encode() + vertex.tobytes()


def read_splats(run: RunFolder) -> dict[str, ndarray]:
    """Read the splats that a run stores, for `splats_to_ply`.

    Raises:
        RunError: If it has none.
    """
    if not run.has(SPLATS_FILE):
        raise RunError(
            f"Run '{run.id}' holds no splats; fit it with '--set appearance.enabled=true'."
        )
    return run.tensors(SPLATS_FILE)
