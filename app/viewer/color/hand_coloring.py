"""Colors of hands: how far their joints are from where images show them, and how fast they are."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from app.viewer.color.coloring import Painted
from app.viewer.color.legend import ColorScale, Legend, Limits, nearly_all
from app.viewer.color.quantities import Quantity, Values
from app.viewer.content.content import Content, ShownHand
from app.viewer.content.layers import Coloring, Layers

_NEAR = 3
"""Joints that tell the error of a vertex."""
_SAMPLED_FRAMES = 16
_QUANTITIES: Mapping[Coloring, Quantity] = {
    "error": Quantity(
        label="Reprojection error",
        about="Distance of the nearest joints from the keypoints found in the images, mean of the "
        "views",
        unit="px",
    ),
    "speed": Quantity(label="Speed", about="Of the hand's surface, from the frame before", unit=""),
}


class HandPainter:
    """Measures and paints the hands of one content that has no object; used by one thread."""

    def __init__(self, content: Content) -> None:
        self._content = content
        self._hands = content.hands if content.fitted is None else ()
        self._errors: dict[str, Float[ndarray, "frame joint"] | None] = {}
        self._weights: dict[str, Float[ndarray, "vertex joint"]] = {}
        self._ranges: dict[Coloring, Limits] = {}
        self.legend: Legend | None = None
        """Legend of the colors painted last; None if they are plain."""

    @property
    def offered(self) -> tuple[Coloring, ...]:
        """Available colorings; none where there is no hand with a surface."""
        if not any(hand.face is not None for hand in self._hands):
            return ()
        is_known = any(self._error(hand) is not None for hand in self._hands)
        return ("error", "speed") if is_known else ("speed",)

    def quantity(self, coloring: Coloring) -> Quantity:
        """Describe one of the offered colorings in the units of the content."""
        quantity = _QUANTITIES[coloring]
        if coloring == "speed":
            return replace(quantity, unit=f"{self._content.length_unit}/s")
        return quantity

    def measure(self, coloring: Coloring, hand: ShownHand, frame: int) -> Float[ndarray, " vertex"]:
        """Measure a quantity at the vertices of a hand, in its own unit; NaN where not known."""
        vertex = hand.vertex
        frame = min(frame, len(vertex) - 1)
        if coloring == "speed":
            before = max(frame - 1, 0)
            now = np.asarray(vertex[frame], dtype=np.float64)
            then = np.asarray(vertex[before], dtype=np.float64)
            speed: Any = self._content.frame_rate * np.linalg.norm(now - then, axis=1)
            return speed
        error = self._error(hand)
        if error is None or hand.joint is None:
            return np.full(len(vertex[0]), np.nan)
        if hand.side not in self._weights:
            self._weights[hand.side] = joint_weights(vertex[0], hand.joint[0])
        weight, now = self._weights[hand.side], error[frame]
        is_known = np.isfinite(now)
        total = weight[:, is_known].sum(axis=1)
        value = weight[:, is_known] @ now[is_known]
        return np.where(total > 0, value / np.maximum(total, 1e-12), np.nan)

    def paint(self, frame: int, layers: Layers) -> dict[str, Painted]:
        """Give the colors of all hands by their side; nothing if they are plain."""
        if layers.color not in self.offered:
            self.legend = None
            return {}
        limits = layers.color_range or self._limits(layers.color)
        scale = ColorScale(quantity=self.quantity(layers.color), limits=limits)
        painted: dict[str, Painted] = {}
        for hand in self._hands:
            value = self.measure(layers.color, hand, frame)
            painted[hand.side] = Painted(
                values=Values(node=value, spring=np.zeros((0, 2))), scale=scale
            )
        value = np.concatenate([painted[hand.side].values.node for hand in self._hands])
        shown = value[np.isfinite(value)]
        self.legend = Legend.of(scale, value, shown=shown, item="vertex")
        return painted

    def _error(self, hand: ShownHand) -> Float[ndarray, "frame joint"] | None:
        """Measure the errors of a hand's joints once [px]."""
        if hand.side not in self._errors:
            self._errors[hand.side] = reprojection_errors(self._content, hand)
        return self._errors[hand.side]

    def _limits(self, coloring: Coloring) -> Limits:
        """Find the range of a quantity over all frames."""
        if coloring not in self._ranges:
            last = self._content.frame_count - 1
            frames = np.unique(np.linspace(0, last, _SAMPLED_FRAMES).astype(int))
            parts = [self.measure(coloring, hand, int(f)) for hand in self._hands for f in frames]
            value = np.concatenate(parts)
            limits = nearly_all(value[np.isfinite(value)], self.quantity(coloring))
            self._ranges[coloring] = limits if limits is not None and limits[1] > 0 else (0.0, 1.0)
        return self._ranges[coloring]


def reprojection_errors(content: Content, hand: ShownHand) -> Float[ndarray, "frame joint"] | None:
    """Measure how far a hand's joints are from its keypoints in the images [px].

    Args:
        content: Gives the cameras.
        hand: Its joints and keypoints.

    Returns:
        The mean over the views that see a joint, NaN where none does; None if nothing is stored.
    """
    joint, keypoint = hand.joint, hand.keypoint
    if (
        joint is None
        or keypoint is None
        or len(keypoint) != len(content.views)
        or not len(keypoint)
    ):
        return None
    views = zip(content.views, keypoint, strict=True)
    distance = np.stack(
        [
            np.linalg.norm(view.camera.project(joint.astype(np.float64)) - seen[..., :2], axis=-1)
            for view, seen in views
        ]
    )
    is_seen = np.isfinite(distance)
    count = is_seen.sum(axis=0)
    total = np.where(is_seen, distance, 0.0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def joint_weights(
    vertex: Float[ndarray, "vertex 3"], joint: Float[ndarray, "joint 3"]
) -> Float[ndarray, "vertex joint"]:
    """Share each vertex among its nearest joints, the nearer ones more; rows add up to one."""
    distance = np.linalg.norm(vertex[:, None].astype(np.float64) - joint[None], axis=-1)
    near = np.argsort(distance, axis=1)[:, :_NEAR]
    weight = np.zeros_like(distance)
    inverse = 1.0 / np.maximum(np.take_along_axis(distance, near, axis=1), 1e-9) ** 2
    np.put_along_axis(weight, near, inverse, axis=1)
    return weight / weight.sum(axis=1, keepdims=True)
