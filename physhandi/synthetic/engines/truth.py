"""The result of a physics engine, and the interfaces of hands and scripts that it uses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

from jaxtyping import Bool, Float, Float32
from numpy import ndarray

from physhandi.data.sequence_meta import Side
from physhandi.synthetic.bodies.bodies import Body
from physhandi.synthetic.hands.true_hand import Capsule, TrueHandPose

FRAME_RATE = 30.0
"""Frames per second [Hz]."""
Hold = Literal["friction", "attachment"]
"""Whether hands hold a body by friction alone, or what they touch for a while sticks to them."""


class CapsuleHand(Protocol):
    """Interface of a hand; `TrueHand` implements it."""

    @property
    def capsules(self) -> Sequence[Capsule]:
        """Its shape for touching."""
        ...

    def bone_transforms(self, pose: TrueHandPose, /) -> Float[ndarray, "bone 4 4"]:
        """Compute where each bone takes the points of the resting hand."""
        ...


class MovingHand(Protocol):
    """Interface of a motion; `HandScript` implements it."""

    @property
    def side(self) -> Side:
        """Side of the hand that moves."""
        ...

    @property
    def begin(self) -> float:
        """When the hand starts to move [s]; 0 (frame 0) if that is within the recording."""
        ...

    def at(self, time: float, /) -> TrueHandPose:
        """Compute the pose at a time [s]."""
        ...


@dataclass(frozen=True, eq=False, kw_only=True)
class PhysicalTruth:
    """A body and the hands that moved it, in every frame."""

    body: Body
    """The body."""
    position: Float32[ndarray, "frame node 3"]
    """Nodes of the body in each frame [m]."""
    contact: Bool[ndarray, "frame node"]
    """Whether a hand touches or holds the node."""
    hold: Hold
    """Kind of hold."""
    hands: Mapping[Side, Float[ndarray, "frame bone 4 4"]]
    """Where each bone takes the points of the resting hand in each frame. Bones give way to what
    they touch, so this is not quite what the script asked for."""
    frame_rate: float = FRAME_RATE
    """Frames per second [Hz]."""

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return len(self.position)
