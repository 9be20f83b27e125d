"""Scores of pictures against sums written out here, and colors seen by a camera that looks down."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from physhandi.data.camera import PinholeCamera
from physhandi.data.view import View
from physhandi.metrics.photometric import (
    phystwin_scores,
    proper_scores,
    seen_colors,
    structural_similarity,
)

CAMERA = PinholeCamera(
    K=np.array([[100.0, 0, 40], [0, 100.0, 30], [0, 0, 1]]),
    T_world_camera=np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 1], [0, 0, 0, 1]]),
    width=80,
    height=60,
)
"""At height 1 above the origin, looking down: x is to the right, y up in the image."""
RED, BLUE = (200, 0, 0), (0, 0, 200)
SHAPE = (30, 40)


def similarity(one: np.ndarray, other: np.ndarray, row: int, column: int) -> float:
    """SSIM of the window around a pixel of two grey images, as Wang et al. write it."""
    offset = np.arange(-5, 6)
    weight = np.exp(-(offset[:, None] ** 2 + offset[None] ** 2) / (2 * 1.5**2))
    weight /= weight.sum()

    def window(image: np.ndarray) -> np.ndarray:
        return np.pad(image, 5)[row : row + 11, column : column + 11]

    x, y = window(one), window(other)
    mean_x, mean_y = (weight * x).sum(), (weight * y).sum()
    variance_x = (weight * (x - mean_x) ** 2).sum()
    variance_y = (weight * (y - mean_y) ** 2).sum()
    covariance = (weight * (x - mean_x) * (y - mean_y)).sum()
    return ((2 * mean_x * mean_y + 1e-4) * (2 * covariance + 9e-4)) / (
        (mean_x**2 + mean_y**2 + 1e-4) * (variance_x + variance_y + 9e-4)
    )


def mean_similarity(one: np.ndarray, other: np.ndarray, counted: np.ndarray) -> float:
    """Mean SSIM over counted pixels and all channels."""
    found = [
        similarity(one[..., channel], other[..., channel], row, column)
        for row, column in np.argwhere(counted)
        for channel in range(one.shape[2])
    ]
    return float(np.mean(found))


def pictures() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Color and alpha of a picture, and mask and color of a recording that differs from it."""
    random = np.random.default_rng(3)
    mask = np.zeros(SHAPE, np.uint8)
    mask[6:20, 8:24] = 1
    mask[15:18, 10:30] = 2  # A hand that hides a part of the object.
    alpha = np.zeros(SHAPE)
    alpha[5:21, 10:28] = random.uniform(0.6, 1.0, (16, 18))
    alpha[2:5, 10:28] = 0.1  # A rim of which next to nothing is seen.
    color = random.uniform(0.0, 1.0, (*SHAPE, 3)) * alpha[..., None]
    recorded = random.integers(0, 256, (*SHAPE, 3)).astype(np.uint8)
    return color, alpha, mask, recorded


def test_similarity_is_that_of_each_window_written_out() -> None:
    random = np.random.default_rng(1)
    one, other = random.uniform(0, 1, (2, 14, 17, 2))
    other = 0.6 * one + 0.4 * other
    found = structural_similarity(one, other)
    for channel in range(2):
        expected = [
            [
                similarity(one[..., channel], other[..., channel], row, column)
                for column in range(17)
            ]
            for row in range(14)
        ]
        np.testing.assert_allclose(found[..., channel], expected, atol=1e-12)
    assert 0.3 < found.mean() < 0.95


def test_two_even_images_have_the_similarity_and_noise_of_their_difference() -> None:
    mask = np.ones((40, 40), np.uint8)
    recorded = np.full((40, 40, 3), 51, np.uint8)  # 0.2, against 0.3.
    scores = proper_scores(np.full((40, 40, 3), 0.3), np.ones((40, 40)), mask, recorded)
    assert scores.psnr == pytest.approx(20.0)  # -20 log10 of 0.1.
    assert scores.iou == 1.0
    inner = structural_similarity(np.full((40, 40, 1), 0.2), np.full((40, 40, 1), 0.3))[20, 20, 0]
    assert inner == pytest.approx((2 * 0.06 + 1e-4) / (0.04 + 0.09 + 1e-4))
    same = proper_scores(recorded / 255, np.ones((40, 40)), mask, recorded)
    assert (same.psnr, same.ssim, same.iou) == (100.0, pytest.approx(1.0), 1.0)


def test_phystwins_scores_count_the_whole_image_and_any_trace_of_the_picture() -> None:
    color, alpha, mask, recorded = pictures()
    scores = phystwin_scores(color, alpha, mask, recorded)
    seen = np.where((mask == 1)[..., None], recorded, 0)
    shown = np.where((mask == 2)[..., None], 0, np.rint(255 * color)).astype(np.uint8)
    assert scores.psnr == pytest.approx(cv2.PSNR(seen, shown), abs=1e-6)
    whole = np.ones(SHAPE, bool)
    expected = mean_similarity(seen / 255, shown / 255, whole)
    assert scores.ssim == pytest.approx(expected, abs=1e-9)
    # Object: rows 6 to 19, columns 8 to 23, less 3 rows of 14 columns that the hand hides. Picture:
    # rows 2 to 20, columns 10 to 27, less 3 rows of 18 columns.
    is_object, is_drawn = 14 * 16 - 3 * 14, 19 * 18 - 3 * 18
    both = 14 * 14 - 3 * 14
    assert scores.iou == pytest.approx(both / (is_object + is_drawn - both))
    barely = np.full(SHAPE, 0.4 / 255)
    assert phystwin_scores(0 * color, barely, mask, None).iou == 0.0
    assert phystwin_scores(0 * color, 2 * barely, mask, None).iou > 0.0


def test_proper_scores_count_the_object_and_its_picture_and_no_hand() -> None:
    color, alpha, mask, recorded = pictures()
    scores = proper_scores(color, alpha, mask, recorded)
    counted = ((mask == 1) | (alpha > 0.5)) & (mask != 2)
    seen = np.where((mask == 1)[..., None], recorded, 0) / 255
    shown = np.where(counted[..., None], color, 0.0)
    error = np.mean([(seen[r, c] - shown[r, c]) ** 2 for r, c in np.argwhere(counted)])
    assert scores.psnr == pytest.approx(-10 * np.log10(error))
    assert scores.ssim == pytest.approx(mean_similarity(seen, shown, counted), abs=1e-9)
    is_object, is_drawn = 14 * 16 - 3 * 14, 16 * 18 - 3 * 18
    both = 14 * 14 - 3 * 14
    assert scores.iou == pytest.approx(both / (is_object + is_drawn - both))
    other = recorded.copy()
    other[mask != 1] = 99
    assert proper_scores(color, alpha, mask, other) == scores
    behind = color.copy()
    behind[mask == 2] = 0.9
    assert proper_scores(behind, alpha, mask, recorded) == scores


def test_where_nothing_can_be_compared_there_is_no_score() -> None:
    color, alpha, mask, recorded = pictures()
    hand = np.full(SHAPE, 3, np.uint8)
    assert np.isnan(list(proper_scores(color, alpha, hand, recorded).to_dict().values())).all()
    assert np.isnan(phystwin_scores(color, alpha, hand, recorded).iou)
    for scores in (phystwin_scores, proper_scores):
        dark = scores(color, alpha, mask, None)
        assert np.isnan([dark.psnr, dark.ssim]).all()
        assert dark.iou == scores(color, alpha, mask, recorded).iou > 0.3


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


def test_a_network_is_shown_what_each_definition_compares() -> None:
    """A made-up network, the mean difference of the red, tells what it is given."""
    color, alpha, mask, recorded = pictures()
    is_object, is_hand = mask == 1, mask > 1

    def network(one: np.ndarray, other: np.ndarray, where: np.ndarray | None) -> float:
        difference = np.abs(one - other)[..., 0]
        return float(difference.mean() if where is None else difference[where].mean())

    red = recorded[..., 0] / 255 * is_object
    rounded = np.rint(255 * color[..., 0]) / 255 * ~is_hand
    whole = phystwin_scores(color, alpha, mask, recorded, network)
    assert whole.to_dict()["lpips"] == pytest.approx(np.abs(red - rounded).sum() / mask.size)
    is_counted = is_object | ((alpha >= 0.5) & ~is_hand)
    proper = proper_scores(color, alpha, mask, recorded, network)
    expected = np.abs(red - color[..., 0])[is_counted].mean()
    assert proper.to_dict()["lpips"] == pytest.approx(expected)
    assert expected > 0.001
    for score in (phystwin_scores, proper_scores):
        assert list(score(color, alpha, mask, recorded).to_dict()) == ["psnr", "ssim", "iou"]
        assert score(color, alpha, mask, None, network).lpips is None
