"""Scene nodes that can be cut at a plane: only what lies on one side of it is sent."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from app.viewer.nodes import SceneNodes


@dataclass(frozen=True, kw_only=True, eq=False)
class Plane:
    """A half space: the points whose coordinate along a direction is below a limit."""

    direction: Float[ndarray, " 3"]
    """Normal of its border, pointing out of it."""
    limit: float
    """Coordinate of its border."""
    has_border: bool
    """Whether points on the border are in it."""

    def keeps(self, point: Float[ndarray, "point 3"]) -> Bool[ndarray, " point"]:
        """Tell which points lie in it."""
        along = point @ self.direction
        return np.asarray(along <= self.limit if self.has_border else along < self.limit)


class ClippedNodes(SceneNodes):
    """Scene nodes that are cut at a plane; surfaces stay whole.

    Attributes:
        plane: What is kept; None for everything.
    """

    plane: Plane | None = None

    def points(self, name: str, point: ndarray, color: Any, size: float, **options: Any) -> None:
        """Draw the points that are kept, in a size that may change."""
        if self.plane is not None and len(point):
            kept = self.plane.keeps(point)
            color = np.asarray(color)[kept] if np.ndim(color) == 2 else color
            point = point[kept]
        super().points(name, point, color, size, **options)
        node = self._nodes.get(name)
        if node is not None and node.point_size != size:
            node.point_size = size

    def segments(
        self, name: str, segment: ndarray, color: Any, width: float, **options: Any
    ) -> None:
        """Draw the lines whose middle is kept."""
        if self.plane is not None and len(segment):
            kept = self.plane.keeps(segment.mean(axis=1))
            color = np.asarray(color)[kept] if np.ndim(color) >= 2 else color
            segment = segment[kept]
        super().segments(name, segment, color, width, **options)

    def arrows(self, name: str, arrow: ndarray, color: Any, width: float, **options: Any) -> None:
        """Draw the arrows whose start is kept."""
        if self.plane is not None and len(arrow):
            kept = self.plane.keeps(arrow[:, 0])
            color = np.asarray(color)[kept] if np.ndim(color) >= 2 else color
            arrow = arrow[kept]
        super().arrows(name, arrow, color, width, **options)
