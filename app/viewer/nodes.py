"""Scene nodes that are added when they are first needed and updated in place afterwards."""

from typing import Any

import numpy as np
import viser
from jaxtyping import Float, Int
from numpy import ndarray

_GRID = {
    False: ((214, 219, 226), (182, 190, 201)),
    True: ((42, 45, 50), (62, 67, 75)),
}
"""Colors of the grid's thin and thick lines on a light and on a dark background."""


class SceneNodes:
    """The nodes of one scene by their path; a part without content is hidden, not sent."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._scene = server.scene
        self._nodes: dict[str, Any] = {}

    def __contains__(self, name: str) -> bool:
        return name in self._nodes

    def clear(self) -> None:
        """Remove all nodes."""
        for node in self._nodes.values():
            node.remove()
        self._nodes.clear()

    def show(self, name: str, *, is_visible: bool) -> None:
        """Show or hide a node, if it is there."""
        if name in self._nodes:
            self._nodes[name].visible = is_visible

    def mesh(
        self,
        name: str,
        vertex: Float[ndarray, "vertex 3"],
        face: Int[ndarray, "face 3"],
        color: tuple[int, int, int],
        *,
        is_visible: bool,
    ) -> None:
        """Draw a semi-transparent surface."""
        node = self._nodes.get(name)
        if node is None and is_visible:
            self._nodes[name] = self._scene.add_mesh_simple(
                name, vertex, face, color=color, opacity=0.62, side="double"
            )
        elif node is not None and is_visible:
            node.vertices = vertex
        self.show(name, is_visible=is_visible)

    def points(
        self,
        name: str,
        point: Float[ndarray, "point 3"],
        color: Any,
        size: float,
        *,
        is_visible: bool,
    ) -> None:
        """Draw points of one color, or of a color each."""
        node = self._nodes.get(name)
        is_visible = is_visible and len(point) > 0
        if node is None and is_visible:
            self._nodes[name] = self._scene.add_point_cloud(
                name,
                np.asarray(point, dtype=np.float32),
                color,
                point_size=size,
                point_shape="circle",
                precision="float32",
            )
        elif node is not None and is_visible:
            node.points = np.asarray(point, dtype=np.float32)
            if np.ndim(color) == 2:
                node.colors = color
        self.show(name, is_visible=is_visible)

    def segments(
        self,
        name: str,
        segment: Float[ndarray, "segment 2 3"],
        color: tuple[int, int, int],
        width: float,
        *,
        is_visible: bool,
    ) -> None:
        """Draw lines of a width in pixels."""
        node = self._nodes.get(name)
        is_visible = is_visible and len(segment) > 0
        if node is None and is_visible:
            self._nodes[name] = self._scene.add_line_segments(
                name,
                np.asarray(segment, dtype=np.float32),
                color,
                thickness=width,
                thickness_units="screen",
            )
        elif node is not None and is_visible:
            node.points = np.asarray(segment, dtype=np.float32)
        self.show(name, is_visible=is_visible)

    def arrows(
        self,
        name: str,
        arrow: Float[ndarray, "arrow 2 3"],
        color: tuple[int, int, int],
        width: float,
    ) -> None:
        """Draw arrows from their first to their second point, of a width in scene units."""
        node = self._nodes.get(name)
        if node is None and len(arrow):
            self._nodes[name] = self._scene.add_arrows(
                name,
                arrow,
                color,
                shaft_radius=0.5 * width,
                head_radius=1.6 * width,
                head_length=5.0 * width,
            )
        elif node is not None and len(arrow):
            node.points = arrow
        self.show(name, is_visible=bool(len(arrow)))

    def ground(
        self, name: str, center: tuple[float, float, float], cell: float, count: int
    ) -> None:
        """Draw a horizontal grid that fades into the distance."""
        self._nodes[name] = self._scene.add_grid(
            name,
            width=cell * count,
            height=cell * count,
            cell_size=cell / 2,
            section_size=cell,
            cell_color=_GRID[False][0],
            section_color=_GRID[False][1],
            cell_thickness=0.6,
            section_thickness=1.0,
            shadow_opacity=0.15,
            fade_distance=2.0 * cell * count,
            position=center,
        )

    def color_ground(self, name: str, *, is_dark: bool) -> None:
        """Color the grid for a light or a dark background."""
        node = self._nodes.get(name)
        cell, section = _GRID[is_dark]
        if node is not None and tuple(node.cell_color) != cell:
            node.cell_color, node.section_color = cell, section
