"""Rigid motions against SciPy's rotations, and points carried by them."""

import numpy as np
import pytest
from scipy.spatial import procrustes
from scipy.spatial.transform import Rotation

from physhandi.metrics.alignment import carried_points, rigid_transform, similarity_aligned


def test_rigid_transform_recovers_a_motion() -> None:
    rng = np.random.default_rng(2)
    source = rng.normal(size=(20, 3))
    rotation = Rotation.from_rotvec([0.4, -1.2, 2.0]).as_matrix()
    target = source @ rotation.T + [1.0, 2.0, 3.0]
    found, translation = rigid_transform(source, target)
    assert found == pytest.approx(rotation)
    assert translation == pytest.approx([1, 2, 3])


def test_rigid_transform_never_mirrors() -> None:
    rng = np.random.default_rng(2)
    source = rng.normal(size=(20, 3))
    found, _ = rigid_transform(source, source * [1.0, 1.0, -1.0])
    expected, _ = Rotation.align_vectors(
        (source - source.mean(0)) * [1, 1, -1], source - source.mean(0)
    )
    assert np.linalg.det(found) == pytest.approx(1.0)
    assert found == pytest.approx(expected.as_matrix())


@pytest.mark.parametrize(
    ("direction", "expected"),
    [
        ([0.0, 1.0, 0.0], [[0, -1, 0], [1, 0, 0], [0, 0, 1]]),
        ([1.0, 0.0, 0.0], np.eye(3)),
    ],
)
def test_points_on_a_line_turn_as_little_as_possible(
    direction: list[float], expected: object
) -> None:
    step = np.linspace(-1, 2, 4)[:, None]
    found, _ = rigid_transform(step * [1.0, 0, 0], step * np.array(direction) + [5.0, 0, 0])
    assert found == pytest.approx(np.array(expected))


def test_a_reversed_line_turns_by_half_a_turn() -> None:
    step = np.linspace(-1, 2, 4)[:, None]
    found, _ = rigid_transform(step * [0.0, 0, 1], step * [0.0, 0, -1])
    assert np.linalg.det(found) == pytest.approx(1.0)
    assert found @ [0, 0, 1] == pytest.approx([0, 0, -1])


def test_one_point_only_moves() -> None:
    found, translation = rigid_transform(np.array([[1.0, 0, 0]]), np.array([[1.0, 2.0, 0]]))
    assert found == pytest.approx(np.eye(3))
    assert translation == pytest.approx([0, 2, 0])


def test_similarity_alignment_agrees_with_scipys_procrustes() -> None:
    rng = np.random.default_rng(6)
    target = rng.normal(size=(2, 21, 3))
    turned = target @ Rotation.from_rotvec([1.0, 0.3, -0.2]).as_matrix().T
    source = 0.4 * turned + [3.0, 0, 1] + rng.normal(scale=0.02, size=target.shape)
    aligned = similarity_aligned(source, target)
    for frame in range(2):
        _, _, disparity = procrustes(target[frame], source[frame])  # of the target at unit size
        size = ((target[frame] - target[frame].mean(0)) ** 2).sum()
        assert ((aligned[frame] - target[frame]) ** 2).sum() == pytest.approx(disparity * size)
        assert disparity > 1e-4


def test_carried_points_follow_a_rigid_motion_exactly() -> None:
    rng = np.random.default_rng(9)
    node = rng.normal(size=(40, 3)) * [0.1, 0.1, 0.0]  # A flat sheet.
    point = rng.normal(size=(5, 3)) * 0.05
    turns = [Rotation.from_rotvec([0.0, angle, 0.3 * angle]) for angle in (0.0, 0.8, 3.0)]
    shift = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.2, -0.1, 0.3]])
    rollout = np.stack([turn.apply(node) + s for turn, s in zip(turns, shift, strict=True)])
    expected = np.stack([turn.apply(point) + s for turn, s in zip(turns, shift, strict=True)])
    assert carried_points(point, rollout) == pytest.approx(expected)
    assert np.abs(expected[2] - expected[0]).max() > 0.2


def test_each_point_is_carried_by_its_own_surroundings() -> None:
    node = np.concatenate([np.eye(3) * 0.01, np.eye(3) * 0.01 + 1.0])
    rollout = np.stack([node, node + np.repeat([[0, 0, 0.5], [0.25, 0, 0]], 3, axis=0)])
    # Eight carriers are wanted and six there are, so a reach is needed to tell them apart.
    moved = carried_points(node[[0, 4]], rollout, reach=0.1)
    assert moved[1] - moved[0] == pytest.approx(np.array([[0, 0, 0.5], [0.25, 0, 0]]))


def test_what_is_not_seen_carries_nothing() -> None:
    carrier = np.zeros((3, 4, 3))
    carrier[:, :, 0] = np.arange(4) * 0.01
    carrier[:, 2, 1] = 0.01
    carrier[1:] += [0.0, 0.0, 0.2]
    carrier[1, 3] = 99.0
    is_visible = np.ones((3, 4), bool)
    is_visible[1, 3] = False
    is_visible[2, :2] = False
    moved = carried_points(np.array([[0.005, 0.0, 0.001]]), carrier, is_visible, reach=0.03)
    assert moved[1, 0] == pytest.approx([0.005, 0.0, 0.201])
    assert np.isnan(moved[2]).all()  # Two carriers do not fix a rotation.
    far = carried_points(np.array([[0.2, 0.0, 0.0]]), carrier, is_visible, reach=0.03)
    assert np.isnan(far).all()


def test_one_node_carries_what_it_can() -> None:
    rollout = np.array([[[0.0, 0, 0]], [[0.0, 0, 0.1]]])
    moved = carried_points(np.array([[0.3, 0, 0]]), rollout)
    assert moved[1, 0] == pytest.approx([0.3, 0, 0.1])
