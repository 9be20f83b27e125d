"""Linear blend skinning of a palm with five fingers of three joints each."""

import torch
from jaxtyping import Float
from torch import Tensor

from physhandi.hand.rotation import rotation_offset


def joint_turns(
    articulation: Float[Tensor, "batch 15 3"], axes: Float[Tensor, "15 3 3"]
) -> Float[Tensor, "batch 15 3 3"]:
    """Compute the rotation of each joint in the hand's frame, less the identity.

    Args:
        articulation: Rotation vector of every joint in its bone's own frame [rad].
        axes: Axes of that frame, as columns.
    """
    return axes @ rotation_offset(articulation) @ axes.transpose(-1, -2)


def turn_bones(
    turn: Float[Tensor, "batch 15 3 3"], joint: Float[Tensor, "16 3"]
) -> tuple[Float[Tensor, "batch 16 3 3"], Float[Tensor, "batch 16 3"]]:
    """Chain the rotations of the joints from the palm outwards.

    Args:
        turn: Rotation of each joint in the hand's frame, less the identity; each finger's three
            joints follow one another.
        joint: Where the bones begin: the wrist, then the joints in the same order [m].

    Returns:
        Each bone's rotation, less the identity, and how far its origin moved [m]; bone 0 is the
        palm, which stays.
    """
    turn = turn.unflatten(1, (5, 3))
    origin = joint[1:].reshape(5, 3, 3)
    rotation, moved = [turn[:, :, 0]], [torch.zeros_like(turn[:, :, 0, 0])]
    for link in (1, 2):
        above = rotation[-1]
        offset = (origin[:, link] - origin[:, link - 1])[..., None]
        moved.append(moved[-1] + (above @ offset)[..., 0])
        rotation.append(above + turn[:, :, link] + above @ turn[:, :, link])
    palm = torch.zeros_like(turn[:, 0, :1])
    return (
        torch.cat([palm, torch.stack(rotation, 2).flatten(1, 2)], 1),
        torch.cat([palm[..., 0], torch.stack(moved, 2).flatten(1, 2)], 1),
    )


def blend(
    point: Float[Tensor, "*batch point 3"],
    weight: Float[Tensor, "*weights point 16"],
    joint: Float[Tensor, "16 3"],
    rotation: Float[Tensor, "batch 16 3 3"],
    moved: Float[Tensor, "batch 16 3"],
) -> Float[Tensor, "batch point 3"]:
    """Move points with the bones that hold them: ``sum_b w_b (R_b (p - j_b) + j_b + moved_b)``.

    Args:
        point: Points of the unposed hand, the same for the whole batch or not [m].
        weight: Skinning weights, the same for the whole batch or not; rows sum to one.
        joint: Where the bones begin in the unposed hand [m].
        rotation: Rotation of each bone, less the identity.
        moved: How far each bone's origin moved [m].
    """
    constant = moved - (rotation @ joint[..., None])[..., 0]
    blended = (weight @ rotation.flatten(2)).unflatten(2, (3, 3))
    return point + (blended @ point[..., None])[..., 0] + weight @ constant


def place(
    point: Float[Tensor, "batch point 3"],
    wrist_rotation: Float[Tensor, "batch 3"],
    wrist_translation: Float[Tensor, "batch 3"],
    scale: float | Float[Tensor, ""],
) -> Float[Tensor, "batch point 3"]:
    """Transform points from the wrist's frame to the world, as `HandModel` defines it."""
    turned = point + point @ rotation_offset(wrist_rotation).transpose(-1, -2)
    return scale * (turned + wrist_translation[:, None])
