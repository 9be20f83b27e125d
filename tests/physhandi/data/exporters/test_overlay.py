"""The overlay of a mesh: where it is drawn, what hides what, and what stays."""

import numpy as np
import pytest

from physhandi.data.camera import PinholeCamera
from physhandi.data.exporters.overlay import hand_overlay

CAMERA = PinholeCamera(
    K=np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]]),
    T_world_camera=np.eye(4),
    width=101,
    height=101,
)
IMAGE = np.full((101, 101, 3), 10, np.uint8)
FACES = np.array([[0, 2, 1], [0, 3, 2]])


def _square(half: float, depth: float) -> np.ndarray:
    corner = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]]) * half
    return np.column_stack([corner, np.full(4, depth)])


def test_a_square_covers_its_projection_and_nothing_else() -> None:
    drawn = hand_overlay(IMAGE, CAMERA, _square(0.4, 2.0), FACES, color=(200, 100, 50), opacity=1.0)
    covered = (drawn != IMAGE).any(-1)
    rows, columns = np.nonzero(covered)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (30, 70, 30, 70)
    assert covered.sum() == 41 * 41
    np.testing.assert_allclose(drawn[50, 50], [200, 100, 50], atol=4)
    assert (IMAGE == 10).all()


def test_opacity_mixes_with_the_image() -> None:
    drawn = hand_overlay(IMAGE, CAMERA, _square(0.4, 2.0), FACES, color=(200, 0, 0), opacity=0.5)
    assert drawn[50, 50, 0] == pytest.approx(105, abs=3)


def test_the_nearer_of_two_squares_is_seen_and_a_back_is_not() -> None:
    vertex = np.concatenate([_square(0.2, 1.0), _square(0.8, 4.0)])
    tilted = vertex.copy()
    tilted[4:, 2] += tilted[4:, 0]
    faces = np.concatenate([FACES + 4, FACES])
    near = hand_overlay(IMAGE, CAMERA, tilted, faces, opacity=1.0)
    alone = hand_overlay(IMAGE, CAMERA, vertex[:4], FACES, opacity=1.0)
    assert np.array_equal(near[50, 50], alone[50, 50])
    assert not np.array_equal(hand_overlay(IMAGE, CAMERA, tilted[4:], FACES)[50, 50], near[50, 50])
    back = hand_overlay(IMAGE, CAMERA, vertex[:4], FACES[:, ::-1])
    assert np.array_equal(back, IMAGE)
    behind = hand_overlay(IMAGE, CAMERA, _square(0.2, -1.0), FACES[:, ::-1])
    assert np.array_equal(behind, IMAGE)
