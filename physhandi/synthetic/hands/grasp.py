"""Inverse kinematics of the true hand: poses that bring the fingertips to given targets."""

from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from physhandi.errors import SequenceError
from physhandi.synthetic.hands.true_hand import BONE_COUNT, Capsule, TrueHand, TrueHandPose

FINGER_NAMES = ("thumb", "index", "middle", "ring", "little")
"""Fingers in the order in which they are numbered."""
THUMB, INDEX, MIDDLE, RING, LITTLE = range(5)

_LAST_JOINT = 0.6
"""The last joint of a finger flexes by this share of the one before it."""
# Flexion, spread and twist of the thumb's root, then flexion of its other joints [rad].
_THUMB_LOW = np.array([-0.7, -0.9, -0.9, -0.3, -0.3])
_THUMB_HIGH = np.array([0.9, 0.9, 0.9, 0.9, 1.2])
# Flexion and spread of a knuckle, and flexion of the middle joint [rad].
_FINGER_LOW = np.array([-0.35, -0.3, -0.05])
_FINGER_HIGH = np.array([1.5, 0.3, 1.8])
_TURN_RANGE = 1.2
_REACH_RANGE = 0.5
# How far each freedom may stray from its guess before it costs as much as a fingertip that is
# 1 mm off: orientation [rad], position [m], joints [rad].
_STRAY_TURN, _STRAY_POSITION, _STRAY_JOINT = 0.5, 0.5, 0.6
_TIP_SCALE = 0.001
_SLANT = 0.15
# Thickness of the hand below its wrist [m].
_HEEL = 0.017
_TIP_ERROR = 0.006

RELAXED = np.array([0.0, 0.0, 0.0, 0.15, 0.2] + [0.45, 0.0, 0.5] * 4)
"""Joints of a hand about to grasp: the thumb's five freedoms, then three of each finger [rad]."""
PINCHING = np.array([0.1, 0.3, 0.0, 0.1, 0.0] + [0.8, 0.0, 0.25] * 2 + [0.6, 0.0, 0.4] * 2)
"""Joints of a hand whose finger pads face the thumb's [rad]."""
FLAT_HAND = np.array([-0.41, -0.33, -0.18, 0.33, 0.36] + [-0.06, 0.0, -0.05] * 4)
"""Joints of an open hand with straight fingers [rad]."""
POINTING = np.array([0.3, 0.0, 0.0, 0.3, 0.5, 0.5, 0.0, 0.25] + [1.2, 0.0, 1.5] * 3)
"""Joints of a hand whose index finger points while the others are curled [rad]."""


def bend_of(joints: Float[ndarray, "*pose 17"]) -> Float[ndarray, "*pose bone 3"]:
    """Bend the bones by 17 joint angles: five of the thumb, three of each other finger [rad].

    The latter are flexion and spread of the knuckle and flexion of the middle joint.
    """
    bend = np.zeros((*joints.shape[:-1], BONE_COUNT, 3))
    bend[..., 1, :] = joints[..., :3]
    bend[..., 2:4, 0] = joints[..., 3:5]
    fingers = joints[..., 5:].reshape(*joints.shape[:-1], 4, 3)
    bend[..., 4::3, :2] = fingers[..., :2]
    bend[..., 5::3, 0] = fingers[..., 2]
    bend[..., 6::3, 0] = _LAST_JOINT * fingers[..., 2]
    return bend


def fingertip(hand: TrueHand, finger: int) -> Capsule:
    """Find the solid at the end of a finger (0 the thumb, 4 the little finger)."""
    bone = 3 * finger + 3
    return next(capsule for capsule in hand.capsules if capsule.bone == bone)


def orientation_towards(
    forward: Float[ndarray, " 3"], *, pitch: float = 0.0
) -> Float[ndarray, " 3"]:
    """Hold a hand palm down with the fingers in a horizontal direction, tipped by an angle.

    Args:
        forward: Where the fingers point, seen from above.
        pitch: How far the fingers point below the horizon [rad].

    Returns:
        Rotation vector for `HandPose`.
    """
    along = np.array([forward[0], forward[1], 0.0])
    along /= np.linalg.norm(along)
    up = np.array([0.0, 0.0, 1.0])
    x = np.cos(pitch) * along - np.sin(pitch) * up
    y = np.cross(up, along)
    return Rotation.from_matrix(np.stack([x, y, np.cross(x, y)], axis=1)).as_rotvec()


def reach(
    hand: TrueHand,
    targets: Mapping[int, Float[ndarray, " 3"]],
    *,
    orientation: Float[ndarray, " 3"],
    joints: Float[ndarray, " 17"],
    start: TrueHandPose | None = None,
    along: Float[ndarray, " 3"] | None = None,
    floor: float = -np.inf,
) -> TrueHandPose:
    """Find the pose of a hand whose fingertips' centres are at given targets.

    The middle of a fingertip is the end of its capsule's line, one radius under the skin.

    Args:
        hand: The hand.
        targets: Place in the world for some fingers' tips, by the finger's number [m].
        orientation: How the hand should be held if the targets let it [rad].
        joints: How the fingers should be bent if the targets let them (see `bend_of`).
        start: A pose to stay near, as while fingers close; the wrist then hardly moves.
        along: Direction in which the last bones of thumb, index and middle finger should point.
        floor: Height under which the heel of the hand should not be [m].

    Raises:
        SequenceError: Thumb, index or middle finger stays more than 6 mm away from its target.
    """
    tips = {finger: fingertip(hand, finger) for finger in targets}
    palm = Rotation.from_rotvec(orientation if start is None else start.orientation)
    wrist = _first_place(hand, targets, palm, joints) if start is None else start.position
    tightness = 1.0 if start is None else 0.15
    guess = np.concatenate([np.zeros(3), wrist, joints])
    scale = np.repeat(
        [_STRAY_TURN * tightness, _STRAY_POSITION * tightness, _STRAY_JOINT], [3, 3, 17]
    )
    reach_low = [wrist - _REACH_RANGE, _THUMB_LOW, np.tile(_FINGER_LOW, 4)]
    reach_high = [wrist + _REACH_RANGE, _THUMB_HIGH, np.tile(_FINGER_HIGH, 4)]
    low = np.concatenate([np.full(3, -_TURN_RANGE), *reach_low])
    high = np.concatenate([np.full(3, _TURN_RANGE), *reach_high])

    def parts_of(value: ndarray) -> tuple[ndarray, ndarray, ndarray]:
        turn = Rotation.from_rotvec(value[..., :3].reshape(-1, 3)) * palm
        orientation = turn.as_rotvec().reshape(*value.shape[:-1], 3)
        return orientation, value[..., 3:6].copy(), bend_of(value[..., 6:])

    bones = [tip.bone for tip in tips.values()]
    ends = np.array([tip.end for tip in tips.values()])[..., None]
    lines = np.array([(tip.end - tip.start) for tip in tips.values()])
    lines = (lines / np.linalg.norm(lines, axis=1, keepdims=True))[..., None]
    goal = np.array(list(targets.values()))
    pads = np.array([finger <= MIDDLE for finger in tips])

    heel = hand.rest_keypoint[:2]

    def residuals(value: ndarray) -> tuple[ndarray, ndarray, ndarray]:
        transform = hand.transforms_of(*parts_of(value))
        height = (heel @ transform[..., 0, 2, :3, None])[..., 0] + transform[..., 0, 2, 3, None]
        low = np.maximum(floor + _HEEL - height, 0.0)
        transform = transform[..., bones, :, :]
        misses = (transform[..., :3, :3] @ ends)[..., 0] + transform[..., :3, 3] - goal
        if along is None:
            return misses, low, np.zeros((*value.shape[:-1], 0, 3))
        return misses, low, (transform[..., pads, :3, :3] @ lines[pads])[..., 0] - along

    def cost(value: ndarray) -> ndarray:
        misses, low, slants = residuals(value)
        stray = (value - guess) / scale
        flat = (*value.shape[:-1], -1)
        off = np.concatenate([misses.reshape(flat), low], axis=-1) / _TIP_SCALE
        return np.concatenate([off, slants.reshape(flat) / _SLANT, stray], axis=-1)

    solution = least_squares(
        cost,
        np.clip(guess, low, high),
        lambda value: _slopes(cost, value, low, high),
        bounds=(low, high),
        ftol=1e-4,
        xtol=1e-4,
        max_nfev=60,
    )
    error = np.linalg.norm(residuals(solution.x)[0], axis=1)[pads]
    worst = int(error.argmax())
    if error[worst] > _TIP_ERROR:
        finger = FINGER_NAMES[[finger for finger in tips if finger <= MIDDLE][worst]]
        raise SequenceError(
            f"The {hand.side} hand cannot reach: its {finger} finger stays "
            f"{error[worst] * 1000:.0f} mm short. Choose a smaller object or another seed."
        )
    turn, place, bend = parts_of(solution.x)
    return TrueHandPose(orientation=turn, position=place, bend=bend)


def _slopes(
    cost: Callable[[ndarray], ndarray],
    value: Float[ndarray, " number"],
    low: Float[ndarray, " number"],
    high: Float[ndarray, " number"],
) -> Float[ndarray, "cost number"]:
    """Take the difference quotients that SciPy takes, but all at once.

    Args:
        cost: Gives the costs of many values.
        value: Where they are taken.
        low: Least of each number.
        high: Most of each number.
    """
    step = np.sqrt(np.finfo(float).eps) * np.maximum(1.0, np.abs(value))
    step = np.where(value >= 0, step, -step)
    step = np.where((value + step < low) | (value + step > high), -step, step)
    here, *there = cost(np.vstack([value, value + np.diag(step)]))
    return ((np.array(there) - here) / ((value + step) - value)[:, None]).T


def _first_place(
    hand: TrueHand, targets: Mapping[int, ndarray], palm: Rotation, joints: ndarray
) -> Float[ndarray, " 3"]:
    """Place the wrist so that the fingertips' mean error is zero."""
    pose = TrueHandPose(orientation=palm.as_rotvec(), position=np.zeros(3), bend=bend_of(joints))
    transform = hand.bone_transforms(pose)
    missing = []
    for finger, target in targets.items():
        tip = fingertip(hand, finger)
        missing.append(target - transform[tip.bone, :3, :3] @ tip.end - transform[tip.bone, :3, 3])
    return np.mean(missing, axis=0)
