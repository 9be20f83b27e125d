"""How a made-up hand that one view shows is turned and bent, and the chain that is chosen."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from support.physics import hand_scene as scene

from physhandi.data.sequence import Sequence
from physhandi.fitting.config import HandFitConfig
from physhandi.fitting.hand_reconstruction import reconstruct_hands
from physhandi.fitting.hands.observed import depth_target, keypoint_target
from physhandi.fitting.hands.search import SearchedHand, cheapest_chain, search_hand
from physhandi.fitting.hands.wrist_guess import guess_wrist, mirrored_pose
from physhandi.hand.loading import load_hand_model
from physhandi.hand.motion import HandMotion

FIST = torch.full((12,), -1.3)
"""Angle of every joint of its fingers [rad]."""
POINTING = torch.tensor([-0.3, -1.1, -1.1, -1.1]).repeat_interleave(3)
"""The same of a hand that points, which no search begins with [rad]."""
CAMERA = scene.looking_at_hand(1.6)


def _moving(bends: torch.Tensor, frames: int) -> HandMotion:
    """A hand that turns and moves while its fingers stay as they are."""
    hand = scene.grasping(frames=frames)
    articulation = hand.articulation.copy()
    articulation[:, 3:, 0] = bends
    return replace(hand, articulation=articulation)


def _filmed(folder: Path, truth: HandMotion) -> tuple[Sequence, np.ndarray]:
    keypoint = scene.seen_keypoints([truth], [CAMERA])
    return scene.write_scene(folder, [truth], [CAMERA], keypoint, depth=True), keypoint[:, :, 0]


def test_one_view_shows_a_fist_that_keypoints_alone_leave_wrong(tmp_path: Path) -> None:
    truth, model = _moving(FIST, 2), load_hand_model("right")
    sequence, _ = _filmed(tmp_path / "a", truth)
    error = {}
    for searched in (20, 0):
        config = HandFitConfig(iterations=40, search_iterations=searched, depth_iterations=20)
        found = reconstruct_hands(sequence, config).motions[0].keypoints(model)
        error[searched] = np.linalg.norm(found - truth.keypoints(model), axis=-1).mean()
    assert error[20] < 0.006
    assert error[0] > 0.012


def test_of_a_palm_and_its_mirror_image_depth_and_fingers_tell_the_true_one(
    tmp_path: Path,
) -> None:
    truth, model = _moving(POINTING, 7), load_hand_model("right")
    sequence, keypoint = _filmed(tmp_path / "a", truth)
    true = Rotation.from_rotvec(truth.wrist_rotation)
    right = guess_wrist([CAMERA], keypoint, model, metric=True, tolerance=10.0)
    assert right.from_one_view
    assert right.is_known.all()
    rotation, translation = right.rotation.copy(), right.translation.copy()
    for frame in (0, 1, 2, 6):
        pose = mirrored_pose([CAMERA], keypoint[:, frame], model, right.pose(frame))
        rotation[frame], translation[frame] = pose[0].as_quat(), pose[1]
        assert (pose[0] * true[frame].inv()).magnitude() > 0.6
    depth, config = depth_target(sequence, "right", 128), HandFitConfig(search_iterations=60)
    assert depth is not None
    hand = SearchedHand(
        cameras=[CAMERA],
        keypoint=keypoint,
        target=keypoint_target([CAMERA], keypoint, config.keypoint_noise),
        depth=depth,
        guess=replace(right, rotation=rotation, translation=translation),
        model=model,
        frame_rate=30.0,
    )
    told: list[tuple[int, float]] = []
    found = search_hand(hand, config, lambda number, loss: told.append((number, float(loss))))
    assert [number for number, _ in told] == list(range(1, 61))
    assert told[-1][1] < told[0][1]
    # Frames 0, 3 and 6 are searched, and the others lie between them.
    turned = (Rotation.from_quat(found["rotation"].numpy()) * true.inv()).magnitude()
    assert turned.max() < 0.15
    assert float((found["articulation"][:, 3:, 0] - POINTING).abs().mean()) < 0.25
    assert np.abs(found["translation"].numpy() - truth.wrist_translation).max() < 0.02


def test_a_chain_takes_a_dearer_hand_rather_than_two_leaps() -> None:
    place = np.array([[0.0, 0.1], [0.0, 0.1], [0.0, 0.1]])
    keypoint = np.zeros((3, 2, 21, 3))
    keypoint[..., 0] = place[..., None]
    cost = np.array([[10.0, 40.0], [30.0, 10.0], [10.0, 40.0]])
    # A leap of 0.1 m costs 25 in a tenth of a second, and a hundredth of that in a whole one.
    assert cheapest_chain(cost, keypoint, np.array([0.1, 0.1])).tolist() == [0, 0, 0]
    assert cheapest_chain(cost, keypoint, np.array([1.0, 1.0])).tolist() == [0, 1, 0]
    # However far a leap is, it costs no more than 50.
    keypoint[:, 1, :, 0] = 5.0
    cost[:, :] = [[10.0, 200.0], [130.0, 10.0], [10.0, 200.0]]
    assert cheapest_chain(cost, keypoint, np.array([0.1, 0.1])).tolist() == [0, 1, 0]
    assert cheapest_chain(cost[:1], keypoint[:1], np.zeros(0)).tolist() == [0]
