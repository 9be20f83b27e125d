"""Keypoints of several views of a made-up hand, some of them wrong: which are believed."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.physics import hand_scene as scene

from physhandi.fitting.config import HandFitConfig
from physhandi.fitting.hand_reconstruction import reconstruct_hands
from physhandi.fitting.hands.agreement import believed_keypoints, keypoint_trust
from physhandi.fitting.hands.left_right import hands_in_place
from physhandi.fitting.hands.wrist_guess import template_keypoints
from physhandi.hand.loading import load_hand_model

CAMERAS = [scene.looking_at_hand(azimuth, distance=1.2) for azimuth in (-0.9, 0.2, 1.6)]
"""The hand is 37 to 56 px large."""
OFF = np.array([0.0, -20.0])
"""A displacement across the lines on which other views see the same joints [px]."""
RIGHT = load_hand_model("right", "open")
TEMPLATE = template_keypoints(RIGHT)
BESIDE = scene.grasping("left").wrist_translation + np.array([0.15, 0.1, 0.0])
FINGER, SPAN = slice(5, 9), slice(4, 12)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory):
    truth = scene.grasping(frames=16)
    keypoint = scene.seen_keypoints([truth], CAMERAS, noise=1.0)
    folder = tmp_path_factory.mktemp("scenes") / "hand"
    return scene.write_scene(folder, [truth], CAMERAS, keypoint), keypoint[:, :, 0]


def test_good_keypoints_are_believed_to_the_bit(recording) -> None:
    sequence, keypoint = recording
    believed = believed_keypoints(sequence.views, keypoint, TEMPLATE, 30.0)
    assert np.array_equal(believed, keypoint)


@pytest.mark.parametrize("view", [0, 1, 2])
def test_displaced_joints_and_only_they_lose_their_weight(recording, view: int) -> None:
    sequence, keypoint = recording
    wrong = keypoint.copy()
    wrong[view, SPAN, FINGER, :2] += OFF
    trust = keypoint_trust(sequence.views, wrong, TEMPLATE, 30.0)
    is_wrong = np.zeros(trust.shape, dtype=bool)
    is_wrong[view, SPAN, FINGER] = True
    assert trust[is_wrong].mean() < 0.15
    assert trust[~is_wrong].min() == 1.0


def test_a_view_falls_away_of_which_most_joints_contradict(recording) -> None:
    sequence, keypoint = recording
    wrong = keypoint.copy()
    wrong[1, SPAN, 3:18, :2] += OFF
    believed = believed_keypoints(sequence.views, wrong, TEMPLATE, 30.0)
    assert np.isnan(believed[1, SPAN]).all()
    believed[1, SPAN] = wrong[1, SPAN]
    assert np.array_equal(believed, wrong)


def test_a_hand_is_fitted_as_well_with_a_view_that_errs(tmp_path: Path) -> None:
    truth = scene.grasping(frames=3)
    keypoint = scene.seen_keypoints([truth], CAMERAS)[:, :, 0]
    sequence = scene.write_scene(tmp_path / "hand", [truth], CAMERAS, keypoint[:, :, None])
    joint = truth.keypoints(RIGHT)
    wrong = keypoint.copy()
    wrong[2, :, 3:, :2] += OFF

    def error(seen: np.ndarray) -> float:
        fit = reconstruct_hands(sequence, HandFitConfig(iterations=40), keypoint=seen[:, :, None])
        return float(np.linalg.norm(fit.motions[0].keypoints(RIGHT) - joint, axis=-1).mean())

    # Without being judged, they are 9 mm apart.
    assert error(wrong) < error(keypoint) + 0.0015


def test_depth_tells_which_of_two_views_errs_and_without_it_both_are_kept(tmp_path: Path) -> None:
    truth = scene.grasping(frames=2)
    keypoint = scene.seen_keypoints([truth], CAMERAS[:2])[:, :, 0]
    sequence = scene.write_scene(tmp_path / "hand", [truth], CAMERAS[:2], None, depth=True)
    wrong = keypoint.copy()
    wrong[1, :, :, :2] = wrong[1, :, 9:10, :2] + (wrong[1, :, ::-1, :2] - wrong[1, :, 9:10, :2]) / 2
    trust = keypoint_trust(sequence.views, wrong, TEMPLATE, 30.0)
    assert trust[0].min() == 1.0
    assert trust[1].max() == 0.0
    blind = scene.write_scene(tmp_path / "blind", [truth], CAMERAS[:2], wrong[:, :, None])
    assert keypoint_trust(blind.views, wrong, TEMPLATE, 30.0).min() == 1.0


@pytest.mark.parametrize("views", [(0, 1, 2), (1, 2)])
def test_a_view_that_takes_the_left_hand_for_the_right_is_found(views: tuple[int, ...]) -> None:
    left = replace(scene.grasping("left"), wrist_translation=BESIDE)
    cameras = [CAMERAS[view] for view in views]
    keypoint = scene.seen_keypoints([scene.grasping(), left], cameras, noise=1.0)
    templates = [TEMPLATE, template_keypoints(load_hand_model("left", "open"))]
    assert np.array_equal(hands_in_place(cameras, keypoint, templates), keypoint)
    wrong = keypoint.copy()
    wrong[1, SPAN] = keypoint[1, SPAN, ::-1]
    assert np.array_equal(hands_in_place(cameras, wrong, templates), keypoint)
