"""Scores of hands, by numbers that can be worked out on paper."""

import numpy as np
import pytest

from physhandi.data.camera import PinholeCamera
from physhandi.metrics.hands import evaluate_hands

CAMERA = PinholeCamera(
    K=np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]]),
    T_world_camera=np.eye(4),
    width=100,
    height=100,
)


def _scene(frames: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """A hand 2 m ahead, and what two equal cameras see of it without any error."""
    joint = np.zeros((frames, 21, 3))
    joint[..., 0] = np.linspace(-0.2, 0.2, 21)
    joint[..., 2] = 2
    pixel = CAMERA.project(joint)
    seen = np.concatenate([pixel, np.ones_like(pixel[..., :1])], -1)
    return joint, np.stack([seen, seen])[:, :, None]


def test_a_shift_of_three_and_four_pixels_is_five() -> None:
    joint, keypoint = _scene()
    keypoint[0, ..., :2] += [3, 4]
    (score,) = evaluate_hands([CAMERA, CAMERA], [joint], keypoint)
    assert score.fitted.mean == pytest.approx(2.5)
    assert score.fitted.p95 == pytest.approx(5)
    assert score.fitted.keypoint_count == 2 * 4 * 21
    assert score.frame_count == 4
    assert score.joint_median == pytest.approx([2.5] * 21)
    assert score.hidden.keypoint_count == 0
    assert np.isnan(score.to_dict()["hidden"]["median"])


def test_hidden_keypoints_are_scored_apart() -> None:
    joint, keypoint = _scene()
    hidden = np.zeros(keypoint.shape[:4], dtype=bool)
    hidden[1, :, :, 7] = True
    keypoint[1, :, :, 7, 0] += 9
    (score,) = evaluate_hands([CAMERA, CAMERA], [joint], keypoint, hidden)
    assert score.hidden.median == pytest.approx(9)
    assert (score.hidden.keypoint_count, score.fitted.keypoint_count) == (4, 164)
    assert score.fitted.mean == pytest.approx(0, abs=1e-9)


def test_frames_without_a_fit_count_as_infinitely_wrong() -> None:
    joint, keypoint = _scene()
    joint[0], joint[1, :, 2] = np.nan, -2
    (score,) = evaluate_hands([CAMERA, CAMERA], [joint], keypoint)
    assert score.frame_count == 4
    assert score.fitted.mean == np.inf
    assert score.fitted.keypoint_count == 168


def test_frames_seen_by_too_few_views_can_be_left_out() -> None:
    joint, keypoint = _scene()
    keypoint[1, 0] = np.nan
    scores = [evaluate_hands([CAMERA, CAMERA], [joint], keypoint, least_views=n)[0] for n in (1, 2)]
    assert [score.frame_count for score in scores] == [4, 3]
    assert [score.fitted.keypoint_count for score in scores] == [147, 126]
