"""MANO against an independent forward pass in double precision, and the open hand it is made of."""

from pathlib import Path

import numpy as np
import pytest
import torch
from support.inputs.mano_file import JOINTS, TO_MANO, mano_arrays, posed_mano

from physhandi.errors import MissingInputError
from physhandi.hand.loading import load_hand_model
from physhandi.hand.mano import FINGERTIP_VERTEX, ManoHand, hands_folder
from physhandi.hand.names import JOINT_NAMES, KEYPOINT_NAMES

MANO_NAMES = [
    f"{finger}_{joint}"
    for finger in ("index", "middle", "pinky", "ring", "thumb")
    for joint in (("cmc", "mcp", "ip") if finger == "thumb" else ("mcp", "pip", "dip"))
]


@pytest.mark.parametrize("side", ["right", "left"])
def test_forward_pass_is_manos(mano: Path, side: str) -> None:
    arrays, hand = mano_arrays(side), ManoHand.load(side)
    random = np.random.default_rng(0)
    shape = random.normal(size=10)
    articulation = 0.5 * random.normal(size=(3, 15, 3))
    turn, shift = random.normal(size=(2, 3, 3))
    given = [torch.from_numpy(a) for a in (shape, articulation, turn, shift)]
    pose = hand(*given)
    own = hand.mano_pose(articulation)
    np.testing.assert_allclose(hand.articulation(own), articulation, atol=1e-12)
    still = arrays["J_regressor"].toarray()[0] @ (
        arrays["v_template"] + arrays["shapedirs"] @ shape
    )
    np.testing.assert_allclose(still, hand.wrist + hand._joint_change[0] @ shape, atol=1e-12)
    for frame in range(3):
        vertex, joint = posed_mano(arrays, shape, own[frame], turn[frame], shift[frame] - still)
        assert np.abs(vertex - (arrays["v_template"] + shift[frame] - still)).max() > 0.05
        np.testing.assert_allclose(pose.vertex[frame], vertex, atol=1e-12)
        named = dict(zip(["wrist", *MANO_NAMES], joint, strict=True))
        tips = dict(
            zip(
                ("thumb", "index", "middle", "ring", "pinky"),
                vertex[[744, 320, 443, 554, 671]],
                strict=True,
            )
        )
        expected = [
            tips[name.removesuffix("_tip")] if name.endswith("_tip") else named[name]
            for name in KEYPOINT_NAMES
        ]
        np.testing.assert_allclose(pose.keypoint[frame], expected, atol=1e-12)


def test_pose_blend_shapes_matter(mano: Path) -> None:
    arrays, hand = mano_arrays("right"), ManoHand.load("right")
    pose = np.zeros(45)
    pose[3:6] = (0.2, -0.4, 0.7)
    with_bulge = posed_mano(arrays, np.zeros(10), pose, np.zeros(3), -hand.wrist)[0]
    without = {**arrays, "posedirs": np.zeros((778, 3, 135))}
    without = posed_mano(without, np.zeros(10), pose, np.zeros(3), -hand.wrist)[0]
    assert np.abs(with_bulge - without).max() > 5e-4


def test_only_the_named_joint_turns(mano: Path) -> None:
    hand = ManoHand.load("right")
    for number, name in enumerate(MANO_NAMES):
        own = np.zeros((1, 45))
        own[0, 3 * number + 1] = 0.3
        turned = np.abs(hand.articulation(own)[0]).max(axis=1) > 0.01
        assert [JOINT_NAMES[joint] for joint in np.flatnonzero(turned)] == [name]


def test_made_of_the_open_hand_it_poses_like_the_open_hand(mano: Path) -> None:
    hand, open_hand = ManoHand.load("right"), load_hand_model("right")
    kept = np.linalg.norm(
        hand.template[:, None] - (open_hand.template @ TO_MANO.T)[None], axis=-1
    ).argmin(axis=1)
    np.testing.assert_allclose(hand.template, open_hand.template[kept] @ TO_MANO.T, atol=1e-12)
    np.testing.assert_allclose(hand.joint_axes, TO_MANO @ open_hand.joint_axes, atol=1e-7)
    random = torch.Generator().manual_seed(3)
    articulation = 0.4 * torch.randn(1, 15, 3, generator=random, dtype=torch.float64)
    zero = torch.zeros(10, dtype=torch.float64), torch.zeros(1, 3, dtype=torch.float64)
    ours = hand(zero[0], articulation, zero[1], zero[1]).vertex[0].numpy()
    expected = open_hand(zero[0], articulation, zero[1], zero[1]).vertex[0].numpy()[kept]
    moved = np.abs(expected - open_hand.template[kept]).max()
    # The pose blend shapes of the made-up file are the rest.
    assert np.abs(ours - expected @ TO_MANO.T).max() < 0.006
    assert moved > 0.05
    index = torch.tensor([[5, 0, 777, 5]])
    chosen = hand.chosen_vertices(index, zero[0] + 0.7, articulation)[0].numpy()
    whole = hand(zero[0] + 0.7, articulation, zero[1], zero[1]).vertex[0].numpy()
    np.testing.assert_allclose(chosen, whole[index[0]], atol=1e-12)
    assert JOINTS[1] == 1 + JOINT_NAMES.index("index_mcp")


def test_zero_is_flat_and_the_mean_pose_is_told(mano: Path) -> None:
    hand = ManoHand.load("right")
    mean = mano_arrays("right")["hands_mean"]
    np.testing.assert_allclose(hand.mano_pose(hand.mean_articulation[None])[0], mean, atol=1e-12)
    tip = hand.template[list(FINGERTIP_VERTEX)]
    np.testing.assert_allclose(hand.keypoint_position[4::4], tip, atol=1e-15)


def test_missing_and_damaged_models_say_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PHYSHANDI_HANDS", str(tmp_path))
    assert hands_folder() == tmp_path
    with pytest.raises(MissingInputError, match=r"left hand's MANO .*import mano MANO_LEFT\.pkl"):
        load_hand_model("left", "mano")
    (tmp_path / "mano_left.npz").write_bytes(b"PK nothing")
    with pytest.raises(MissingInputError, match=r"mano_left\.npz is damaged"):
        load_hand_model("left", "mano")
    np.savez(tmp_path / "mano_right.npz", v_template=np.zeros((778, 3)))
    with pytest.raises(MissingInputError, match="shapedirs"):
        load_hand_model("right", "mano")
    monkeypatch.delenv("PHYSHANDI_HANDS")
    assert hands_folder() == Path.home() / ".local/share/physhandi/hands"
