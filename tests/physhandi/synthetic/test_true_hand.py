import hashlib
from collections import Counter

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from physhandi.data.sequence_meta import Side
from physhandi.hand.loading import load_hand_model
from physhandi.synthetic.hands.true_hand import (
    ASSET,
    BONE_COUNT,
    FINGERTIPS,
    TrueHand,
    TrueHandPose,
    load_true_hand,
    soft_tissue_offset,
)
from physhandi.triangles import vertex_normals


def pose(**changed: np.ndarray) -> TrueHandPose:
    rest = {"orientation": np.zeros(3), "position": np.zeros(3), "bend": np.zeros((BONE_COUNT, 3))}
    return TrueHandPose(**(rest | changed))


def bend(**bones: tuple[float, float, float]) -> np.ndarray:
    """Bend by bone name, as ``index_1=(0.5, 0, 0)``."""
    names = load_true_hand("right").bone_names
    turned = np.zeros((BONE_COUNT, 3))
    for name, value in bones.items():
        turned[names.index(name.replace("_", "-"))] = value
    return turned


def random_pose(seed: int) -> TrueHandPose:
    random = np.random.default_rng(seed)
    turned = random.uniform(-0.6, 0.6, (BONE_COUNT, 3))
    turned[0] = 0
    return pose(orientation=random.normal(size=3), position=random.normal(size=3), bend=turned)


def test_the_asset_is_the_one_that_is_vouched_for():
    lines = (ASSET.parent / "SHA256SUMS").read_text().splitlines()
    sums = {name: digest for digest, name in (line.split() for line in lines)}
    for path in (ASSET, ASSET.parent / "LICENSE-makehuman.md"):
        assert hashlib.sha256(path.read_bytes()).hexdigest() == sums[path.name]
    assert "CC0 1.0 Universal" in (ASSET.parent / "LICENSE-makehuman.md").read_text()


@pytest.mark.parametrize("side", ["right", "left"])
def test_it_is_a_closed_adult_hand_that_looks_outwards(side: Side):
    hand = load_true_hand(side)
    edges = Counter((a, b) for f in hand.faces for a, b in zip(f, np.roll(f, -1), strict=True))
    assert max(edges.values()) == 1
    assert all((b, a) in edges for a, b in edges)
    a, b, c = hand.rest_vertex[hand.faces].transpose(1, 0, 2)
    volume = np.einsum("fd,fd->", a, np.cross(b, c)) / 6
    assert volume == pytest.approx(238e-6, rel=0.01)
    length = np.linalg.norm(hand.rest_keypoint[12] - hand.rest_keypoint[0])
    assert 0.165 < length < 0.195
    assert np.allclose(hand.weight.sum(axis=1), 1, atol=1e-6)


def test_it_is_another_hand_than_the_one_that_is_fitted():
    assert len(load_true_hand("right").rest_vertex) != load_hand_model("right").vertex_count


def test_in_the_rest_frame_fingers_point_along_x_and_the_thumb_is_to_its_side():
    right, left = load_true_hand("right"), load_true_hand("left")
    assert right.rest_keypoint[0] == pytest.approx(np.zeros(3), abs=1e-9)
    assert right.rest_keypoint[12][0] > 0.15
    assert right.rest_keypoint[4][1] > 0.05
    assert right.rest_keypoint[12][2] < 0  # fingers hang towards the palm
    assert left.rest_keypoint[4][1] < -0.05


def test_the_pose_moves_all_bones_rigidly_with_the_wrist():
    hand, placed = (
        load_true_hand("right"),
        pose(orientation=np.array([0.3, -0.7, 0.2]), position=np.array([1.0, 2.0, 3.0])),
    )
    posed = hand.pose(placed)
    turn = Rotation.from_rotvec(placed.orientation)
    assert posed.vertex == pytest.approx(turn.apply(hand.rest_vertex) + placed.position, abs=1e-6)
    assert posed.keypoint[0] == pytest.approx(placed.position)


def test_a_bend_turns_what_is_beyond_the_joint_and_nothing_else():
    hand = load_true_hand("right")
    rest, bent = (
        hand.pose(pose()).keypoint,
        hand.pose(pose(bend=bend(index_2=(0.9, 0, 0)))).keypoint,
    )
    moved = np.linalg.norm(bent - rest, axis=1)
    assert np.flatnonzero(moved > 1e-9).tolist() == [7, 8]
    arm = rest[7] - rest[6]
    assert (bent[7] - bent[6]) @ arm / (arm @ arm) == pytest.approx(np.cos(0.9))
    assert bent[7][2] < rest[7][2] - 0.01  # towards the palm


def test_fist_brings_fingertips_to_the_palm():
    hand = load_true_hand("right")
    fingers = ("index", "middle", "ring", "pinky")
    closed = {f"{finger}_{bone}": (1.3, 0.0, 0.0) for finger in fingers for bone in (1, 2)}
    rest, fist = hand.pose(pose()).keypoint, hand.pose(pose(bend=bend(**closed))).keypoint
    for tip, knuckle in zip(FINGERTIPS[1:], (5, 9, 13, 17), strict=True):
        assert fist[tip][0] < rest[knuckle][0] - 0.02
        assert -0.06 < fist[tip][2] < -0.015


def test_spreading_is_towards_the_thumb_and_the_thumb_flexes_towards_the_little_finger():
    hand = load_true_hand("right")
    rest = hand.pose(pose()).keypoint
    spread = hand.pose(pose(bend=bend(ring_1=(0, 0.3, 0)))).keypoint
    assert spread[16][1] > rest[16][1] + 0.01
    thumb = hand.pose(pose(bend=bend(thumb_1=(0.4, 0, 0)))).keypoint
    before, after = (np.linalg.norm(k[4] - rest[17]) for k in (rest, thumb))
    assert after < before - 0.01


def test_the_left_hand_does_the_mirrored_motion():
    right, left = load_true_hand("right", seed=3), load_true_hand("left", seed=3)
    mirror = np.array([1.0, -1.0, 1.0])
    turned = random_pose(1).bend
    a, b = right.pose(pose(bend=turned)), left.pose(pose(bend=turned))
    assert b.vertex == pytest.approx(a.vertex * mirror, abs=1e-9)
    assert b.keypoint == pytest.approx(a.keypoint * mirror, abs=1e-9)


def test_skinning_agrees_with_a_sum_over_bones_vertex_by_vertex():
    hand, placed = load_true_hand("left", seed=5), random_pose(7)
    posed = hand.pose(placed)
    for vertex in (0, 400, 1200):
        place = sum(
            w * (T[:3, :3] @ hand.rest_vertex[vertex] + T[:3, 3])
            for w, T in zip(hand.weight[vertex], posed.bone_transform, strict=True)
        )
        assert posed.vertex[vertex] == pytest.approx(place)
    for matrix in posed.bone_transform[:, :3, :3]:
        assert matrix @ matrix.T == pytest.approx(np.eye(3), abs=1e-9)
        assert np.linalg.det(matrix) == pytest.approx(1)


def distance_to_capsules(hand: TrueHand) -> np.ndarray:
    """How far each resting vertex is outside of the nearest capsule [m]."""
    distance = []
    for capsule in hand.capsules:
        line = capsule.end - capsule.start
        share = np.clip((hand.rest_vertex - capsule.start) @ line / (line @ line), 0, 1)
        foot = capsule.start + share[:, None] * line
        distance.append(np.linalg.norm(hand.rest_vertex - foot, axis=1) - capsule.radius)
    return np.min(distance, axis=0)


def test_capsules_cover_every_bone_and_follow_the_skin_within_millimetres():
    hand = load_true_hand("right", seed=0)
    assert {capsule.bone for capsule in hand.capsules} == set(range(BONE_COUNT))
    assert 16 <= len(hand.capsules) <= 22
    outside = distance_to_capsules(hand)
    fingers = hand.weight[:, 1:].max(axis=1) > 0.9
    assert np.median(np.abs(outside[fingers])) < 0.0015
    assert np.quantile(np.abs(outside[fingers]), 0.95) < 0.006
    assert np.quantile(outside, 0.95) < 0.012
    tips = [max(c.end[0] + c.radius for c in hand.capsules if c.bone == bone) for bone in (6, 9)]
    skin = [hand.rest_vertex[hand.weight[:, bone] > 0.9][:, 0].max() for bone in (6, 9)]
    assert tips == pytest.approx(skin, abs=0.002)


def test_soft_tissue_thickens_by_one_to_two_millimetres_and_smoothly():
    hand = load_true_hand("right")
    offset = soft_tissue_offset(hand, 4)
    outwards = np.einsum("vd,vd->v", offset, vertex_normals(hand.rest_vertex, hand.faces))
    assert outwards.min() >= 0.001 - 1e-9
    assert outwards.max() <= 0.002 + 1e-9
    assert np.ptp(outwards) > 0.0005
    edge = hand.faces[:, :2]
    length = np.linalg.norm(np.diff(hand.rest_vertex[edge], axis=1)[:, 0], axis=1)
    slope = np.abs(outwards[edge[:, 0]] - outwards[edge[:, 1]]) / length
    assert slope.max() < 0.3
    assert not np.allclose(offset, soft_tissue_offset(hand, 5))
    thick = load_true_hand("right", seed=4)
    assert thick.rest_vertex == pytest.approx(hand.rest_vertex + offset)
    assert thick.capsules[5].radius > hand.capsules[5].radius + 0.0008


def test_a_bend_of_the_wrist_bone_is_refused():
    turned = np.zeros((BONE_COUNT, 3))
    turned[0, 1] = 0.1
    with pytest.raises(ValueError, match="bone 0 stays zero"):
        load_true_hand("right").pose(pose(bend=turned))
