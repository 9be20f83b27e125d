"""Shapes that can be drawn: surfaces, balls, line segments, images and, made of these, arrows.

Places are in the world and in its unit of length. Colors are red, green and blue from 0 to 255.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

_SIDES = 12
_GRAY = 128.0


def _no_color() -> ndarray:
    return np.full((1, 3), _GRAY)


@dataclass(frozen=True, eq=False, kw_only=True)
class Surface:
    """Triangles, seen from both sides."""

    vertex: Float[ndarray, "vertex 3"]
    """Corners; triangles with one that is not finite are left out."""
    faces: Int[ndarray, "face 3"]
    """Corners of each triangle."""
    color: Float[ndarray, "#vertex 3"] = field(default_factory=_no_color)
    """Of each vertex or of all, blended between them."""
    opacity: float = 1.0
    """How much the nearest sheet of it covers of what is behind."""
    shading: float = 0.0
    """How much darker it is on the side away from the light: 0 as bright, 1 black."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Balls:
    """Points with an extent; those that are not finite are left out."""

    center: Float[ndarray, "ball 3"]
    """Their middles."""
    radius: Float[ndarray, "#ball"]
    """Of each ball or of all."""
    color: Float[ndarray, "#ball 3"] = field(default_factory=_no_color)
    """Of each ball or of all."""
    shading: float = 0.0
    """As `Surface` has it; balls without look like disks."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Segments:
    """Straight lines, equally wide wherever they are; those that are not finite are left out.

    They are round like wires: a line within a surface is seen.
    """

    ends: Float[ndarray, "segment 2 3"]
    """Both ends of each."""
    width: float
    """Width [px]."""
    color: Float[ndarray, "#segment 3"] = field(default_factory=_no_color)
    """Of each segment or of all."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Image:
    """An image in the scene, seen from both sides."""

    corner: Float[ndarray, "4 3"]
    """Of its first row the first and last corner, of its last row the last and first."""
    image: UInt8[ndarray, "row column 3"]
    """Its pixels."""


Shape = Surface | Balls | Segments | Image


def arrows(
    ends: Float[ndarray, "arrow 2 3"],
    *,
    radius: float,
    head_radius: float,
    head_length: float,
    color: Float[ndarray, "#arrow 3"],
    shading: float = 0.0,
) -> Surface:
    """Build arrows, each a tube and a cone that ends in the second point.

    An arrow shorter than its head is a smaller head; one without a length is left out.

    Args:
        ends: Where each begins and ends.
        radius: Of the tubes.
        head_radius: Of the cones.
        head_length: Of the cones.
        color: Of each arrow or of all.
        shading: As `Surface` has it.
    """
    ends = np.asarray(ends, np.float64)
    color = np.broadcast_to(color, (len(ends), 3))
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    drawn = np.isfinite(length) & (length > 0)
    ends, color, length = ends[drawn], color[drawn], length[drawn, None]
    along = (ends[:, 1] - ends[:, 0]) / length
    head = np.minimum(head_length, length)
    first = np.cross(along, np.eye(3)[np.abs(along).argmin(axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(along, first)
    angle = (2 * np.pi / _SIDES) * np.arange(_SIDES)[:, None]
    circle = np.cos(angle) * first[:, None] + np.sin(angle) * second[:, None]
    neck = (ends[:, 1] - head * along)[:, None]
    wide = (head_radius / head_length * head)[:, None]
    rings = [
        ends[:, :1] + radius * circle,
        neck + radius * circle,
        # Sharp edges have vertices, and so normals, of their own on either side.
        neck + radius * circle,
        neck + wide * circle,
        neck + wide * circle,
        np.repeat(ends[:, 1:], _SIDES, axis=1),
    ]
    here = np.arange(_SIDES)
    after = np.roll(here, -1)
    quads = [(ring * _SIDES + here, ring * _SIDES + after) for ring in (0, 2, 4)]
    faces = [np.stack([a, b, b + _SIDES], axis=1) for a, b in quads]
    faces += [np.stack([a, b + _SIDES, a + _SIDES], axis=1) for a, b in quads]
    count = len(rings) * _SIDES
    first_vertex = count * np.arange(len(ends))[:, None, None]
    return Surface(
        vertex=np.concatenate(rings, axis=1).reshape(-1, 3),
        faces=(np.concatenate(faces) + first_vertex).reshape(-1, 3),
        color=np.repeat(color, count, axis=0),
        shading=shading,
    )


def facets(
    vertex: Float[ndarray, "vertex 3"], faces: Int[ndarray, "face 3"]
) -> tuple[Float[ndarray, "corner 3"], Int[ndarray, "face 3"]]:
    """Give every triangle corners of its own, for sharp edges between them."""
    corner = vertex[faces].reshape(-1, 3)
    return corner, np.arange(len(corner)).reshape(-1, 3)
