import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from physhandi.appearance.binding import SplatBinding
from physhandi.appearance.splats import Splats

TURN = Rotation.from_rotvec([0.4, -1.1, 2.0])
SHIFT = np.array([0.3, -0.2, 0.5])


def bound(node: np.ndarray, center: np.ndarray) -> SplatBinding:
    count = len(center)
    return SplatBinding.of(
        Splats(
            center=center.astype(np.float32),
            scale=np.full(count, 0.002, np.float32),
            color=np.zeros((count, 3), np.float32),
            opacity=np.ones(count, np.float32),
            rest_node=node.astype(np.float32),
        )
    )


def grid(*sides: int) -> np.ndarray:
    axes = [0.01 * np.arange(side) for side in sides]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def test_splats_follow_what_sixteen_neighbors_did_as_scipy_aligns_them() -> None:
    random = np.random.default_rng(3)
    node = random.uniform(-0.05, 0.05, (60, 3)).astype(np.float32).astype(np.float64)
    center = random.uniform(-0.05, 0.05, (25, 3)).astype(np.float32).astype(np.float64)
    moved = TURN.apply(node * [1.0, 1.3, 0.8]) + SHIFT + random.normal(0, 0.003, node.shape)

    turned = []
    for number in range(len(node)):
        beside = np.argsort(np.linalg.norm(node - node[number], axis=1))[1:17]
        aligned = Rotation.align_vectors(
            moved[beside] - moved[number], node[beside] - node[number]
        )[0]
        turned.append(aligned.as_matrix())
    expected = np.zeros_like(center)
    for splat, place in enumerate(center):
        distance = np.linalg.norm(node - place, axis=1)
        near = np.argsort(distance)[:16]
        weight = 1 / (distance[near] + 1e-6)
        for k, share in zip(near, weight / weight.sum(), strict=True):
            expected[splat] += share * (turned[k] @ (place - node[k]) + moved[k])

    binding = bound(node, center)
    np.testing.assert_allclose(binding.rotations(moved[None])[0], turned, atol=1e-9)
    np.testing.assert_allclose(binding.carry(moved[None])[0], expected, atol=1e-7)
    assert np.linalg.norm(expected - center, axis=1).min() > 0.4


@pytest.mark.parametrize(
    "node",
    [grid(4, 4, 4), grid(6, 7, 1), grid(2, 1, 1), grid(3, 1, 1)[:1]],
    ids=["body", "sheet", "two nodes", "one node"],
)
def test_rigid_motion_moves_splats_rigidly_as_far_as_nodes_tell_it(node: np.ndarray) -> None:
    center = node.mean(axis=0) + np.array([[0.004, 0.0, 0.0], [0.02, 0.0, 0.0]])
    if len(node) > 2:
        center = np.concatenate([center, center + np.array([0.0, 0.003, 0.006])])
    # About the axis of two nodes nothing is told, so these turn across it.
    turn = Rotation.from_rotvec([0.0, 0.0, 1.2]) if len(node) == 2 else TURN
    turn = Rotation.identity() if len(node) == 1 else turn
    carried = bound(node, center).carry((turn.apply(node) + SHIFT)[None])[0]
    np.testing.assert_allclose(carried, turn.apply(center) + SHIFT, atol=1e-6)


def test_nodes_on_a_line_turn_the_shortest_way_and_even_back_to_front() -> None:
    node = grid(20, 1, 1)
    beside = np.array([[0.05, 0.004, 0.0]])
    binding = bound(node, beside)
    upright = np.stack([np.zeros(20), np.zeros(20), node[:, 0]], axis=1)
    np.testing.assert_allclose(binding.carry(upright[None])[0], [[0.0, 0.004, 0.05]], atol=1e-7)
    turned = binding.rotations(-node[None])[0]
    np.testing.assert_allclose(np.linalg.det(turned), 1.0)
    np.testing.assert_allclose(turned[:, :, 0], np.tile([-1.0, 0.0, 0.0], (20, 1)), atol=1e-9)


def test_neighbors_that_leave_a_line_do_not_turn_at_once() -> None:
    node = grid(20, 1, 1)
    binding = bound(node, node[:1])
    heights = np.linspace(0.0, 0.3, 301)
    zigzag = node + np.stack(
        [np.array([[0.0, 0.0, 1.0]]) * (h * 0.01 * (np.arange(20) % 2)[:, None]) for h in heights]
    )
    turned = binding.rotations(zigzag)
    assert np.abs(np.diff(turned, axis=0)).max() < 0.01


def test_mirrored_and_coincident_neighbors_still_give_rotations() -> None:
    node = np.concatenate([grid(3, 3, 3), np.zeros((30, 3))])
    binding = bound(node, node[:2] + 0.001)
    turned = binding.rotations(np.stack([node * [1, 1, -1], node * 0.0]))
    np.testing.assert_allclose(
        turned @ np.swapaxes(turned, -1, -2), np.tile(np.eye(3), (2, 57, 1, 1)), atol=1e-9
    )
    np.testing.assert_allclose(np.linalg.det(turned), 1.0)
    np.testing.assert_allclose(turned[1], np.tile(np.eye(3), (57, 1, 1)))


def test_a_frame_is_carried_alike_alone_and_after_others() -> None:
    random = np.random.default_rng(5)
    node = grid(9, 9, 9)
    frames = node + np.cumsum(random.normal(0, 0.002, (120, *node.shape)), axis=0)
    binding = bound(node, node + 0.003)
    carried = binding.carry(frames)
    assert carried.dtype == np.float32
    for frame in (0, 60, 119):
        np.testing.assert_array_equal(binding.carry(frames[frame : frame + 1])[0], carried[frame])


def test_nodes_that_cannot_carry_are_told_by_frame() -> None:
    binding = bound(grid(3, 3, 1), np.zeros((1, 3)))
    with pytest.raises(ValueError, match=r"node has shape \(1, 8, 3\); expected \(frame, 9, 3\)"):
        binding.carry(np.zeros((1, 8, 3)))
    lost = np.tile(grid(3, 3, 1), (3, 1, 1))
    lost[2, 4, 1] = np.nan
    with pytest.raises(ValueError, match="Frame 2 has nodes that are not finite"):
        binding.carry(lost)
