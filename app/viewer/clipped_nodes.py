"""Scene nodes of which only what lies on one side of a plane is sent."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from app.viewer.nodes import SceneNodes


@dataclass(frozen=True, kw_only=True, eq=False)
class Plane:
    """A half space: the points whose coordinate along a direction is not above a limit."""

    direction: Float[ndarray, " 3"]
    """Normal of its border, pointing out of it."""
    limit: float
    """Coordinate of its border."""

    def keeps(self, point: Float[ndarray, "point 3"]) -> Bool[ndarray, " point"]:
        """Tell which points lie in it."""
        return np.asarray(point @ self.direction <= self.limit)


class ClippedNodes(SceneNodes):
    """Scene nodes that are cut at a plane; surfaces stay whole.

    Attributes:
        plane: What is kept; None for everything.
    """

    plane: Plane | None = None

    def points(self, name: str, point: ndarray, color: Any, size: float, **options: Any) -> None:
        """Draw the points that are kept."""
        if self.plane is not None and len(point):
            kept = self.plane.keeps(point)
            color = np.asarray(color)[kept] if np.ndim(color) == 2 else color
            point = point[kept]
        super().points(name, point, color, size, **options)

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
