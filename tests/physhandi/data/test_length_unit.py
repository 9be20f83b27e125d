"""Doubts about units: on which side of each limit they begin."""

import numpy as np
import pytest

from physhandi.data.length_unit import (
    doubt_depth,
    doubt_extent,
    doubt_keypoints,
    doubt_position,
)


def test_positions_are_believed_up_to_20_m() -> None:
    position = np.zeros((3, 2, 3))
    position[1, 1] = [0.0, -19.9, np.nan]
    position[2, 0, 2] = np.inf
    assert doubt_position(position) is None
    position[2, 1, 0] = -20.1
    position[2, 1, 1] = 500.0
    found = doubt_position(position)
    assert found is not None
    assert found[0] == (2, 1)
    assert found[1].startswith("is 500 m from the origin, which looks like millimetres")
    assert doubt_position(np.zeros((0, 3))) is None
    assert doubt_position(np.array([21.0, 0, 0])) is not None


def test_objects_are_believed_from_2_mm_on() -> None:
    point = np.array([[5.0, 5, 5], [5.0, 5.0021, 5], [np.nan, 9, 9]])
    assert doubt_extent(point) is None
    point[1, 1] = 5.0019
    assert "1.9 mm" in (doubt_extent(point) or "")
    assert doubt_extent(point[:1]) is None
    assert doubt_extent(np.zeros((4, 3))) is None


@pytest.mark.parametrize(
    ("largest", "is_doubted"), [(0, False), (1, True), (19, True), (20, False)]
)
def test_depth_is_believed_from_20_mm_on(largest: int, is_doubted: bool) -> None:
    assert (doubt_depth(largest) is not None) == is_doubted


def test_keypoints_are_pixels_near_their_image() -> None:
    keypoint = np.full((2, 1, 21, 3), 0.9)
    keypoint[..., 0], keypoint[..., 1] = 300.0, 20.0
    keypoint[1, 0, 4] = np.nan
    assert doubt_keypoints(keypoint, 640, 480) is None
    # A hand may reach far out of the image, but not five images far.
    keypoint[1, 0, 7, 0] = 640 * 5.4
    assert doubt_keypoints(keypoint, 640, 480) is None
    keypoint[1, 0, 7, 0] = 640 * 5.6
    found = doubt_keypoints(keypoint, 640, 480)
    assert found is not None
    assert found[0] == (1, 0, 7)
    assert "far outside of the 640x480 image" in found[1]
    # What nobody saw may stand anywhere.
    keypoint[1, 0, 7, 2] = 0.0
    assert doubt_keypoints(keypoint, 640, 480) is None
    parts = keypoint / [640, 480, 1]
    parts[1, 0, 7, :2] = 0.5
    found = doubt_keypoints(parts, 640, 480)
    assert found is not None
    assert found[0] == (0, 0, 0)
    assert "multiply by 640 and 480" in found[1]
    assert doubt_keypoints(np.full((1, 1, 21, 3), np.nan), 640, 480) is None
