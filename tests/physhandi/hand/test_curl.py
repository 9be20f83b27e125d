"""Fingers that close and open: against the hand model, anatomy and joint angles."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.physics.hand_scene import flat_and_bent

from physhandi.hand.curl import BONE_OF_KEYPOINT, blended, curl_motion, curled_rotations
from physhandi.hand.loading import load_hand_model
from physhandi.hand.skin import hand_skin

AMOUNTS = np.array([-0.5, 0.0, 0.4, 1.0])
TIPS, KNUCKLES = [8, 12, 16, 20], [5, 9, 13, 17]


@pytest.fixture(scope="module", params=["right", "left"])
def hand(request) -> tuple:
    model = load_hand_model(request.param)
    motion = flat_and_bent(request.param)
    return model, motion, hand_skin(model, motion).to_tensors()


def test_the_hand_model_bends_in_the_same_way(hand) -> None:
    model, motion, skin = hand
    moved = curl_motion(skin, motion.side, 1, AMOUNTS)
    rotation = Rotation.from_quat(
        curled_rotations(skin, motion.side, 1, AMOUNTS)[:, 1:].reshape(-1, 4)
    )
    turned = rotation.as_rotvec().reshape(len(AMOUNTS), 15, 3)
    as_articulated = replace(
        motion,
        articulation=np.einsum("jca,sjc->sja", model.joint_axes, turned),
        wrist_rotation=np.repeat(motion.wrist_rotation[1:], len(AMOUNTS), axis=0),
        wrist_translation=np.repeat(motion.wrist_translation[1:], len(AMOUNTS), axis=0),
    )
    vertex = motion.vertices(model)[1]
    found = blended(moved, skin["vertex_bone"], skin["vertex_weight"], vertex)
    expected = as_articulated.vertices(model)
    # Blended from where the vertices are, not from the rest pose; joints are exact.
    assert np.linalg.norm(found - expected, axis=2).mean() < 5e-4
    keypoint = motion.keypoints(model)[1]
    one = np.ones((21, 1))
    found = blended(moved, np.array(BONE_OF_KEYPOINT)[:, None], one, keypoint)
    np.testing.assert_allclose(found, as_articulated.keypoints(model), atol=1e-5)
    assert np.linalg.norm(found[3] - found[1], axis=1)[TIPS].min() > 0.03
    np.testing.assert_allclose(moved[1], np.broadcast_to(np.eye(4), (16, 4, 4)), atol=1e-9)


def test_closing_brings_fingertips_to_the_palm_and_opening_away_from_it(hand) -> None:
    model, motion, skin = hand
    keypoint = motion.keypoints(model)[1].astype(float)
    moved = curl_motion(skin, motion.side, 1, AMOUNTS)
    place = blended(moved, np.array(BONE_OF_KEYPOINT)[:, None], np.ones((21, 1)), keypoint)
    palm = keypoint[[0, 5, 17]].mean(axis=0)
    away = np.linalg.norm(place[:, TIPS] - palm, axis=2)
    assert (np.diff(away, axis=0) < 0).all()
    # The tips go to the side of the palm on which they are bent already.
    normal = np.cross(keypoint[5] - keypoint[0], keypoint[17] - keypoint[0])
    height = (place[:, TIPS] - keypoint[KNUCKLES]) @ normal
    assert (np.sign(height[2]) == np.sign(height[1])).all()
    still = [0, *KNUCKLES]
    np.testing.assert_allclose(place[:, still], place[:1, still].repeat(4, 0), rtol=1e-9)
    # The thumb goes towards the other fingers.
    to_middle = np.linalg.norm(place[:, 4] - keypoint[9], axis=1)
    assert to_middle[3] < to_middle[2] < to_middle[1] - 0.002


def test_joints_turn_as_far_as_they_are_told_and_can(hand) -> None:
    _, motion, skin = hand
    still, little, fist, farther = (
        Rotation.from_quat(its[1:])
        for its in curled_rotations(skin, motion.side, 0, np.array([0.0, 0.3, 1.0, 5.0]))
    )
    angle = (still.inv() * little).magnitude().reshape(5, 3)
    np.testing.assert_allclose(angle[0], 0.3 * np.array([0.2, 0.4, 0.5]))
    np.testing.assert_allclose(angle[1:], np.tile(0.3 * np.array([0.9, 1.2, 0.8]), (4, 1)))
    angle = (still.inv() * fist).magnitude().reshape(5, 3)
    np.testing.assert_allclose(angle[2], [0.9, 1.2, 0.8])
    angle = (still.inv() * farther).magnitude().reshape(5, 3)
    np.testing.assert_allclose(angle[2], [1.5, 1.8, 1.3])
