"""The open hand against closed forms, its own file and finite differences."""

import hashlib
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from physhandi.hand.model import HandPose
from physhandi.hand.names import JOINT_NAMES
from physhandi.hand.open_hand import ASSETS, SHAPE_NAMES, SHAPE_RATE, OpenHand, read_skinned_mesh


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


def test_template_is_as_large_as_a_hand(hand: OpenHand) -> None:
    assert np.abs(hand.template).max() == pytest.approx(0.1897, abs=1e-3)


def test_chosen_vertices_are_those_of_the_whole_surface(hand: OpenHand) -> None:
    random = torch.Generator().manual_seed(1)
    shape = torch.randn(10, generator=random, dtype=torch.float64)
    articulation = 0.4 * torch.randn(3, 15, 3, generator=random, dtype=torch.float64)
    index = torch.randint(0, hand.vertex_count, (3, 7), generator=random)
    still = torch.zeros(3, 3, dtype=torch.float64)
    whole = hand(shape, articulation, still, still).vertex
    expected = torch.stack([surface[chosen] for surface, chosen in zip(whole, index, strict=True)])
    found = hand.chosen_vertices(index, shape, articulation)
    np.testing.assert_allclose(found, expected, atol=1e-12, rtol=0)


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


_FINGERS = ("thumb_length", "index_length", "middle_length", "ring_length", "pinky_length")


# The thumb is set on the palm, so a longer or wider palm carries its root outwards.
_RIDES_ALONG = {("palm_length", "thumb_set"), ("palm_width", "thumb_set")}


def _measure(hand: OpenHand, name: str, shape: Tensor) -> float:
    bone = hand.bone_origins(shape).numpy()
    thumb, index, middle, pinky = 1, 4, 7, 13
    if name == "size":
        vertex = _pose(hand, shape=shape).vertex[0].numpy()
        return float(np.linalg.norm(vertex[0] - vertex[500]))
    if name == "palm_length":
        return float(np.linalg.norm(bone[middle]))
    if name == "palm_width":
        return float((bone[index] - bone[pinky]) @ hand.palm_axes[:, 0])
    if name == "thumb_set":
        return float(np.linalg.norm(bone[thumb]))
    if name == "finger_thickness":
        joint = JOINT_NAMES.index("middle_dip")
        vertex = _pose(hand, shape=shape).vertex[0].numpy()
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


def test_a_file_that_is_no_mesh_is_refused(tmp_path: Path) -> None:
    (tmp_path / "hand.glb").write_bytes(b"<html>no mesh</html>")
    with pytest.raises(ValueError, match=r"hand\.glb is not a binary glTF"):
        read_skinned_mesh(tmp_path / "hand.glb")
    (tmp_path / "short.glb").write_bytes((ASSETS / "right.glb").read_bytes()[:12])
    with pytest.raises(ValueError, match=r"short\.glb lacks"):
        read_skinned_mesh(tmp_path / "short.glb")
