"""Areas and normals in closed form."""

import numpy as np
import pytest
from numpy import ndarray
from scipy.optimize import minimize
from scipy.spatial import ConvexHull

from physhandi.triangles import (
    is_closed,
    sample_surface,
    segment_distance,
    triangle_areas,
    triangle_distance,
    unit_normals,
    vertex_normals,
)


def test_vertex_normals_of_a_roof_lie_between_its_sides() -> None:
    vertex = np.array([[0, 0, 1.0], [0, 1, 1], [1, 0, 0], [-1, 0, 0]])
    normal = vertex_normals(vertex, np.array([[0, 2, 1], [0, 1, 3]]))
    np.testing.assert_allclose(normal[0], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(normal[2], [np.sqrt(0.5), 0, np.sqrt(0.5)], atol=1e-12)


def test_a_larger_triangle_counts_more() -> None:
    vertex = np.array([[0.0, 0, 0], [3, 0, 0], [0, 1, 0], [0, 0, 1], [5, 5, 5]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    normal = vertex_normals(vertex.astype(np.float32), faces)
    np.testing.assert_allclose(normal[0], np.array([1, 0, 3]) / np.sqrt(10), atol=1e-7)
    np.testing.assert_array_equal(normal[4], 0)
    unit = unit_normals(vertex, faces)
    np.testing.assert_allclose(unit[:4], normal[:4], atol=1e-7)
    np.testing.assert_array_equal(unit[4], [0, 0, 1])


def test_areas_are_half_of_base_times_height() -> None:
    vertex = np.array([[0.0, 0, 1], [4, 0, 1], [1, 3, 1], [2, 0, 1]])
    np.testing.assert_allclose(triangle_areas(vertex, np.array([[0, 1, 2], [0, 1, 3]])), [6, 0])


def brute(point: ndarray, corner: ndarray) -> float:
    """The nearest point of a triangle, found by descent over its two coordinates."""
    a, b, c = corner

    def at(uv: ndarray) -> float:
        u, v = uv
        return float(np.sum((a + u * (b - a) + v * (1 - u) * (c - a) - point) ** 2))

    starts = [(x, y) for x in (0.1, 0.5, 0.9) for y in (0.1, 0.5, 0.9)]
    found = [minimize(at, start, bounds=[(0, 1), (0, 1)], tol=1e-14).fun for start in starts]
    return float(np.sqrt(min(found)))


def test_the_distance_to_a_triangle_is_that_of_its_nearest_point() -> None:
    rng = np.random.default_rng(2)
    point, corner = rng.normal(size=(12, 3)), rng.normal(size=(12, 3, 3))
    point[0] = [0.2, 0.3, 2.5]
    corner[0] = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    found = triangle_distance(point, corner)
    assert found[0] == pytest.approx(2.5)
    expected = [brute(p, c) for p, c in zip(point, corner, strict=True)]
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    # All corners on a line: the triangle is that line.
    line = np.array([[[0.0, 0, 0], [1.0, 0, 0], [0.4, 0, 0]]])
    assert triangle_distance(np.array([[0.5, 0.3, 0.4]]), line) == pytest.approx([0.5])
    assert triangle_distance(np.array([[4.0, 0.0, 4.0]]), line) == pytest.approx([5.0])


def test_the_distance_to_a_segment_is_to_its_line_or_its_ends() -> None:
    start, end = np.zeros((3, 3)), np.tile([2.0, 0.0, 0.0], (3, 1))
    point = np.array([[1.0, 3.0, 4.0], [-3.0, 4.0, 0.0], [2.5, 0.0, 0.0]])
    assert segment_distance(point, start, end) == pytest.approx([5.0, 5.0, 0.5])
    assert segment_distance(point[:1], start[:1], start[:1]) == pytest.approx([26**0.5])


def slab() -> tuple[np.ndarray, np.ndarray]:
    """Corners and triangles of a box of 2 x 3 x 0.1, seen from outside."""
    corner = np.indices((2, 2, 2)).reshape(3, -1).T * [2.0, 3.0, 0.1]
    faces = ConvexHull(corner).simplices
    a, b, c = (corner[faces[:, k]] for k in range(3))
    inwards = (np.cross(b - a, c - a) * (a - [1.0, 1.5, 0.05])).sum(axis=1) < 0
    faces[inwards] = faces[inwards][:, ::-1]
    return corner, faces


def test_samples_say_what_is_inside() -> None:
    corner, faces = slab()
    samples = sample_surface(corner, faces, 6000)
    assert samples.area * 6000 == pytest.approx(2 * (6.0 + 0.2 + 0.3))
    # All samples lie on the box, and as many on each side as its area says.
    height = samples.point[:, 2]
    assert (np.abs(height - 0.1) < 1e-9).mean() == pytest.approx(6.0 / 13.0, abs=0.002)
    assert np.all(height[samples.normal[:, 2] > 0.9] > 0.0999)
    inside = np.array([[1.0, 1.5, 0.05], [0.2, 2.7, 0.05]])
    outside = np.array([[1.0, 1.5, 0.2], [1.0, 1.5, -0.1], [-0.1, 1.0, 0.05], [9.0, 9.0, 9.0]])
    assert samples.winding_number(inside) == pytest.approx([1, 1], abs=0.05)
    assert samples.winding_number(outside) == pytest.approx([0, 0, 0, 0], abs=0.05)
    # Twice the volume by the area.
    assert samples.thickness == pytest.approx(2 * 0.6 / 13.0, rel=0.01)


def test_a_mesh_with_few_open_edges_is_closed() -> None:
    _, faces = slab()
    assert is_closed(faces)
    assert not is_closed(faces[1:])
    point = np.random.default_rng(0).normal(size=(300, 3))
    ball = ConvexHull(point / np.linalg.norm(point, axis=1, keepdims=True))
    assert is_closed(ball.simplices[1:])
    assert not is_closed(ball.simplices[::2])
