"""Paints the scene of a viser server without a browser or a graphics card.

The farthest shapes are painted first, into horizontal strips of twice the resolution, which bounds
the memory of a large picture. Shapes are small beside the scene, so that the order of their
middles is the order in which they hide each other; a picture from the browser is exact.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from app.exports.primitives import Part
from app.viewer.content.session_state import Pose

BACKGROUND = {False: (255, 255, 255), True: (20, 21, 23)}
"""Behind everything, on light and dark pages."""
LARGEST = 4_096
"""Longest side of a picture."""
_FINER = 2
_STRIP = 512
_BITS = 4
_WINDOW = 800.0
_TEXT = {False: (30, 36, 44), True: (226, 230, 236)}


@dataclass(frozen=True, eq=False, kw_only=True)
class _View:
    """A camera, and the window that it looks through."""

    pose: Pose
    width: int
    height: int

    @property
    def focal(self) -> float:
        return 0.5 * self.height / float(np.tan(self.pose.fov / 2))

    def local(self, point: Float[ndarray, "... 3"]) -> Float[ndarray, "... 3"]:
        """Turn points into the camera's axes: right, down, ahead."""
        ahead = self.pose.look_at - self.pose.position
        ahead = ahead / np.linalg.norm(ahead)
        right = np.cross(ahead, self.pose.up)
        right = right / np.linalg.norm(right)
        axes = np.stack([right, np.cross(ahead, right), ahead])
        return (point - self.pose.position) @ axes.T

    def pixels(self, local: Float[ndarray, "... 3"]) -> Float[ndarray, "... 2"]:
        """Project points in the camera's axes."""
        middle = np.array([self.width - 1.0, self.height - 1.0]) / 2
        return local[..., :2] * (self.focal / local[..., 2:]) + middle


@dataclass(frozen=True, eq=False, kw_only=True)
class _Shapes:
    """Shapes in the picture: their distances, how far they may reach, pixels in a metre."""

    part: Part
    pixel: Float[ndarray, "shape corner 2"]
    depth: Float[ndarray, " shape"]
    color: Float[ndarray, "shape 3"]
    reach: Float[ndarray, " shape"]
    scale: Float[ndarray, " shape"]


def paint_scene(
    parts: Iterable[Part], pose: Pose, width: int, height: int, *, is_dark: bool = False
) -> UInt8[ndarray, "row column 3"]:
    """Paint a picture.

    Args:
        parts: What there is, as `parts_of` lists it.
        pose: Where the camera stands.
        width: Of the picture [px].
        height: Of the picture [px].
        is_dark: Whether the background is dark.

    Returns:
        The picture (red, green, blue).
    """
    fine = _View(pose=pose, width=_FINER * width, height=_FINER * height)
    shapes = [shape for part in parts for shape in _project(part, fine, is_dark)]
    grids = [shape for shape in shapes if shape.part.fade is not None]
    solid = [s for s in shapes if s.part.fade is None and s.part.opacity >= 1]
    sheer = [s for s in shapes if s.part.opacity < 1]
    strips: list[ndarray] = []
    for top in range(0, height, _STRIP):
        rows = min(_STRIP, height - top)
        strip = _Strip(fine, _FINER * top, _FINER * rows, BACKGROUND[is_dark])
        strip.draw(grids, keeps_order=True)
        strip.draw(solid)
        for shape in sheer:
            strip.cover(shape)
        strips.append(strip.shrunk(width, rows))
    return np.concatenate(strips)


def _project(part: Part, view: _View, is_dark: bool) -> list[_Shapes]:
    """Find where shapes are in the picture; what is behind the camera is left out."""
    near = 1e-3 * float(np.linalg.norm(view.pose.look_at - view.pose.position))
    local = view.local(part.point)
    color = np.asarray(part.color, np.float64)
    if part.kind == "line":
        local = _clipped(local, near)
    is_ahead = (local[..., 2] >= near).all(axis=-1)
    local, color = local[is_ahead], color[is_ahead]
    if not len(local):
        return []
    depth = local[..., 2].mean(axis=-1)
    if part.kind == "disk":
        depth = np.maximum(depth - 0.5 * part.size, near)  # As if it were a ball.
    if part.fade is not None:
        share = (np.maximum(0.0, 1 - depth / part.fade))[:, None]
        color = share * color + (1 - share) * np.array(BACKGROUND[is_dark], np.float64)
    if part.kind == "text":
        color = np.array([_TEXT[is_dark]], np.float64)
    scale = view.focal / local[..., 2].mean(axis=-1)
    wide = {"disk": part.size, "arrow": 2 * part.head[0] + 2 * part.size, "text": 20 * part.size}
    reach = wide.get(part.kind, 0.0) * scale + 4 + part.size * (part.kind == "line")
    pixel = view.pixels(local)
    return [_Shapes(part=part, pixel=pixel, depth=depth, color=color, reach=reach, scale=scale)]


def _clipped(local: Float[ndarray, "line 2 3"], near: float) -> Float[ndarray, "line 2 3"]:
    """Cut the parts of lines off that are behind the camera."""
    first, last = local[:, 0], local[:, 1]
    span = last[:, 2] - first[:, 2]
    share = (near - first[:, 2]) / np.where(span == 0, 1.0, span)
    cut = first + share[:, None] * (last - first)
    cut[:, 2] = near
    crosses = (first[:, 2] < near) != (last[:, 2] < near)
    ends = [np.where((crosses & (end[:, 2] < near))[:, None], cut, end) for end in (first, last)]
    return np.stack(ends, axis=1)


class _Strip:
    """Some rows of the picture."""

    def __init__(self, view: _View, top: int, rows: int, background: tuple[int, int, int]) -> None:
        self._view = view
        self._shift = np.array([0.0, float(top)])
        self._shape = (rows, view.width)
        self._color = np.full((rows, view.width, 3), background, np.uint8)
        self._depth = np.full((rows, view.width), np.inf, np.float32)

    def draw(self, shapes: list[_Shapes], *, keeps_order: bool = False) -> None:
        """Paint shapes, the farthest first."""
        jobs: list[tuple[float, _Shapes, int]] = []
        for shape in shapes:
            jobs += [(float(shape.depth[i]), shape, int(i)) for i in self._within(shape)]
        if not keeps_order:
            jobs.sort(key=lambda job: -job[0])
        for _, shape, index in jobs:
            self._stamp(shape, index, self._color, self._depth)

    def cover(self, shape: _Shapes) -> None:
        """Lay a sheer surface over what is behind it."""
        color, depth = self._color.copy(), np.full(self._shape, np.inf, np.float32)
        within = self._within(shape)
        for index in within[np.argsort(-shape.depth[within], kind="stable")]:
            self._stamp(shape, int(index), color, depth)
        is_before = depth < self._depth
        if is_before.any():
            share = shape.part.opacity
            mixed = cv2.addWeighted(color, share, self._color, 1 - share, 0)
            self._color[is_before] = mixed[is_before]

    def shrunk(self, width: int, rows: int) -> ndarray:
        """Give the rows in the picture's resolution."""
        return np.asarray(cv2.resize(self._color, (width, rows), interpolation=cv2.INTER_AREA))

    def _within(self, shape: _Shapes) -> ndarray:
        """Find the shapes that may reach into these rows."""
        pixel = shape.pixel - self._shift
        low, high = pixel.min(axis=1), pixel.max(axis=1)
        reach = shape.reach[:, None]
        limit = np.array(self._shape[::-1], np.float64)
        is_near = ((high >= -reach) & (low <= limit + reach)).all(axis=1)
        # OpenCV counts pixels in 32 bits, of which some are behind the point.
        return np.flatnonzero(is_near & (np.abs(pixel).max(axis=(1, 2)) < 2**24))

    def _stamp(self, shape: _Shapes, index: int, color: ndarray, depth: ndarray) -> None:
        part = shape.part
        scale = float(shape.scale[index])
        point = shape.pixel[index] - self._shift
        value = tuple(float(c) for c in shape.color[index])
        fixed: ndarray = np.asarray(np.round(point * 2**_BITS), np.int32)
        thickness = max(1, round(part.size * self._view.height / _WINDOW))
        stamps: dict[str, Callable[[ndarray, tuple[float, ...]], object]] = {
            "disk": lambda to, v: cv2.circle(
                to,
                fixed[0].tolist(),
                max(round(0.5 * part.size * scale * 2**_BITS), 2**_BITS),
                v,
                cv2.FILLED,
                cv2.LINE_8,
                _BITS,
            ),
            "line": lambda to, v: cv2.line(
                to, fixed[0].tolist(), fixed[1].tolist(), v, thickness, cv2.LINE_8, _BITS
            ),
            "triangle": lambda to, v: cv2.fillConvexPoly(to, fixed, v, cv2.LINE_8, _BITS),
            "arrow": lambda to, v: _arrow(to, point, scale, part, v),
        }
        if part.kind == "text":
            _write(color, point[0], part.size * scale, part.text, value)
        elif part.kind == "picture" and part.image is not None:
            _lay(color, point, part.image)
        else:
            stamps[part.kind](color, value)
            stamps[part.kind](depth, (float(shape.depth[index]),))


def _arrow(to: ndarray, point: ndarray, scale: float, part: Part, value: tuple[float, ...]) -> None:
    """Draw a shaft and a head, as long as they look."""
    start, end = point
    along = end - start
    length = float(np.linalg.norm(along))
    if length < 1e-6:
        return
    along = along / length
    across = np.array([-along[1], along[0]])
    head = min(part.head[1] * scale, length)
    neck = end - head * along
    half, wide = max(part.size * scale, 0.5), part.head[0] * scale
    shaft = [start + half * across, neck + half * across, neck - half * across]
    for corners in (
        [*shaft, start - half * across],
        [neck + wide * across, end, neck - wide * across],
    ):
        fixed = np.round(np.array(corners) * 2**_BITS).astype(np.int32)
        cv2.fillConvexPoly(to, fixed, value, cv2.LINE_8, _BITS)


def _lay(to: ndarray, corner: ndarray, image: ndarray) -> None:
    """Draw an image between four corners."""
    rows, columns = image.shape[:2]
    source = np.array([[0, 0], [columns, 0], [columns, rows], [0, rows]], np.float32)
    # A pixel's middle has whole coordinates, so that the image begins half a pixel before 0.
    turn = cv2.getPerspectiveTransform(source - np.float32(0.5), corner.astype(np.float32))
    size = (to.shape[1], to.shape[0])
    laid = cv2.warpPerspective(image, turn, size, borderMode=cv2.BORDER_REPLICATE)
    mask = np.zeros(to.shape[:2], np.uint8)
    cv2.fillConvexPoly(mask, np.round(corner * 2**_BITS).astype(np.int32), (255,), 8, _BITS)
    np.copyto(to, laid, where=mask[..., None] > 0)


def _write(to: ndarray, place: ndarray, height: float, text: str, value: tuple[float, ...]) -> None:
    """Write lines of text around a place."""
    font, size = cv2.FontFace("sans"), max(int(0.8 * height), 1)
    lines = text.split("\n")
    for number, line in enumerate(lines):
        box = cv2.getTextSize((0, 0), line, (0, 0), font, size)
        x = int(place[0] - 0.5 * box[2])
        y = int(place[1] + (number - len(lines) / 2 + 0.8) * height)
        cv2.putText(to, line, (x, y), value, font, size)


def visible_from(parts: Iterable[Part], pose: Pose) -> list[Part]:
    """Drop what stands at the camera itself, such as the frustum that it looks from."""
    kept: list[Part] = []
    for part in parts:
        distance = np.linalg.norm(part.point - pose.position, axis=-1)
        is_apart = (distance > 1e-6).all(axis=-1)
        kept.append(replace(part, point=part.point[is_apart], color=part.color[is_apart]))
    return kept
