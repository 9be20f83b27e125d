"""Discs of known size before a camera that looks straight down."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from physhandi.data.camera import PinholeCamera
from physhandi.data.view import View
from physhandi.metrics.photometric import (
    Drawing,
    draw_nodes,
    photometric_curves,
    seen_colors,
    shaded_psnr,
    silhouette_iou,
)

CAMERA = PinholeCamera(
    K=np.array([[100.0, 0, 40], [0, 100.0, 30], [0, 0, 1]]),
    T_world_camera=np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 1], [0, 0, 0, 1]]),
    width=80,
    height=60,
)
"""At height 1 above the origin, looking down: x is to the right, y up in the image."""
RED, BLUE = (200, 0, 0), (0, 0, 200)


def colors(*values: tuple[int, int, int]) -> np.ndarray:
    return np.array(values, dtype=np.uint8)


def test_a_disc_is_where_and_as_large_as_the_camera_sees_it() -> None:
    drawing = draw_nodes(CAMERA, np.array([[0.1, 0.05, 0.0]]), colors(RED), 0.08)
    rows, columns = np.nonzero(drawing.is_covered)
    assert (rows.mean(), columns.mean()) == pytest.approx((25.0, 50.0))
    assert drawing.is_covered.sum() == pytest.approx(np.pi * 8.0**2, rel=0.1)
    assert drawing.image[25, 50].tolist() == list(RED)
    nearer = draw_nodes(CAMERA, np.array([[0.0, 0.0, 0.5]]), colors(RED), 0.08)
    assert nearer.is_covered.sum() == pytest.approx(np.pi * 16.0**2, rel=0.1)


@pytest.mark.parametrize("order", [[0, 1], [1, 0]])
def test_the_nearer_node_hides_the_farther_one(order: list[int]) -> None:
    node = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.3], [0.0, 0.0, 1.5]])[[*order, 2]]
    drawing = draw_nodes(CAMERA, node, colors(*[(RED, BLUE)[i] for i in order], RED), 0.02)
    assert drawing.image[30, 40].tolist() == list(BLUE)


def halves() -> Drawing:
    covered = np.zeros((60, 80), dtype=bool)
    covered[:, :40] = True
    image = np.where(covered[..., None], np.array(RED, np.uint8), np.uint8(0))
    return Drawing(image=image, is_covered=covered)


def test_iou_counts_pixels_without_hands() -> None:
    mask = np.zeros((60, 80), dtype=np.uint8)
    mask[:, 20:60] = 1
    assert silhouette_iou(halves(), mask) == pytest.approx(20 / 60)
    mask[:, :20] = 2  # A hand hides what is drawn there.
    assert silhouette_iou(halves(), mask) == pytest.approx(20 / 40)
    assert np.isnan(silhouette_iou(halves(), np.full((60, 80), 3, dtype=np.uint8)))


def test_psnr_is_that_of_opencv() -> None:
    random = np.random.default_rng(0)
    color = random.integers(0, 256, (60, 80, 3)).astype(np.uint8)
    whole = np.ones((60, 80), dtype=np.uint8)
    assert shaded_psnr(halves(), color, whole) == pytest.approx(cv2.PSNR(halves().image, color))
    hand = np.full((60, 80), 2, dtype=np.uint8)
    assert shaded_psnr(halves(), color, hand) > 100  # Nothing is left to compare.
    mask = whole.copy()
    mask[:, 40:] = 0
    red = np.full((60, 80, 3), RED, dtype=np.uint8)
    assert shaded_psnr(halves(), red, mask) > 100


@pytest.fixture
def view(tmp_path: Path) -> View:
    """Two frames: a red object left and a blue one right of the middle, then all one column on."""
    for kind in ("color", "mask"):
        (tmp_path / kind).mkdir()
    for frame in range(2):
        mask = np.zeros((60, 80), dtype=np.uint8)
        mask[20:40, 20 + 10 * frame : 60 + 10 * frame] = 1
        color = np.zeros((60, 80, 3), dtype=np.uint8)
        color[:, : 40 + 10 * frame] = RED
        color[:, 40 + 10 * frame :] = BLUE
        cv2.imwrite(str(tmp_path / f"mask/{frame:05d}.png"), mask)
        cv2.imwrite(str(tmp_path / f"color/{frame:05d}.png"), color[..., ::-1])
    return View(tmp_path, "scene", CAMERA, 2)


def grid() -> np.ndarray:
    """Nodes every 2 cm, so every 2 px, over what frame 0 shows, and one beside it."""
    x, y = np.meshgrid(np.arange(-0.19, 0.2, 0.02), np.arange(-0.09, 0.1, 0.02))
    node = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    return np.concatenate([node, [[0.21, 0.0, 0.0]]])


def test_nodes_have_the_color_of_their_pixel_or_of_their_neighbour(view: View) -> None:
    found = seen_colors([view], grid())
    assert found is not None
    node = grid()
    np.testing.assert_array_equal(found[node[:, 0] < 0], np.broadcast_to(RED, (100, 3)))
    np.testing.assert_array_equal(found[node[:, 0] > 0], np.broadcast_to(BLUE, (101, 3)))
    assert seen_colors([view], grid() + np.array([0.0, 5.0, 0.0])) is None


def test_views_that_look_straight_at_a_surface_decide_its_color(view: View, tmp_path: Path) -> None:
    folder = tmp_path / "aside"
    blue_first = np.full((60, 80, 3), BLUE[::-1], np.uint8)
    for kind, image in (("color", blue_first), ("mask", np.ones((60, 80), np.uint8))):
        (folder / kind).mkdir(parents=True)
        cv2.imwrite(str(folder / kind / "00000.png"), image)
    half, high = 0.5, np.sqrt(0.75)  # It looks at the origin from 60° beside the vertical.
    pose = np.eye(4)
    pose[:3] = [[half, 0, -high, high], [0, -1, 0, 0], [-high, 0, -half, half]]
    aside = View(folder, "scene", replace(CAMERA, T_world_camera=pose), 1)
    point, up = np.array([[-0.02, 0.0, 0.0]]), np.array([[0.0, 0.0, -1.0]])
    both = seen_colors([view, aside], point)
    np.testing.assert_allclose(both, [[100, 0, 100]], atol=1)
    # The cosine of 60° to the fourth power is 1/16.
    straight = seen_colors([view, aside], point, up)
    np.testing.assert_allclose(straight, [[200 * 16 / 17, 0, 200 / 17]], atol=1)


def test_with_normals_pixels_at_the_outline_lend_no_color(view: View) -> None:
    rim = np.array([[-0.2, 0.0, 0.0], [-0.18, 0.0, 0.0]])
    image = view.color(0)
    image[30, 20] = (0, 255, 0)
    cv2.imwrite(str(next(iter(view.files("color")))), image[..., ::-1])
    up = np.tile([0.0, 0.0, 1.0], (2, 1))
    assert seen_colors([view], rim)[0].tolist() == [0, 255, 0]
    assert seen_colors([view], rim, up).tolist() == [list(RED), list(RED)]


def test_the_right_motion_beats_standing_still(view: View) -> None:
    still = np.stack([grid(), grid()])
    right = np.stack([grid(), grid() + np.array([0.1, 0.0, 0.0])])
    stood, moved = (photometric_curves([view], rollout) for rollout in (still, right))
    # Pixels that lie within a disc of 2 px about a node, told by distance.
    row, column = np.mgrid[:60, :80]
    place = np.stack([(column - 40) / 100, (30 - row) / 100], axis=-1)
    gap = np.linalg.norm(place[:, :, None] - grid()[:, :2], axis=-1).min(axis=-1)
    drawn = gap < 0.0205
    for frame, curves in ((0, stood), (0, moved), (1, stood)):
        seen = view.mask(frame) == 1
        expected = (seen & drawn).sum() / (seen | drawn).sum()
        assert curves["iou"][frame] == pytest.approx(expected, abs=0.02)
    assert moved["iou"][1] == pytest.approx(moved["iou"][0], abs=0.02)
    assert stood["iou"][1] < moved["iou"][1] - 0.2
    assert moved["psnr"][1] > stood["psnr"][1] + 1.0


def test_without_masks_there_is_nothing_to_compare_with(view: View, tmp_path: Path) -> None:
    bare = View(tmp_path / "nothing", "scene", CAMERA, 2)
    assert photometric_curves([bare], np.stack([grid(), grid()])) == {}
