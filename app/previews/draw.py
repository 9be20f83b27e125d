"""Drawing hands, nodes and springs into small pictures with a clear background."""

from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from app.previews.camera import fitting_camera
from physhandi.data.camera import PinholeCamera
from physhandi.synthetic.film.rasterizer import Raster, rasterize, vertex_normals

WIDTH, HEIGHT = 384, 240
"""Size of a preview [px]."""
_FINER = 2
_SKIN = np.array([226.0, 178.0, 150.0])
_NODE = np.array([74.0, 155.0, 232.0])
_CONTROL = np.array([232.0, 85.0, 74.0])
_MARKER = np.array([63.0, 174.0, 92.0])
_SPRING = np.array([112.0, 160.0, 208.0])
_LIGHT = np.array([-0.35, -0.65, -0.67])
_SAMPLED_POINTS = 4_000
_HIDDEN_BY = 0.01


@dataclass(frozen=True, eq=False, kw_only=True)
class Motion:
    """What moves in a sequence or a run, in the sequence's own unit of length."""

    hands: tuple[tuple[Float[ndarray, "frame vertex 3"], Int[ndarray, "face 3"] | None], ...] = ()
    """Vertices and triangles of each hand."""
    node: Float[ndarray, "frame node 3"] | None = None
    """Object nodes."""
    marker: Float[ndarray, "frame marker 3"] | None = None
    """Observed points; NaN where not seen."""
    control: Float[ndarray, "frame control 3"] | None = None
    """Points that move the object, where there is no hand."""
    spring: Int[ndarray, "spring 2"] = field(default_factory=lambda: np.empty((0, 2), dtype=int))
    """Object nodes, or markers where there are no nodes, that lines join."""

    @property
    def tracks(self) -> list[Float[ndarray, "frame point 3"]]:
        """Everything that moves, as points."""
        found = [vertex for vertex, _ in self.hands]
        return found + [t for t in (self.node, self.marker, self.control) if t is not None]

    @property
    def frame_count(self) -> int:
        """Number of frames that everything has."""
        return min((len(track) for track in self.tracks), default=0)


def draw_motion(motion: Motion, frames: list[int]) -> list[UInt8[ndarray, "row column 4"]]:
    """Draw frames of a motion from a camera that sees all of them.

    Args:
        motion: What moves; something of it must be finite in these frames.
        frames: Numbers of the frames.

    Returns:
        Pictures of `WIDTH` by `HEIGHT` pixels: red, green, blue and opacity.

    Raises:
        ValueError: If there is nothing finite to draw.
    """
    points = [np.asarray(track[frame], dtype=float) for track in motion.tracks for frame in frames]
    finite = [point[np.isfinite(point).all(axis=-1)] for point in points]
    sampled = [point[:: max(1, len(point) * len(finite) // _SAMPLED_POINTS)] for point in finite]
    point = np.concatenate(sampled) if sampled else np.empty((0, 3))
    if not len(point):
        raise ValueError("there is no finite point in any frame")
    camera = fitting_camera(point, WIDTH * _FINER, HEIGHT * _FINER)
    return [_draw_frame(camera, motion, frame) for frame in frames]


def _draw_frame(
    camera: PinholeCamera, motion: Motion, frame: int
) -> UInt8[ndarray, "row column 4"]:
    image = np.zeros((camera.height, camera.width, 4), dtype=np.uint8)
    linked = motion.node if motion.node is not None else motion.marker
    if linked is not None:
        _draw_lines(image, camera, np.asarray(linked[frame]), motion.spring)
    hidden = np.full((camera.height, camera.width), np.inf)
    for vertex, face in motion.hands:
        if face is None:
            _draw_points(image, camera, np.asarray(vertex[frame]), (_SKIN, 2.0), hidden=hidden)
        else:
            _draw_surface(image, camera, np.asarray(vertex[frame], dtype=float), face, hidden)
    radius = _radius(motion)
    for track, color in (
        (motion.node, _NODE),
        (motion.marker, _MARKER),
        (motion.control, _CONTROL),
    ):
        if track is not None:
            _draw_points(image, camera, np.asarray(track[frame]), (color, radius), hidden=hidden)
    # The colours are weighted by the opacity so far: empty places are black, not dark.
    small = cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA).astype(np.float64)
    opacity = small[..., 3:]
    small[..., :3] *= 255.0 / np.maximum(opacity, 1.0)
    return np.clip(small.round(), 0, 255).astype(np.uint8)


def _radius(motion: Motion) -> float:
    """Choose how large points are drawn, the smaller the more there are [px]."""
    tracks = [track for track in (motion.node, motion.marker) if track is not None]
    count = max((track.shape[1] for track in tracks), default=1)
    return float(np.clip(40.0 / np.sqrt(count), 1.6, 6.0)) * _FINER


def _draw_lines(
    image: UInt8[ndarray, "row column 4"],
    camera: PinholeCamera,
    point: Float[ndarray, "point 3"],
    line: Int[ndarray, "line 2"],
) -> None:
    pixel = camera.project(point)
    for ends in pixel[line]:
        if np.isfinite(ends).all():
            (x0, y0), (x1, y1) = ends.round().astype(int).tolist()
            cv2.line(image, (x0, y0), (x1, y1), _opaque(_SPRING), _FINER, cv2.LINE_AA)


def _draw_points(
    image: UInt8[ndarray, "row column 4"],
    camera: PinholeCamera,
    point: Float[ndarray, "point 3"],
    dot: tuple[Float[ndarray, " 3"], float],
    *,
    hidden: Float[ndarray, "row column"],
) -> None:
    """Draw points as discs of a color and radius, far ones first; not behind a surface."""
    color, radius = dot
    point = np.asarray(point[np.isfinite(point).all(axis=-1)], dtype=float)
    if not len(point):
        return
    depth, pixel = camera.camera_depth(point), camera.project(point)
    nearest, spread = depth.min(), max(float(np.ptp(depth)), 1e-9)
    for number in np.argsort(-depth):
        x, y = (round(value) for value in pixel[number].tolist())
        is_inside = 0 <= x < camera.width and 0 <= y < camera.height
        if is_inside and depth[number] > hidden[y, x] * (1 + _HIDDEN_BY):
            continue
        shade = 1.0 - 0.35 * (depth[number] - nearest) / spread
        cv2.circle(image, (x, y), round(radius + 1), _opaque(0.55 * shade * color), -1, cv2.LINE_AA)
        cv2.circle(image, (x, y), round(radius), _opaque(shade * color), -1, cv2.LINE_AA)


def _draw_surface(
    image: UInt8[ndarray, "row column 4"],
    camera: PinholeCamera,
    vertex: Float[ndarray, "vertex 3"],
    face: Int[ndarray, "face 3"],
    hidden: Float[ndarray, "row column"],
) -> None:
    """Draw a shaded surface and note how far away it is."""
    if not np.isfinite(vertex).all():
        return
    raster: Raster = rasterize(camera, vertex, face)
    normal = vertex_normals(vertex, face) @ camera.T_world_camera[:3, :3]
    facing = normal @ (_LIGHT / np.linalg.norm(_LIGHT))
    seen = (raster.face >= 0) & (raster.depth < hidden)
    facing = (raster.weight[seen] * facing[face[raster.face[seen]]]).sum(axis=1)
    shade = 0.45 + 0.55 * np.clip(facing, 0.0, 1.0)
    image[seen, :3] = np.clip(shade[:, None] * _SKIN, 0, 255).astype(np.uint8)
    image[seen, 3] = 255
    hidden[seen] = raster.depth[seen]


def _opaque(color: Float[ndarray, " 3"]) -> tuple[float, float, float, float]:
    red, green, blue = np.clip(color, 0, 255).tolist()
    return red, green, blue, 255.0
