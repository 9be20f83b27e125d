"""The open hand against closed forms, its own file and finite differences."""

import hashlib
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from physhandi.hand.gltf import read_skinned_mesh
from physhandi.hand.model import JOINT_NAMES, KEYPOINT_NAMES, HandPose, load_hand_model
from physhandi.hand.open_hand import ASSETS, SHAPE_NAMES, SHAPE_RATE, OpenHand

WRIST = 0


def _pose(hand: OpenHand, **changes: Tensor) -> HandPose:
    inputs = {
        "shape": torch.zeros(10, dtype=torch.float64),
        "articulation": torch.zeros(1, 15, 3, dtype=torch.float64),
        "wrist_rotation": torch.zeros(1, 3, dtype=torch.float64),
        "wrist_translation": torch.zeros(1, 3, dtype=torch.float64),
    }
    return hand(**{**inputs, **changes})


def _shape(name: str, value: float) -> Tensor:
    shape = torch.zeros(10, dtype=torch.float64)
    shape[SHAPE_NAMES.index(name)] = value
    return shape


def _rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


@pytest.fixture(params=["right", "left"])
def hand(request: pytest.FixtureRequest) -> OpenHand:
    return OpenHand.load(request.param)


def test_vendored_files_are_the_published_ones() -> None:
    lines = (ASSETS / "SHA256SUMS").read_text().splitlines()
    assert len(lines) == len([path for path in ASSETS.iterdir() if path.name != "SHA256SUMS"])
    for line in lines:
        digest, name = line.split("  ")
        assert hashlib.sha256((ASSETS / name).read_bytes()).hexdigest() == digest, name


def test_identity_pose_is_the_template_exactly(hand: OpenHand) -> None:
    pose = _pose(hand)
    assert np.array_equal(pose.vertex[0].numpy(), hand.template)
    assert np.array_equal(pose.keypoint[0].numpy(), hand.keypoint_position)
    assert np.abs(hand.template).max() == pytest.approx(0.1897, abs=1e-3)


@pytest.mark.parametrize("side", ["right", "left"])
def test_template_is_the_file_moved_to_the_wrist(side: str) -> None:
    mesh = read_skinned_mesh(ASSETS / f"{side}.glb")
    template = OpenHand.load(side).template
    ours = np.sort(np.round(template - template.mean(0), 5), axis=0)
    file = np.sort(np.round(mesh.vertex - mesh.vertex.mean(0), 5), axis=0)
    assert len(template) == 1159
    np.testing.assert_allclose(ours, file, atol=1.1e-5)


def test_surface_is_watertight_and_faces_point_outwards(hand: OpenHand) -> None:
    import trimesh

    pose = _pose(hand, articulation=torch.full((1, 15, 3), -0.1, dtype=torch.float64))
    for vertex in (hand.template, pose.vertex[0].numpy()):
        mesh = trimesh.Trimesh(vertex, hand.faces, process=False)
        assert mesh.is_watertight
        assert len(mesh.vertices) == 1159
        assert mesh.volume == pytest.approx(343e-6, rel=0.06)


def test_weights_are_shares_and_joints_are_named(hand: OpenHand) -> None:
    np.testing.assert_allclose(hand.weight.sum(1), 1, atol=1e-12)
    assert hand.weight.min() >= -1e-12
    assert (len(JOINT_NAMES), len(KEYPOINT_NAMES)) == (15, 21)
    assert (hand.shape_count, hand.joint_count, hand.vertex_count) == (10, 15, 1159)


def test_one_joint_turns_what_hangs_on_it_by_rodrigues_formula(hand: OpenHand) -> None:
    joint, angle = JOINT_NAMES.index("index_pip"), -0.7
    articulation = torch.zeros(1, 15, 3, dtype=torch.float64)
    articulation[0, joint, 0] = angle
    pose = _pose(hand, articulation=articulation)
    axis = hand.joint_axes[joint][:, 0]
    centre = hand.joint_position[joint]
    expected = centre + (hand.template - centre) @ _rotation(axis, angle).T
    rigid = hand.weight[:, joint + 1 : joint + 3].sum(1) > 1 - 1e-9
    still = hand.weight[:, joint + 1 : joint + 3].sum(1) < 1e-9
    assert rigid.sum() > 40
    np.testing.assert_allclose(pose.vertex[0].numpy()[rigid], expected[rigid], atol=1e-12)
    np.testing.assert_allclose(pose.vertex[0].numpy()[still], hand.template[still], atol=1e-15)
    assert np.abs(expected[rigid] - hand.template[rigid]).max() > 0.02


def test_negative_curl_closes_the_fist(hand: OpenHand) -> None:
    articulation = torch.zeros(1, 15, 3, dtype=torch.float64)
    articulation[0, 3:, 0] = -1.2
    before, after = _pose(hand).keypoint[0], _pose(hand, articulation=articulation).keypoint[0]
    for tip in (8, 12, 16, 20):
        reach = [torch.linalg.norm(k[tip] - k[WRIST]).item() for k in (before, after)]
        assert reach[1] < 0.65 * reach[0]
    palm_side = -1 if hand.side == "right" else 1
    assert np.sign((after - before)[12, 0].item()) == palm_side


def test_wrist_turns_and_scale_multiplies_everything(hand: OpenHand) -> None:
    rotation, translation = np.array([0.3, -0.5, 0.9]), np.array([1.0, 2.0, 3.0])
    pose = hand(
        torch.zeros(10, dtype=torch.float64),
        torch.zeros(1, 15, 3, dtype=torch.float64),
        torch.from_numpy(rotation)[None],
        torch.from_numpy(translation)[None],
        2.0,
    )
    turned = hand.template @ _rotation(rotation, float(np.linalg.norm(rotation))).T
    expected = 2 * (turned + translation)
    np.testing.assert_allclose(pose.vertex[0].numpy(), expected, atol=1e-12)
    wrist = hand.keypoint_position[0] @ _rotation(rotation, float(np.linalg.norm(rotation))).T
    np.testing.assert_allclose(pose.keypoint[0, 0].numpy(), 2 * (wrist + translation), atol=1e-12)


_FINGERS = ("thumb_length", "index_length", "middle_length", "ring_length", "pinky_length")


# The thumb is set on the palm, so a longer or wider palm carries its root outwards.
_RIDES_ALONG = {("palm_length", "thumb_set"), ("palm_width", "thumb_set")}


def _measure(hand: OpenHand, name: str, shape: Tensor) -> float:
    bone, vertex = hand.bone_origins(shape).numpy(), _pose(hand, shape=shape).vertex[0].numpy()
    thumb, index, middle, pinky = 1, 4, 7, 13
    if name == "size":
        return float(np.linalg.norm(vertex[0] - vertex[500]))
    if name == "palm_length":
        return float(np.linalg.norm(bone[middle]))
    if name == "palm_width":
        return float((bone[index] - bone[pinky]) @ hand.palm_axes[:, 0])
    if name == "thumb_set":
        return float(np.linalg.norm(bone[thumb]))
    if name == "finger_thickness":
        joint = JOINT_NAMES.index("middle_dip")
        rigid = vertex[hand.weight[:, joint + 1] > 1 - 1e-9]
        return float(np.ptp((rigid - bone[joint + 1]) @ hand.joint_axes[joint][:, 0]))
    first = 1 + 3 * _FINGERS.index(name)
    return float(np.linalg.norm(np.diff(bone[first : first + 3], axis=0), axis=1).sum())


@pytest.mark.parametrize("name", SHAPE_NAMES)
@pytest.mark.parametrize("value", [-2.0, 1.5])
def test_shape_coefficient_scales_what_its_name_says(
    hand: OpenHand, name: str, value: float
) -> None:
    ratio = np.exp(SHAPE_RATE[SHAPE_NAMES.index(name)] * value)
    assert abs(ratio - 1) > 0.07
    before, after = _shape(name, 0), _shape(name, value)
    measured = _measure(hand, name, after) / _measure(hand, name, before)
    assert measured == pytest.approx(ratio, rel=1e-9)
    for other in set(SHAPE_NAMES[1:]) - {name}:
        if name != "size":
            kept = _measure(hand, other, after) / _measure(hand, other, before)
            assert kept == pytest.approx(1, abs=0.07 if (name, other) in _RIDES_ALONG else 1e-9), (
                other
            )


@pytest.mark.parametrize("sign", [-3.0, 3.0])
@pytest.mark.parametrize("name", SHAPE_NAMES)
def test_extreme_shapes_stay_closed_bodies(name: str, sign: float) -> None:
    import trimesh

    hand = OpenHand.load("right")
    vertex = _pose(hand, shape=_shape(name, sign)).vertex[0].numpy()
    assert trimesh.Trimesh(vertex, hand.faces, process=False).volume == pytest.approx(
        343e-6, rel=0.6
    )


def test_a_joints_keypoint_stays_when_the_joint_turns_but_a_tips_does_not() -> None:
    hand = OpenHand.load("right")
    articulation = torch.zeros(1, 15, 3, dtype=torch.float64)
    articulation[0, JOINT_NAMES.index("ring_dip"), 0] = -0.8
    moved = (_pose(hand, articulation=articulation).keypoint - _pose(hand).keypoint).norm(dim=-1)[0]
    assert moved[:16].max() == 0
    assert moved[16] > 0.008
    assert moved[17:].max() == 0


def test_left_hand_is_the_mirrored_right_hand() -> None:
    random = torch.Generator().manual_seed(0)
    right, left = OpenHand.load("right"), OpenHand.load("left")
    shape = torch.randn(10, generator=random, dtype=torch.float64)
    articulation = 0.4 * torch.randn(3, 15, 3, generator=random, dtype=torch.float64)
    rotation = torch.randn(3, 3, generator=random, dtype=torch.float64)
    translation = torch.randn(3, 3, generator=random, dtype=torch.float64)
    mirror, turn = torch.tensor([-1.0, 1, 1]).double(), torch.tensor([1.0, -1, -1]).double()
    ours = right(shape, articulation, rotation, translation)
    mirrored = left(shape, articulation * turn, rotation * turn, translation * mirror)
    np.testing.assert_allclose(mirrored.vertex, ours.vertex * mirror, atol=1e-12)
    np.testing.assert_allclose(mirrored.keypoint, ours.keypoint * mirror, atol=1e-12)
    only_keypoints = right.keypoints(shape, articulation, rotation, translation)
    assert torch.equal(only_keypoints, ours.keypoint)


def test_gradient_is_that_of_finite_differences() -> None:
    hand = OpenHand.load("right")
    random = torch.Generator().manual_seed(1)

    def draw(*size: int) -> Tensor:
        return 0.3 * torch.randn(size, generator=random, dtype=torch.float64)

    inputs = [draw(10), draw(2, 15, 3), draw(2, 3), draw(2, 3), torch.tensor(1.3).double()]
    inputs[1][0, 4] = 0.0
    vertex_weight, keypoint_weight = draw(2, 1159, 3), draw(2, 21, 3)

    def loss(*values: Tensor) -> Tensor:
        pose = hand(*values)
        return (pose.vertex * vertex_weight).sum() + (pose.keypoint * keypoint_weight).sum()

    for value in inputs:
        value.requires_grad_()
    loss(*inputs).backward()
    for position, value in enumerate(inputs):
        gradient = value.grad
        assert gradient is not None
        direction = draw(*value.shape)
        step = 1e-6
        with torch.no_grad():
            shifted = [
                loss(
                    *(
                        v + sign * step * direction if i == position else v
                        for i, v in enumerate(inputs)
                    )
                )
                for sign in (1, -1)
            ]
        expected = ((shifted[0] - shifted[1]) / (2 * step)).item()
        assert abs(expected) > 1e-4
        assert (gradient * direction).sum().item() == pytest.approx(expected, rel=1e-6)


def test_model_is_loaded_once_and_knows_its_side() -> None:
    assert load_hand_model("right") is load_hand_model("right")
    assert load_hand_model("left").side == "left"


def test_a_file_that_is_no_mesh_is_refused(tmp_path: Path) -> None:
    (tmp_path / "hand.glb").write_bytes(b"<html>no mesh</html>")
    with pytest.raises(ValueError, match=r"hand\.glb is not a binary glTF"):
        read_skinned_mesh(tmp_path / "hand.glb")
    (tmp_path / "short.glb").write_bytes((ASSETS / "right.glb").read_bytes()[:12])
    with pytest.raises(ValueError, match=r"short\.glb lacks"):
        read_skinned_mesh(tmp_path / "short.glb")
