"""Places at which an object that lies on the ground can be grasped from above."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.random import Generator

_NARROWEST, _WIDEST = 0.008, 0.075
_ROOM = 0.024
_STRIP = 0.012
_DIRECTIONS = 12
_CANDIDATES = 120
_INSET = 0.03
_FLAT = 0.010
_LINE = 0.06
_THICKER = 0.01


class Lying(Protocol):
    """An object on the ground."""

    @property
    def node(self) -> Float[ndarray, "node 3"]:
        """Nodes; the ground is z = 0 [m]."""
        ...

    @property
    def radius(self) -> float:
        """Contact radius around its nodes [m]."""
        ...


@dataclass(frozen=True, eq=False, kw_only=True)
class Place:
    """A place at which a hand can grasp an object."""

    point: Float[ndarray, " 3"]
    """Middle between thumb and fingers; its height is that of the object [m]."""
    forward: Float[ndarray, " 3"]
    """Horizontal direction from the thumb to the fingers."""
    inwards: Float[ndarray, " 3"]
    """Horizontal direction from there to the object's middle."""
    width: float | None = None
    """Width of the object between thumb and fingers; None if they rake it together [m]."""
    thickness: float = 0.0
    """How thick it is between bottom and top; 0 where that does not matter [m]."""
    depth: float = 0.0
    """Height of the lowest skin of the fingertips [m]."""
    open_gap: float = 0.0
    """Distance between the skins of thumb and fingers before they close [m]."""
    closed_gap: float = 0.0
    """Distance between them at the end; less than what is left between them, so they press [m]."""
    remoteness: float = 0.0
    """Distance from the object's middle [m]."""


def height_range(body: Lying, point: Float[ndarray, " 3"], reach: float) -> tuple[float, float]:
    """Find the lowest and highest skin near a point, seen from above [m]."""
    distance = np.linalg.norm(body.node[:, :2] - point[:2], axis=1)
    near = body.node[distance <= max(reach, distance.min() + 1e-9), 2]
    return float(near.min()) - body.radius, float(near.max()) + body.radius


def narrow_places(body: Lying, random: Generator, *, end: float = 0.0) -> list[Place]:
    """List places where the object is narrow enough to be taken between thumb and fingers.

    Args:
        body: The object.
        random: Decides which places are tried.
        end: 1 or -1 to keep those that stick out towards +y or -y, as limbs do; 0 for all.

    Returns:
        Places with room for the fingers on both sides; none if the object is flat or too wide.
    """
    middle = body.node.mean(axis=0)
    if np.ptp(body.node[:, 2]) < 0.002 and np.ptp(body.node[:, 1]) > 2 * _WIDEST:
        return []
    narrow = []
    count = min(_CANDIDATES, len(body.node))
    for node in body.node[random.choice(len(body.node), count, replace=False)]:
        if end and end * (node[1] - middle[1]) < 0.6 * np.abs(body.node[:, 1] - middle[1]).max():
            continue
        angles = np.arange(_DIRECTIONS) * 2 * np.pi / _DIRECTIONS
        lines = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(_DIRECTIONS)])
        places = [_across(body, node, forward, middle) for forward in lines]
        fitting = [place for place in places if place is not None]
        if fitting:
            narrow.append(min(fitting, key=lambda place: place.width or 0.0))
    return narrow


def rim_place(body: Lying, random: Generator, *, end: float = 0.0) -> Place:
    """Choose a place near the rim, for a pinch with the thumb below and fingers above.

    Args:
        body: The object.
        random: Decides which part of the rim, among those that stick out and are thin.
        end: 1 or -1 for the rim towards +x or -x; 0 for any.
    """
    if np.ptp(body.node[:, 1]) < _LINE:
        return _beside_line(body, random, end)
    middle = body.node.mean(axis=0)
    if end:
        angles = (0.0 if end > 0 else np.pi) + np.linspace(-0.3, 0.3, 9)
    else:
        angles = -np.pi / 2 + np.linspace(-1.8, 1.8, 19)
    angles = angles + random.uniform(-0.05, 0.05)
    places = [_rim_along(body, middle, float(angle)) for angle in angles]
    thinnest = min(place.thickness for place in places)
    places = [place for place in places if place.thickness <= thinnest + _THICKER]
    return places[random.integers(len(places))]


def handful_place(body: Lying, random: Generator) -> Place:
    """Choose a place about the middle of a flat object, where it is raked together."""
    middle = body.node.mean(axis=0)
    angle = np.pi / 2 + random.uniform(-0.5, 0.5)
    forward = np.array([np.cos(angle), np.sin(angle), 0.0])
    point = middle + np.array([*random.uniform(-0.03, 0.03, 2), 0.0])
    bottom, top = height_range(body, point, 0.025)
    is_flat = top - bottom < _FLAT
    return Place(
        point=np.array([*point[:2], top]),
        forward=forward,
        inwards=forward,
        depth=top - (0.002 if is_flat else 0.45 * (top - bottom)),
        open_gap=0.085,
        closed_gap=0.03,
    )


def _rim_along(body: Lying, middle: ndarray, angle: float) -> Place:
    """Find the rim in one direction from the middle, and go a fingertip's length back."""
    outwards = np.array([np.cos(angle), np.sin(angle), 0.0])
    offset = body.node - middle
    in_strip = (np.abs(np.cross(offset, outwards)[:, 2]) < 0.02) & (offset @ outwards > 0)
    rim = float((offset @ outwards)[in_strip].max(initial=0.0))
    point = middle + max(rim - _INSET, 0.5 * rim) * outwards
    return _between(body, point, -outwards, -outwards, rim)


def _beside_line(body: Lying, random: Generator, end: float) -> Place:
    """Choose a place some centimetres from the end of a rope, across it."""
    along = body.node[:, 0] - body.node[:, 0].mean()
    sign = end or float(random.choice([-1.0, 1.0]))
    want = sign * (np.abs(along).max() - random.uniform(0.06, 0.14))
    number = int(np.abs(along - want).argmin())
    near = np.argsort(np.abs(along - along[number]))[:5]
    slope = np.polyfit(body.node[near, 0], body.node[near, 1], 1)[0]
    forward = np.array([-slope, 1.0, 0.0]) / np.hypot(slope, 1.0)
    inwards = np.array([-sign, 0.0, 0.0])
    return _between(body, body.node[number], forward, inwards, float(abs(along[number])))


def _between(
    body: Lying, point: ndarray, forward: ndarray, inwards: ndarray, remoteness: float
) -> Place:
    """Describe a place between a thumb below and fingers above."""
    bottom, top = height_range(body, point, 0.015)
    thickness = top - bottom
    return Place(
        point=np.array([*point[:2], (bottom + top) / 2]),
        forward=forward,
        inwards=inwards,
        thickness=thickness,
        open_gap=thickness + 0.02,
        closed_gap=max(thickness - 0.004, 0.001) if thickness < 0.015 else 0.55 * thickness,
        remoteness=remoteness,
    )


def _across(body: Lying, node: ndarray, forward: ndarray, middle: ndarray) -> Place | None:
    """Measure the object along one line through a node; None if it does not fit a hand."""
    offset = body.node - node
    in_strip = np.abs(np.cross(offset, forward)[:, 2]) < _STRIP
    along = np.sort(offset[in_strip] @ forward)
    breaks = np.diff(along) > _ROOM + 2 * body.radius
    piece = np.concatenate([[0], np.cumsum(breaks)])
    mine = along[piece == piece[np.searchsorted(along, 0.0)]]
    width = float(np.ptp(mine)) + 2 * body.radius
    if not _NARROWEST <= width <= _WIDEST:
        return None
    point = node + (mine.min() + mine.max()) / 2 * forward
    bottom, top = height_range(body, point, 0.02)
    inwards = np.array([*(middle - point)[:2], 0.0])
    remoteness = float(np.linalg.norm(inwards))
    return Place(
        point=np.array([*point[:2], top]),
        forward=forward,
        inwards=inwards / max(remoteness, 1e-9),
        width=width,
        depth=bottom + max(0.25 * (top - bottom) - 0.008, 0.001),
        open_gap=width + 0.012,
        closed_gap=max(0.55 * width, width - 0.02) - 0.002,
        remoteness=remoteness,
    )
