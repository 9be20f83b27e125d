"""Views without the distortion of their lens, against where the camera itself sees points."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from physhandi.data.camera import PinholeCamera
from physhandi.data.view import View

CAMERA = PinholeCamera(
    K=np.array([[150.0, 0, 80], [0, 140.0, 60], [0, 0, 1]]),
    T_world_camera=np.eye(4),
    width=160,
    height=120,
    distortion=np.array([-0.3, 0.08, 0.004, -0.003, 0.0]),
)
POINT = np.array([[0.0, 0.0, 1.0], [-0.38, 0.3, 1.0], [0.35, -0.28, 1.0]])
"""In the middle, and near two corners, where the lens moves what it shows by several pixels."""
RADIUS = 4


def blobs(camera: PinholeCamera) -> np.ndarray:
    """Discs around the pixels at which a camera sees the points, numbered from 1."""
    row, column = np.mgrid[: camera.height, : camera.width]
    image = np.zeros((camera.height, camera.width), np.uint8)
    for number, (x, y) in enumerate(camera.project(POINT), 1):
        image[(column - x) ** 2 + (row - y) ** 2 <= RADIUS**2] = number
    return image


@pytest.fixture
def view(tmp_path: Path) -> View:
    label = blobs(CAMERA)
    images = {
        "mask": label,
        "depth": (1000 + 100 * label.astype(np.uint16)) * (label > 0),
        "color": np.repeat(60 * label[..., None], 3, axis=2),
    }
    for kind, image in images.items():
        (tmp_path / kind).mkdir()
        cv2.imwrite(str(tmp_path / kind / "00000.png"), image)
    pixel = CAMERA.project(POINT).astype(np.float32)
    np.save(tmp_path / "track.npy", pixel[None])
    hand = np.full((1, 1, 21, 3), np.nan, np.float32)
    hand[0, 0, :3] = np.concatenate([pixel, np.full((3, 1), 0.7, np.float32)], axis=1)
    np.save(tmp_path / "keypoint.npy", hand)
    return View(tmp_path, "scene", CAMERA, 1)


def test_a_point_is_where_a_camera_without_distortion_sees_it(view: View) -> None:
    straight = view.straightened()
    plain = replace(CAMERA, distortion=np.zeros(5))
    assert not straight.camera.distortion.any()
    place = plain.project(POINT)
    assert np.linalg.norm(place - CAMERA.project(POINT), axis=1)[1:].min() > 3.0
    for number, (x, y) in enumerate(place, 1):
        row, column = np.nonzero(straight.mask(0) == number)
        assert (column.mean(), row.mean()) == pytest.approx((x, y), abs=0.5)
        middle = round(y), round(x)
        assert straight.depth(0)[middle] == pytest.approx(1.0 + 0.1 * number, abs=1e-6)
        assert straight.color(0)[middle].tolist() == [60 * number] * 3
    np.testing.assert_array_equal(np.unique(straight.mask(0)), [0, 1, 2, 3])
    np.testing.assert_allclose(straight.track[0], place, atol=1e-3)
    np.testing.assert_allclose(straight.keypoint[0, 0, :3, :2], place, atol=1e-3)
    np.testing.assert_allclose(straight.keypoint[0, 0, :3, 2], 0.7, atol=1e-6)
    assert np.isnan(straight.keypoint[0, 0, 3:]).all()


def test_a_view_of_a_straight_lens_is_left_alone(view: View) -> None:
    plain = View(view.folder, "scene", replace(CAMERA, distortion=np.zeros(5)), 1)
    assert plain.straightened() is plain
