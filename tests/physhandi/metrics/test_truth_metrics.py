"""Distances to the true surface: closed forms, and plain loops over a surface that moves."""

import numpy as np
import pytest
from numpy import ndarray
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from physhandi.data.truth import Truth
from physhandi.errors import SequenceError
from physhandi.metrics.truth_metrics import (
    SAMPLE_COUNT,
    TrueSurface,
    surface_distance,
    true_motion,
    true_surface,
    truth_curves,
)

FRAMES = 5
SQUARE = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
TWO = np.array([[0, 1, 2], [0, 2, 3]])


def surface_of(point: np.ndarray, face: np.ndarray) -> TrueSurface:
    truth = Truth(hand_keypoint={}, hand_vertex={}, object_point=point, object_face=face)
    found = true_surface(truth)
    assert found is not None
    return found


def waving(count: int = 14) -> tuple[np.ndarray, np.ndarray]:
    """A sheet, 0.3 wide, that rises, turns and bends; and its triangles."""
    x, y = (v.reshape(-1) for v in np.meshgrid(*[np.linspace(-0.15, 0.15, count)] * 2))
    frames = [
        np.column_stack(
            [x * np.cos(0.3 * f) - y * np.sin(0.3 * f), y, 0.02 * f + 0.03 * np.sin(20 * x + f)]
        )
        for f in range(FRAMES)
    ]
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).reshape(-1)
    lower = np.column_stack([corner, corner + 1, corner + count])
    upper = np.column_stack([corner + 1, corner + count + 1, corner + count])
    return np.stack(frames), np.concatenate([lower, upper])


def drawn_by_loops(vertex: np.ndarray, face: np.ndarray, fine: int = 12) -> tuple[ndarray, ndarray]:
    """Fill each triangle with small ones: their middles, and the area of each."""
    middle, area = [], []
    for a, b, c in vertex[face]:
        size = np.linalg.norm(np.cross(b - a, c - a)) / 2 / fine**2
        for i in range(fine):
            for j in range(fine - i):
                for third in (1, 2) if i + j < fine - 1 else (1,):
                    u, v = (i + third / 3) / fine, (j + third / 3) / fine
                    middle.append(a + u * (b - a) + v * (c - a))
                    area.append(size)
    return np.array(middle), np.array(area)


def distance_by_loops(point: np.ndarray, vertex: np.ndarray, face: np.ndarray) -> np.ndarray:
    """Distance to the nearest triangle: to its plane where that is inside, else to an edge."""
    nearest = np.full(len(point), np.inf)
    for a, b, c in vertex[face]:
        side = np.stack([b - a, c - a])
        share = np.linalg.lstsq(side.T, (point - a).T, rcond=None)[0].T
        gap = np.linalg.norm(point - a - share @ side, axis=1)
        is_inside = (share >= 0).all(axis=1) & (share.sum(axis=1) <= 1)
        nearest[is_inside] = np.minimum(nearest, gap)[is_inside]
        for start, end in ((a, b), (b, c), (c, a)):
            along = np.clip((point - start) @ (end - start) / ((end - start) @ (end - start)), 0, 1)
            gap = np.linalg.norm(point - start - along[:, None] * (end - start), axis=1)
            nearest = np.minimum(nearest, gap)
    return nearest


def test_a_node_above_the_middle_of_a_square() -> None:
    surface = surface_of(np.stack([SQUARE] * 2), TWO)
    nodes = np.array([[[0.0, 0, 0]], [[0.0, 0, 0.5]]])
    curves = truth_curves(nodes, surface)
    # Mean distance to the middle of a square of side 2: (sqrt(2) + asinh(1)) / 3.
    mean = (2**0.5 + np.arcsinh(1.0)) / 3
    assert curves["chamfer_truth_to_nodes"][0] == pytest.approx(mean, rel=0.01)
    assert curves["chamfer_nodes_to_truth"] == pytest.approx([0.0, 0.5])
    grid = (np.arange(400) + 0.5) / 200 - 1
    above = np.sqrt(grid[:, None] ** 2 + grid**2 + 0.25).mean()
    assert curves["chamfer_truth_to_nodes"][1] == pytest.approx(above, rel=0.01)
    assert curves["chamfer_truth"][1] == pytest.approx((above + 0.5) / 2, rel=0.01)
    assert curves["chamfer_truth"][0] == pytest.approx(mean / 2, rel=0.01)


def test_samples_are_even_over_the_area_and_stick_to_it() -> None:
    # Two squares apart, one of nine times the area; the second frame shrinks the large one.
    large = 3 * SQUARE + np.array([10.0, 0, 0])
    start = np.concatenate([SQUARE, large])
    later = np.concatenate([SQUARE, SQUARE + np.array([0.0, 0, 7.0])])
    surface = surface_of(np.stack([start, later]), np.concatenate([TWO, TWO + 4]))
    first, second = surface.samples(0), surface.samples(1)
    assert len(first) == SAMPLE_COUNT
    on_large = first[:, 0] > 5
    assert on_large.mean() == pytest.approx(0.9, abs=0.001)
    assert first[on_large].mean(axis=0) == pytest.approx([10, 0, 0], abs=0.1)
    assert first[on_large].std(axis=0) == pytest.approx([3**0.5, 3**0.5, 0], rel=0.03)
    assert second[on_large] == pytest.approx((first[on_large] - [10.0, 0, 0]) / 3 + [0.0, 0, 7.0])
    assert second[~on_large] == pytest.approx(first[~on_large])
    again = surface_of(np.stack([start, later]), np.concatenate([TWO, TWO + 4]))
    assert np.array_equal(again.samples(1), second)


def test_both_ways_agree_with_plain_loops() -> None:
    point, face = waving(count=8)
    nodes = point[:, ::3] + np.random.default_rng(2).normal(scale=0.01, size=point[:, ::3].shape)
    curves = truth_curves(nodes, surface_of(point, face))
    for frame in range(FRAMES):
        drawn, area = drawn_by_loops(point[frame], face)
        there = np.average(cdist(drawn, nodes[frame]).min(axis=1), weights=area)
        back = distance_by_loops(nodes[frame], point[frame], face).mean()
        # Samples are even over the area of frame 0, which bending and turning change a little.
        assert curves["chamfer_truth_to_nodes"][frame] == pytest.approx(there, rel=0.05)
        assert curves["chamfer_nodes_to_truth"][frame] == pytest.approx(back, rel=1e-6)
        assert curves["chamfer_truth"][frame] == pytest.approx((there + back) / 2, rel=0.04)
        assert 0.003 < back < there < 0.05


def test_another_frame_is_another_surface() -> None:
    point, face = waving()
    surface = surface_of(point, face)
    right = truth_curves(point, surface)
    assert right["chamfer_nodes_to_truth"] == pytest.approx(np.zeros(FRAMES), abs=1e-9)
    late = truth_curves(point[[0, 0, 1, 2, 3]], surface)
    assert (late["chamfer_nodes_to_truth"][1:] > 0.005).all()
    assert (late["chamfer_truth"][1:] > 1.2 * right["chamfer_truth"][1:]).all()
    assert late["chamfer_truth"][0] == right["chamfer_truth"][0]


def test_every_part_of_a_triangle_can_be_nearest() -> None:
    triangle = np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]])
    point = np.array(
        [
            [0.2, 0.3, -0.7],  # below the inside
            [0.5, -0.3, 0.4],  # beside an edge
            [1.0, 1.0, 0.0],  # beyond the long edge
            [-3.0, -4.0, 12.0],  # beyond a corner
        ]
    )
    assert surface_distance(point, triangle) == pytest.approx([0.7, 0.5, 0.5**0.5, 13.0])
    line = np.array([[[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]])
    assert surface_distance(np.array([[1.5, 3.0, 4.0]]), line) == pytest.approx([5.0])


def test_without_a_surface_there_is_nothing_to_measure() -> None:
    point = np.stack([SQUARE])

    def prepared(point: np.ndarray | None, face: np.ndarray | None) -> TrueSurface | None:
        return true_surface(
            Truth(hand_keypoint={}, hand_vertex={}, object_point=point, object_face=face)
        )

    assert prepared(point, TWO) is not None
    assert prepared(point, None) is None
    assert prepared(None, TWO) is None
    assert prepared(0 * point, TWO) is None
    with pytest.raises(SequenceError, match=r"object_face\.npy: triangle 1 joins .*\[0, 2, 4\]"):
        prepared(point, np.array([[0, 1, 2], [0, 2, 4]]))


def bent(point: np.ndarray, curvature: float, height: float = 0.0) -> np.ndarray:
    """Wind a plane about a cylinder, in closed form; `height` is above the plane."""
    if curvature == 0.0:
        return np.column_stack([point[:, 0], point[:, 1], height + 0.0 * point[:, 0]])
    angle, radius = point[:, 0] * curvature, 1.0 / curvature - height
    return np.column_stack(
        [radius * np.sin(angle), point[:, 1], 1.0 / curvature - radius * np.cos(angle)]
    )


def test_nodes_that_the_truth_carries_move_rigidly_with_it_to_the_last_digit() -> None:
    point, face = waving()
    turn = Rotation.from_rotvec([0.3, -0.9, 0.5]).as_matrix()
    up = np.array([0.0, 0.0, 1.0])
    frames = np.stack([point[0], point[0] @ turn.T + [0.1, 0.2, -0.3], point[0] + up])
    # On the sheet, above it and beyond its rim.
    node = np.array([[0.01, 0.02, 0.03], [-0.1, 0.14, 0.0], [0.17, 0.1, 0.05], [0.0, -0.2, 0.0]])
    moved = true_motion(node, surface_of(frames, face))
    assert moved.dtype == np.float64
    np.testing.assert_allclose(moved[0], node, atol=1e-14)
    np.testing.assert_allclose(moved[1], node @ turn.T + [0.1, 0.2, -0.3], atol=1e-13)
    np.testing.assert_allclose(moved[2], node + up, atol=1e-13)


def test_nodes_that_the_truth_carries_are_wound_about_a_cylinder_with_it() -> None:
    flat, face = waving(60)
    flat = flat[0] * [1.0, 1.0, 0.0]
    curvature = np.array([0.0, 2.0, 5.0])
    surface = surface_of(np.stack([bent(flat, c) for c in curvature]), face)
    node = np.random.default_rng(1).uniform(-0.14, 0.14, (50, 3)) * [1.0, 1.0, 0.0]
    for height in (0.0, 0.004):
        moved = true_motion(node + height * np.array([0.0, 0.0, 1.0]), surface)
        for frame, c in enumerate(curvature):
            # Triangles of 5 mm lie at most 5 mm²/8 times the curvature beside the cylinder, and
            # their normals turn in steps of 5 mm times it.
            expected = bent(node, c, height)
            np.testing.assert_allclose(moved[frame], expected, atol=2e-5 + 0.006 * c * height)
        assert np.abs(moved[2] - moved[0]).max() > 0.03


def test_a_flat_triangle_carries_no_node() -> None:
    point = np.concatenate([SQUARE, [[0.2, 0.0, 0.0]]])
    face = np.concatenate([TWO, [[4, 4, 4]]])
    frames = np.stack([point, point + np.array([0.0, 0.0, 0.5])])
    moved = true_motion(np.array([[0.2, 0.0, 0.1]]), surface_of(frames, face))
    np.testing.assert_allclose(moved[:, 0], [[0.2, 0.0, 0.1], [0.2, 0.0, 0.6]], atol=1e-15)
