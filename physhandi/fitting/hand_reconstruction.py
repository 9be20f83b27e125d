"""Stage 1: a hand mesh in every frame, from keypoints and depth of all views (paper, 3.2)."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.data.sequence import Sequence
from physhandi.errors import FitError, MissingInputError
from physhandi.fitting.hand_config import HandFitConfig as HandFitConfig
from physhandi.fitting.hand_problem import HandProblem
from physhandi.hand.model import load_hand_model
from physhandi.hand.motion import HandMotion
from physhandi.perception.keypoints import detect_sequence
from physhandi.progress import NullProgress, Progress


@dataclass(frozen=True, kw_only=True, eq=False)
class HandFit:
    """The result of stage 1."""

    motions: tuple[HandMotion, ...]
    """Motion of each hand, in the order of the sequence's hands."""
    keypoint: Float[ndarray, "view frame hand 21 3"]
    """Keypoints that the hands were fitted to; NaN where not seen [px]."""
    loss_before: float
    """Loss of the first guess, without depth."""
    loss_after: float
    """Loss of the result, without depth."""
    curve: list[tuple[int, float]] = field(default_factory=list)
    """Loss of every tenth iteration, summed over the hands."""


def reconstruct_hands(
    sequence: Sequence,
    config: HandFitConfig | None = None,
    progress: Progress | None = None,
    *,
    keypoint: Float[ndarray, "view frame hand 21 3"] | None = None,
) -> HandFit:
    """Fit a hand model to all frames of a sequence at once.

    Shape is constant; a sequence that is not metric gets one scale for each hand. Frames that no
    view saw are bridged by smoothness; no frame is left out.

    Args:
        sequence: The recording; its `hands` say what is to be fitted.
        config: Settings.
        progress: Told after every tenth iteration.
        keypoint: Keypoints to fit to; if None, the views' own, or else what the networks find.

    Raises:
        MissingInputError: If there is no hand, no view, nothing to find keypoints in, or no MANO
            when it is asked for.
        FitError: If a hand is not seen well enough to start from.
    """
    config, progress = config or HandFitConfig(), progress or NullProgress()
    if not sequence.hands or not sequence.views:
        raise MissingInputError(
            f"Sequence '{sequence.name}': stage 1 needs at least one view and one hand; "
            f"there are {len(sequence.views)} views and {len(sequence.hands)} hands."
        )
    if keypoint is None:
        keypoint = given_keypoints(sequence)
    if keypoint is None:
        keypoint = detect_sequence(sequence, progress)
    fits = []
    for hand, side in enumerate(sequence.hands):
        model = load_hand_model(side, config.model)
        try:
            problem = HandProblem(sequence, keypoint[:, :, hand], model, config)
            fits.append(problem.solve(progress))
        except FitError as error:
            raise FitError(f"Sequence '{sequence.name}': {error}") from error
    losses = zip(*(fit.curve for fit in fits), strict=False)
    curve = [(at[0][0], float(sum(loss for _, loss in at))) for at in losses]
    return HandFit(
        motions=tuple(fit.motion for fit in fits),
        keypoint=keypoint.astype(np.float32),
        loss_before=sum(fit.loss_before for fit in fits),
        loss_after=sum(fit.loss_after for fit in fits),
        curve=curve,
    )


def given_keypoints(sequence: Sequence) -> Float[ndarray, "view frame hand 21 3"] | None:
    """Collect the keypoints that the sequence itself holds; None unless all views have them."""
    keypoint = [view.keypoint for view in sequence.views]
    if any(one is None for one in keypoint):
        return None
    return np.stack([one for one in keypoint if one is not None])
