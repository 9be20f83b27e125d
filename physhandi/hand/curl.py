"""Fingers of a skinned hand that close and open together.

Each joint of a finger turns about the axis across it, so that the finger goes towards the palm;
those of the thumb go towards the knuckle of the middle finger. Joints stop at what hands can do.
"""

from collections.abc import Mapping
from typing import Literal

import numpy as np
from jaxtyping import Float, Integer
from numpy import ndarray
from scipy.spatial.transform import Rotation

_Side = Literal["right", "left"]
_BONES, _MIDDLE_KNUCKLE = 16, 7
_INDEX_KNUCKLE, _PINKY_KNUCKLE = 4, 13
_CLOSING = np.array([[0.2, 0.4, 0.5]] + 4 * [[0.9, 1.2, 0.8]]).ravel()
"""How far each joint turns from a hand as it is to one that is closed by one [rad]."""
_MOST, _LEAST = np.array([[0.6, 0.9, 1.2]] + 4 * [[1.5, 1.8, 1.3]]).ravel(), -0.2
"""How far a joint turns at most and at least, from the rest pose [rad]."""
BONE_OF_KEYPOINT = (0, *(bone for k in range(1, 16, 3) for bone in (0, k, k + 1, k + 2)))
"""Bone that carries each of the 21 keypoints: a joint's rides on the bone before it."""


def curled_rotations(
    skin: Mapping[str, ndarray],
    side: _Side,
    frame: int,
    amount: Float[ndarray, " sample"],
) -> Float[ndarray, "sample bone 4"]:
    """Close the fingers of a hand as it is in a frame.

    Args:
        skin: Arrays of `HandSkin.to_tensors`.
        side: Which hand it is.
        frame: The frame; the last one that there is if it is later.
        amount: How far fingers are closed: 1 for a fist, 0 for as they are, -1 for open.

    Returns:
        Rotation of each bone against its parent: quaternion x, y, z, w.
    """
    rotation = np.asarray(skin["rotation"], np.float64)
    now = Rotation.from_quat(rotation[min(frame, len(rotation) - 1)])
    axis = _axes(-np.asarray(skin["T_bone_hand"], np.float64)[:, :3, 3], side)
    bent = np.sum(now.as_rotvec()[1:] * axis, axis=1)
    turn = np.asarray(amount, np.float64)[:, None] * _CLOSING
    # A joint that is beyond what hands can do does not go farther, and may come back.
    turn = np.clip(turn, np.minimum(_LEAST - bent, 0.0), np.maximum(_MOST - bent, 0.0))
    turned = [
        now * Rotation.from_rotvec(np.concatenate([np.zeros((1, 3)), its[:, None] * axis]))
        for its in turn
    ]
    return np.stack([each.as_quat() for each in turned])


def curl_motion(
    skin: Mapping[str, ndarray],
    side: _Side,
    frame: int,
    amount: Float[ndarray, " sample"],
) -> Float[ndarray, "sample bone 4 4"]:
    """Tell how closing the fingers moves each bone in the world; the arguments are the same.

    Returns:
        Matrices that take points of a bone from where they are in the frame to where they go.
    """
    place = np.asarray(skin["translation"], np.float64)
    still = curled_rotations(skin, side, frame, np.zeros(1))
    rotation = np.concatenate([still, curled_rotations(skin, side, frame, amount)])
    T_parent_bone = np.tile(np.eye(4), (len(rotation), _BONES, 1, 1))
    turned = Rotation.from_quat(rotation.reshape(-1, 4)).as_matrix()
    T_parent_bone[..., :3, :3] = turned.reshape(len(rotation), _BONES, 3, 3)
    T_parent_bone[..., :3, 3] = place[min(frame, len(place) - 1)]
    T_world_bone = T_parent_bone.copy()
    for bone, parent in enumerate(skin["parent"]):
        if parent >= 0:
            T_world_bone[:, bone] = T_world_bone[:, parent] @ T_parent_bone[:, bone]
    return T_world_bone[1:] @ np.linalg.inv(T_world_bone[0])


def blended(
    motion: Float[ndarray, "sample bone 4 4"],
    bone: Integer[ndarray, "point some"],
    weight: Float[ndarray, "point some"],
    point: Float[ndarray, "point 3"],
) -> Float[ndarray, "sample point 3"]:
    """Move points with several bones each.

    Args:
        motion: What `curl_motion` gives.
        bone: Bones of each point.
        weight: Weight of each of them; rows sum to one.
        point: Where the points are [m].
    """
    matrix = np.einsum("pk,spkij->spij", weight, motion[:, bone])
    return np.einsum("spij,pj->spi", matrix[..., :3, :3], point) + matrix[..., :3, 3]


def _axes(origin: Float[ndarray, "bone 3"], side: _Side) -> Float[ndarray, "joint 3"]:
    """Find the axes about which joints bend, in the rest pose, in which all bones have the hand's.

    Args:
        origin: Origin of each bone, the wrist's first.
        side: Which hand it is.
    """
    palm = np.cross(origin[_INDEX_KNUCKLE] - origin[0], origin[_PINKY_KNUCKLE] - origin[0]) * (
        1.0 if side == "right" else -1.0
    )
    bone = np.arange(1, _BONES)
    is_last = bone % 3 == 0
    along = origin[bone + ~is_last] - origin[bone - is_last]
    towards = np.tile(palm, (len(bone), 1))
    towards[:3] = origin[_MIDDLE_KNUCKLE] - origin[1]
    axis = np.cross(along, towards)
    return axis / np.linalg.norm(axis, axis=1, keepdims=True)
