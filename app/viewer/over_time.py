"""One value of one thing in the scene, over all frames."""

from dataclasses import replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from app.viewer.coloring import Painter
from app.viewer.content import Content
from app.viewer.picking import Kind, Pick
from app.viewer.take import Take

History = Literal["speed", "force", "strain", "error", "difference", "height", "length"]
"""What a chart can show of a thing."""
HISTORIES: dict[Kind, tuple[History, ...]] = {
    "node": ("speed", "force", "strain", "error", "difference", "height"),
    "spring": ("strain", "force", "length"),
    "control": ("speed", "force", "height"),
    "hand": ("speed", "height"),
    "marker": ("speed", "height"),
}
"""What a chart can show of each kind of thing."""


def follow(
    pick: Pick, kind: History, take: Take | None, content: Content, painter: Painter
) -> Float[ndarray, " frame"]:
    """Follow one value of a thing over the frames that are ready, in SI units.

    Args:
        pick: The thing.
        kind: One of its `HISTORIES`.
        take: The rollout; None without an object.
        content: Hands and control nodes.
        painter: Measures what colors tell as well.
    """
    if pick.kind in {"hand", "marker"} or take is None:
        return _of_track(track_of(pick, content), kind, content.frame_rate)
    if kind == "height":
        of = take.position if pick.kind == "node" else take.control
        return np.asarray(of[: take.ready, pick.index, 2], dtype=np.float64)
    if kind == "length":
        first, second = take.model.spring_nodes[pick.index]
        point = np.concatenate([take.position[: take.ready], take.control[: take.ready]], axis=1)
        return np.linalg.norm(point[:, second] - point[:, first], axis=-1).astype(np.float64)
    part = reduced(take, pick)
    if pick.kind == "control":
        return np.array([_of_control(pick.index, kind, part, frame) for frame in range(take.ready)])
    values = [painter.measure(kind, part, frame) for frame in range(take.ready)]
    if pick.kind == "spring":
        return np.array([float(value.spring[0].mean()) for value in values])
    return np.array([float(value.node[pick.index]) for value in values])


def unit_of(kind: History, content: Content, painter: Painter) -> tuple[str, float]:
    """Tell the unit in which a history is written, and its number in one SI unit."""
    if kind == "height" or kind == "length":  # noqa: PLR1714  # narrows the type
        return length_unit(content)
    quantity = painter.quantity(kind)
    return quantity.unit, quantity.factor


def length_unit(content: Content) -> tuple[str, float]:
    """Tell the unit of small lengths, and its number in one unit of the content."""
    return ("mm", 1e3) if content.is_metric else (content.length_unit, 1.0)


def track_of(pick: Pick, content: Content) -> Float[ndarray, "frame 3"]:
    """Find where a vertex of a hand, or a control node without an object, is in every frame [m]."""
    if pick.kind == "control" and content.control is not None:
        return np.asarray(content.control[:, pick.index], dtype=np.float64)
    if pick.kind == "marker" and content.markers is not None:
        return np.asarray(content.markers.point[:, pick.index], dtype=np.float64)
    hand = next(hand for hand in content.hands if hand.side == pick.side)
    return np.asarray(hand.vertex[:, pick.index], dtype=np.float64)


def springs_at(take: Take, point: int) -> Int[ndarray, " spring"]:
    """Find the springs that end at an object node, or at a control node counted after them."""
    return np.flatnonzero((take.model.spring_nodes == point).any(axis=1))


def reduced(take: Take, pick: Pick) -> Take:
    """Keep only the springs that matter to a thing, so that all its frames are read quickly."""
    model = take.model
    if pick.kind == "spring":
        chosen = np.array([pick.index])
    else:
        chosen = springs_at(take, pick.index + (model.node_count if pick.kind == "control" else 0))
    smaller = replace(
        model,
        spring_nodes=model.spring_nodes[chosen],
        rest_length=model.rest_length[chosen],
        stiffness=model.stiffness[chosen],
        damping=model.damping[chosen],
        object_spring_count=int((chosen < model.object_spring_count).sum()),
    )
    return replace(take, model=smaller)


def _of_track(
    track: Float[ndarray, "frame 3"], kind: History, frame_rate: float
) -> Float[ndarray, " frame"]:
    if kind == "height":
        return track[:, 2]
    return frame_rate * np.linalg.norm(np.diff(track, axis=0, prepend=track[:1]), axis=1)


def _of_control(control: int, kind: History, part: Take, frame: int) -> float:
    value = part.state(frame)[3][control] if kind == "speed" else part.spring_forces(frame).sum(0)
    return float(np.linalg.norm(value))
