"""Scene nodes that are added when they are first needed and updated in place afterwards."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
import viser._messages as messages
from jaxtyping import Bool, Float, Float32, Int, UInt8
from numpy import ndarray

from app.viewer.scene.splat_groups import SplatGroups
from physhandi.srgb import to_linear

_GRID = {
    False: ((214, 219, 226), (182, 190, 201)),
    True: ((42, 45, 50), (62, 67, 75)),
}
"""Colors of the grid's thin and thick lines on a light and on a dark background."""

_UNMOVED, _UNTURNED = 0.005, 5e-4
"""By so little a group of splats may be elsewhere unseen: in widths of splats, and in parts of a
quaternion."""
_DARKEST = 32
"""Least brightness of a mesh's own color, by which those of its vertices are divided."""
_LINEAR = np.round(255 * to_linear(np.arange(256) / 255)).astype(np.uint8)
"""Brightness of each color value: the viewer takes colors of single line ends for brightness."""


class SceneNodes:
    """The nodes of one scene by their path; a part without content is hidden, not sent."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._scene = server.scene
        self._nodes: dict[str, Any] = {}
        self._splats: dict[str, _MovedSplats] = {}

    def __contains__(self, name: str) -> bool:
        return name in self._nodes

    def clear(self) -> None:
        """Remove all nodes, those below others first."""
        for node in reversed(self._nodes.values()):
            node.remove()
        self._nodes.clear()
        self._splats.clear()

    def hide(self, *paths: str) -> None:
        """Hide all nodes, or those whose path begins with one of these."""
        for name, node in self._nodes.items():
            if not paths or name.startswith(paths):
                node.visible = False

    def show(self, name: str, *, is_visible: bool) -> None:
        """Show or hide a node, if it is there."""
        if name in self._nodes:
            self._nodes[name].visible = is_visible

    def mesh(
        self,
        name: str,
        vertex: Float[ndarray, "vertex 3"],
        face: Int[ndarray, "face 3"],
        color: tuple[int, int, int] | UInt8[ndarray, "vertex 3"],
        *,
        is_visible: bool,
        opacity: float | None = 0.62,
    ) -> None:
        """Draw a surface of one color, or of a color each vertex.

        viser's meshes have one color. The colors of vertices follow it in the same field, for our
        own part of the page (`web_assets/scene_frame.js`); viser alone shows their mean.
        """
        node: Any = self._nodes.get(name)
        if is_visible:
            if node is None:
                # Coarse maps of shadows put whole surfaces into a shadow of their own.
                node = self._nodes[name] = self._scene.add_mesh_simple(
                    name, vertex, face, opacity=opacity, side="double", receive_shadow=False
                )
            node.vertices, node.faces = vertex, np.asarray(face, dtype=np.uint32)
            node.opacity = opacity
            node.color = color if isinstance(color, tuple) else with_mean(color)
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
            node.colors = np.asarray(color, dtype=np.uint8)
        self.show(name, is_visible=is_visible)

    def spheres(
        self,
        name: str,
        point: Float[ndarray, "point 3"],
        color: Any,
        size: float,
        *,
        is_visible: bool,
    ) -> None:
        """Draw points as shaded spheres, as large as `points` draws its disks."""
        node = self._nodes.get(name)
        is_visible = is_visible and len(point) > 0
        if node is not None and is_visible and len(node.batched_positions) != len(point):
            self._nodes.pop(name).remove()
            node = None
        if node is None and is_visible:
            self._nodes[name] = self._scene.add_batched_meshes_simple(
                name,
                *_sphere(0.5 * size),
                np.tile([1.0, 0.0, 0.0, 0.0], (len(point), 1)),
                np.asarray(point, dtype=np.float32),
                batched_colors=color,
                lod="off",
                cast_shadow=False,
                receive_shadow=False,
            )
        elif node is not None and is_visible:
            node.batched_positions = np.asarray(point, dtype=np.float32)
            node.batched_colors = np.asarray(color, dtype=np.uint8)
        self.show(name, is_visible=is_visible)

    def splats(
        self, name: str, groups: SplatGroups, node: Float[ndarray, "node 3"], *, is_visible: bool
    ) -> None:
        """Draw splats where the nodes of their object carry them.

        Args:
            name: Path below which there is a node a group.
            groups: The splats; always the same ones below this path.
            node: The object's nodes [m].
            is_visible: Whether to show them.
        """
        if is_visible:
            if name not in self._nodes:
                self._nodes[name] = self._scene.add_frame(name, show_axes=False)
                self._splats[name] = _MovedSplats(self._scene, name, groups)
            self._splats[name].move(node)
        self.show(name, is_visible=is_visible)

    def frame(self, name: str, position: Float[ndarray, " 3"]) -> None:
        """Place a coordinate frame, below which other nodes can be drawn."""
        node = self._nodes.get(name)
        if node is None:
            self._nodes[name] = self._scene.add_frame(name, show_axes=False, position=position)
            return
        node.position = position
        node.visible = True

    def label(
        self, name: str, text: str, position: Float[ndarray, " 3"], *, anchor: Any, height: float
    ) -> None:
        """Write a text that faces the camera, its lines as high as `height` in the scene."""
        node = self._nodes.get(name)
        if node is None:
            self._nodes[name] = self._scene.add_label(
                name,
                text,
                position=position,
                anchor=anchor,
                font_size_mode="scene",
                font_scene_height=height,
            )
            return
        node.text, node.position, node.visible = text, position, True
        if node.font_scene_height != height:
            node.font_scene_height = height

    def segments(
        self,
        name: str,
        segment: Float[ndarray, "segment 2 3"],
        color: Any,
        width: float,
        *,
        is_visible: bool,
    ) -> None:
        """Draw lines of a width in pixels, of one color or of a color for each end."""
        # The viewer's lines do not change from one color to many: these are other lines.
        painted = f"{name}_painted"
        is_painted = np.ndim(color) > 1
        self.show(name if is_painted else painted, is_visible=False)
        name = painted if is_painted else name
        color = _LINEAR[np.asarray(color, dtype=np.uint8)] if is_painted else color
        node = self._nodes.get(name)
        is_visible = is_visible and len(segment) > 0
        if node is None and is_visible:
            self._nodes[name] = self._scene.add_line_segments(
                name,
                np.asarray(segment, dtype=np.float32),
                np.asarray(color, dtype=np.uint8),
                thickness=width,
                thickness_units="screen",
            )
        elif node is not None and is_visible:
            node.points = np.asarray(segment, dtype=np.float32)
            node.colors = np.asarray(color, dtype=np.uint8)
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
                head_length=4.0 * width,
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

    def lift(self, name: str, height: float) -> None:
        """Put a node at another height."""
        node = self._nodes.get(name)
        if node is not None and abs(float(node.position[2]) - height) > 1e-9:
            node.position = (float(node.position[0]), float(node.position[1]), height)

    def color_ground(self, name: str, *, is_dark: bool) -> None:
        """Color the grid for a light or a dark background."""
        node = self._nodes.get(name)
        cell, section = _GRID[is_dark]
        if node is not None and tuple(node.cell_color) != cell:
            node.cell_color, node.section_color = cell, section


class _MovedSplats:
    """The nodes of one object's groups of splats."""

    def __init__(self, scene: viser.SceneApi, name: str, groups: SplatGroups) -> None:
        self._queue: Any = scene._queue_scene_message  # noqa: SLF001  # see `move`
        self._groups = groups
        splats = groups.splats
        # Squares of a millimetre would have three digits in the 16-bit floats that are sent.
        unit = float(splats.scale.max())
        offset = (splats.center - groups.middle[groups.group]) / unit
        covariance = np.square(splats.scale / unit)[:, None, None] * np.eye(3)
        self._nodes: list[Any] = []
        for group in range(groups.count):
            of_group = groups.group == group
            node = scene.add_gaussian_splats(
                f"{name}/{group:03d}",
                offset[of_group],
                covariance[of_group],
                splats.color[of_group],
                splats.opacity[of_group, None],
                scale=unit,
            )
            self._nodes.append(node)
        self._pose = np.full((groups.count, 7), np.nan)
        self._least = np.repeat([_UNTURNED, _UNMOVED * unit], [4, 3])

    def move(self, node: Float[ndarray, "node 3"]) -> None:
        """Move the groups that are elsewhere when the object's nodes are there.

        The setters of viser compare two numbers at a time, which takes seven times as long.
        """
        pose = np.concatenate(self._groups.poses(node), axis=1)
        # The differences to a group that was nowhere before are not numbers.
        moved = np.flatnonzero(~(np.abs(pose - self._pose) <= self._least).all(axis=1))
        for group in moved:
            its, at = self._nodes[group], pose[group]
            its._impl.wxyz[:], its._impl.position[:] = at[:4], at[4:]  # noqa: SLF001  # see `move`
            self._queue(messages.SetOrientationMessage(its.name, tuple(at[:4].tolist())))
            self._queue(messages.SetPositionMessage(its.name, tuple(at[4:].tolist())))
        self._pose[moved] = pose[moved]


def with_mean(color: UInt8[ndarray, "vertex 3"]) -> UInt8[ndarray, "mean_and_vertex 3"]:
    """Put the mean of colors before them; dark ones are brightened, since they divide others."""
    mean = np.maximum(color.mean(axis=0, keepdims=True), _DARKEST)
    return np.concatenate([mean.round().astype(np.uint8), color])


def _sphere(radius: float) -> tuple[Float[ndarray, "vertex 3"], Int[ndarray, "face 3"]]:
    """Make a small sphere: an octahedron, each face cut into four twice over."""
    corner = np.concatenate([np.eye(3), -np.eye(3)])
    upper = [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2]]
    face = corner[np.array(upper + [[b, a, 5] for a, b, _ in upper])]
    for _ in range(2):
        a, b, c = face[:, 0], face[:, 1], face[:, 2]
        middle = [(a + b) / 2, (b + c) / 2, (c + a) / 2]
        ab, bc, ca = (m / np.linalg.norm(m, axis=1, keepdims=True) for m in middle)
        parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        face = np.concatenate([np.stack(part, axis=1) for part in parts])
    vertex, index = np.unique(face.reshape(-1, 3).round(9), axis=0, return_inverse=True)
    return (radius * vertex).astype(np.float32), index.reshape(-1, 3).astype(np.uint32)


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

    def cut(
        self,
        vertex: Float[ndarray, "vertex 3"],
        face: Int[ndarray, "face 3"],
        color: UInt8[ndarray, "vertex 3"],
    ) -> tuple[Float32[ndarray, "kept 3"], Int[ndarray, "cut 3"], UInt8[ndarray, "kept 3"]]:
        """Keep the part of a surface that lies in it; triangles on the border are cut.

        Args:
            vertex: Its vertices [m].
            face: Its triangles.
            color: Colors of the vertices.

        Returns:
            The same of the part, with the vertices that it needs; those on the border are not
            shared between triangles.
        """
        is_in = self.keeps(vertex)
        count = is_in[face].sum(axis=1)
        # The vertex that is alone on its side comes first: two edges leave it over the border.
        crossing = face[(count == 1) | (count == 2)]
        alone = is_in[crossing] == (is_in[crossing].sum(axis=1) == 1)[:, None]
        first = np.argmax(alone, axis=1)[:, None]
        crossing = np.take_along_axis(crossing, (first + np.arange(3)) % 3, axis=1)
        start, end = crossing[:, [0, 0]], crossing[:, 1:]
        height = vertex @ self.direction - self.limit
        part = height[start] / np.where(
            height[start] == height[end], 1.0, height[start] - height[end]
        )
        part = np.clip(part, 0.0, 1.0)[..., None]
        on_border = vertex[start] + part * (vertex[end] - vertex[start])
        its_color = color[start] + part * (color[end].astype(float) - color[start])
        a, b = len(vertex) + np.arange(2 * len(crossing)).reshape(-1, 2).T
        is_first_in = is_in[crossing[:, 0]]
        one = np.stack([crossing[:, 0], a, b], axis=1)[is_first_in]
        two = np.stack([a, crossing[:, 1], crossing[:, 2], a, crossing[:, 2], b], axis=1)
        part_face = np.concatenate([face[count == 3], one, two[~is_first_in].reshape(-1, 3)])
        used, place = np.unique(part_face, return_inverse=True)
        return (
            np.concatenate([vertex, on_border.reshape(-1, 3)])[used].astype(np.float32),
            place.reshape(-1, 3),
            np.concatenate([color, its_color.reshape(-1, 3).round().astype(np.uint8)])[used],
        )


class ClippedNodes(SceneNodes):
    """Scene nodes that are cut at a plane.

    Attributes:
        plane: What is kept; None for everything.
    """

    plane: Plane | None = None

    def mesh(
        self,
        name: str,
        vertex: ndarray,
        face: ndarray,
        color: Any,
        *,
        is_visible: bool,
        **options: Any,
    ) -> None:
        """Draw the part of a surface that is kept."""
        if self.plane is not None:
            is_painted = np.ndim(color) == 2
            painted: Any = color if is_painted else np.zeros((len(vertex), 3), np.uint8)
            vertex, face, painted = self.plane.cut(vertex, face, painted)
            color = painted if is_painted else color
            is_visible = is_visible and len(face) > 0
        super().mesh(name, vertex, face, color, is_visible=is_visible, **options)

    def points(self, name: str, point: ndarray, color: Any, size: float, **options: Any) -> None:
        """Draw the points that are kept, in a size that may change."""
        if self.plane is not None and len(point):
            is_kept = self.plane.keeps(point)
            color = np.asarray(color)[is_kept] if np.ndim(color) == 2 else color
            point = point[is_kept]
        super().points(name, point, color, size, **options)
        node = self._nodes.get(name)
        if node is not None and node.point_size != size:
            node.point_size = size

    def segments(
        self, name: str, segment: ndarray, color: Any, width: float, **options: Any
    ) -> None:
        """Draw the lines whose middle is kept."""
        if self.plane is not None and len(segment):
            is_kept = self.plane.keeps(segment.mean(axis=1))
            color = np.asarray(color)[is_kept] if np.ndim(color) >= 2 else color
            segment = segment[is_kept]
        super().segments(name, segment, color, width, **options)

    def arrows(self, name: str, arrow: ndarray, color: Any, width: float, **options: Any) -> None:
        """Draw the arrows whose start is kept."""
        if self.plane is not None and len(arrow):
            is_kept = self.plane.keeps(arrow[:, 0])
            color = np.asarray(color)[is_kept] if np.ndim(color) >= 2 else color
            arrow = arrow[is_kept]
        super().arrows(name, arrow, color, width, **options)
