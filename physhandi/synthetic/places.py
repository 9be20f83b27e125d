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
_INSET = 0.05
_FLAT = 0.010


class Lying(Protocol):
    """An object on the ground."""

    @property
    def node(self) -> Float[ndarray, "node 3"]:
        """Nodes; the ground is z = 0 [m]."""
        ...

    @property
    def radius(self) -> float:
        """Distance at which others touch it, about its nodes [m]."""
        ...


@dataclass(frozen=True, eq=False, kw_only=True)
class Place:
    """Where to take hold of an object."""

    point: Float[ndarray, " 3"]
    """Middle between thumb and fingers; its height is that of the object [m]."""
    forward: Float[ndarray, " 3"]
    """Horizontal direction from the thumb to the fingers."""
    inwards: Float[ndarray, " 3"]
    """Horizontal direction from there to the object's middle."""
    width: float | None = None
    """How wide the object is between thumb and fingers; None if they rake it together [m]."""
    depth: float = 0.0
    """Height of the lowest skin of the fingertips [m]."""
    open_gap: float = 0.0
    """Distance between the skins of thumb and fingers before they close [m]."""
    closed_gap: float = 0.0
    """Distance between them at the end; less than what is left between them, so they press [m]."""
    remoteness: float = 0.0
    """Distance from the object's middle [m]."""

    def score(self, *, prefers_narrow: bool) -> float:
        """Rate the place; less is better: far out and narrow, or wide and in the middle [m]."""
        width = self.width or 0.0
        return 0.5 * width - self.remoteness if prefers_narrow else -width


def height_range(body: Lying, point: Float[ndarray, " 3"], reach: float) -> tuple[float, float]:
    """Find the lowest and highest skin near a point, seen from above [m]."""
    distance = np.linalg.norm(body.node[:, :2] - point[:2], axis=1)
    near = body.node[distance <= max(reach, distance.min() + 1e-9), 2]
    return float(near.min()) - body.radius, float(near.max()) + body.radius


def grasp_places(body: Lying, random: Generator, *, end: float = 0.0) -> list[Place]:
    """List places where the object is narrow enough to be taken between thumb and fingers.

    Args:
        body: The object.
        random: Decides which places are tried.
        end: 1 or -1 to keep those in the last third towards +x or -x; 0 for all.

    Returns:
        Places with room for the fingers on both sides; none if the object is flat or too wide.
    """
    middle = body.node.mean(axis=0)
    if np.ptp(body.node[:, 2]) < 0.002 and np.ptp(body.node[:, 1]) > 2 * _WIDEST:
        return []
    found = []
    count = min(_CANDIDATES, len(body.node))
    for node in body.node[random.choice(len(body.node), count, replace=False)]:
        reach = np.abs(body.node[:, 0] - middle[0]).max()
        if end and end * (node[0] - middle[0]) < 0.5 * reach:
            continue
        for angle in np.arange(_DIRECTIONS) * 2 * np.pi / _DIRECTIONS:
            place = _across(body, node, np.array([np.cos(angle), np.sin(angle), 0.0]), middle)
            if place is not None:
                found.append(place)
    return found


def rim_place(body: Lying, random: Generator, *, end: float = 0.0) -> Place:
    """Choose a place near the rim where the object is raked together, facing its middle.

    Args:
        body: The object.
        random: Decides which part of the rim, among those that face -y and +-x.
        end: 1 or -1 for the rim towards +x or -x; 0 for any.
    """
    middle = body.node.mean(axis=0)
    if end:
        angle = (0.0 if end > 0 else np.pi) + random.uniform(-0.15, 0.15)
    else:
        angle = -np.pi / 2 + random.uniform(-0.9, 0.9)
    outwards = np.array([np.cos(angle), np.sin(angle), 0.0])
    beside = np.linalg.norm(np.cross(body.node - middle, outwards)[:, 2:], axis=1) < 0.02
    rim = float(((body.node - middle) @ outwards)[beside].max())
    point = middle + max(rim - _INSET, 0.35 * rim) * outwards
    bottom, top = height_range(body, point, 0.025)
    is_flat = top - bottom < _FLAT
    return Place(
        point=np.array([*point[:2], top]),
        forward=-outwards,
        inwards=-outwards,
        width=None,
        depth=top - (0.002 if is_flat else 0.45 * (top - bottom)),
        open_gap=0.045,
        closed_gap=4 * body.radius - 0.004,
        remoteness=float(np.linalg.norm((point - middle)[:2])),
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
        depth=bottom + max(0.25 * (top - bottom) - 0.004, 0.001),
        open_gap=width + 0.012,
        closed_gap=max(0.55 * width, width - 0.02) - 0.002,
        remoteness=remoteness,
    )
