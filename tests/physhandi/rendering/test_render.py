"""Antialiased pictures: coverage, colors, light, what is sheer, and lines of a width."""

from functools import partial

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation
from support.physics.render_world import crowd

from physhandi.data.camera import PinholeCamera
from physhandi.rendering import renderer
from physhandi.rendering.renderer import rasterize, render
from physhandi.rendering.shapes import Balls, Image, Segments, Shape, Surface, arrows

QUAD = np.array([[0, 1, 2], [0, 2, 3]])
RED, BLUE, GRAY = (np.array([color]) for color in ([200.0, 0, 0], [0, 0, 200.0], [100.0] * 3))
FOCAL = 100.0


@pytest.fixture(autouse=True)
def drawn_on_every_device(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run each test on each device of this machine."""
    monkeypatch.setitem(globals(), "rasterize", partial(rasterize, device=device))
    monkeypatch.setitem(globals(), "render", partial(render, device=device))


def camera(width: int = 80, height: int = 60) -> PinholeCamera:
    """A camera at the origin that looks along z; the world's y is down, so light is from -y."""
    K = np.array([[FOCAL, 0, (width - 1) / 2], [0, FOCAL, (height - 1) / 2], [0, 0, 1]])
    return PinholeCamera(K=K, T_world_camera=np.eye(4), width=width, height=height)


def square(x: float, y: float, half: float, depth: float) -> np.ndarray:
    around = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
    return np.column_stack([np.array([x, y]) + half * around, np.full(4, depth)])


def wall(half: float, depth: float, color: np.ndarray, **options: float) -> Surface:
    return Surface(vertex=square(0, 0, half, depth), faces=QUAD, color=color, **options)


@pytest.mark.parametrize("samples", [1, 2, 3])
def test_a_pixel_tells_how_much_of_it_is_covered(samples: int) -> None:
    # Samples lie evenly within a pixel, so an edge covers whole columns of them.
    covered = 40 - 0.5 + np.arange(samples) / samples  # Left edges of the samples' columns.
    for count, edge in enumerate(covered):
        right = (edge + 0.25 / samples - 39.5) / FOCAL
        vertex = np.array([[-9, -9, 1.0], [right, -9, 1], [right, 9, 1], [-9, 9, 1]])
        shape = Surface(vertex=vertex, faces=QUAD, color=RED)
        row = render(camera(), [shape], samples=samples)[30]
        assert (row[:40] == [200, 0, 0, 255]).all()
        assert (row[41:] == 0).all()
        assert tuple(row[40]) == (200 if count else 0, 0, 0, round(255 * count / samples))
        row = render(camera(), [shape], samples=samples, background=(100, 100, 100))[30]
        share = count / samples
        expected = share * np.array([200, 0, 0]) + (1 - share) * 100
        np.testing.assert_allclose(row[40, :3], expected, atol=0.51)
        assert (row[:, 3] == 255).all()


def test_a_tall_picture_has_no_seam_between_its_strips(monkeypatch: pytest.MonkeyPatch) -> None:
    view, shapes = crowd()
    whole = render(view, shapes)
    monkeypatch.setattr(renderer, "_STRIP", 2 * 2 * 2 * view.width * 7)
    np.testing.assert_array_equal(render(view, shapes), whole)


def test_a_ball_is_as_large_as_a_sphere_looks() -> None:
    radius, depth = 0.3, 1.5
    ball = Balls(center=np.array([[0.0, 0, depth]]), radius=np.array([radius]), color=RED)
    image = render(camera(), [ball], samples=4)
    tangent = radius / np.sqrt(depth**2 - radius**2)
    assert image[..., 3].sum() / 255 == pytest.approx(np.pi * (FOCAL * tangent) ** 2, rel=0.003)
    np.testing.assert_array_equal(image, image[::-1, ::-1])


def test_colors_are_blended_between_vertices() -> None:
    color = np.array([[0.0, 50, 255], [200, 50, 0], [100, 50, 100], [50, 50, 50]])
    shape = Surface(vertex=square(0.1, 0, 0.35, 1.3), faces=QUAD, color=color)
    image = render(camera(), [shape], samples=1)
    raster = rasterize(camera(), [shape])
    expected = raster.interpolate(QUAD, color)
    assert (raster.element >= 0).sum() > 2_000
    np.testing.assert_allclose(image[..., :3], expected, atol=0.51)


def test_shading_darkens_what_looks_away_from_the_light() -> None:
    for towards, expected in (
        ((0, 0, -1), 1.0),
        ((0, 0, 1), 1 - 0.6),
        ((0, 1, 0), 1 - 0.3),
        ((0, -3, -4), 1 - 0.3 * (1 - 0.8)),
    ):
        # Wound so that its normal looks at the camera.
        plane = Surface(
            vertex=square(0, 0, 0.3, 1), faces=QUAD[:, ::-1], color=GRAY * 2, shading=0.6
        )
        image = render(camera(), [plane], light=np.array(towards, float))
        assert image[30, 40, 0] == pytest.approx(200 * expected, abs=1)
        ball = Balls(center=np.array([[0.0, 0, 3]]), radius=np.ones(1), color=2 * GRAY, shading=0.6)
        image = render(camera(81, 61), [ball], light=np.array(towards, float), samples=1)
        assert image[30, 40, 0] == pytest.approx(200 * expected, abs=1)
    # Beside the middle a ball's normal turns: at (0.6, 0, -0.8) of a distant one.
    far = Balls(center=np.array([[0.0, 0, 1e6]]), radius=np.array([1e3]), color=GRAY, shading=1.0)
    K = np.array([[3e4, 0, 50], [0, 3e4, 50], [0, 0, 1]])
    view = PinholeCamera(K=K, T_world_camera=np.eye(4), width=101, height=101)
    image = render(view, [far], light=np.array([1.0, 0, 0]), samples=1)
    assert image[50, 50 + 18, 0] == pytest.approx(100 * 0.5 * 1.6, abs=1.5)
    assert image[50, 50 - 18, 0] == pytest.approx(100 * 0.5 * 0.4, abs=1.5)


def test_light_comes_from_a_direction_of_the_world() -> None:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0.3, 2.0, -0.5]).as_matrix()
    turned = PinholeCamera(K=camera().K, T_world_camera=pose, width=80, height=60)
    view, (sheet, _, balls, *_) = camera(), crowd()[1]

    def moved(point: np.ndarray) -> np.ndarray:
        return point @ pose[:3, :3].T

    shapes: list[Shape] = [
        Surface(vertex=moved(sheet.vertex), faces=sheet.faces, color=sheet.color, shading=0.5),
        Balls(center=moved(balls.center), radius=balls.radius, color=balls.color, shading=0.7),
    ]
    light = np.array([0.2, -0.9, 0.1])
    expected = render(view, [sheet, balls], light=light).astype(int)
    image = render(turned, shapes, light=moved(light))
    assert (abs(image - expected).max(axis=-1) <= 1).mean() > 0.999


def test_a_sheer_surface_lets_through_what_is_behind_it_and_not_what_is_before() -> None:
    sheet = wall(0.3, 2.0, GRAY, opacity=0.75)
    behind, before = (
        wall(0.9, 3.0, RED),
        Surface(vertex=square(0.1, 0, 0.02, 1.0), faces=QUAD, color=BLUE),
    )
    for shapes in ([sheet, behind, before], [before, behind, sheet]):
        image = render(camera(), shapes, background=(255, 255, 255))[..., :3].astype(int)
        np.testing.assert_allclose(image[30, 35], 0.75 * 100 + 0.25 * RED[0], atol=1)
        np.testing.assert_allclose(image[30, 50], BLUE[0], atol=1)
    alone = render(camera(), [sheet])
    assert tuple(alone[30, 40]) == (100, 100, 100, 191)
    both = render(camera(), [sheet, wall(0.9, 3.0, RED, opacity=0.5)])
    cover = 0.75 + 0.25 * 0.5
    color = (0.75 * 100 + 0.25 * 0.5 * RED[0]) / cover
    np.testing.assert_allclose(both[30, 40], [*color, 255 * cover], atol=1)


def test_several_sheer_surfaces_are_laid_over_each_other_from_the_farthest_on() -> None:
    colors = [np.array([color]) for color in ([250.0, 0, 0], [0, 250.0, 0], [0, 0, 250.0])]
    sheets = [wall(0.3, 2.0 - 0.3 * n, color, opacity=0.5) for n, color in enumerate(colors)]
    expected = np.zeros(3)
    for color in colors:
        expected = 0.5 * expected + 0.5 * color[0]
    for order in ([0, 1, 2], [2, 1, 0], [1, 2, 0]):
        shapes = [sheets[number] for number in order]
        image = render(camera(), shapes, background=(0, 0, 0))
        np.testing.assert_allclose(image[30, 40, :3], expected, atol=1)
    # Of one sheer surface only the nearest sheet is seen.
    two = np.concatenate([square(0, 0, 0.3, 2), square(0, 0, 0.3, 2.5)])
    shape = Surface(vertex=two, faces=np.concatenate([QUAD, QUAD + 4]), color=RED, opacity=0.5)
    assert tuple(render(camera(), [shape])[30, 40]) == (200, 0, 0, 128)


@pytest.mark.parametrize("width", [1.0, 3.0])
def test_segments_are_as_wide_near_the_camera_as_far_away(width: float) -> None:
    ends = np.array([[[-0.3, -0.2, 0.8], [3.0, 1.0, 9.0]]])
    image = render(camera(), [Segments(ends=ends, width=width, color=RED)], samples=4)
    pixel = camera().project(ends[0])
    length = np.linalg.norm(pixel[1] - pixel[0])
    assert image[..., 3].sum() / 255 == pytest.approx(width * length, rel=0.03)
    sums = image[..., 3].astype(float).sum(axis=0)[15:50] / 255
    slope = (pixel[1, 1] - pixel[0, 1]) / (pixel[1, 0] - pixel[0, 0])
    np.testing.assert_allclose(sums, width * np.hypot(1, slope), atol=0.3)
    rows, columns = np.nonzero(image[..., 3] > 100)
    off = rows - pixel[0, 1] - slope * (columns - pixel[0, 0])
    assert abs(off).max() < 0.5 * width * np.hypot(1, slope) + 0.5


def test_a_segment_ends_at_the_camera_and_shows_on_the_surface_that_it_lies_in() -> None:
    line = np.array([[[0.0, 0.2, -5.0], [0.0, 0.2, 5.0]]])  # Comes from behind the camera.
    seen = render(camera(), [Segments(ends=line, width=3.0, color=RED)])[..., 3] > 128
    assert seen[40:, 39].all()
    assert not seen[:33].any()
    on = np.array([[[-0.2, 0.0, 1.0], [0.2, 0.0, 1.0]]])
    image = render(camera(), [wall(0.4, 1.0, GRAY), Segments(ends=on, width=2.0, color=RED)])
    assert (image[29:31, 22:58] == [200, 0, 0, 255]).all()
    behind = np.array([[[-0.2, 0.0, 1.1], [0.2, 0.0, 1.1]]])
    image = render(camera(), [wall(0.4, 1.0, GRAY), Segments(ends=behind, width=2.0, color=RED)])
    assert (image[30, :, 0] == 100).all()


def test_arrows_have_a_tube_and_a_cone() -> None:
    ends = np.array([[[-0.3, 0, 1.0], [0.3, 0, 1.0]], [[0.0, 0.2, 1], [0.0, 0.2, 1]]])
    shape = arrows(
        ends, radius=0.02, head_radius=0.1, head_length=0.2, color=np.vstack([RED, BLUE])
    )
    image = render(camera(), [shape], samples=4)
    assert (image[..., 2] == 0).all()  # One without a length is nothing.
    wide = image[..., 3].astype(float).sum(axis=0) / 255
    middle = 39.5
    assert wide[round(middle - 15)] == pytest.approx(2 * FOCAL * 0.02, rel=0.1)
    for x in (0.12, 0.2, 0.28):
        expected = 2 * FOCAL * 0.1 * (0.3 - x) / 0.2
        assert wide[round(middle + FOCAL * x)] == pytest.approx(expected, abs=1.0)
    assert not wide[round(middle + 32) :].any()
    # Seen from the tip it is a disk, and a short one is all head.
    tip = np.array([[[0.0, 0, 1.3], [0, 0, 1.0]]])
    image = render(
        camera(), [arrows(tip, radius=0.02, head_radius=0.1, head_length=0.2, color=RED)], samples=4
    )
    assert image[..., 3].sum() / 255 == pytest.approx(np.pi * (FOCAL * 0.1 / 1.2) ** 2, rel=0.06)
    short = arrows(ends[:1] / 6, radius=0.02, head_radius=0.1, head_length=0.2, color=RED)
    extent = np.ptp(short.vertex, axis=0)
    np.testing.assert_allclose(extent, [0.1, 0.1, 0.1], rtol=0.05)
    assert len(arrows(ends[1:], radius=1.0, head_radius=1.0, head_length=1.0, color=RED).faces) == 0


def test_an_image_lies_between_its_corners_as_a_plane_is_seen() -> None:
    random = np.random.default_rng(3)
    shown = np.kron(random.integers(0, 255, (4, 6, 3)), np.ones((8, 8, 1))).astype(np.uint8)
    corner = np.array([[-0.5, -0.3, 1.0], [0.6, -0.3, 1.8], [0.6, 0.4, 1.8], [-0.5, 0.4, 1.0]])
    image = render(camera(), [Image(corner=corner, image=shown)], samples=1)
    # Middles of the patches in the world.
    rows, columns = np.mgrid[:4, :6]
    u, v = ((columns + 0.5) / 6)[..., None], ((rows + 0.5) / 4)[..., None]
    place = corner[0] + u * (corner[1] - corner[0]) + v * (corner[3] - corner[0])
    pixel = camera().project(place).round().astype(int)
    np.testing.assert_array_equal(image[pixel[..., 1], pixel[..., 0], :3], shown[4::8, 4::8])
    two = [
        Image(corner=corner - [0, 0, 0.2], image=shown),
        Image(corner=corner, image=shown[:, ::-1]),
    ]
    np.testing.assert_array_equal(
        render(camera(), two), render(camera(), [two[0], wall(0.01, 5.0, RED)])
    )


def test_pictures_are_the_same_every_time() -> None:
    view, shapes = crowd()
    first = render(view, shapes, background=(9, 9, 9))
    np.testing.assert_array_equal(first, render(view, shapes, background=(9, 9, 9)))
    nothing = render(view, [], background=(20, 21, 23))
    assert (nothing == [20, 21, 23, 255]).all()
    assert (render(view, []) == 0).all()


@pytest.mark.gpu
def test_a_graphics_card_draws_what_a_processor_draws() -> None:
    if not (wp.is_cuda_available() and wp.is_cpu_available()):
        pytest.skip("needs a CUDA device, and a Warp that compiles for the processor")
    view, shapes = crowd()
    ours, theirs = render(view, shapes), render(view, shapes, device="cuda:0")
    np.testing.assert_array_equal(theirs, render(view, shapes, device="cuda:0"))
    assert (abs(ours.astype(int) - theirs).max(axis=-1) <= 1).mean() > 0.995
