"""Fingers of a skinned hand that close and open together, and bend one by one.

Each joint of a finger turns about the axis across it, so that the finger goes towards the palm;
those of the thumb go towards the knuckle of the middle finger. The first joint of a finger also
swings it to the sides, about the axis across that and the finger at rest; a positive angle takes it
away from the thumb. Joints stop at what hands can do.
"""

from collections.abc import Mapping
from dataclasses import dataclass
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
_SWING = 0.35
"""How far a finger swings to either side at most, from the rest pose [rad]."""
_TIPS = (4, 8, 12, 16, 20)
"""Keypoints at the fingertips."""
BONE_OF_KEYPOINT = (0, *(bone for k in range(1, 16, 3) for bone in (0, k, k + 1, k + 2)))
"""Bone that carries each of the 21 keypoints: a joint's rides on the bone before it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Joints:
    """How the joints of a hand bend, in its rest pose, in which all bones have the hand's axes."""

    axis: Float[ndarray, "joint 3"]
    """Axis about which each of them bends."""
    swing_axis: Float[ndarray, "finger 3"]
    """Axis about which each finger swings."""
    low: Float[ndarray, "finger 4"]
    """How far each finger swings back and its joints turn back at most, from the frame [rad]."""
    high: Float[ndarray, "finger 4"]
    """How far they go on at most [rad]."""

    @classmethod
    def of(cls, skin: Mapping[str, ndarray], side: _Side, now: Rotation) -> "_Joints":
        """Find them for a hand whose bones are rotated against their parents as they are now."""
        axis, swing_axis = _axes(-np.asarray(skin["T_bone_hand"], np.float64)[:, :3, 3], side)
        turned = now.as_rotvec()[1:]
        bent = np.zeros((5, 4))
        bent[:, 0] = np.sum(turned[::3] * swing_axis, axis=1)
        bent[:, 1:] = np.sum(turned * axis, axis=1).reshape(5, 3)
        least, most = np.full((5, 4), -_SWING), np.full((5, 4), _SWING)
        least[:, 1:], most[:, 1:] = _LEAST, _MOST.reshape(5, 3)
        # A joint that is beyond what hands can do does not go farther, and may come back.
        low, high = np.minimum(least - bent, 0.0), np.maximum(most - bent, 0.0)
        return cls(axis=axis, swing_axis=swing_axis, low=low, high=high)

    def turned_by(self, amount: Float[ndarray, " sample"]) -> Float[ndarray, "sample joint"]:
        """Tell how far closing the fingers turns each joint [rad]."""
        turn = np.asarray(amount, np.float64)[:, None] * _CLOSING
        return np.clip(turn, self.low[:, 1:].ravel(), self.high[:, 1:].ravel())


def curled_rotations(
    skin: Mapping[str, ndarray],
    side: _Side,
    frame: int,
    amount: Float[ndarray, " sample"],
    bend: Float[ndarray, "sample bend"] | None = None,
) -> Float[ndarray, "sample bone 4"]:
    """Close the fingers of a hand as it is in a frame.

    Args:
        skin: Arrays of `HandSkin.to_tensors`.
        side: Which hand it is.
        frame: The frame; the last one that there is if it is later.
        amount: How far fingers are closed: 1 for a fist, 0 for as they are, -1 for open.
        bend: How far each finger swings and its three joints turn on top of that [rad].

    Returns:
        Rotation of each bone against its parent: quaternion x, y, z, w.
    """
    now = _rotation_in(skin, frame)
    joints = _Joints.of(skin, side, now)
    turn = joints.turned_by(amount)
    more = np.zeros((len(turn), 5, 4)) if bend is None else np.reshape(bend, (-1, 5, 4))
    turn = turn + more[:, :, 1:].reshape(turn.shape)
    swing = np.zeros((len(turn), _BONES, 3))
    swing[:, 1::3] = more[:, :, :1] * joints.swing_axis
    about = np.zeros((len(turn), _BONES, 3))
    about[:, 1:] = turn[:, :, None] * joints.axis
    turned = (
        Rotation.from_rotvec(swing.reshape(-1, 3))
        * now[np.tile(np.arange(_BONES), len(turn))]
        * Rotation.from_rotvec(about.reshape(-1, 3))
    )
    return turned.as_quat().reshape(len(turn), _BONES, 4)


def curl_motion(
    skin: Mapping[str, ndarray],
    side: _Side,
    frame: int,
    amount: Float[ndarray, " sample"],
    bend: Float[ndarray, "sample bend"] | None = None,
) -> Float[ndarray, "sample bone 4 4"]:
    """Tell how closing the fingers moves each bone in the world; the arguments are the same.

    Returns:
        Matrices that take points of a bone from where they are in the frame to where they go.
    """
    # The first sample is the hand as it is.
    amount = np.concatenate([np.zeros(1), amount])
    if bend is not None:
        bend = np.concatenate([np.zeros((1, bend.shape[1])), bend])
    placed = _placed(skin, frame, curled_rotations(skin, side, frame, amount, bend))
    return placed[1:] @ np.linalg.inv(placed[0])


def finger_joints(
    skin: Mapping[str, ndarray],
    side: _Side,
    frame: int,
    amount: Float[ndarray, " sample"],
    keypoint: Float[ndarray, "21 3"],
) -> dict[str, ndarray]:
    """Tell where the joints of the fingers are, about which they bend, and how far.

    Args:
        skin: Arrays of `HandSkin.to_tensors`.
        side: Which hand it is.
        frame: The frame; the last one that there is if it is later.
        amount: How far fingers are closed, as for `curled_rotations`.
        keypoint: Keypoints of the hand in the frame [m].

    Returns:
        Arrays of `physhandi.simulation.fingers.Fingers` by their names; the points are the skin's
        vertices.
    """
    joints = _Joints.of(skin, side, _rotation_in(skin, frame))
    T_world_bone = _placed(skin, frame, curled_rotations(skin, side, frame, amount))
    motion = curl_motion(skin, side, frame, amount)
    return {
        "origin": T_world_bone[:, 1:, :3, 3],
        "axis": np.einsum("sjab,jb->sja", T_world_bone[:, 1:, :3, :3], joints.axis),
        "swing_axis": joints.swing_axis @ T_world_bone[0, 0, :3, :3].T,
        "tip": blended(
            motion,
            np.array(BONE_OF_KEYPOINT)[list(_TIPS), None],
            np.ones((len(_TIPS), 1)),
            np.asarray(keypoint, np.float64)[list(_TIPS)],
        ),
        "turn": joints.turned_by(amount),
        "low": joints.low.ravel(),
        "high": joints.high.ravel(),
        "weight": weight_of_joints(skin["vertex_bone"], skin["vertex_weight"]),
    }


def weight_of_joints(
    bone: Integer[ndarray, "point some"], weight: Float[ndarray, "point some"]
) -> Float[ndarray, "point joint"]:
    """Tell how much points move with each of the 15 joints; the arguments are `blended`'s."""
    every = np.zeros((len(bone), _BONES))
    np.add.at(every, (np.arange(len(bone))[:, None], np.asarray(bone, np.int64)), weight)
    return every[:, 1:]


def _rotation_in(skin: Mapping[str, ndarray], frame: int) -> Rotation:
    """Give the rotation of each bone against its parent in a frame."""
    rotation = np.asarray(skin["rotation"], np.float64)
    return Rotation.from_quat(rotation[min(frame, len(rotation) - 1)])


def _placed(
    skin: Mapping[str, ndarray], frame: int, rotation: Float[ndarray, "sample bone 4"]
) -> Float[ndarray, "sample bone 4 4"]:
    """Chain the bones of a hand, whose wrist is where it is in a frame, from the palm outwards."""
    place = np.asarray(skin["translation"], np.float64)
    T_parent_bone = np.tile(np.eye(4), (len(rotation), _BONES, 1, 1))
    turned = Rotation.from_quat(rotation.reshape(-1, 4)).as_matrix()
    T_parent_bone[..., :3, :3] = turned.reshape(len(rotation), _BONES, 3, 3)
    T_parent_bone[..., :3, 3] = place[min(frame, len(place) - 1)]
    T_world_bone = T_parent_bone.copy()
    for bone, parent in enumerate(skin["parent"]):
        if parent >= 0:
            T_world_bone[:, bone] = T_world_bone[:, parent] @ T_parent_bone[:, bone]
    return T_world_bone


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


def _axes(
    origin: Float[ndarray, "bone 3"], side: _Side
) -> tuple[Float[ndarray, "joint 3"], Float[ndarray, "finger 3"]]:
    """Find the axes about which joints bend and fingers swing, in the rest pose.

    Args:
        origin: Origin of each bone, the wrist's first.
        side: Which hand it is.
    """
    sign = 1.0 if side == "right" else -1.0
    across = np.cross(origin[_INDEX_KNUCKLE] - origin[0], origin[_PINKY_KNUCKLE] - origin[0])
    palm = sign * across
    bone = np.arange(1, _BONES)
    is_last = bone % 3 == 0
    along = origin[bone + ~is_last] - origin[bone - is_last]
    towards = np.tile(palm, (len(bone), 1))
    towards[:3] = origin[_MIDDLE_KNUCKLE] - origin[1]
    axis = _unit(np.cross(along, towards))
    return axis, sign * _unit(np.cross(axis[::3], along[::3]))


def _unit(vector: Float[ndarray, "_ 3"]) -> Float[ndarray, "_ 3"]:
    return vector / np.linalg.norm(vector, axis=1, keepdims=True)
