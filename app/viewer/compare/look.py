"""How two rollouts are shown together: side by side, one over the other, and in which colors."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from app.comparison import Mode, Tint
from app.viewer.color.coloring import Painted
from app.viewer.color.colormaps import levels, paint
from app.viewer.color.quantities import QUANTITIES, Values, from_nodes
from app.viewer.scene.object_drawing import Color, Style
from physhandi.object_rollout import ObjectRollout

MODES: dict[Mode, str] = {"side": "side by side", "overlay": "overlay", "wipe": "wipe"}
"""What the modes are called on the panel."""
SIDES = ("a", "b")
STYLES = {
    "a": Style(
        node=(47, 111, 222),
        control=(19, 60, 140),
        spring=(152, 182, 236),
        virtual=(92, 178, 236),
        arrow=(24, 70, 170),
        spring_width=1.0,
    ),
    "b": Style(
        node=(232, 118, 24),
        control=(150, 66, 8),
        spring=(243, 196, 150),
        virtual=(244, 176, 40),
        arrow=(196, 78, 6),
        spring_width=1.0,
    ),
}
"""Colors of both sides, told apart by people who confuse red and green too."""
GHOST: Color = (140, 148, 160)
"""Color of A's nodes where B shows the difference from them."""
_BACKGROUND = {False: (255, 255, 255), True: (24, 25, 28)}


@dataclass(kw_only=True)
class Look:
    """What the panel of the comparison chooses."""

    mode: Mode = "side"
    """How both are placed."""
    tint: Tint = "side"
    """What the colors of the nodes mean."""
    fade: float = 0.5
    """In an overlay: 0 shows A alone, 1 shows B alone, 0.5 shows both."""
    wipe: float = 0.5
    """Where the line of a wipe is, as a part of the width from the left."""
    is_swapped: bool = False
    """Whether B is on the left."""
    scale: float = 0.0
    """Difference that the end of the color scale means [m]; 0 if it is not known yet."""

    def is_ghost(self, side: str) -> bool:
        """Tell whether a side is only the shadow from which the other one's difference counts."""
        is_over = self.mode == "overlay" and self.fade > 0.0
        return side == "a" and self.tint == "difference" and is_over

    def node_size(self, side: str) -> float:
        """Diameter of nodes, as a part of their spacing: over each other both must be seen."""
        if self.is_ghost(side):
            return 0.14
        return 0.22 if self.mode == "overlay" and self.tint == "side" else 0.36

    def strength(self, side: str) -> float:
        """Tell how strongly a side is drawn: 0 for not at all, 1 for in its own colors."""
        if self.mode != "overlay":
            return 1.0
        part = 1.0 - self.fade if side == "a" else self.fade
        return min(1.0, 2.0 * part)


def shade(
    color: UInt8[ndarray, "node 3"], strength: float, *, is_dark: bool
) -> UInt8[ndarray, "node 3"]:
    """Let colors fade into the background."""
    mixed = strength * color + (1.0 - strength) * np.array(_BACKGROUND[is_dark])
    return np.round(mixed).astype(np.uint8)


def scale_end(value: float) -> float:
    """Choose a round end of a color scale: the next of 1, 2, 5 times a power of ten."""
    if not np.isfinite(value) or value <= 0.0:
        return 0.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(step * power for step in (1, 2, 5, 10) if step * power >= 0.999999 * value))


def difference_paint(take: ObjectRollout, distance: Float[ndarray, " node"], end: float) -> Painted:
    """Color nodes and springs by distances, from dark blue (none) to yellow (`end` and more).

    Args:
        take: Whose nodes and springs.
        distance: How far each node is from the other side [m].
        end: Distance at the end of the scale [m].
    """
    limits = (0.0, end)
    return Painted(
        values=Values(node=distance, spring=from_nodes(take, distance)),
        node=paint(distance, limits),
        level=levels(distance, limits),
        quantity=QUANTITIES["difference"],
        limits=limits,
    )
