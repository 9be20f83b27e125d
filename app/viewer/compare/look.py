"""How two rollouts are shown together: side by side, one over the other, and in which colors."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from app.comparison import Mode, Tint
from app.viewer.color.coloring import Painted
from app.viewer.color.legend import ColorScale
from app.viewer.color.quantities import QUANTITIES, Values, from_nodes, in_length_unit
from app.viewer.scene.object_drawing import RGB, Style
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
GHOST: RGB = (140, 148, 160)
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


def difference_scale(end: float, length_unit: str) -> ColorScale:
    """Color scale of the difference of A and B.

    Args:
        end: Distance at the end of the scale [m].
        length_unit: Unit of the content's lengths.
    """
    quantity = in_length_unit(QUANTITIES["difference"], length_unit)
    quantity = replace(quantity, about="Distance of a node from the other side")
    return ColorScale(quantity=quantity, limits=(0.0, end), is_open=True)


def difference_paint(
    rollout: ObjectRollout, distance: Float[ndarray, " node"], end: float
) -> Painted:
    """Color nodes and springs by distances, from dark blue (none) to yellow (`end` and more).

    Args:
        rollout: Whose nodes and springs.
        distance: How far each node is from the other side [m].
        end: Distance at the end of the scale [m].
    """
    return Painted(
        values=Values(node=distance, spring=from_nodes(rollout, distance)),
        scale=difference_scale(end, "m"),
    )
