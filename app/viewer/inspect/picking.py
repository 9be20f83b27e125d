"""Picking: nodes, springs, control nodes or the hand under a click, as they are drawn."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from app.viewer.content.content import Content
from app.viewer.content.layers import Layers
from physhandi.object_rollout import ObjectRollout
from physhandi.simulation.model import SpringMassModel

PickKind = Literal["node", "spring", "control", "hand", "marker"]

NEAR_PIXELS = 9.0
"""Farther from a click than this, nothing is meant."""
_LINE_PIXELS = 6.0
_DEPTH = 2.5
"""Of what is near a click, the things that lie this many spacings behind the first are hidden."""


@dataclass(frozen=True, kw_only=True)
class Pick:
    """One thing in the scene."""

    kind: PickKind
    """Its kind."""
    index: int
    """Number of the object node, of the spring in the model's order, of the control node, of
    the hand's vertex or of the marker."""
    side: Literal["right", "left"] | None = None
    """Side of the hand, for a vertex that is no control node."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Ray:
    """Ray of a click."""

    origin: Float[ndarray, " 3"]
    """The eye [m]."""
    direction: Float[ndarray, " 3"]
    """Unit vector into the picture."""
    pixel: float
    """Angle between two neighboring pixels [rad]."""

    def offsets(
        self, point: Float[ndarray, "point 3"]
    ) -> tuple[Float[ndarray, " point"], Float[ndarray, " point"]]:
        """Measure how far points are from the ray in pixels, and how deep they lie [m].

        Points behind the eye are infinitely far.
        """
        offset = np.asarray(point, dtype=np.float64) - self.origin
        depth = offset @ self.direction
        across = np.linalg.norm(offset - depth[:, None] * self.direction, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            angle = np.where(depth > 0, across / depth, np.inf)
        return angle / self.pixel, depth


@dataclass(frozen=True, kw_only=True, eq=False)
class Target:
    """Drawn things that can be hit."""

    content: Content
    """Hands and control nodes."""
    rollout: ObjectRollout | None
    """The rollout; None without an object."""
    frame: int
    """Frame of the hands."""
    rollout_frame: int
    """Frame of the rollout."""
    layers: Layers
    """Drawn layers."""
    spacing: float
    """Typical distance of nodes [m]."""


def pick(ray: Ray, target: Target, *, prefers_hand: bool = False) -> Pick | None:
    """Find what a click means; None if there is nothing near it.

    Nodes come before springs, and both before the hand, through which they are seen; of the
    object's surface, which splats lie around, and the hand the nearer one counts.

    Args:
        ray: Where it points.
        target: What can be hit.
        prefers_hand: Whether the hand comes first.
    """
    content, frame, layers = target.content, target.frame, target.layers
    hand, hand_depth = _pick_hand(ray, content, frame) if layers.hands else (None, np.inf)
    if prefers_hand and hand is not None:
        return hand
    picked = None
    if target.rollout is not None:
        picked = _pick_object(ray, target, target.rollout)
        if picked is None and (layers.surface or layers.splats):
            picked = _pick_surface(ray, target, target.rollout, within=hand_depth)
    elif content.control is not None and layers.controls:
        at = _nearest(ray, np.asarray(content.control[frame]), target.spacing)
        picked = None if at is None else Pick(kind="control", index=at[0])
    return picked or _pick_marker(ray, target) or hand


def pick_dot(ray: Ray, dot: Float[ndarray, "dot 3"]) -> int | None:
    """Find the dot that a click means, the nearest to it; None if there is none near it.

    Args:
        ray: Where it points.
        dot: Where the dots are, which nothing hides [m].
    """
    if not len(dot):
        return None
    pixels, _ = ray.offsets(dot)
    number = int(np.argmin(pixels))
    return number if pixels[number] <= NEAR_PIXELS else None


def _pick_marker(ray: Ray, target: Target) -> Pick | None:
    """Find a marker of a recording; those that are held are under their control points."""
    markers = target.content.markers
    if markers is None or not target.layers.observed:
        return None
    point = np.asarray(markers.point[target.frame], dtype=np.float64)
    at = _nearest(ray, np.where(np.isfinite(point), point, np.inf), target.spacing)
    return None if at is None else Pick(kind="marker", index=at[0])


def _pick_object(ray: Ray, target: Target, rollout: ObjectRollout) -> Pick | None:
    frame, layers = target.rollout_frame, target.layers
    spacing = target.spacing
    position = np.asarray(rollout.position[frame], dtype=np.float64)
    control = np.asarray(rollout.control[frame], dtype=np.float64)
    count, own = rollout.model.node_count, rollout.model.object_spring_count
    point = np.concatenate([position, control])
    offers: list[Int[ndarray, " point"]] = []
    if layers.nodes:
        offers.append(np.arange(count))
    if layers.all_controls:
        offers.append(count + np.arange(len(control)))
    elif layers.controls:
        offers.append(np.unique(rollout.model.spring_nodes[own:].max(axis=1)))
    if offers:
        number = np.concatenate(offers)
        at = _nearest(ray, point[number], spacing)
        if at is not None:
            chosen = int(number[at[0]])
            if chosen < count:
                return Pick(kind="node", index=chosen)
            return Pick(kind="control", index=chosen - count)
    spring = _pick_spring(ray, point, rollout.model, frame, layers, spacing)
    return None if spring is None else Pick(kind="spring", index=spring)


def _pick_surface(
    ray: Ray, target: Target, rollout: ObjectRollout, *, within: float
) -> Pick | None:
    """Find the node nearest to where the ray meets the object's surface, if it does so in time."""
    position = np.asarray(rollout.position[target.rollout_frame], dtype=np.float64)
    surface = target.content.surface
    if surface is None or surface.node_count != len(position):
        return None
    hit = first_triangle(ray, surface.place(position), surface.face)
    if hit is None or hit[1] > within:
        return None
    place = ray.origin + hit[1] * ray.direction
    return Pick(kind="node", index=int(np.argmin(np.linalg.norm(position - place, axis=1))))


def _pick_spring(  # noqa: PLR0917  (a ray, what it may meet, and what of that is shown)
    ray: Ray,
    point: Float[ndarray, "point 3"],
    model: SpringMassModel,
    frame: int,
    layers: Layers,
    spacing: float,
) -> int | None:
    is_own = np.arange(len(model.spring_nodes)) < model.object_spring_count
    is_shown = np.where(is_own, layers.object_springs, layers.virtual_springs)
    spring = np.flatnonzero(is_shown & model.acts_in(frame))
    if not len(spring):
        return None
    nearest = nearest_on_segments(ray, point[model.spring_nodes[spring]])
    at = _nearest(ray, nearest, spacing, within=_LINE_PIXELS)
    return None if at is None else int(spring[at[0]])


def _pick_hand(ray: Ray, content: Content, frame: int) -> tuple[Pick | None, float]:
    """Find the vertex nearest to where the ray enters a hand, and how far away that is [m]."""
    best: tuple[float, Pick] | None = None
    for hand in content.hands:
        vertex = np.asarray(hand.vertex[min(frame, len(hand.vertex) - 1)], dtype=np.float64)
        if hand.face is None:
            at = _nearest(ray, vertex, 0.0)
        else:
            hit = first_triangle(ray, vertex, hand.face)
            at = None
            if hit is not None:
                corners = hand.face[hit[0]]
                at = int(corners[np.argmin(ray.offsets(vertex[corners])[0])]), hit[1]
        if at is not None and (best is None or at[1] < best[0]):
            best = at[1], Pick(kind="hand", index=at[0], side=hand.side)
    return (None, np.inf) if best is None else (best[1], best[0])


def _nearest(
    ray: Ray, point: Float[ndarray, "point 3"], spacing: float, within: float = NEAR_PIXELS
) -> tuple[int, float] | None:
    """Find the point nearest to the ray among those that nothing else hides, and its depth."""
    pixels, depth = ray.offsets(point)
    near = np.flatnonzero(pixels <= within)
    if len(near) == 0:
        return None
    near = near[depth[near] <= depth[near].min() + _DEPTH * spacing]
    chosen = int(near[np.argmin(pixels[near])])
    return chosen, float(depth[chosen])


def nearest_on_segments(
    ray: Ray, ends: Float[ndarray, "segment 2 3"]
) -> Float[ndarray, "segment 3"]:
    """Find the point of each segment that is nearest to the ray's line [m]."""
    start = np.asarray(ends[:, 0], dtype=np.float64)
    along = np.asarray(ends[:, 1], dtype=np.float64) - start
    offset = start - ray.origin
    across = along - (along @ ray.direction)[:, None] * ray.direction
    apart = offset - (offset @ ray.direction)[:, None] * ray.direction
    size = np.sum(across**2, axis=1)
    part = -np.sum(apart * across, axis=1) / np.maximum(size, 1e-300)
    return start + np.clip(np.where(size > 1e-18, part, 0.0), 0.0, 1.0)[:, None] * along


def first_triangle(
    ray: Ray, vertex: Float[ndarray, "vertex 3"], face: Int[ndarray, "face 3"]
) -> tuple[int, float] | None:
    """Find the first triangle that the ray meets, and how far away [m] (Möller and Trumbore)."""
    if len(face) == 0:
        return None
    a, b, c = (np.asarray(vertex, dtype=np.float64)[face[:, i]] for i in range(3))
    ab, ac = b - a, c - a
    cross = np.cross(ray.direction, ac)
    volume = np.sum(ab * cross, axis=1)
    is_flat = np.abs(volume) < 1e-300
    inverse = 1.0 / np.where(is_flat, 1.0, volume)
    offset = ray.origin - a
    u = np.sum(offset * cross, axis=1) * inverse
    other = np.cross(offset, ab)
    v = (other @ ray.direction) * inverse
    distance = np.sum(ac * other, axis=1) * inverse
    hits = np.flatnonzero(~is_flat & (u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 0))
    if len(hits) == 0:
        return None
    first = int(hits[np.argmin(distance[hits])])
    return first, float(distance[first])
