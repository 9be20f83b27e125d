"""Smoothing of a hand's motion against dense algebra, and against motions that are known."""

from pathlib import Path

import numpy as np
import pytest
import torch
from numpy import ndarray
from support.physics import hand_scene as scene

from physhandi.fitting.hand_reconstruction import HandFitConfig, reconstruct_hands
from physhandi.fitting.hands.smoothing import (
    FREEDOM,
    STRENGTHS,
    best_strength,
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
    found = smoothed_pose(pose, 1.0)["rotation"].double().numpy()
    assert np.abs((found * turn).sum(axis=1)) == pytest.approx(1.0, abs=1e-4)
    assert (found[1:] * found[:-1]).sum(axis=1).min() > 0.9


@pytest.mark.parametrize("period", [8.0, 200.0])
def test_the_strength_is_about_the_one_that_comes_nearest_to_the_true_motion(period: float) -> None:
    random = np.random.default_rng(2)
    shape = (80, FREEDOM)
    true = np.sin(2 * np.pi * np.arange(80)[:, None] / period + random.uniform(0, 6, FREEDOM))
    # Each number is measured twice, and the fit is the mean.
    seen = true + 0.1 * random.normal(size=(2, *shape))
    fitted = seen.mean(axis=0)
    chosen = best_strength(
        lambda strength: float(((smoothed(fitted, strength) - seen) ** 2).mean()),
        frame_count=80,
        coordinate_count=float(seen.size),
    )
    off = {s: ((smoothed(fitted, s) - true) ** 2).mean() for s in (0.0, *STRENGTHS.tolist())}
    assert off[chosen] < 1.1 * min(off.values())
    assert chosen < 1.0 if period < 10 else chosen > 10.0


def test_too_few_keypoints_tell_nothing_of_a_motion_that_is_too_free_for_them() -> None:
    chosen = best_strength(lambda _: 1.0, frame_count=50, coordinate_count=50 * FREEDOM / 4)
    assert 0.25 * 50 > freedom_left(50, chosen) > 1.0
    assert best_strength(lambda _: 1.0, frame_count=50, coordinate_count=0.0) == 0.0


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
