"""The smooth surface of an object in the colors that a recording shows of it."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.data.view import View
from physhandi.metrics.photometric import seen_colors
from physhandi.simulation.object_surface import ObjectSurface
from physhandi.triangles import vertex_normals


def colored_surface(
    surface: ObjectSurface, node: Float[ndarray, "node 3"], views: Sequence[View]
) -> ObjectSurface:
    """Give a surface the colors of frame 0; those of views that look straight at it count most.

    Args:
        surface: The surface.
        node: Its nodes in frame 0 [m].
        views: Views of the recording; those that have color and masks lend their colors.

    Raises:
        SequenceError: If an image is damaged.
    """
    vertex = surface.place(node).astype(np.float64)
    return replace(surface, color=seen_colors(views, vertex, vertex_normals(vertex, surface.face)))
