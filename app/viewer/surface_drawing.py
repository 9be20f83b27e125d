"""The surface of an object: smooth in one color, or in facets whose colors tell a quantity.

The viewer's meshes have one color each, so a colored surface is a mesh for each step of the scale.
"""

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from app.viewer.coloring import Painted
from app.viewer.colormaps import UNKNOWN, table
from app.viewer.nodes import SceneNodes

STEPS = 24
"""Colors of a colored surface."""
_PLAIN = (92, 142, 230)
_OPACITY = None


class SurfaceDrawing:
    """Draws a surface below one path of the scene; used by one thread."""

    def __init__(self, nodes: SceneNodes, root: str) -> None:
        self._nodes = nodes
        self._root = f"{root}/object/surface"

    def draw(
        self,
        position: Float[ndarray, "node 3"],
        faces: Int[ndarray, "face 3"],
        painted: Painted | None,
        *,
        is_visible: bool,
    ) -> None:
        """Bring the surface to a frame.

        Args:
            position: Object nodes [m].
            faces: Triangles between them.
            painted: The nodes' colors; None for one color.
            is_visible: Whether it is shown.
        """
        is_visible = is_visible and len(faces) > 0
        plain = f"{self._root}/plain"
        is_plain = is_visible and painted is None
        used, local = _compact(faces) if is_plain else _NOTHING
        self._nodes.mesh(
            plain, position[used], local, _PLAIN, is_visible=is_plain, opacity=_OPACITY
        )
        step = None if painted is None or not is_visible else face_steps(painted.level, faces)
        for number in range(STEPS + 1):
            self._facets(number, position, faces, step, painted)

    def _facets(
        self,
        number: int,
        position: Float[ndarray, "node 3"],
        faces: Int[ndarray, "face 3"],
        step: Int[ndarray, " face"] | None,
        painted: Painted | None,
    ) -> None:
        """Draw the triangles of one step of the scale."""
        name = f"{self._root}/step_{number:02d}"
        chosen = faces[step == number] if step is not None else faces[:0]
        if len(chosen) == 0 or painted is None:
            self._nodes.show(name, is_visible=False)
            return
        used, local = _compact(chosen)
        color = UNKNOWN
        if number < STEPS:
            ramp = table(painted.quantity.scale)
            at = round((number + 0.5) / STEPS * (len(ramp) - 1))
            color = (int(ramp[at, 0]), int(ramp[at, 1]), int(ramp[at, 2]))
        self._nodes.mesh(
            name, position[used], local, color, is_visible=True, opacity=None, is_flat=True
        )


def face_steps(
    level: Float[ndarray, " node"], faces: Int[ndarray, "face 3"]
) -> Int[ndarray, " face"]:
    """Tell which step of the scale each triangle has: the mean of its corners' levels.

    Corners that are not known are left out; a triangle without known corners gets `STEPS`.
    """
    corner = level[faces]
    is_known = np.isfinite(corner)
    count = is_known.sum(axis=1)
    mean = np.where(is_known, corner, 0.0).sum(axis=1) / np.maximum(count, 1)
    step = np.minimum((mean * STEPS).astype(np.int64), STEPS - 1)
    return np.where(count > 0, step, STEPS)


_NOTHING = (np.zeros(0, np.int64), np.zeros((0, 3), np.uint32))


def _compact(
    faces: Int[ndarray, "face 3"],
) -> tuple[Int[ndarray, " used"], Int[ndarray, "face 3"]]:
    """Number the corners of triangles anew, without gaps; also gives the old numbers."""
    used, local = np.unique(faces, return_inverse=True)
    return used, local.reshape(-1, 3).astype(np.uint32)
