"""What a painter draws: the parts of a viser scene as disks, lines, triangles and pictures."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
import viser.transforms
from jaxtyping import Float, UInt8
from numpy import ndarray

_GRID_PIECES = 24
_SKY = np.array([0.25, -0.35, 0.9]) / np.linalg.norm([0.25, -0.35, 0.9])
_CORNERS = np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], np.float64)


@dataclass(frozen=True, eq=False, kw_only=True)
class Part:
    """Some shapes of one kind; every color is red, green, blue from 0 to 255."""

    kind: str
    """``disk``, ``line``, ``arrow``, ``triangle``, ``picture`` or ``text``."""
    point: Float[ndarray, "shape corner 3"]
    """Corners in the world."""
    color: Float[ndarray, "shape 3"]
    """Of each shape."""
    size: float = 0.0
    """Diameter of disks and radius of arrows' shafts in the world; width of lines in pixels of a
    window 800 pixels high; height of text in the world."""
    opacity: float = 1.0
    """How much a triangle covers."""
    fade: float | None = None
    """Distance at which lines have faded away; None if they do not."""
    text: str = ""
    """What is written."""
    image: UInt8[ndarray, "row column 3"] | None = None
    """Picture between the four corners."""
    head: tuple[float, float] = (0.0, 0.0)
    """Radius and length of an arrow's head."""


def parts_of(server: viser.ViserServer) -> Iterator[Part]:
    """List what can be seen of a server's scene, grids first.

    Args:
        server: Whose scene.
    """
    scene: Any = server.scene
    handles: dict[str, Any] = scene._handle_from_node_name
    shown = [(name, node) for name, node in handles.items() if _is_visible(name, handles)]
    makers: dict[str, Any] = {
        "GridHandle": _grid,
        "PointCloudHandle": _points,
        "LineSegmentsHandle": _segments,
        "ArrowsHandle": _arrows,
        "MeshHandle": _mesh,
        "BatchedMeshHandle": _batch,
        "CameraFrustumHandle": _frustum,
        "LabelHandle": _label,
    }
    shown.sort(key=lambda entry: type(entry[1]).__name__ != "GridHandle")
    for name, node in shown:
        maker = makers.get(type(node).__name__)
        if maker is not None:
            yield from maker(node, *_place(name, handles))


def _ancestors(name: str) -> list[str]:
    parts = name.strip("/").split("/")
    return ["/" + "/".join(parts[: count + 1]) for count in range(len(parts))]


def _is_visible(name: str, handles: dict[str, Any]) -> bool:
    return all(handles[part].visible for part in _ancestors(name) if part in handles)


def _place(name: str, handles: dict[str, Any]) -> tuple[ndarray, ndarray]:
    """Find rotation and position of a node in the world."""
    rotation, position = np.eye(3), np.zeros(3)
    for part in _ancestors(name):
        if part in handles:
            node = handles[part]
            position = position + rotation @ np.asarray(node.position, np.float64)
            turn = viser.transforms.SO3(np.asarray(node.wxyz, np.float64)).as_matrix()
            rotation = rotation @ turn
    return rotation, position


def _in_world(point: Any, rotation: ndarray, position: ndarray) -> ndarray:
    return np.asarray(point, np.float64) @ rotation.T + position


def _colors(color: Any, count: int) -> ndarray:
    """Give each of some shapes a color; of corners that differ, the mean."""
    values = np.asarray(color, np.float64)
    if values.ndim == 3:
        values = values.mean(axis=1)
    return np.broadcast_to(values, (count, 3))


def _points(node: Any, rotation: ndarray, position: ndarray) -> Iterator[Part]:
    point = _in_world(node.points, rotation, position)[:, None]
    color = _colors(node.colors, len(point))
    # viser's size of a point is half its width.
    yield Part(kind="disk", point=point, color=color, size=2 * float(node.point_size))


def _segments(node: Any, rotation: ndarray, position: ndarray) -> Iterator[Part]:
    point = _in_world(node.points, rotation, position)
    color = _colors(node.colors, len(point))
    if np.ndim(node.colors) > 1:
        # viser takes colors of single line ends for amounts of light.
        light = color / 255
        bright = 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055
        color = 255 * np.where(light <= 0.0031308, 12.92 * light, bright)
    yield Part(kind="line", point=point, color=color, size=float(node.thickness))


def _arrows(node: Any, rotation: ndarray, position: ndarray) -> Iterator[Part]:
    point = _in_world(node.points, rotation, position)
    head = (float(node.head_radius), float(node.head_length))
    color, radius = _colors(node.colors, len(point)), float(node.shaft_radius)
    yield Part(kind="arrow", point=point, color=color, size=radius, head=head)


def _mesh(node: Any, rotation: ndarray, position: ndarray) -> Iterator[Part]:
    vertex = _in_world(node.vertices, rotation, position)
    corner = vertex[np.asarray(node.faces)]
    base = _colors(node.color, len(corner))
    opacity = 1.0 if node.opacity is None else float(node.opacity)
    yield Part(kind="triangle", point=corner, color=_shaded(corner, base), opacity=opacity)


def _batch(node: Any, rotation: ndarray, position: ndarray) -> Iterator[Part]:
    count = len(node.batched_positions)
    turn = viser.transforms.SO3(np.asarray(node.batched_wxyzs, np.float64)).as_matrix()
    local = np.einsum("nij,vj->nvi", turn, np.asarray(node.vertices, np.float64))
    vertex = _in_world(local + np.asarray(node.batched_positions)[:, None], rotation, position)
    corner = vertex[:, np.asarray(node.faces)]
    color = np.repeat(_colors(node.batched_colors, count), corner.shape[1], axis=0)
    corner = corner.reshape(-1, 3, 3)
    yield Part(kind="triangle", point=corner, color=_shaded(corner, color))


def _shaded(corner: ndarray, color: ndarray) -> ndarray:
    """Light both sides of triangles from above."""
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return np.clip(color * (0.84 + 0.2 * (normal @ _SKY))[:, None], 0, 255)


def _frustum(node: Any, rotation: ndarray, position: ndarray) -> Iterator[Part]:
    y = math.tan(float(node.fov) / 2)
    aspect = float(node.aspect)
    scale = float(node.scale) / math.cbrt(y * y * aspect / 3)
    size = scale * np.array([y * aspect, y, 1.0])
    corner = _in_world(_CORNERS * size, rotation, position)
    if node.image is not None:
        white = np.full((1, 3), 255.0)
        image = np.ascontiguousarray(node.image[..., :3])
        yield Part(kind="picture", point=corner[None], color=white, image=image)
    ends = [(corner[i], corner[(i + 1) % 4]) for i in range(4)]
    ends += [(position, corner[i]) for i in range(4)]
    point = np.array(ends)
    yield Part(kind="line", point=point, color=_colors(node.color, len(point)), size=1.5)


def _label(node: Any, _rotation: ndarray, position: ndarray) -> Iterator[Part]:
    height = float(node.font_scene_height)
    point = position[None, None]
    color = np.array([[30.0, 36.0, 44.0]])
    yield Part(kind="text", point=point, color=color, size=height, text=str(node.text))


def _grid(node: Any, rotation: ndarray, position: ndarray) -> Iterator[Part]:
    half = 0.5 * float(node.width)
    for size, color, width in (
        (node.cell_size, node.cell_color, node.cell_thickness),
        (node.section_size, node.section_color, node.section_thickness),
    ):
        count = int(half / float(size))
        step: ndarray = np.arange(-count, count + 1) * float(size)
        along = np.linspace(-half, half, _GRID_PIECES + 1)
        ends = np.stack([along[:-1], along[1:]], axis=-1)
        a, b = np.broadcast_arrays(step[:, None, None], ends[None])
        flat = np.zeros_like(a)
        lines = [np.stack([a, b, flat], axis=-1), np.stack([b, a, flat], axis=-1)]
        point = _in_world(np.concatenate(lines).reshape(-1, 2, 3), rotation, position)
        yield Part(
            kind="line",
            point=point,
            color=_colors(color, len(point)),
            size=float(width),
            fade=float(node.fade_distance),
        )
