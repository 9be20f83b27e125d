"""PhysTwin's way of holding the object of a run: few visible points, long virtual springs."""

from collections.abc import Sequence as Listing
from dataclasses import dataclass
from itertools import permutations

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from app.viewer.content.content import Content, ShownHand
from physhandi.fitting.config import named_profile
from physhandi.object_rollout import ObjectRollout
from physhandi.simulation.parameters import SimulationParameters

PROFILE = "phystwin"
"""Profile that the rival's values come from."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PhysTwinBaseline:
    """Baseline of the comparison with PhysTwin: the run's object, held in PhysTwin's way."""

    controls: Int[ndarray, " chosen"]
    """Numbers of the run's control nodes that hold the object."""
    parameters: SimulationParameters
    """The fitted parameters with PhysTwin's virtual springs."""
    source: str
    """Source of the control nodes, in a few words."""
    note: str = ""
    """Differences from PhysTwin, or why there is little to compare; empty if there are none."""

    @staticmethod
    def is_offered(content: Content) -> bool:
        """Tell whether there is something to compare: fewer points than PhysTwin's are no rival."""
        if content.fitted is None:
            return False
        count = named_profile(PROFILE).control_count
        return bool(content.hands) or content.fitted.model.control_count >= count

    @classmethod
    def of(cls, content: Content, fitted: ObjectRollout) -> "PhysTwinBaseline":
        """Choose control nodes and parameters for a run.

        Thirty points far from each other are picked among the hand vertices that a camera sees at
        frame 0, as PhysTwin samples its controllers from depth images. The object keeps nodes,
        springs and material as fitted; δ, d_max and rest length floor of the virtual springs, and
        control nodes whose velocity does not count, are those of the profile ``phystwin``, and a
        virtual spring is as stiff as an object spring.

        Args:
            content: Hands and cameras.
            fitted: The run's rollout.
        """
        from physhandi.fitting.placement import farthest_points  # It loads torch.

        profile = named_profile(PROFILE)
        values = profile.simulation
        parameters = fitted.parameters.replace(
            virtual_connection_radius=values.virtual_connection_radius,
            virtual_max_neighbors=values.virtual_max_neighbors,
            virtual_rest_length_floor=values.virtual_rest_length_floor,
            virtual_stiffness=fitted.parameters.stiffness,
            use_control_velocity=values.use_control_velocity,
        )
        control = np.asarray(fitted.control[0])
        candidates, source, note = _candidates(content, control, profile.control_count)
        chosen = candidates[farthest_points(control[candidates], profile.control_count)]
        return cls(
            controls=chosen, parameters=parameters, source=f"{len(chosen)} {source}", note=note
        )


def _candidates(
    content: Content, control: Float[ndarray, "control 3"], count: int
) -> tuple[Int[ndarray, " candidate"], str, str]:
    """Find the control nodes that PhysTwin could see, what they are, and what is to be said."""
    from physhandi.fitting.placement import visible_vertices  # It loads torch.

    everything = np.arange(len(control))
    hands = _hands_in_order(content.hands, control)
    if hands is None:
        if len(control) <= count:
            note = (
                f"This run moves its object by {len(control)} points already; both sides use them."
            )
        else:
            note = "This run moves its object by recorded points; some of them are used."
        return everything, "control points", note
    if not content.views or any(hand.face is None for hand in hands):
        missing = "cameras" if not content.views else "hand surface"
        return everything, "hand vertices", f"Seen or not: the run's {missing} is not known."
    offset, seen = 0, list[ndarray]()
    for hand in hands:
        if hand.face is not None:
            vertex = control[offset : offset + hand.vertex.shape[1]]
            seen.append(visible_vertices(content.views, vertex, hand.face) + offset)
        offset += hand.vertex.shape[1]
    visible = np.concatenate(seen)
    if len(visible) == 0:
        return everything, "hand vertices", "No camera sees a hand vertex at frame 0."
    return visible, "visible hand points", ""


def _hands_in_order(
    hands: Listing[ShownHand], control: Float[ndarray, "control 3"]
) -> tuple[ShownHand, ...] | None:
    """Find the order in which the hands' vertices are the control nodes; None if they are not."""
    for order in permutations(hands):
        if order and sum(hand.vertex.shape[1] for hand in order) == len(control):
            vertex = np.concatenate([np.asarray(hand.vertex[0]) for hand in order])
            if np.allclose(vertex, control, rtol=0.0, atol=1e-5):
                return order
    return None
