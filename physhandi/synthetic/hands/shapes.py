"""Poses of a hand at a place: pinch and claw, and rigid motions of poses."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from physhandi.synthetic.hands.grasp import (
    INDEX,
    LITTLE,
    MIDDLE,
    PINCHING,
    RELAXED,
    RING,
    THUMB,
    fingertip,
    orientation_towards,
    reach,
)
from physhandi.synthetic.hands.places import Place
from physhandi.synthetic.hands.true_hand import TrueHand, TrueHandPose

_UP = np.array([0.0, 0.0, 1.0])
_CLEAR_OF = 0.02
_FINGER_SPACING, _PINCH_SPACING = 0.020, 0.016
_PITCH, _PINCH_PITCH = 0.75, 0.0
# How far below the horizon pinching fingers point, and how much of them is beyond the pinch.
_TILT, _PAD = 0.7, 0.006


def pinch(hand: TrueHand, place: Place, gap: float, start: TrueHandPose | None) -> TrueHandPose:
    """Put the thumb below a place and two fingers above it; the others stay clear of it."""
    along = np.cos(_TILT) * place.forward - np.sin(_TILT) * _UP
    above = np.sin(_TILT) * place.forward + np.cos(_TILT) * _UP
    point = place.point + _PAD * along
    targets = {THUMB: point - (gap / 2 + fingertip(hand, THUMB).radius) * above}
    clear = place.thickness / 2 + _CLEAR_OF
    for finger in (INDEX, MIDDLE, RING, LITTLE):
        height = gap / 2 if finger <= MIDDLE else clear
        aside = (INDEX + 0.5 - finger) * _PINCH_SPACING * _thumb_side(hand, place)
        targets[finger] = point + (height + fingertip(hand, finger).radius) * above + aside
    return reach(
        hand,
        targets,
        orientation=orientation_towards(place.forward, pitch=_PINCH_PITCH),
        joints=PINCHING,
        start=start,
        along=along,
    )


def claw(hand: TrueHand, place: Place, gap: float, start: TrueHandPose | None) -> TrueHandPose:
    """Put the thumb and all fingers on opposite sides of a place, tips down."""
    targets: dict[int, ndarray] = {}
    for finger in (THUMB, INDEX, MIDDLE, RING, LITTLE):
        radius = fingertip(hand, finger).radius
        sign, order = (-1.0, 0.0) if finger == THUMB else (1.0, 2.5 - finger)
        target = place.point + sign * (gap / 2 + radius) * place.forward
        target = target + order * _FINGER_SPACING * _thumb_side(hand, place)
        targets[finger] = np.array([*target[:2], max(place.depth, 0.001) + radius])
    return reach(
        hand,
        targets,
        orientation=orientation_towards(place.forward, pitch=_PITCH),
        joints=RELAXED,
        start=start,
        along=0.3 * place.forward - 0.95 * _UP,
        floor=0.0,
    )


def lowest_skin(hand: TrueHand, pose: TrueHandPose) -> tuple[float, Float[ndarray, " 3"]]:
    """Find the lowest skin of a pose, and the middle of its palm."""
    transform = hand.bone_transforms(pose)
    lowest = np.inf
    for capsule in hand.capsules:
        turn, shift = transform[capsule.bone, :3, :3], transform[capsule.bone, :3, 3]
        for end in (capsule.start, capsule.end):
            lowest = min(lowest, float((turn @ end + shift)[2]) - capsule.radius)
    keypoint = hand.pose(pose).keypoint
    return lowest, (keypoint[0] + keypoint[9]) / 2


def moved(pose: TrueHandPose, shift: Float[ndarray, " 3"]) -> TrueHandPose:
    """Shift a pose."""
    return TrueHandPose(
        orientation=pose.orientation, position=pose.position + shift, bend=pose.bend
    )


def turned(
    pose: TrueHandPose,
    point: Float[ndarray, " 3"],
    shift: Float[ndarray, " 3"],
    turn: Float[ndarray, " 3"],
) -> TrueHandPose:
    """Turn a pose about a point, then shift it."""
    rotation = Rotation.from_rotvec(turn)
    return TrueHandPose(
        orientation=(rotation * Rotation.from_rotvec(pose.orientation)).as_rotvec(),
        position=point + rotation.apply(pose.position - point) + shift,
        bend=pose.bend,
    )


def _thumb_side(hand: TrueHand, place: Place) -> Float[ndarray, " 3"]:
    """Compute the horizontal direction from the little finger to the index finger."""
    side = 1.0 if hand.side == "right" else -1.0
    return side * np.cross(_UP, place.forward)
