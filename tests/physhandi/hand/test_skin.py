"""The skeleton of a hand, evaluated bone by bone in NumPy against the hand model itself."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from physhandi.hand.loading import load_hand_model
from physhandi.hand.motion import HandMotion
from physhandi.hand.names import JOINT_NAMES, HandKind, HandSide
from physhandi.hand.skin import HandSkin, hand_skin


def _motion(side: HandSide, kind: HandKind) -> HandMotion:
    random = np.random.default_rng(5)
    time = np.linspace(0, 1, 7)[:, None, None]
    turn = np.linspace(0, 7, 7)[:, None] * np.array([0.2, 0.9, -0.4])
    return HandMotion(
        side=side,
        shape=random.normal(size=10),
        articulation=time * random.normal(size=(1, 15, 3)) * [1.0, 0.3, 0.3],
        wrist_rotation=Rotation.from_rotvec(turn).as_rotvec(),
        wrist_translation=random.normal(size=(7, 3)),
        scale=3.0,
        model=kind,
    )


def _vertices(skin: HandSkin, frame: int) -> np.ndarray:
    world: list[np.ndarray] = []
    for bone, parent in enumerate(skin.parent):
        local = np.eye(4)
        local[:3, :3] = Rotation.from_quat(skin.rotation[frame, bone]).as_matrix()
        local[:3, 3] = skin.translation[frame, bone]
        world.append(local if parent < 0 else world[parent] @ local)
    moved = np.array(world) @ skin.T_bone_hand
    point = np.c_[skin.vertex, np.ones(len(skin.vertex))]
    held = np.einsum("vkab,vb->vka", moved[skin.vertex_bone], point)
    return (skin.vertex_weight[..., None] * held).sum(1)[:, :3]


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_open_hands_skin_is_exact(side: HandSide) -> None:
    hand, motion = load_hand_model(side), _motion(side, "open")
    skin, expected = hand_skin(hand, motion), motion.vertices(hand)
    for frame in (0, 3, 6):
        np.testing.assert_allclose(_vertices(skin, frame), expected[frame], atol=3e-6)
    assert np.abs(expected[6] - expected[0] - (expected[6] - expected[0]).mean(0)).max() > 0.1
    assert skin.names == ("wrist", *JOINT_NAMES)
    assert [skin.names[parent] for parent in skin.parent[[2, 4, 15]]] == [
        "thumb_cmc",
        "wrist",
        "pinky_pip",
    ]


def test_manos_skin_lacks_only_the_bulges_of_bent_joints(mano: Path) -> None:
    hand, motion = load_hand_model("right", "mano"), _motion("right", "mano")
    skin = hand_skin(hand, motion)
    np.testing.assert_allclose(_vertices(skin, 0), motion.vertices(hand)[0], atol=3e-6)
    bent = np.abs(_vertices(skin, 6) - motion.vertices(hand)[6]).max() / motion.scale
    assert 1e-4 < bent < 0.02


def test_rotations_do_not_jump() -> None:
    motion = _motion("right", "open")
    rotation = hand_skin(load_hand_model("right"), motion).rotation
    assert np.einsum("fbq,fbq->fb", rotation[1:], rotation[:-1]).min() > 0
    # The wrist turns by more than 180 degrees, where the usual choice of sign jumps.
    usual = Rotation.from_rotvec(motion.wrist_rotation).as_quat()
    assert (usual[1:] * usual[:-1]).sum(1).min() < 0


def test_a_skin_needs_its_own_model(mano: Path) -> None:
    motion = _motion("right", "open")
    with pytest.raises(ValueError, match="'open' was given the right hand 'mano'"):
        hand_skin(load_hand_model("right", "mano"), motion)
    with pytest.raises(ValueError, match="given the left hand"):
        hand_skin(load_hand_model("left"), replace(motion, scale=1.0))
