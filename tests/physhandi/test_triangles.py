"""Areas and normals in closed form."""

import numpy as np

from physhandi.triangles import triangle_areas, vertex_normals


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


def test_areas_are_half_of_base_times_height() -> None:
    vertex = np.array([[0.0, 0, 1], [4, 0, 1], [1, 3, 1], [2, 0, 1]])
    np.testing.assert_allclose(triangle_areas(vertex, np.array([[0, 1, 2], [0, 1, 3]])), [6, 0])
