"""The two sides of a comparison: what A and B show at a moment."""

from collections.abc import Mapping
from dataclasses import dataclass

from app.viewer.content.content import Content
from physhandi.object_rollout import ObjectRollout

SIDE_KEYS = ("a", "b")
"""Keys of the sides; A is on the left unless they are swapped."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ComparedSide:
    """One side of a comparison at a moment: a run, the fit, a kept rollout or PhysTwin's way."""

    name: str
    """Name of the side in exported files."""
    title: str
    """Caption in the scene."""
    detail: str
    """Second line of the caption."""
    rollout: ObjectRollout | None
    """The rollout; None without an object, or while no frame is ready."""
    frame: int
    """Frame of the rollout."""
    content: Content
    """Hands and observation."""
    content_frame: int
    """Frame of hands and observation."""


Sides = Mapping[str, ComparedSide]
"""Both sides by their keys, `SIDES`."""
ComparedRollouts = Mapping[str, tuple[ObjectRollout, int]]
"""Rollouts of both sides, each with its frame, by the sides' names in exported files."""


def compared_rollouts(sides: Sides) -> ComparedRollouts:
    """Collect the rollouts to be exported; a side that has none is left out."""
    return {s.name: (s.rollout, s.frame) for s in sides.values() if s.rollout is not None}
