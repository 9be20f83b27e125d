"""Pictures of viser scenes, against projections and areas worked out by hand."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import viser

from app.exports.scene_picture import BACKGROUND, draw_scene
from app.viewer.content.session_state import Pose
from app.viewer.scene.nodes import with_mean
from app.viewer.scene.scene_server import start_viser

RED, BLUE, GRAY = (200, 10, 10), (10, 10, 200), (100, 100, 100)
UP = np.array([0.0, 0.0, 1.0])
SQUARE = np.array([[-1, 0, 0], [1, 0, 0], [1, 0, 2], [-1, 0, 2]], np.float32)
QUAD = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
FOCAL = 0.5 / math.tan(math.radians(30))
"""Of `POSE`, in heights of the picture."""
POSE = Pose(
    position=np.array([0.0, -2.0, 1.0]),
    look_at=np.array([0.0, 0.0, 1.0]),
    up=UP,
    fov=math.radians(60),
)
"""A camera that looks along +y: right is +x, down is -z."""


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    server = start_viser("pictures")
    yield server
    server.stop()


@pytest.fixture
def scene(server: viser.ViserServer) -> Any:
    server.scene.reset()
    return server.scene


def draw(server: viser.ViserServer, size: tuple[int, int] = (200, 200), **options: Any) -> Any:
    return draw_scene(server, POSE, *size, **options).astype(int)


def covered(image: np.ndarray, channel: int) -> np.ndarray:
    """Pixels in which one color outshines the others."""
    rest = [c for c in range(3) if c != channel]
    return (image[..., channel] - image[..., rest].max(axis=-1)) > 60


def add_point(scene: Any, name: str, place: tuple[float, ...], color: Any, radius: float) -> None:
    scene.add_point_cloud(
        name, np.array([place], np.float32), color, point_size=radius, precision="float32"
    )


def test_a_point_is_where_and_as_large_as_the_pinhole_says(
    server: viser.ViserServer, scene: Any
) -> None:
    place, radius, (width, height) = (0.4, 1.0, 1.5), 0.15, (400, 300)
    add_point(scene, "/point", place, RED, radius)
    image = draw(server, (width, height))
    assert image.shape == (height, width, 3)
    focal, depth = FOCAL * height, place[1] + 2.0
    row, column = np.nonzero(covered(image, 0))
    assert column.mean() == pytest.approx((width - 1) / 2 + focal * place[0] / depth, abs=0.3)
    assert row.mean() == pytest.approx((height - 1) / 2 - focal * (place[2] - 1) / depth, abs=0.3)
    assert len(row) == pytest.approx(math.pi * (radius * focal / depth) ** 2, rel=0.05)
    assert tuple(image[0, 0]) == BACKGROUND[False]


def test_a_point_too_far_away_to_be_seen_still_leaves_a_mark(
    server: viser.ViserServer, scene: Any
) -> None:
    add_point(scene, "/point", (0.0, 50.0, 1.0), (0, 0, 0), 0.001)
    assert (255 - draw(server)).sum() / 255 / 3 == pytest.approx(math.pi / 4, abs=0.3)


def test_a_sheer_surface_lets_through_what_is_behind_it_and_not_what_is_before(
    server: viser.ViserServer, scene: Any
) -> None:
    scene.add_mesh_simple("/sheet", SQUARE, QUAD, color=GRAY, opacity=0.75, side="double")
    add_point(scene, "/behind", (-0.5, 1.0, 1.0), RED, 0.2)
    add_point(scene, "/before", (0.3, -1.0, 1.0), BLUE, 0.1)
    image = draw(server, (300, 300))
    focal = FOCAL * 300
    # The light falls on it from a direction of which this is the part along its normal.
    facing = 0.35 / math.sqrt(0.25**2 + 0.35**2 + 0.9**2)
    gray = 100 * (1 - 0.2 * (1 - facing))
    np.testing.assert_allclose(image[150, 150], 0.75 * gray + 0.25 * 255, atol=1)
    through = image[150, round(149.5 - 0.5 * focal / 3)]
    np.testing.assert_allclose(through, 0.75 * gray + 0.25 * np.array(RED), atol=2)
    np.testing.assert_allclose(image[150, round(149.5 + 0.3 * focal)], BLUE, atol=2)
    scene.add_mesh_simple("/sheet", SQUARE, QUAD, color=GRAY, side="double")
    assert not covered(draw(server, (300, 300)), 0).any()


def test_facets_have_a_color_each_and_smooth_surfaces_blend(
    server: viser.ViserServer, scene: Any
) -> None:
    roof = np.array([[-1, 0, 0.5], [0, 0.8, 1], [1, 0, 0.5], [0, 0, 1.9]], np.float32)
    faces = np.array([[0, 1, 3], [1, 2, 3]], np.uint32)
    for is_flat in (True, False):
        scene.add_mesh_simple(
            "/roof", roof, faces, color=(200, 200, 200), flat_shading=is_flat, side="double"
        )
        image = draw(server, (300, 300))
        shades, pixels = np.unique(image[..., 0], return_counts=True)
        count = int(((pixels > 500) & (shades != 255)).sum())
        assert (count == 2) if is_flat else (count > 6)


def test_lines_are_as_wide_as_in_a_window_of_800_rows(
    server: viser.ViserServer, scene: Any
) -> None:
    line = np.array([[[0.0, -5.0, 0.5], [0.0, 5.0, 0.5]]], np.float32)  # From behind the camera.
    scene.add_line_segments("/line", line, RED, thickness=4.0, thickness_units="screen")
    for height in (200, 800):
        image = draw(server, (200, height))
        ink = (255 - image[..., 1]).sum(axis=1) / 245
        assert ink[-1] == pytest.approx(max(4.0 * height / 800, 0.5), abs=0.1)
        assert not ink[: height // 2].any()


def test_colors_of_line_ends_are_amounts_of_light(server: viser.ViserServer, scene: Any) -> None:
    # An amount of light of 0.2158 is shown as sRGB 128.
    line = np.array([[[-1.0, 0.0, 1.0], [1.0, 0.0, 1.0]]], np.float32)
    scene.add_line_segments("/line", line, np.full((1, 2, 3), 55, np.uint8), thickness=40.0)
    np.testing.assert_allclose(draw(server)[100, 100], 128, atol=1)


def test_an_arrow_ends_in_a_cone(server: viser.ViserServer, scene: Any) -> None:
    arrow = np.array([[[-0.5, 0.0, 1.0], [0.5, 0.0, 1.0]]], np.float32)
    scene.add_arrows("/arrow", arrow, BLUE, shaft_radius=0.02, head_radius=0.1, head_length=0.3)
    rows = covered(draw(server, (400, 400)), 2).sum(axis=0)
    focal = FOCAL * 400
    neck = round(199.5 + 0.5 * 0.2 * focal)
    assert rows[neck + 3] == pytest.approx(2 * 0.1 * focal / 2, abs=6)  # The head is wide there.
    assert rows[neck - 9] == pytest.approx(0.04 * focal / 2, abs=2)


def test_many_small_meshes_are_at_their_places(server: viser.ViserServer, scene: Any) -> None:
    corner = np.array([[0, 0, 0.1], [0.1, 0, -0.05], [-0.1, 0, -0.05]], np.float32)
    place = np.array([[-0.5, 0, 1], [0.5, 0, 1.4]], np.float32)
    turn = np.array([[1.0, 0, 0, 0], [0, 0, 1.0, 0]], np.float32)  # The second is upside down.
    scene.add_batched_meshes_simple(
        "/balls", corner, np.array([[0, 1, 2]], np.uint32), turn, place,
        batched_colors=np.array([RED, BLUE], np.uint8),
    )  # fmt: skip
    image, focal = draw(server, (400, 400)), FOCAL * 400
    for channel, (x, _, z), tip in ((0, place[0], 1), (2, place[1], -1)):
        row, column = np.nonzero(covered(image, channel))
        assert column.mean() == pytest.approx(199.5 + focal * x / 2, abs=0.6)
        assert row.mean() == pytest.approx(199.5 - focal * (z - 1) / 2, abs=0.6)
        assert len(row) == pytest.approx(0.015 * (focal / 2) ** 2, rel=0.1)
        widest = row[np.argmax(np.abs(column - column.mean()))]
        assert (widest - row.mean()) * tip > 0


def test_a_camera_is_drawn_with_its_image_and_its_edges(
    server: viser.ViserServer, scene: Any
) -> None:
    shown = np.zeros((64, 96, 3), np.uint8)
    shown[:32, :48] = (250, 0, 0)
    turned = (math.sqrt(0.5), -math.sqrt(0.5), 0.0, 0.0)  # Looks along +y.
    fov = 2 * math.atan(0.25)
    camera = scene.add_camera_frustum(
        "/camera", fov=fov, aspect=1.5, scale=1.0, image=shown, color=(0, 0, 200), wxyz=turned,
        position=(0.0, -1.0, 1.0),
    )  # fmt: skip
    image = draw(server, (300, 300))
    # viser's scale is the edge of a cube of three times the volume of the frustum.
    depth = 1 / math.cbrt(0.25**2 * 1.5 / 3)
    high, wide = (FOCAL * 300 * 0.25 * side * depth / (depth + 1) for side in (1.0, 1.5))
    red = covered(image, 0)
    assert red.sum() == pytest.approx(high * wide, rel=0.05)
    row, column = np.nonzero(red)
    assert row.mean() == pytest.approx(149.5 - high / 2, abs=1)
    assert column.mean() == pytest.approx(149.5 - wide / 2, abs=1)
    diagonal = round(0.5 * wide)
    assert image[round(149.5 + diagonal * high / wide), 149 + diagonal, 2] > 100
    # From where it stands itself only the frame around the image is seen.
    camera.position = POSE.position
    inner = draw(server, (300, 300))
    assert covered(inner, 2).sum() < 0.05 * inner[..., 0].size
    half = FOCAL * 300 * 0.25 - 6
    window = inner[round(149.5 - half) : 150, 152 : round(149.5 + 1.5 * half)]
    assert (window.max(axis=-1) <= 2).all()


def test_a_grid_fades_away_and_lies_below_what_lies_on_it(
    server: viser.ViserServer, scene: Any
) -> None:
    scene.add_grid(
        "/ground", width=4.0, height=4.0, cell_size=0.5, section_size=1.0, cell_color=(0, 0, 0),
        section_color=(0, 0, 0), section_thickness=2.0, fade_distance=4.0,
    )  # fmt: skip
    flat = np.array([[-0.4, -0.4, 0], [0.4, -0.4, 0], [0.4, 0.4, 0], [-0.4, 0.4, 0]], np.float32)
    image = draw(server, (400, 400))
    near, far = image[360:].min(), image[295:310].min()
    assert near < 130
    assert near + 30 < far < 255
    assert (image[:199] == 255).all()
    scene.add_mesh_simple("/sheet", flat, QUAD, color=(250, 250, 0), side="double")
    image = draw(server, (400, 400))
    inside = image[round(199.5 + FOCAL * 400 / 2.3) : round(199.5 + FOCAL * 400 / 1.7), 160:240]
    assert (inside[..., 2] == 0).all()


def add_splat(scene: Any, name: str, place: tuple[float, ...], color: Any, width: float) -> None:
    """Add a splat with an opacity of 0.8 in a node that is elsewhere, turned and scaled."""
    scene.add_gaussian_splats(
        name,
        np.array([[0.5, 0.0, 0.0]]),
        np.eye(3)[None] * (2.0 * width) ** 2,
        np.array([color]) / 255,
        np.array([[0.8]]),
        scale=0.5,
        wxyz=(math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)),
        position=np.array(place) - [0.0, 0.25, 0.0],
    )


def test_splats_cover_what_is_behind_them_by_their_opacity(
    server: viser.ViserServer, scene: Any
) -> None:
    add_splat(scene, "/cloud/near", (0.0, 0.0, 1.0), RED, 0.1)
    image = draw(server)
    expected = 0.8 * np.array(RED) + 0.2 * 255
    np.testing.assert_allclose(image[100, 100], expected, atol=4)
    # One deviation aside, at a distance of 2 m; the nearest pixels are half a pixel off.
    aside = 100 + round(0.1 / 2.0 * FOCAL * 200)
    share = 0.8 * math.exp(-0.5)
    np.testing.assert_allclose(image[100, aside, 0], share * 200 + (1 - share) * 255, atol=6)
    np.testing.assert_allclose(image[100, aside, 1], share * 10 + (1 - share) * 255, atol=12)
    assert (image[20, 20] == 255).all()


def test_splats_and_surfaces_hide_each_other(server: viser.ViserServer, scene: Any) -> None:
    wall = SQUARE + np.array([0.0, 1.0, 0.0], np.float32)
    scene.add_mesh_simple("/wall", wall, QUAD, color=GRAY, side="double")
    add_splat(scene, "/cloud/near", (0.0, 0.0, 1.0), RED, 0.1)
    bare = draw(server)[100, 150]
    image = draw(server)
    np.testing.assert_allclose(image[100, 100], 0.8 * np.array(RED) + 0.2 * bare, atol=4)
    scene.remove_by_name("/cloud/near")
    add_splat(scene, "/cloud/far", (0.0, 2.0, 1.0), RED, 0.1)
    np.testing.assert_allclose(draw(server)[100, 100], bare, atol=1)


def test_labels_are_written_over_everything(server: viser.ViserServer, scene: Any) -> None:
    scene.add_mesh_simple("/wall", SQUARE, QUAD, color=(130, 130, 130), side="double")
    scene.add_label(
        "/label", "HHHH\nHHHH", position=(0.0, 1.0, 1.0), font_size_mode="scene",
        font_scene_height=0.3,
    )  # fmt: skip
    for is_dark in (False, True):
        image = draw(server, (300, 300), is_dark=is_dark)
        ink = abs(image - image[150, 20]).max(axis=-1) > 20
        row, column = np.nonzero(ink[90:210, 75:225])
        assert len(row) > 300
        assert column.mean() == pytest.approx(74.5, abs=3)
        assert np.ptp(row) == pytest.approx(2 * 0.3 * FOCAL * 300 / 3, rel=0.3)


def test_what_is_behind_the_camera_far_outside_or_hidden_is_left_out(
    server: viser.ViserServer, scene: Any
) -> None:
    add_point(scene, "/behind", (0.0, -3.0, 1.0), RED, 0.5)
    add_point(scene, "/aside", (1e7, 0.0, 1.0), RED, 0.5)
    scene.add_label("/label", "behind", position=(0.0, -3.0, 1.0))
    hidden = scene.add_frame("/hidden", show_axes=False)
    add_point(scene, "/hidden/points", (0.0, 0.0, 1.0), RED, 0.5)
    hidden.visible = False
    assert (draw(server, (64, 48)) == 255).all()
    assert (draw(server, (64, 48), is_dark=True) == BACKGROUND[True]).all()


def test_nodes_are_placed_by_all_that_they_hang_on(server: viser.ViserServer, scene: Any) -> None:
    turned = (math.sqrt(0.5), 0, 0, math.sqrt(0.5))
    scene.add_frame("/turned", wxyz=turned, position=(0.5, 0, 1), show_axes=False)
    scene.add_frame("/turned/again", position=(0.0, 0.2, 0.0), show_axes=False)
    add_point(scene, "/turned/again/point", (0.5, 0.0, 0.3), RED, 0.05)
    row, column = np.nonzero(covered(draw(server, (300, 300)), 0))
    focal = FOCAL * 300 / 2.5
    assert column.mean() == pytest.approx(149.5 + 0.3 * focal, abs=0.5)
    assert row.mean() == pytest.approx(149.5 - 0.3 * focal, abs=0.5)


def test_colors_of_vertices_follow_that_of_their_mesh(
    server: viser.ViserServer, scene: Any
) -> None:
    mesh = scene.add_mesh_simple("/square", SQUARE, QUAD, side="double")
    top_is_red = np.array([BLUE, BLUE, RED, RED], np.uint8)
    mesh.color = with_mean(top_is_red)
    image = draw(server)
    red, blue = covered(image, 0), covered(image, 2)
    assert red.sum() > 1_000
    assert blue.sum() > 1_000
    assert np.argwhere(red)[:, 0].max() < np.argwhere(blue)[:, 0].min()
    mesh.color = RED
    assert covered(draw(server), 0).sum() > 2 * red.sum()
