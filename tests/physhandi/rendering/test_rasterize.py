"""What pixel centres see, against rays in closed form and against every triangle in turn."""

from functools import partial

import numpy as np
import pytest
import warp as wp
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation
from support.physics.render_world import camera, crowd

from physhandi.data.camera import PinholeCamera
from physhandi.rendering.renderer import Raster, rasterize
from physhandi.rendering.shapes import Balls, Image, Segments, Surface

FACE = np.array([[0, 1, 2]])
QUAD = np.array([[0, 1, 2], [0, 2, 3]])


@pytest.fixture(autouse=True)
def drawn_on_every_device(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run each test on each device of this machine."""
    monkeypatch.setitem(globals(), "rasterize", partial(rasterize, device=device))


def turned_camera() -> PinholeCamera:
    """A camera somewhere in the world, with unequal focal lengths and skew."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
    pose[:3, 3] = [0.3, -2.0, 0.8]
    K = np.array([[61.0, 3.5, 30.2], [0, 48.0, 25.7], [0, 0, 1]])
    return PinholeCamera(K=K, T_world_camera=pose, width=70, height=50)


def rays(view: PinholeCamera) -> np.ndarray:
    """Rays of depth one through all pixel centres, in the camera's axes."""
    rows, columns = np.indices((view.height, view.width))
    pixel = np.stack([columns, rows, np.ones_like(rows)], axis=-1).astype(float)
    return pixel @ np.linalg.inv(view.K).T


def meet(ray: np.ndarray, corner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth and corner weights where rays from the origin meet one triangle; NaN where not."""
    a, ab, ac = corner[0], corner[1] - corner[0], corner[2] - corner[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        cross = np.cross(ray, ac)
        inverse = 1.0 / (cross @ ab)
        u = (cross @ -a) * inverse
        v = (ray @ np.cross(-a, ab)) * inverse
        depth = (ac @ np.cross(-a, ab)) * inverse
    outside = ~((u >= 0) & (v >= 0) & (u + v <= 1))
    weight = np.stack([1 - u - v, u, v], axis=-1)
    weight[outside] = np.nan
    return np.where(outside, np.nan, depth), weight


def nearest_of_all(
    view: PinholeCamera, vertex: np.ndarray, faces: np.ndarray, near: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth, triangle and weights by asking every triangle at every pixel."""
    ray, local = rays(view), view.to_camera(vertex)
    best = np.full(ray.shape[:2], np.inf)
    face, weights = np.full(ray.shape[:2], -1), np.zeros(ray.shape)
    for number, corners in enumerate(faces):
        depth, weight = meet(ray, local[corners])
        nearer = (depth >= near) & (depth < best)
        best[nearer], face[nearer], weights[nearer] = depth[nearer], number, weight[nearer]
    return np.where(face >= 0, best, 0.0), face, weights


def test_a_tilted_triangle_has_the_depth_of_its_plane() -> None:
    vertex = np.array([[-0.4, -0.4, 0.8], [0.5, -0.3, 1.4], [-0.1, 0.5, 1.0]])
    raster = rasterize(camera(), [Surface(vertex=vertex, faces=FACE)])
    rows, columns = np.nonzero(raster.element == 0)
    assert len(rows) > 300
    normal = np.cross(vertex[1] - vertex[0], vertex[2] - vertex[0])
    ray = np.stack([(columns - 31.5) / 50, (rows - 23.5) / 50, np.ones(len(rows))], axis=1)
    expected = (normal @ vertex[0]) / (ray @ normal)
    np.testing.assert_allclose(raster.depth[rows, columns], expected, rtol=1e-12)
    seen = raster.interpolate(FACE, vertex)
    np.testing.assert_allclose(seen[rows, columns], ray * expected[:, None], atol=1e-12)
    is_free = raster.element < 0
    assert (raster.depth[is_free] == 0).all()
    assert (raster.shape[is_free] == -1).all()
    assert (seen[is_free] == 0).all()


def test_a_ball_has_the_depth_of_a_sphere() -> None:
    view = turned_camera()
    middle, radius = np.array([[0.3, 0.2, 2.0], [-0.6, -0.3, 1.4]]), np.array([0.4, 0.25])
    world = middle @ view.T_world_camera[:3, :3].T + view.T_world_camera[:3, 3]
    raster = rasterize(view, [Balls(center=world, radius=radius)])
    ray = rays(view)
    expected = np.full(ray.shape[:2], np.inf)
    ball = np.full(ray.shape[:2], -1)
    for number in range(2):
        squared = np.sum(ray**2, axis=-1)
        along = ray @ middle[number]
        root = along**2 - squared * (middle[number] @ middle[number] - radius[number] ** 2)
        depth = np.where(root >= 0, (along - np.sqrt(np.maximum(root, 0))) / squared, np.inf)
        ball[depth < expected] = number
        expected = np.minimum(expected, depth)
    assert (ball == 0).sum() > 250
    assert (ball == 1).sum() > 150
    np.testing.assert_array_equal(raster.element, ball)
    np.testing.assert_allclose(raster.depth[ball >= 0], expected[ball >= 0], rtol=1e-12)
    assert (raster.weight == 0).all()


@pytest.mark.parametrize("near", [1e-3, 0.7])
def test_triangles_in_all_places_are_seen_as_by_asking_each_of_them(near: float) -> None:
    random = np.random.default_rng(4)
    view = turned_camera()
    # Some are smaller than a pixel, some reach behind the camera, and so does the floor.
    size = 10.0 ** random.uniform(-2.5, -0.6, (400, 1, 1))
    local = random.uniform([-2, -2, -0.5], [2, 2, 4], (400, 1, 3))
    local = local + size * random.normal(size=(400, 3, 3))
    local[0] = [[-50, 0.6, -30], [50, 0.6, -30], [0, 0.6, 70]]
    local[1:3] = (
        [[0.3, -0.5, -1], [0.5, -0.5, 2], [0.5, -0.2, 2]],
        [[0, 1, -1], [0, -1, -1], [-1, 0, 3]],
    )
    vertex = local.reshape(-1, 3) @ view.T_world_camera[:3, :3].T + view.T_world_camera[:3, 3]
    faces = np.arange(1200).reshape(-1, 3)
    depth, face, weight = nearest_of_all(view, vertex, faces, near)
    raster = rasterize(view, [Surface(vertex=vertex, faces=faces)], near=near)
    assert len(np.unique(face)) > 40
    crosses = (local[..., 2] < near).any(axis=1) & (local[..., 2] > near).any(axis=1)
    assert crosses[np.unique(face[face >= 0])].sum() > 1
    np.testing.assert_array_equal(raster.element, face)
    np.testing.assert_allclose(raster.depth, depth, rtol=1e-9)
    np.testing.assert_allclose(raster.weight, weight, atol=1e-8)


def test_attributes_are_blended_on_the_surface_and_not_in_the_picture() -> None:
    random = np.random.default_rng(1)
    flat = random.uniform(-1.5, 1.5, (60, 2))
    faces = Delaunay(flat).simplices.astype(np.int64)
    vertex = np.column_stack([flat, 3 + flat @ [0.8, 0.3]])  # Strong perspective.
    value = random.normal(size=(60, 4))
    raster = rasterize(camera(), [Surface(vertex=vertex, faces=faces)])
    _, face, weight = nearest_of_all(camera(), vertex, faces, 1e-3)
    expected = np.einsum("rck,rckd->rcd", weight, value[faces[face]]) * (face >= 0)[..., None]
    assert (face >= 0).mean() > 0.3
    np.testing.assert_allclose(raster.interpolate(faces, value), expected, atol=1e-10)


def test_a_pixel_s_centre_has_whole_coordinates() -> None:
    view = turned_camera()
    for column, row in ((0, 0), (69, 49), (17, 30)):
        around = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
        for half, count in ((0.49, 1), (0.51, 1), (1.01, 9)):
            pixel = np.array([column, row]) + half * around
            vertex = view.unproject(pixel, np.full(4, 1.7))
            raster = rasterize(view, [Surface(vertex=vertex, faces=QUAD)])
            rows, columns = np.nonzero(raster.element >= 0)
            assert row in rows
            assert column in columns
            is_inside = (abs(rows - row) <= half) & (abs(columns - column) <= half)
            assert is_inside.all()
            at_edge = column in (0, 69) or row in (0, 49)
            assert len(rows) == count or (at_edge and count == 9)
    aside = view.unproject(np.array([[-0.6, 3], [-0.01, 3], [-0.01, 5], [-0.6, 5]]), np.ones(4))
    assert (rasterize(view, [Surface(vertex=aside, faces=QUAD)]).element == -1).all()


def test_covered_area_is_that_of_the_projection() -> None:
    vertex = np.array([[-0.3, -0.2, 1.0], [0.3, -0.2, 1.0], [0.3, 0.2, 1.0], [-0.3, 0.2, 1.0]])
    raster = rasterize(camera(), [Surface(vertex=vertex, faces=QUAD)])
    assert (raster.element >= 0).sum() == 30 * 20


def test_the_nearer_triangle_wins_whatever_the_order_and_winding() -> None:
    near = np.array([[-0.2, -0.2, 0.5], [0.2, -0.2, 0.5], [0.0, 0.2, 0.5]])
    vertex = np.concatenate([near, near * [3, 3, 2]])
    for faces in ([[0, 1, 2], [3, 4, 5]], [[5, 4, 3], [2, 1, 0]]):
        raster = rasterize(camera(), [Surface(vertex=vertex, faces=np.array(faces))])
        assert raster.depth[23, 31] == 0.5
        assert 1.0 in raster.depth


def test_the_nearest_of_shapes_of_all_kinds_is_named() -> None:
    wall = Surface(vertex=np.array([[-9, -9, 3.0], [9, -9, 3], [9, 9, 3], [-9, 9, 3]]), faces=QUAD)
    balls = Balls(center=np.array([[0, 0, 9.0], [0.2, 0.1, 1.5]]), radius=np.full(2, 0.2))
    wire = np.array([[[-3, 0, 9.0], [3, 0, 9]], [[-3.0, -0.4, 2], [3, -0.4, 2]]])
    corner = np.array([[-0.6, 0.3, 2], [-0.3, 0.3, 2], [-0.3, 0.5, 2], [-0.6, 0.5, 2.0]])
    image = Image(corner=corner, image=np.zeros((2, 3, 3), np.uint8))
    raster = rasterize(camera(), [wall, balls, Segments(ends=wire, width=2.0), image])
    for pixel, shape, element, depth in (
        ((2, 2), 0, 1, 3.0),
        ((60, 2), 0, 0, 3.0),
        ((38, 27), 1, 1, 1.5 - 0.2),
        ((50, 13), 2, 1, 2.0),
        ((20, 33), 3, 0, 2.0),
    ):
        column, row = pixel
        assert (raster.shape[row, column], raster.element[row, column]) == (shape, element)
        assert raster.depth[row, column] == pytest.approx(depth, rel=0.03)


def test_of_equally_near_shapes_the_first_is_seen() -> None:
    vertex = np.array([[-1, -1, 2.0], [1, -1, 2], [1, 1, 2], [-1, 1, 2]])
    one, other = Surface(vertex=vertex, faces=QUAD), Surface(vertex=vertex, faces=QUAD[::-1, ::-1])
    for shapes in ([one, other], [other, one]):
        raster = rasterize(camera(), shapes)
        assert set(np.unique(raster.shape)) == {-1, 0}


def test_what_is_behind_beside_or_not_finite_is_left_out() -> None:
    behind = np.array([[-1, -1, -1.0], [1, -1, -1], [0, 1, -1]])
    beside = np.array([[5, 5, 1.0], [6, 5, 1], [5, 6, 1]])
    far = np.array([[1e12, 0, 1.0], [1e12, 1, 1], [1e12, 0, 2]])
    lost = np.array([[0, 0, 1.0], [np.nan, 0, 1], [0, 1, 1]])
    flat = np.array([[0, 0, 1.0], [0.1, 0, 1], [0.2, 0, 1]])
    vertex = np.concatenate([behind, beside, far, lost, flat])
    shapes = [
        Surface(vertex=vertex, faces=np.arange(15).reshape(-1, 3)),
        Balls(center=np.array([[0, 0, -2.0], [np.inf, 0, 1], [0, 0, 0.1]]), radius=np.full(3, 0.2)),
        Segments(
            ends=np.array([[[0, 0, -2.0], [1, 0, -1]], [[0, 0, np.nan], [1, 0, 1]]]), width=3.0
        ),
    ]
    raster = rasterize(camera(), shapes)
    assert (raster.element == -1).all()
    assert (rasterize(camera(), []).depth == 0).all()


def test_a_mesh_of_many_sizes_leaves_no_seam() -> None:
    random = np.random.default_rng(0)
    flat = np.concatenate(
        [random.uniform(-0.9, 0.9, (300, 2)), [[-1, -1], [1, -1], [1, 1], [-1, 1]]]
    )
    faces = Delaunay(flat).simplices.astype(np.int64)
    vertex = np.column_stack([flat, np.ones(len(flat))])
    raster = rasterize(camera(), [Surface(vertex=vertex, faces=faces)])
    assert (raster.element >= 0).all()
    np.testing.assert_allclose(raster.depth, 1.0)


def test_a_camera_with_distortion_is_refused() -> None:
    bent = PinholeCamera(
        K=camera().K, T_world_camera=np.eye(4), width=9, height=9, distortion=np.full(5, 0.01)
    )
    with pytest.raises(ValueError, match="no lens distortion; undistort"):
        rasterize(bent, [])


def same(one: Raster, other: Raster) -> bool:
    names = ("depth", "shape", "element", "weight")
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in names)


def test_the_same_shapes_give_the_same_bits() -> None:
    view, shapes = crowd()
    first = rasterize(view, shapes)
    assert set(np.unique(first.shape)) == {-1, 0, 1, 2, 3, 4}
    assert same(first, rasterize(view, shapes))


@pytest.mark.gpu
def test_a_graphics_card_sees_what_a_processor_sees() -> None:
    if not (wp.is_cuda_available() and wp.is_cpu_available()):
        pytest.skip("needs a CUDA device, and a Warp that compiles for the processor")
    view, shapes = crowd()
    ours, theirs = rasterize(view, shapes), rasterize(view, shapes, device="cuda:0")
    assert same(theirs, rasterize(view, shapes, device="cuda:0"))
    agree = (ours.shape == theirs.shape) & (ours.element == theirs.element)
    assert agree.mean() > 0.999  # Where two shapes are equally near within a float's last bit.
    np.testing.assert_allclose(ours.depth[agree], theirs.depth[agree], rtol=1e-9)
    np.testing.assert_allclose(ours.weight[agree], theirs.weight[agree], atol=1e-7)
