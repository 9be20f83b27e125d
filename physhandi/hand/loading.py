"""Loads hand models: the built-in open hand, or the user's MANO."""

from physhandi.hand.model import HandModel
from physhandi.hand.names import HandKind, HandSide


def load_hand_model(side: HandSide, kind: HandKind = "open") -> HandModel:
    """Load a hand model; repeated calls return the same object.

    Args:
        side: Which hand.
        kind: ``open`` for the built-in hand, ``mano`` for the user's imported MANO.

    Raises:
        MissingInputError: If MANO was not imported; says how to.
    """
    # These import torch, which neither the server nor `import physhandi` may load at start.
    from physhandi.hand.mano import ManoHand
    from physhandi.hand.open_hand import OpenHand

    return ManoHand.load(side) if kind == "mano" else OpenHand.load(side)
