"""Fitted hands made wrong by a known amount: the third disturbance of the robustness table."""

from dataclasses import dataclass, replace

import numpy as np
from safetensors.numpy import load_file
from scipy.spatial.transform import Rotation

from physhandi.data.attempt import Attempt
from physhandi.errors import MissingInputError
from physhandi.hand.model import load_hand_model
from physhandi.hand.motion import HandMotion

HAND_NOISE = 0.010
"""Mean joint error of the paper's disturbed hands [m]."""
_PLACE, _TURN, _POSE = 0.01, 0.1, 0.1
_HALVINGS = 30
_MOST = 8.0


@dataclass(frozen=True, kw_only=True)
class HandNoise:
    """How hands are made wrong."""

    error: float
    """Mean distance of the joints from where they were [m]."""
    seed: int
    """Of the noise; another one for every recording, or all would be wrong in the same way."""


def disturb_hands(attempt: Attempt, folder: str, noise: HandNoise) -> None:
    """Replace the stored hands of a sequence by wrong ones; twice would be too much.

    Args:
        attempt: Holds hands as they were fitted.
        folder: Folder of the sequence in it.
        noise: How wrong they become.

    Raises:
        MissingInputError: If there is no hand.
    """
    paths = sorted((attempt.out / folder).glob("hand_*.safetensors"))
    if not paths:
        raise MissingInputError(f"{attempt.out / folder} has no hand to disturb.")
    for number, path in enumerate(paths):
        motion = HandMotion.from_tensors(load_file(path))
        wrong = disturbed(motion, noise.error, seed=(noise.seed, number))
        attempt.save_tensors(f"{folder}/{path.name}", wrong.to_tensors())


def disturbed(motion: HandMotion, error: float, *, seed: tuple[int, ...]) -> HandMotion:
    """Disturb place, turn and pose of a hand in every frame by itself.

    Each wrist coordinate gets normal noise of 10 mm, wrist and joints 0.1 rad about each axis;
    everything is then scaled by one factor, so that the mean joint error is what was asked for.

    Args:
        motion: The hand.
        error: Mean distance of its 21 joints from where they were [m].
        seed: Of the noise.
    """
    random = np.random.default_rng([4, *seed])
    count = motion.frame_count
    place = _PLACE * random.standard_normal((count, 3))
    turn = _TURN * random.standard_normal((count, 3))
    pose = _POSE * random.standard_normal((count, 15, 3))
    model = load_hand_model(motion.side, motion.model)
    before = motion.keypoints(model)

    def moved(share: float) -> HandMotion:
        rotation = Rotation.from_rotvec(motion.wrist_rotation) * Rotation.from_rotvec(share * turn)
        return replace(
            motion,
            articulation=(motion.articulation + share * pose).astype(np.float32),
            wrist_rotation=rotation.as_rotvec().astype(np.float32),
            wrist_translation=(motion.wrist_translation + share * place).astype(np.float32),
        )

    low, high = 0.0, _MOST
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        gap = np.linalg.norm(moved(middle).keypoints(model) - before, axis=2).mean()
        low, high = (middle, high) if gap < error else (low, middle)
    return moved(high)
