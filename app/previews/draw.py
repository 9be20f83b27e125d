"""Drawing hands, nodes and springs into small pictures with a clear background."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from app.previews.camera import fitting_camera
from physhandi.data.camera import PinholeCamera
from physhandi.rendering.renderer import render
from physhandi.rendering.shapes import Balls, Segments, Shape, Surface
from physhandi.simulation.object_surface import ObjectSurface

WIDTH, HEIGHT = 384, 240
"""Size of a preview [px]."""
_SKIN = np.array([226.0, 178.0, 150.0])
_NODE = np.array([74.0, 155.0, 232.0])
_CONTROL = np.array([232.0, 85.0, 74.0])
_MARKER = np.array([63.0, 174.0, 92.0])
_SPRING = np.array([[112.0, 160.0, 208.0]])
_LIGHT = np.array([-0.35, -0.65, -0.67])
"""Direction of the light, in the camera's axes."""
_SKIN_SHADING, _OBJECT_SHADING, _POINT_SHADING = 0.9, 0.5, 0.5
_FADING = 0.3
"""Darkening of the farthest points relative to the nearest."""
_SKIN_RADIUS = 1.0
_SAMPLED_POINTS = 4_000


@dataclass(frozen=True, eq=False, kw_only=True)
class PreviewMotion:
    """Moving parts of a sequence or a run, in the sequence's own unit of length."""

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
    surface: ObjectSurface | None = None
    """Surface of the object, which is drawn in place of nodes and springs."""

    @property
    def tracks(self) -> list[Float[ndarray, "frame point 3"]]:
        """Everything that moves, as points."""
        hand_vertices = [vertex for vertex, _ in self.hands]
        return hand_vertices + [t for t in (self.node, self.marker, self.control) if t is not None]

    @property
    def frame_count(self) -> int:
        """Number of frames that everything has."""
        return min((len(track) for track in self.tracks), default=0)


def draw_motion(motion: PreviewMotion, frames: list[int]) -> list[UInt8[ndarray, "row column 4"]]:
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
    camera = fitting_camera(point, WIDTH, HEIGHT)
    light = camera.T_world_camera[:3, :3] @ _LIGHT
    return [render(camera, _shapes(camera, motion, frame), light=light) for frame in frames]


def _shapes(camera: PinholeCamera, motion: PreviewMotion, frame: int) -> list[Shape]:
    """List what moves as it is in a frame."""
    shapes: list[Shape] = []
    for vertices, faces in motion.hands:
        vertex = np.asarray(vertices[frame], dtype=float)
        if faces is None:
            shapes.append(_balls(camera, vertex, _SKIN, _SKIN_RADIUS))
        else:
            color = _SKIN[None]
            shapes.append(Surface(vertex=vertex, faces=faces, color=color, shading=_SKIN_SHADING))
    radius = _radius(motion)
    surface = motion.surface if motion.node is not None else None
    if surface is not None and motion.node is not None:
        vertex = surface.place(motion.node[frame]).astype(float)
        color = _NODE[None] if surface.color is None else surface.color.astype(float)
        shape = Surface(vertex=vertex, faces=surface.face, color=color, shading=_OBJECT_SHADING)
        shapes.append(shape)
    for track, color in (
        (motion.node if surface is None else None, _NODE),
        (motion.marker, _MARKER),
        (motion.control, _CONTROL),
    ):
        if track is not None:
            shapes.append(_balls(camera, np.asarray(track[frame], dtype=float), color, radius))
    linked = motion.node if motion.node is not None else motion.marker
    if linked is not None and surface is None:
        ends = np.asarray(linked[frame], dtype=float)[motion.spring]
        shapes.append(Segments(ends=ends, width=1.0, color=_SPRING))
    return shapes


def _radius(motion: PreviewMotion) -> float:
    """Choose how large points are drawn, the smaller the more there are [px]."""
    tracks = [track for track in (motion.node, motion.marker) if track is not None]
    count = max((track.shape[1] for track in tracks), default=1)
    return float(np.clip(40.0 / np.sqrt(count), 1.6, 6.0)) + 0.5


def _balls(
    camera: PinholeCamera,
    point: Float[ndarray, "point 3"],
    color: Float[ndarray, " 3"],
    radius: float,
) -> Balls:
    """Draw points as equally large balls, far ones darker."""
    point = point[np.isfinite(point).all(axis=-1)]
    depth = camera.camera_depth(point)
    spread = max(float(np.ptp(depth)), 1e-9) if len(depth) else 1.0
    shade = 1.0 - _FADING * (depth - depth.min(initial=np.inf)) / spread
    return Balls(
        center=point,
        radius=depth * (radius / float(camera.K[0, 0])),
        color=shade[:, None] * color,
        shading=_POINT_SHADING,
    )
