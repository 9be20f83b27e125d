import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from physhandi.errors import SequenceError
from physhandi.synthetic.hands.grasp import (
    INDEX,
    LITTLE,
    MIDDLE,
    PINCHING,
    POINTING,
    RELAXED,
    THUMB,
    bend_of,
    fingertip,
    orientation_towards,
    reach,
)
from physhandi.synthetic.hands.true_hand import TrueHand, TrueHandPose, load_true_hand

UP = np.array([0.0, 0.0, 1.0])


def tip(hand: TrueHand, pose: TrueHandPose, finger: int) -> np.ndarray:
    solid = fingertip(hand, finger)
    return (hand.bone_transforms(pose)[solid.bone] @ [*solid.end, 1])[:3]


def test_a_hand_held_towards_a_direction_points_there_with_its_palm_down():
    turn = Rotation.from_rotvec(orientation_towards(np.array([0.0, 2.0, 0.0]), pitch=0.3))
    assert turn.apply([1, 0, 0]) == pytest.approx([0, np.cos(0.3), -np.sin(0.3)])
    assert turn.apply([0, 0, 1])[2] == pytest.approx(np.cos(0.3))


def test_a_fingertip_is_its_fingers_last_solid():
    hand = load_true_hand("right")
    for finger, keypoint in ((THUMB, 4), (INDEX, 8), (LITTLE, 20)):
        solid = fingertip(hand, finger)
        assert np.linalg.norm(solid.end - hand.rest_keypoint[keypoint]) < 0.015


def test_joint_angles_become_bends_and_the_last_joint_follows_the_one_before():
    joints = np.zeros(17)
    joints[[2, 4, 8, 10]] = 0.1, 0.2, 0.3, 0.5
    bend = bend_of(joints)
    assert bend[1].tolist() == [0, 0, 0.1]
    assert bend[3, 0] == 0.2
    assert bend[7, 0] == 0.3
    assert bend[8:10, 0].tolist() == pytest.approx([0.5, 0.3])
    assert np.count_nonzero(bend) == 5


@pytest.mark.parametrize("side", ["right", "left"])
def test_thumb_and_fingers_meet_where_they_are_sent(side):
    hand = load_true_hand(side, seed=1)
    along = np.array([0.8, 0.0, -0.6])
    targets = {
        THUMB: np.array([0.3, 0.2, 0.030]),
        INDEX: np.array([0.3, 0.2, 0.050]),
        MIDDLE: np.array([0.3, 0.2 - (0.016 if side == "right" else -0.016), 0.050]),
    }
    held = orientation_towards(np.array([1.0, 0.0, 0.0]))
    pose = reach(hand, targets, orientation=held, joints=PINCHING, along=along)
    for finger, target in targets.items():
        assert tip(hand, pose, finger) == pytest.approx(target, abs=0.004)
        solid = fingertip(hand, finger)
        line = hand.bone_transforms(pose)[solid.bone, :3, :3] @ (solid.end - solid.start)
        assert line @ along / np.linalg.norm(line) > 0.85
    wider = reach(
        hand, targets | {THUMB: targets[THUMB] - 0.02 * UP}, orientation=held, joints=PINCHING,
        start=pose, along=along,
    )  # fmt: skip
    assert np.linalg.norm(wider.position - pose.position) < 0.02
    assert tip(hand, wider, THUMB)[2] == pytest.approx(0.010, abs=0.004)


def test_a_single_finger_can_be_sent_anywhere():
    hand = load_true_hand("right")
    target = np.array([-0.2, 0.4, 0.02])
    held = orientation_towards(UP[[2, 0, 1]], pitch=0.7)
    pose = reach(hand, {INDEX: target}, orientation=held, joints=POINTING)
    assert tip(hand, pose, INDEX) == pytest.approx(target, abs=1e-3)


def test_what_no_hand_spans_is_refused_and_the_finger_named():
    hand = load_true_hand("right")
    targets = {THUMB: np.zeros(3), INDEX: np.array([0.3, 0.0, 0.0])}
    with pytest.raises(SequenceError, match=r"right hand cannot reach.*(thumb|index).*smaller"):
        reach(hand, targets, orientation=np.zeros(3), joints=RELAXED)
