"""Fingers that bend one by one: against bones that are chained by parents, anatomy and a search."""

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from support.physics.hand_scene import flat_and_bent

from physhandi.hand.curl import (
    BONE_OF_KEYPOINT,
    blended,
    curl_motion,
    curled_rotations,
    finger_joints,
)
from physhandi.hand.loading import load_hand_model
from physhandi.hand.motion import HandMotion
from physhandi.hand.skin import hand_skin
from physhandi.simulation.fingers import BENDS, CURLS, FINGERS, Fingers

TIPS = [4, 8, 12, 16, 20]
CURL = 0.25
"""One of `CURLS`, where nothing is interpolated."""
STEP = 1e-8
"""Step of a difference quotient [rad]."""


class Hand:
    """A hand of the open model in a frame: 0, where it is flat, or 1, where it is bent a little."""

    def __init__(self, side: str, frame: int) -> None:
        self.frame = frame
        self.model = load_hand_model(side)
        self.motion = flat_and_bent(side)
        self.skin = hand_skin(self.model, self.motion).to_tensors()
        self.keypoint = self.motion.keypoints(self.model)[frame].astype(float)
        self.fingers = Fingers(**finger_joints(self.skin, side, frame, CURLS, self.keypoint))

    def chained(self, curl: float, bend: np.ndarray) -> np.ndarray:
        """Where the 21 keypoints come, by bones that hang on each other."""
        return self.all_chained(curl, bend[None])[0]

    def all_chained(self, curl: float, bend: np.ndarray) -> np.ndarray:
        """Where they come by each of several bends."""
        amount = np.full(len(bend), curl)
        moved = curl_motion(self.skin, self.motion.side, self.frame, amount, bend)
        bone = np.array(BONE_OF_KEYPOINT)[:, None]
        return blended(moved, bone, np.ones((21, 1)), self.keypoint)


@pytest.fixture(scope="module", params=["right", "left"])
def hand(request) -> Hand:
    return Hand(request.param, 1)


@pytest.fixture(scope="module", params=["right", "left"])
def flat(request) -> Hand:
    return Hand(request.param, 0)


def out_of_palm(hand: Hand) -> np.ndarray:
    """Unit vector to the side to which fingers close."""
    wrist, index, little = hand.keypoint[[0, 5, 17]]
    palm = np.cross(index - wrist, little - wrist)
    return (1.0 if hand.motion.side == "right" else -1.0) * palm / np.linalg.norm(palm)


def some_bend(hand: Hand, seed: int, curl: float = CURL) -> np.ndarray:
    return np.random.default_rng(seed).uniform(*hand.fingers.limits(curl))


def test_bends_move_tips_and_surface_as_chained_bones_do(hand: Hand) -> None:
    bend = some_bend(hand, 1)
    tip = hand.chained(CURL, bend)[TIPS]
    np.testing.assert_allclose(hand.fingers.tips(CURL, bend), tip, atol=1e-9)
    still = hand.chained(CURL, np.zeros(BENDS))
    assert np.linalg.norm(tip - still[TIPS], axis=1).min() > 0.01
    # Points that one bone carries alone.
    skin, side = hand.skin, hand.motion.side
    vertex = hand.motion.vertices(hand.model)[1].astype(float)
    bone, weight = skin["vertex_bone"], skin["vertex_weight"]
    moved = curl_motion(skin, side, 1, np.array([CURL, CURL]), np.stack([0 * bend, bend]))
    before, after = blended(moved, bone, weight, vertex)
    found = hand.fingers.bent(before, CURL, bend)
    rigid = weight.max(axis=1) > 0.999
    assert len(np.unique(bone[rigid, np.argmax(weight[rigid], axis=1)])) > 8
    np.testing.assert_allclose(found[rigid], after[rigid], atol=2e-4)
    assert np.linalg.norm(found - after, axis=1).mean() < 2e-3
    assert np.linalg.norm(found - before, axis=1).max() > 0.03


def test_the_hand_model_with_the_same_rotations_has_the_same_tips(hand: Hand) -> None:
    bend = some_bend(hand, 2)
    turned = Rotation.from_quat(
        curled_rotations(hand.skin, hand.motion.side, 1, np.array([CURL]), bend[None])[0, 1:]
    )
    motion = hand.motion
    bent = HandMotion(
        side=motion.side,
        shape=motion.shape,
        articulation=np.einsum("jca,jc->ja", hand.model.joint_axes, turned.as_rotvec())[None],
        wrist_rotation=motion.wrist_rotation[1:],
        wrist_translation=motion.wrist_translation[1:],
    )
    expected = bent.keypoints(hand.model)[0]
    np.testing.assert_allclose(hand.fingers.tips(CURL, bend), expected[TIPS], atol=1e-5)


def test_a_joint_turns_what_lies_behind_it_to_the_side_that_it_is_told(flat: Hand) -> None:
    keypoint = flat.keypoint
    palm = out_of_palm(flat)
    fist = np.tile([0.0, 0.5, 0.6, 0.4], 5)
    nail = flat.fingers.nails(0.0, fist)[1:]
    still = flat.fingers.nails(0.0, np.zeros(BENDS))[1:]
    assert (still @ palm < -0.9).all()
    np.testing.assert_allclose(np.sum(nail * still, axis=1), np.cos(1.5), atol=0.05)
    away_from_thumb = keypoint[17] - keypoint[5]
    for finger in range(1, 5):
        for angle in range(4):
            bend = np.zeros(BENDS)
            bend[4 * finger + angle] = 0.1
            tips = flat.fingers.tips(0.0, bend) - keypoint[TIPS]
            np.testing.assert_allclose(np.delete(tips, finger, axis=0), 0.0, atol=1e-9)
            # A chord of the circle about the joint, to which the axis is nearly square.
            joint = keypoint[4 * finger + max(angle, 1)]
            reach = np.linalg.norm(keypoint[TIPS[finger]] - joint)
            way = np.linalg.norm(tips[finger])
            assert 0.75 < way / (2.0 * np.sin(0.05) * reach) < 1.1
            direction = tips[finger] / way
            if angle == 0:
                assert direction @ away_from_thumb > 0.0
                assert abs(direction @ palm) < 0.3
            else:
                assert direction @ palm > 0.5


def test_the_back_of_a_hand_is_opposite_to_where_its_fingers_close(hand: Hand, flat: Hand) -> None:
    for each in (hand, flat):
        assert each.fingers.back @ out_of_palm(each) < -0.95


@pytest.mark.parametrize("finger", range(5))
def test_a_tip_reaches_whatever_its_finger_can(hand: Hand, finger: int) -> None:
    start = some_bend(hand, 3)
    own = slice(4 * finger, 4 * finger + 4)
    for seed in range(4, 8):
        wanted = start.copy()
        wanted[own] = some_bend(hand, seed)[own]
        target = hand.chained(CURL, wanted)[TIPS[finger]]
        before = hand.chained(CURL, start)[TIPS[finger]]
        found = hand.fingers.follow(finger, target, CURL, start)
        # 10 µm of a way of millimetres to centimetres.
        assert np.linalg.norm(hand.chained(CURL, found)[TIPS[finger]] - target) < 1e-5
        assert np.linalg.norm(before - target) > 1e-3
        low, high = hand.fingers.limits(CURL)
        assert (low <= found).all()
        assert (found <= high).all()
        np.testing.assert_array_equal(np.delete(found, np.r_[own]), np.delete(start, np.r_[own]))


@pytest.mark.parametrize("finger", [0, 1, 4])
def test_a_tip_goes_as_near_as_its_joints_let_it(hand: Hand, finger: int) -> None:
    """As near as a search by another method from many starts comes."""
    own = slice(4 * finger, 4 * finger + 4)
    low, high = hand.fingers.limits(CURL)
    rng = np.random.default_rng(finger)
    tip = hand.chained(CURL, np.zeros(BENDS))[TIPS[finger]]
    along = tip - hand.keypoint[4 * finger + 1]
    back = -out_of_palm(hand)
    for way in (along / np.linalg.norm(along), back, hand.keypoint[17] - hand.keypoint[5]):
        target = tip + 0.1 * way / np.linalg.norm(way)

        def away(angles: np.ndarray, target: np.ndarray = target) -> tuple[float, np.ndarray]:
            """Distance, ten times, and its difference quotients."""
            bend = np.zeros((5, BENDS))
            bend[:, own] = angles + STEP * np.eye(5, 4, -1)
            tip = hand.all_chained(CURL, bend)[:, TIPS[finger]]
            distance = 10.0 * np.linalg.norm(tip - target, axis=1)
            return distance[0], (distance[1:] - distance[0]) / STEP

        bounds = list(zip(low[own], high[own], strict=True))
        starts = [np.zeros(4), rng.uniform(low[own], high[own])]
        ends = [minimize(away, start, jac=True, bounds=bounds, tol=1e-9) for start in starts]
        best = min(end.fun for end in ends) / 10.0
        found = hand.fingers.follow(finger, target, CURL, np.zeros(BENDS))
        distance = np.linalg.norm(hand.chained(CURL, found)[TIPS[finger]] - target)
        assert distance > 0.02
        assert distance < best + 1e-5, (finger, way, distance, best)


def test_joints_stop_where_hands_do_and_together_with_the_curl(flat: Hand) -> None:
    index = FINGERS.index("index finger")
    for curl, turned in ((0.0, np.zeros(3)), (0.5, np.array([0.45, 0.6, 0.4]))):
        low, high = (limit.reshape(5, 4)[index] for limit in flat.fingers.limits(curl))
        np.testing.assert_allclose(high, [0.35, *(np.array([1.5, 1.8, 1.3]) - turned)], atol=1e-6)
        np.testing.assert_allclose(low, [-0.35, *(-0.2 - turned)], atol=1e-6)
    target = flat.keypoint[8] - 0.2 * out_of_palm(flat)
    found = flat.fingers.follow(index, target, 0.0, np.zeros(BENDS)).reshape(5, 4)
    np.testing.assert_allclose(found[index, 1:], -0.2, atol=1e-6)
    # Joints of a fist that have gone as far as they can stay there; no bend may not be zero.
    low, high = flat.fingers.limits(1.0)
    assert (low <= 0.0).all()
    assert (high >= 0.0).all()
    found = flat.fingers.follow(index, np.array([9.0, 9.0, 9.0]), 0.0, np.full(BENDS, 5.0))
    np.testing.assert_array_equal(np.delete(found, np.r_[4:8]), 5.0)
    assert (found[4:8] <= flat.fingers.limits(0.0)[1][4:8]).all()


def test_arrays_that_do_not_fit_are_named(hand: Hand) -> None:
    tensors = hand.fingers.to_tensors()
    again = Fingers.from_tensors(tensors)
    bend = some_bend(hand, 9)
    np.testing.assert_array_equal(again.tips(CURL, bend), hand.fingers.tips(CURL, bend))
    with pytest.raises(ValueError, match="low of fingers has shape"):
        Fingers.from_tensors({**tensors, "low": np.zeros(3)})
    tensors.pop("axis")
    with pytest.raises(ValueError, match="Fingers need the arrays axis"):
        Fingers.from_tensors(tensors)
