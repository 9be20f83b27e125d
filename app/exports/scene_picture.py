"""A picture of a viser server's scene without a browser or a graphics card."""

import math
from collections.abc import Callable, Iterator
from collections.abc import Sequence as Listing
from typing import Any

import cv2
import numpy as np
import viser
import viser.transforms
from jaxtyping import Float, UInt8
from numpy import ndarray

from app.viewer.content.session_state import Pose
from physhandi.appearance.rasterise import render_splats
from physhandi.appearance.splats import Splats
from physhandi.data.camera import PinholeCamera
from physhandi.rendering.renderer import rasterize, render
from physhandi.rendering.shapes import Balls, Image, Segments, Shape, Surface, arrows, facets
from physhandi.srgb import to_srgb

BACKGROUND = {False: (255, 255, 255), True: (20, 21, 23)}
"""Behind everything, on light and dark pages."""
INK = {False: (30, 36, 44), True: (226, 230, 236)}
"""Of what is written on them."""
SKY = np.array([0.25, -0.35, 0.9])
"""Direction from which the light comes."""
SHADING = 0.4
_WINDOW = 800.0
"""Rows of the window in which a line is as many pixels wide as viser says."""
_NEAR = 1e-3
"""Nearest that is seen, in distances from the camera to what it looks at."""
_LEAST_RADIUS, _LEAST_WIDTH = 0.5, 0.5
_GRID_PIECES = 24
_SUNK = 1.005
"""Factor by which grids are drawn farther away than what lies in them."""
_CORNERS = np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], np.float64)

_Nodes = dict[str, Any]


def draw_scene(
    server: viser.ViserServer, pose: Pose, width: int, height: int, *, is_dark: bool = False
) -> UInt8[ndarray, "row column 3"]:
    """Draw what can be seen of a scene.

    Args:
        server: Whose scene.
        pose: Where the camera stands.
        width: Of the picture [px].
        height: Of the picture [px].
        is_dark: Whether the background is dark.

    Returns:
        The picture (red, green, blue).
    """
    view = _View(pose, width, height, is_dark=is_dark)
    shapes = [shape for node in _visible_nodes(server) for shape in view.shapes(*node)]
    near = _NEAR * float(np.linalg.norm(pose.look_at - pose.position))
    image = render(view.camera, shapes, background=BACKGROUND[is_dark], light=SKY, near=near)
    image = cv2.cvtColor(image, cv2.COLOR_RGBA2RGB)
    groups = [node for node in _visible_nodes(server) if _is_splats(node[0])]
    if groups:
        drawn = render_splats(
            view.camera,
            _all_splats(groups),
            background=image / np.float32(255.0),
            occluder=rasterize(view.camera, shapes, near=near).depth.astype(np.float32),
        )
        image = np.rint(255.0 * drawn.color).astype(np.uint8)
    for node, _, position in _visible_nodes(server):
        if type(node).__name__ == "LabelHandle":
            view.write(image, node, position)
    return image


def _is_splats(node: Any) -> bool:
    return type(node).__name__ == "GaussianSplatHandle"


def _all_splats(groups: Listing[tuple[Any, ndarray, ndarray]]) -> Splats:
    """Collect the splats of nodes, which are equally wide in all directions."""
    parts: list[tuple[ndarray, ...]] = []
    for node, rotation, position in groups:
        unit = float(node.scale)
        center = _in_world(unit * node.centers, rotation, position)
        parts.append(
            (
                center.astype(np.float32),
                np.float32(unit) * np.sqrt(node.covariances[:, 0, 0]),
                node.rgbs / np.float32(255.0),
                node.opacities[:, 0] / np.float32(255.0),
            )
        )
    center, scale, color, opacity = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Splats(center=center, scale=scale, color=color, opacity=opacity, rest_node=center[:1])


def _visible_nodes(server: viser.ViserServer) -> Iterator[tuple[Any, ndarray, ndarray]]:
    """List the nodes that are shown, with their rotations and positions in the world."""
    scene: Any = server.scene
    nodes: _Nodes = scene._handle_from_node_name  # noqa: SLF001  # no other way
    for name, node in nodes.items():
        parts = name.strip("/").split("/")
        paths = ["/" + "/".join(parts[: count + 1]) for count in range(len(parts))]
        line = [nodes[path] for path in paths if path in nodes]
        if not all(one.visible for one in line):
            continue
        rotation, position = np.eye(3), np.zeros(3)
        for one in line:
            position = position + rotation @ np.asarray(one.position, np.float64)
            rotation = rotation @ _rotations(one.wxyz)
        yield node, rotation, position


class _View:
    """Turns nodes into shapes for one picture."""

    def __init__(self, pose: Pose, width: int, height: int, *, is_dark: bool) -> None:
        self.camera: PinholeCamera = pose.camera(width, height)
        self._is_dark = is_dark
        self._focal = float(self.camera.K[0, 0])
        self._makers: dict[str, Callable[..., Iterator[Shape]]] = {
            "GridHandle": self._grid,
            "PointCloudHandle": self._points,
            "LineSegmentsHandle": self._lines,
            "ArrowsHandle": self._arrows,
            "MeshHandle": self._mesh,
            "BatchedMeshHandle": self._meshes,
            "CameraFrustumHandle": self._frustum,
        }

    def shapes(self, node: Any, rotation: ndarray, position: ndarray) -> Iterator[Shape]:
        """Give the shapes of a node; none if it is of a kind that has none."""
        maker = self._makers.get(type(node).__name__)
        if maker is not None:
            yield from maker(node, rotation, position)

    def write(self, image: ndarray, node: Any, position: ndarray) -> None:
        """Write the lines of a label over a picture; viser hides labels behind nothing."""
        if self.camera.camera_depth(position) <= 0:
            return
        place = self.camera.project(position)
        height = float(node.font_scene_height) * self._focal / self.camera.camera_depth(position)
        if not (np.abs(place) < 2**15).all() or height > 2**10:
            return
        font, size = cv2.FontFace("sans"), max(int(0.8 * height), 1)
        lines = str(node.text).split("\n")
        for number, line in enumerate(lines):
            box = cv2.getTextSize((0, 0), line, (0, 0), font, size)
            x = int(place[0] - 0.5 * box[2])
            y = int(place[1] + (number - len(lines) / 2 + 0.8) * height)
            cv2.putText(image, line, (x, y), INK[self._is_dark], font, size)

    def _wide(self, thickness: float) -> float:
        """Give the width of lines [px]."""
        return max(thickness * self.camera.height / _WINDOW, _LEAST_WIDTH)

    def _points(self, node: Any, rotation: ndarray, position: ndarray) -> Iterator[Balls]:
        center = _in_world(node.points, rotation, position)
        least = _LEAST_RADIUS / self._focal * self.camera.camera_depth(center)
        # viser's size of a point is half its width.
        radius = np.maximum(float(node.point_size), least)
        yield Balls(center=center, radius=radius, color=_colors(node.colors))

    def _lines(self, node: Any, rotation: ndarray, position: ndarray) -> Iterator[Segments]:
        color = _colors(node.colors)
        if np.ndim(node.colors) > 1:
            # viser takes colors of single line ends for amounts of light.
            color = 255 * to_srgb(color / 255)
        ends = _in_world(node.points, rotation, position)
        yield Segments(ends=ends, width=self._wide(float(node.thickness)), color=color)

    def _arrows(self, node: Any, rotation: ndarray, position: ndarray) -> Iterator[Surface]:
        yield arrows(
            _in_world(node.points, rotation, position),
            radius=float(node.shaft_radius),
            head_radius=float(node.head_radius),
            head_length=float(node.head_length),
            color=_colors(node.colors),
            shading=SHADING,
        )

    def _mesh(self, node: Any, rotation: ndarray, position: ndarray) -> Iterator[Surface]:
        vertex, faces = (
            _in_world(node.vertices, rotation, position),
            np.asarray(node.faces, np.int64),
        )
        color = _colors(node.color)
        if node.flat_shading:
            vertex, faces = facets(vertex, faces)
        yield Surface(
            vertex=vertex,
            faces=faces,
            # Behind the color of a mesh may be those of its vertices.
            color=color[1:] if len(color) > 1 else color,
            opacity=1.0 if node.opacity is None else float(node.opacity),
            shading=SHADING,
        )

    def _meshes(self, node: Any, rotation: ndarray, position: ndarray) -> Iterator[Surface]:
        vertex, faces = np.asarray(node.vertices, np.float64), np.asarray(node.faces, np.int64)
        if node.flat_shading:
            vertex, faces = facets(vertex, faces)
        local = np.einsum("nij,vj->nvi", _rotations(node.batched_wxyzs), vertex)
        placed = _in_world(local + np.asarray(node.batched_positions)[:, None], rotation, position)
        count = len(placed)
        first = len(vertex) * np.arange(count)[:, None, None]
        color = np.broadcast_to(_colors(node.batched_colors), (count, 3))
        yield Surface(
            vertex=placed.reshape(-1, 3),
            faces=(faces + first).reshape(-1, 3),
            color=np.repeat(color, len(vertex), axis=0),
            shading=SHADING,
        )

    def _frustum(self, node: Any, rotation: ndarray, position: ndarray) -> Iterator[Shape]:
        y = math.tan(float(node.fov) / 2)
        aspect = float(node.aspect)
        scale = float(node.scale) / math.cbrt(y * y * aspect / 3)
        size = scale * np.array([y * aspect, y, 1.0])
        corner = _in_world(_CORNERS * size, rotation, position)
        if node.image is not None:
            yield Image(corner=corner, image=np.ascontiguousarray(node.image[..., :3]))
        ends = [(corner[i], corner[(i + 1) % 4]) for i in range(4)]
        # From where the camera stands itself, the other edges are points.
        if np.linalg.norm(position - self.camera.T_world_camera[:3, 3]) > 1e-6:
            ends += [(position, corner[i]) for i in range(4)]
        yield Segments(ends=np.array(ends), width=self._wide(1.5), color=_colors(node.color))

    def _grid(self, node: Any, rotation: ndarray, position: ndarray) -> Iterator[Segments]:
        half = 0.5 * float(node.width)
        ground = np.array(BACKGROUND[self._is_dark], np.float64)
        eye = self.camera.T_world_camera[:3, 3]
        for size, color, thickness in (
            (node.cell_size, node.cell_color, node.cell_thickness),
            (node.section_size, node.section_color, node.section_thickness),
        ):
            count = int(half / float(size))
            step: ndarray = np.arange(-count, count + 1) * float(size)
            along = np.linspace(-half, half, _GRID_PIECES + 1)
            ends = np.stack([along[:-1], along[1:]], axis=-1)
            a, b = np.broadcast_arrays(step[:, None, None], ends[None])
            flat = np.zeros_like(a)
            lines = np.stack([[a, b], [b, a]], axis=0)
            local = np.concatenate([lines, np.stack([flat, flat])[:, None]], axis=1)
            point = _in_world(np.moveaxis(local, 1, -1).reshape(-1, 2, 3), rotation, position)
            depth = self.camera.camera_depth(point).mean(axis=1, keepdims=True)
            # Where something lies on the ground, that is seen.
            point = eye + _SUNK * (point - eye)
            share = np.clip(1 - depth / float(node.fade_distance), 0.0, 1.0)
            yield Segments(
                ends=point,
                width=self._wide(float(thickness)),
                color=share * _colors(color) + (1 - share) * ground,
            )


def _rotations(wxyz: Any) -> Float[ndarray, "*batch 3 3"]:
    return viser.transforms.SO3(np.asarray(wxyz, np.float64)).as_matrix()


def _in_world(point: Any, rotation: ndarray, position: ndarray) -> Float[ndarray, "*batch 3"]:
    return np.asarray(point, np.float64) @ rotation.T + position


def _colors(color: Any) -> Float[ndarray, "#shape 3"]:
    """Give the color of all shapes, or of each; of corners that differ, the mean."""
    values = np.asarray(color, np.float64)
    return values.mean(axis=1) if values.ndim == 3 else np.atleast_2d(values)
