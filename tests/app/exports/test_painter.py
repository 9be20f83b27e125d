"""The painter, against projections and areas worked out by hand."""

import math

import numpy as np
import pytest

from app.exports.painter import BACKGROUND, paint_scene, visible_from
from app.exports.primitives import Part, parts_of
from app.viewer.content.session_state import Pose
from app.viewer.scene.scene_server import start_viser

RED, BLUE = np.array([[200.0, 10.0, 10.0]]), np.array([[10.0, 10.0, 200.0]])
UP = np.array([0.0, 0.0, 1.0])


def pose(fov: float = 60.0) -> Pose:
    """A camera at (0, -2, 1) that looks along +y: right is +x, down is -z."""
    at = np.array([0.0, -2.0, 1.0])
    return Pose(position=at, look_at=np.array([0.0, 0.0, 1.0]), up=UP, fov=math.radians(fov))


def disk(place: tuple[float, float, float], color: np.ndarray, size: float) -> Part:
    return Part(kind="disk", point=np.array([[place]]), color=color, size=size)


def covered(image: np.ndarray, channel: int) -> np.ndarray:
    """Pixels in which one color outshines the others."""
    rest = [c for c in range(3) if c != channel]
    return (image[..., channel].astype(int) - image[..., rest].max(axis=-1)) > 60


def test_a_disk_is_where_and_as_large_as_the_pinhole_says() -> None:
    place, size, width, height = (0.4, 1.0, 1.5), 0.3, 400, 300
    image = paint_scene([disk(place, RED, size)], pose(), width, height)
    assert image.shape == (height, width, 3)
    focal = 0.5 * height / math.tan(math.radians(30))
    depth = place[1] + 2.0
    row, column = np.nonzero(covered(image, 0))
    assert column.mean() == pytest.approx((width - 1) / 2 + focal * place[0] / depth, abs=0.6)
    assert row.mean() == pytest.approx((height - 1) / 2 - focal * (place[2] - 1) / depth, abs=0.6)
    assert len(row) == pytest.approx(math.pi * (0.5 * size * focal / depth) ** 2, rel=0.07)
    assert tuple(image[0, 0]) == BACKGROUND[False]


def test_a_tall_picture_has_no_seam_between_its_strips() -> None:
    height = 1_300
    image = paint_scene([disk((0.0, 0.0, 1.0), RED, 2.0)], pose(), 800, height)
    seen = covered(image, 0)
    focal = 0.5 * height / math.tan(math.radians(30))
    assert seen.sum(axis=1).max() == pytest.approx(min(800, 2 * 0.5 * focal), abs=2)
    np.testing.assert_array_equal(seen, seen[::-1])
    for row in (512, 1024):
        assert abs(int(seen[row].sum()) - int(seen[row - 1].sum())) <= 4
    assert seen.any(axis=1).sum() == pytest.approx(focal, abs=3)


def test_the_nearer_shape_hides_the_farther_one_in_whatever_order_they_come() -> None:
    near, far = disk((0.0, 0.0, 1.0), RED, 0.2), disk((0.0, 3.0, 1.0), BLUE, 2.0)
    first, second = (paint_scene(parts, pose(), 200, 200) for parts in ([near, far], [far, near]))
    np.testing.assert_array_equal(first, second)
    assert covered(first, 0)[100, 100]
    assert covered(first, 2)[100, 130]


def test_a_sheer_surface_lets_through_what_is_behind_it_and_not_what_is_before() -> None:
    square = np.array([[[-1, 0, 0], [1, 0, 0], [1, 0, 2]], [[-1, 0, 0], [1, 0, 2], [-1, 0, 2]]])
    gray = np.full((2, 3), 100.0)
    sheet = Part(kind="triangle", point=square.astype(float), color=gray, opacity=0.75)
    behind, before = disk((-0.5, 1.0, 1.0), RED, 0.4), disk((0.3, -1.0, 1.0), BLUE, 0.2)
    image = paint_scene([sheet, behind, before], pose(), 300, 300).astype(int)
    focal = 150 / math.tan(math.radians(30))
    through = image[150, round(149.5 - 0.5 * focal / 3)]
    np.testing.assert_allclose(through, 0.75 * 100 + 0.25 * RED[0], atol=2)
    np.testing.assert_allclose(image[150, round(149.5 + 0.3 * focal)], BLUE[0], atol=2)
    np.testing.assert_allclose(image[150, 150], 0.75 * 100 + 0.25 * 255, atol=2)


def test_lines_arrows_and_pictures_are_drawn_up_to_the_camera() -> None:
    line = np.array([[[0.0, -5.0, 0.8], [0.0, 5.0, 0.8]]])  # Comes from behind the camera.
    image = paint_scene([Part(kind="line", point=line, color=RED, size=3.0)], pose(), 200, 200)
    seen = covered(image, 0)
    assert seen[-1, 96:104].any()
    assert not seen[:100].any()
    arrow = np.array([[[-0.5, 0.0, 1.0], [0.5, 0.0, 1.0]]])
    part = Part(kind="arrow", point=arrow, color=BLUE, size=0.02, head=(0.1, 0.3))
    seen = covered(paint_scene([part], pose(), 400, 400), 2)
    rows = seen.sum(axis=0)
    focal = 200 / math.tan(math.radians(30))
    neck = round(199.5 + 0.5 * 0.2 * focal)
    assert rows[neck + 3] == pytest.approx(2 * 0.1 * focal / 2, abs=6)  # The head is wide there.
    assert rows[neck - 9] == pytest.approx(0.04 * focal / 2, abs=2)
    corner = np.array([[[-0.5, 0, 1.5], [0.5, 0, 1.5], [0.5, 0, 0.5], [-0.5, 0, 0.5]]])
    shown = np.zeros((64, 64, 3), np.uint8)
    shown[:32, :32] = (250, 0, 0)
    picture = Part(kind="picture", point=corner, color=RED, image=shown)
    seen = covered(paint_scene([picture], pose(), 200, 200), 0)
    assert seen[75, 75]
    assert not seen[75, 125]
    assert not seen[125, 75]
    assert seen.sum() == pytest.approx((0.5 * 100 / math.tan(math.radians(30)) / 2) ** 2, rel=0.06)


def test_what_is_behind_the_camera_or_far_outside_is_left_out() -> None:
    behind, aside = disk((0.0, -3.0, 1.0), RED, 1.0), disk((1e7, 0.0, 1.0), RED, 1.0)
    assert (paint_scene([behind, aside], pose(), 64, 48) == 255).all()
    dark = paint_scene([], pose(), 64, 48, is_dark=True)
    assert (dark == BACKGROUND[True]).all()


def test_the_parts_of_a_scene_are_found_where_their_nodes_are() -> None:
    server = start_viser("parts")
    try:
        scene = server.scene
        scene.add_frame("/turned", wxyz=(math.sqrt(0.5), 0, 0, math.sqrt(0.5)), position=(1, 0, 0))
        scene.add_point_cloud(
            "/turned/points", np.array([[0.5, 0.0, 0.2]], np.float32), (1, 2, 3), point_size=0.1
        )
        scene.add_line_segments("/lines", np.ones((4, 2, 3), np.float32), (9, 9, 9), thickness=2.0)
        ends = np.full((4, 2, 3), 55, np.uint8)
        scene.add_line_segments("/painted", np.ones((4, 2, 3), np.float32), ends, thickness=2.0)
        hidden = scene.add_frame("/hidden")
        scene.add_point_cloud("/hidden/points", np.zeros((2, 3), np.float32), (0, 0, 0))
        hidden.visible = False
        scene.add_camera_frustum(
            "/camera", fov=1.0, aspect=1.5, scale=0.3, image=np.zeros((4, 6, 3), np.uint8)
        )
        parts = list(parts_of(server))
    finally:
        server.stop()
    assert [part.kind for part in parts] == ["disk", "line", "line", "picture", "line"]
    np.testing.assert_allclose(parts[0].point, [[[1.0, 0.5, 0.2]]], atol=1e-3)
    assert parts[0].size == pytest.approx(0.2)
    np.testing.assert_array_equal(parts[0].color, [[1, 2, 3]])
    np.testing.assert_array_equal(parts[1].color, np.full((4, 3), 9))
    # An amount of light of 0.2158 is shown as sRGB 128: what viser does to ends with colors.
    np.testing.assert_allclose(parts[2].color, 128, atol=1)
    corners = parts[3].point[0]
    wide, high = corners[1] - corners[0], corners[3] - corners[0]
    assert np.linalg.norm(wide) / np.linalg.norm(high) == pytest.approx(1.5)
    assert np.linalg.norm(high) / corners[0][2] == pytest.approx(2 * math.tan(0.5))
    at_camera = Pose(position=np.zeros(3), look_at=UP, up=np.array([0, 1.0, 0]), fov=1.0)
    assert len(visible_from(parts, at_camera)[4].point) == 4  # Of eight edges, four end there.
