import numpy as np

from physhandi.data.camera import PinholeCamera
from physhandi.synthetic.film.rasterizer import rasterize, vertex_normals


def camera(width: int = 64, height: int = 48) -> PinholeCamera:
    K = np.array([[50.0, 0, 31.5], [0, 50.0, 23.5], [0, 0, 1]])
    return PinholeCamera(K=K, T_world_camera=np.eye(4), width=width, height=height)


def test_a_tilted_triangle_has_the_depth_of_its_plane():
    vertex = np.array([[-0.4, -0.4, 0.8], [0.5, -0.3, 1.4], [-0.1, 0.5, 1.0]])
    faces = np.array([[0, 1, 2]])
    raster = rasterize(camera(), vertex, faces)
    rows, columns = np.nonzero(raster.face == 0)
    assert len(rows) > 300
    normal = np.cross(vertex[1] - vertex[0], vertex[2] - vertex[0])
    ray = np.stack([(columns - 31.5) / 50, (rows - 23.5) / 50, np.ones(len(rows))], axis=1)
    expected = (normal @ vertex[0]) / (ray @ normal)
    np.testing.assert_allclose(raster.depth[rows, columns], expected, rtol=1e-12)
    seen = raster.interpolate(faces, vertex)[rows, columns]
    np.testing.assert_allclose(seen, ray * expected[:, None], atol=1e-12)
    assert (raster.depth[raster.face < 0] == 0).all()


def test_covered_area_is_that_of_the_projection():
    vertex = np.array([[-0.3, -0.2, 1.0], [0.3, -0.2, 1.0], [0.3, 0.2, 1.0], [-0.3, 0.2, 1.0]])
    raster = rasterize(camera(), vertex, np.array([[0, 1, 2], [0, 2, 3]]))
    assert (raster.face >= 0).sum() == 30 * 20


def test_the_nearer_triangle_wins_whatever_the_order_and_winding():
    near = np.array([[-0.2, -0.2, 0.5], [0.2, -0.2, 0.5], [0.0, 0.2, 0.5]])
    far = near * [3, 3, 2]
    vertex = np.concatenate([near, far])
    for faces in ([[0, 1, 2], [3, 4, 5]], [[5, 4, 3], [2, 1, 0]]):
        raster = rasterize(camera(), vertex, np.array(faces))
        assert raster.depth[23, 31] == 0.5
        assert 1.0 in raster.depth


def test_what_is_behind_or_beside_the_camera_is_left_out():
    behind = np.array([[-1, -1, -1.0], [1, -1, -1], [0, 1, -1]])
    beside = np.array([[5, 5, 1.0], [6, 5, 1], [5, 6, 1]])
    raster = rasterize(camera(), np.concatenate([behind, beside]), np.arange(6).reshape(2, 3))
    assert (raster.face == -1).all()


def test_a_mesh_of_many_sizes_leaves_no_seam():
    random = np.random.default_rng(0)
    flat = np.concatenate(
        [random.uniform(-0.9, 0.9, (300, 2)), [[-1, -1], [1, -1], [1, 1], [-1, 1]]]
    )
    from scipy.spatial import Delaunay

    vertex = np.column_stack([flat, np.ones(len(flat))])
    raster = rasterize(camera(), vertex, Delaunay(flat).simplices.astype(np.int64))
    assert (raster.face >= 0).all()
    np.testing.assert_allclose(raster.depth, 1.0)


def test_vertex_normals_of_a_roof_lie_between_its_sides():
    vertex = np.array([[0, 0, 1.0], [0, 1, 1], [1, 0, 0], [-1, 0, 0]])
    normal = vertex_normals(vertex, np.array([[0, 2, 1], [0, 1, 3]]))
    np.testing.assert_allclose(normal[0], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(normal[2], [np.sqrt(0.5), 0, np.sqrt(0.5)], atol=1e-12)
