"""Smoothing of a hand's motion against dense algebra, and against motions that are known."""

from pathlib import Path

import numpy as np
import pytest
import torch
from numpy import ndarray
from support.physics import hand_scene as scene

from physhandi.fitting.hand_reconstruction import HandFitConfig, reconstruct_hands
from physhandi.fitting.hands.smoothing import (
    FINGERS,
    STRENGTHS,
    WRIST,
    best_strengths,
    freedom_left,
    smoothed,
    smoothed_pose,
)
from physhandi.hand.loading import load_hand_model


def _smoother(count: int, strength: float) -> ndarray:
    difference = np.diff(np.eye(count), 2, axis=0)
    return np.linalg.inv(np.eye(count) + strength * difference.T @ difference)


@pytest.mark.parametrize("count", [3, 4, 40])
def test_smoothing_and_its_freedom_are_those_of_the_dense_problem(count: int) -> None:
    series = np.random.default_rng(1).normal(size=(count, 2, 3))
    for strength in (0.01, 1.0, 300.0):
        dense = _smoother(count, strength)
        expected = np.einsum("ft,tij->fij", dense, series)
        assert smoothed(series, strength) == pytest.approx(expected, abs=1e-9)
        assert freedom_left(count, strength) == pytest.approx(np.trace(dense), rel=0.1, abs=1.5)


def test_even_motion_stays_and_short_motion_is_left_alone() -> None:
    even = np.outer(np.arange(30.0), [1.0, -2.0, 0.5]) + 7.0
    assert smoothed(even, 1000.0) == pytest.approx(even, abs=1e-6)
    short = np.array([[1.0], [5.0]])
    assert smoothed(short, 1000.0) == pytest.approx(short)


def test_a_rotation_is_smoothed_whichever_of_its_two_quaternions_it_is() -> None:
    angle = np.linspace(0.0, 3.0, 20)
    turn = np.stack([np.sin(angle / 2), 0 * angle, 0 * angle, np.cos(angle / 2)], axis=1)
    flipped = turn * np.where(np.arange(20) % 3 == 0, -2.0, 1.0)[:, None]
    pose = {
        "articulation": torch.zeros(20, 15, 3),
        "rotation": torch.tensor(flipped, dtype=torch.float32),
        "translation": torch.zeros(20, 3),
    }
    rotation = smoothed_pose(pose, 0.0, 1.0)["rotation"].double().numpy()
    assert np.abs((rotation * turn).sum(axis=1)) == pytest.approx(1.0, abs=1e-4)
    assert (rotation[1:] * rotation[:-1]).sum(axis=1).min() > 0.9


def test_fingers_and_wrist_are_smoothed_each_with_its_own_strength() -> None:
    series = np.random.default_rng(4).normal(size=(20, 3))
    pose = {
        "articulation": torch.tensor(series[:, None]),
        "rotation": torch.tensor(np.column_stack([0.1 * series, np.ones(20)])),
        "translation": torch.tensor(series),
    }
    motion = smoothed_pose(pose, 10.0, 0.1)
    assert motion["articulation"][:, 0].numpy() == pytest.approx(smoothed(series, 10.0), abs=1e-5)
    assert motion["translation"].numpy() == pytest.approx(smoothed(series, 0.1), abs=1e-5)
    angle = motion["rotation"][:, :3] / motion["rotation"][:, 3:]
    assert angle.numpy() == pytest.approx(0.1 * smoothed(series, 0.1), abs=0.01)


@pytest.mark.parametrize("periods", [(8.0, 200.0), (200.0, 8.0), (200.0, 200.0)])
def test_the_strengths_are_about_those_that_come_nearest_to_the_true_motion(
    periods: tuple[float, float],
) -> None:
    random = np.random.default_rng(2)
    parts = slice(FINGERS), slice(FINGERS, None)
    period = np.repeat(periods, (FINGERS, WRIST))
    start = random.uniform(0, 6, FINGERS + WRIST)
    true = np.sin(2 * np.pi * np.arange(80)[:, None] / period + start)
    # Each number is measured twice, and the fit is the mean.
    seen = true + 0.1 * random.normal(size=(2, *true.shape))
    fitted = seen.mean(axis=0)

    def motion(*strengths: float) -> ndarray:
        each = zip(parts, strengths, strict=True)
        return np.concatenate([smoothed(fitted[:, part], s) for part, s in each], axis=1)

    chosen = best_strengths(
        lambda *strengths: float(((motion(*strengths) - seen) ** 2).mean()),
        frame_count=80,
        coordinate_count=float(seen.size),
    )
    for part, strength, its_period in zip(parts, chosen, periods, strict=True):
        off = {s: ((smoothed(fitted[:, part], s) - true[:, part]) ** 2).mean() for s in STRENGTHS}
        assert off[strength] < 1.1 * min(off.values())
        assert strength < 1.0 if its_period < 10 else strength > 10.0


def test_too_few_keypoints_tell_nothing_of_a_motion_that_is_too_free_for_them() -> None:
    count = 50 * (FINGERS + WRIST)
    fingers, wrist = best_strengths(lambda *_: 1.0, frame_count=50, coordinate_count=count / 4)
    numbers = FINGERS * freedom_left(50, fingers) + WRIST * freedom_left(50, wrist)
    assert 0.25 * count > numbers > FINGERS + WRIST
    assert best_strengths(lambda *_: 1.0, frame_count=50, coordinate_count=0.0) == (0.0, 0.0)


def test_a_hand_trembles_less_than_its_keypoints_and_is_nearer_to_the_true_one(
    tmp_path: Path,
) -> None:
    truth, model = scene.grasping(frames=16), load_hand_model("right")
    cameras = [scene.looking_at_hand(angle) for angle in (0.0, 1.2, 2.6)]
    keypoint = scene.seen_keypoints([truth], cameras)
    keypoint[..., :2] += 2.0 * np.random.default_rng(3).normal(size=keypoint[..., :2].shape)
    sequence = scene.write_scene(tmp_path / "a", [truth], cameras, keypoint)
    true, error, trembling = truth.keypoints(model), [], []
    for smooths in (False, True):
        config = HandFitConfig(iterations=60, depth_iterations=0, smooths_motion=smooths)
        off = reconstruct_hands(sequence, config).motions[0].keypoints(model) - true
        error.append(np.linalg.norm(off, axis=-1).mean())
        trembling.append(np.linalg.norm(np.diff(off, axis=0), axis=-1).mean())
    assert trembling[1] < 0.5 * trembling[0]
    assert error[1] < error[0]
