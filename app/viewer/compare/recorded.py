"""The hands and observed points of both sides of a comparison."""

from dataclasses import dataclass

import numpy as np

from app.viewer.compare.figure import Side
from app.viewer.content.content import Content
from app.viewer.content.layers import GREEN, SKIN
from app.viewer.scene.framing import Framing
from app.viewer.scene.nodes import SceneNodes

PLAYING_OBSERVED = 1_000
"""Most observed points of a side that are sent while the clock is running."""
_SAME_HAND = 1e-5
_HAND_OPACITY = 0.4


@dataclass(frozen=True, kw_only=True, eq=False)
class Half:
    """One side of the comparison at a moment."""

    side: Side
    """Rollout, its frame and caption."""
    content: Content
    """Hands and observation."""
    frame: int
    """Frame of hands and observation."""


Halves = dict[str, Half]
"""Both sides by their names, ``a`` and ``b``."""


class RecordedDrawing:
    """Draws what was recorded of a side; used by one thread."""

    def __init__(self, nodes: SceneNodes, framing: Framing, root: str) -> None:
        """Prepare; nothing is drawn yet.

        Args:
            nodes: The scene's nodes.
            framing: Sizes.
            root: Path of the side.
        """
        self._nodes = nodes
        self._framing = framing
        self._root = root

    def draw_hands(self, half: Half, *, is_visible: bool) -> None:
        """Bring the hands to a moment."""
        for hand in half.content.hands:
            path, color = f"{self._root}/hand/{hand.side}", SKIN[hand.side]
            vertex = np.asarray(hand.vertex[min(half.frame, len(hand.vertex) - 1)], np.float32)
            if hand.face is None:
                size = 0.006 * self._framing.extent
                self._nodes.points(path, vertex, color, size, is_visible=is_visible)
            else:
                face = hand.face
                self._nodes.mesh(
                    path, vertex, face, color, is_visible=is_visible, opacity=_HAND_OPACITY
                )

    def draw_observed(self, half: Half, *, is_playing: bool, is_visible: bool) -> None:
        """Bring the observed points to a moment."""
        observed, path = half.content.observed, f"{self._root}/observed"
        if observed is None or not is_visible:
            self._nodes.show(path, is_visible=False)
            return
        point = observed.points(half.frame)
        every = max(1, -(-len(point) // PLAYING_OBSERVED)) if is_playing else 1
        size = 0.4 * self._framing.spacing
        self._nodes.points(path, point[::every], GREEN, size, is_visible=True)


def have_same_hands(halves: Halves) -> bool:
    """Tell whether both sides show the same hands, so that one is enough where they overlap."""
    first, second = (
        {h.side: np.asarray(h.vertex[min(half.frame, len(h.vertex) - 1)]) for h in hands}
        for half in halves.values()
        for hands in (half.content.hands,)
    )
    return first.keys() == second.keys() and all(
        first[side].shape == second[side].shape
        and np.allclose(first[side], second[side], rtol=0.0, atol=_SAME_HAND)
        for side in first
    )
