"""The state in the last observed frame, worked out node by node in float64."""

from dataclasses import replace

import numpy as np
import pytest
from reference.scenes import as_model, bare_scene, cube_scene
from reference.spring_mass import simulate

from physhandi.data.observation import ObjectObservation
from physhandi.errors import MissingInputError
from physhandi.fitting.observed.state_estimate import observed_state

LAST = 2
SCENE = cube_scene()


def observed(shift: np.ndarray, **changes) -> ObjectObservation:
    """The nodes of the oracle, moved by `shift` in the last frame and nonsense after it."""
    point = simulate(SCENE)[0].astype(np.float32)
    point[LAST] += shift.astype(np.float32)
    point[LAST + 1 :] += 7.0
    seen = np.ones(point.shape[:2], bool)
    fields = {"is_visible": seen, "is_motion_valid": seen, "node_of_track": np.arange(8)}
    return ObjectObservation(**({"point": point} | fields | changes))


def estimate(observation: ObjectObservation, frame: int = LAST):
    model, parameters = as_model(SCENE)
    return observed_state(model, parameters, SCENE.control, observation, frame)


def test_a_node_that_is_seen_is_where_it_is_seen_and_moves_as_it_did() -> None:
    shift = np.random.default_rng(1).normal(0, 0.004, (8, 3))
    shift[:, 2] = np.abs(shift[:, 2])
    position = simulate(SCENE)[0]
    found = estimate(observed(shift))
    assert found.frame == LAST
    np.testing.assert_allclose(found.position, position[LAST] + shift, atol=2e-6)
    # The line that fits three points best is as steep as the one through the outer two.
    mean = (position[LAST] + shift - position[0]) / 2.0 * SCENE.frame_rate
    np.testing.assert_allclose(found.velocity, mean, atol=1e-4)
    assert np.abs(mean).max() > 0.1
    # The frame before shows no residual.
    np.testing.assert_allclose(
        estimate(observed(shift), LAST - 1).position, position[LAST - 1], atol=2e-6
    )
    assert np.abs(position[LAST] - position[LAST - 1]).max() > 1e-3


def test_a_node_that_is_not_seen_takes_the_mean_of_the_tracks_around_it() -> None:
    shift = np.random.default_rng(2).uniform(0.001, 0.006, (8, 3))
    seen = np.ones((4, 8), bool)
    seen[LAST, [2, 5]] = False
    found = estimate(observed(shift, is_visible=seen))
    position = simulate(SCENE)[0]
    for node in (2, 5):
        total, weights = np.zeros(3), 0.0
        for track in (0, 1, 3, 4, 6, 7):
            weight = 1.0 / (np.linalg.norm(SCENE.node[node] - SCENE.node[track]) + 1e-6)
            total += weight * shift[track]
            weights += weight
        np.testing.assert_allclose(
            found.position[node], position[LAST, node] + total / weights, atol=2e-6
        )


def test_the_velocity_is_that_of_three_frames_whatever_the_rollout_does() -> None:
    random = np.random.default_rng(3)
    node = random.uniform(0.1, 0.2, (4, 3))
    point = (node + random.normal(0, 0.01, (9, 4, 3))).astype(np.float32)
    point[0] = node
    seen = np.ones((9, 4), bool)
    observation = ObjectObservation(
        point=point, is_visible=seen, is_motion_valid=seen, node_of_track=np.arange(4)
    )
    scene = bare_scene(node, velocity=np.full((4, 3), 3.0), frames=9)
    model, parameters = as_model(scene)
    found = observed_state(model, parameters, scene.control, observation, 7)
    slope = np.polyfit(np.arange(5, 8) / scene.frame_rate, point[5:8].reshape(3, -1), 1)[0]
    np.testing.assert_allclose(found.velocity, slope.reshape(4, 3), atol=1e-4)
    assert np.abs(slope).max() > 0.05


def test_the_velocity_is_the_rollouts_if_the_frame_before_shows_no_track() -> None:
    seen = np.ones((4, 8), bool)
    seen[LAST - 1] = False
    found = estimate(observed(np.full((8, 3), 0.002), is_visible=seen))
    np.testing.assert_allclose(found.velocity, simulate(SCENE)[1][LAST], atol=5e-6)


def test_no_node_ends_below_the_ground_and_grips_are_eased_there() -> None:
    found = estimate(observed(np.full((8, 3), -1.0)))
    assert found.eases_grips
    assert found.position[:, 2].tolist() == [0.0] * 8
    assert found.position[:, 0].max() < -0.5
    model, parameters = as_model(SCENE)
    held = replace(model, clearance=np.linspace(0.0, 0.003, 8, dtype=np.float32))
    seen = observed(np.full((8, 3), -1.0))
    found = observed_state(held, parameters, SCENE.control, seen, LAST)
    np.testing.assert_allclose(found.position[:, 2], held.clearance, rtol=1e-6)


def test_strain_is_averaged_over_a_time() -> None:
    model, parameters = as_model(SCENE)
    shift = observed(np.full((8, 3), 0.002))
    rate = parameters.simulated_frame_rate
    for time, frames in ((0.0, 1), (0.4 / rate, 1), (2.6 / rate, 3), (0.5, round(0.5 * rate))):
        found = observed_state(model, parameters, SCENE.control, shift, LAST, strain_time=time)
        assert found.strain_frames == frames


def test_without_a_track_there_is_no_state() -> None:
    seen = np.ones((4, 8), bool)
    seen[LAST] = False
    with pytest.raises(MissingInputError, match="frame 2 shows no track"):
        estimate(observed(np.zeros((8, 3)), is_visible=seen))


GRID = np.stack(np.meshgrid(np.arange(8), np.arange(6), indexing="ij"), axis=-1).reshape(-1, 2)
SHEET = np.concatenate([0.01 * GRID, np.full((48, 1), 0.5)], axis=1)
BESIDE = SHEET + np.array([0.002, 0.001, 0.0])
HELD = 19


def moved_sheet(residual: np.ndarray, hidden: np.ndarray, *, is_held: bool = False):
    """Estimate where a sheet is that rests in the air; tracks beside its nodes moved at last.

    Args:
        residual: What each track moved by from frame 1 to frame 2 [m].
        hidden: Tracks that frame 2 does not show.
        is_held: Whether a spring, at rest, holds node `HELD` to a hand.
    """
    scene = bare_scene(SHEET, frames=3)
    if is_held:
        hand = np.tile(SHEET[HELD] + [0.0, 0.0, 0.01], (3, 1, 1))
        one = np.ones(1)
        spring = {"springs": np.array([[48, HELD]]), "rest": 0.01 * one, "damping": 0.0 * one}
        scene = replace(scene, control=hand, stiffness=1e-6 * one, **spring)
    point = np.stack([BESIDE, BESIDE, BESIDE + residual]).astype(np.float32)
    seen = np.ones(point.shape[:2], bool)
    seen[2, hidden] = False
    model, parameters = as_model(scene)
    observation = ObjectObservation(point=point, is_visible=seen, is_motion_valid=seen)
    return observed_state(model, parameters, scene.control, observation, 2).position


def gaussian_mean(node: np.ndarray, place: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Weigh one value after the other by exp(-d^2 / 2 w^2)."""
    distance = [float(np.sqrt(((node - at) ** 2).sum())) for at in place]
    width = max(0.375 * 0.01, sorted(distance)[7] / 2)
    weight = [np.exp(-0.5 * (far / width) ** 2) for far in distance]
    return sum(w * v for w, v in zip(weight, value, strict=True)) / sum(weight)


def test_a_node_takes_the_mean_of_the_tracks_around_it_weighted_by_a_gaussian() -> None:
    noise = np.random.default_rng(4).normal(0, 0.002, (48, 3))
    hidden = np.zeros(48, bool)
    hidden[[7, 8, 13, 14]] = True
    found = moved_sheet(noise, hidden)
    expected = [gaussian_mean(node, BESIDE[~hidden], noise[~hidden]) for node in SHEET]
    np.testing.assert_allclose(found, SHEET + expected, atol=2e-6)
    # Noise of single tracks is more than halved.
    assert 1e-4 < np.std(found - SHEET) < 0.5 * np.std(noise)


def test_what_a_hand_hides_is_where_the_rollout_has_it() -> None:
    residual = np.tile([0.004, -0.002, 0.003], (48, 1))
    far = np.linalg.norm(BESIDE - SHEET[HELD], axis=1)
    is_seen = far > 0.012
    free = moved_sheet(residual, ~is_seen)
    np.testing.assert_allclose(free, SHEET + residual, atol=2e-6)
    held = moved_sheet(residual, ~is_seen, is_held=True)
    place = np.concatenate([BESIDE[is_seen], SHEET[[HELD]]])
    value = np.concatenate([residual[is_seen], np.zeros((1, 3))])
    expected = [gaussian_mean(node, place, value) for node in SHEET]
    np.testing.assert_allclose(held, SHEET + expected, atol=2e-6)
    moved = np.linalg.norm(held - SHEET, axis=1)
    assert moved[HELD] < 0.8 * np.linalg.norm(residual[0]) < 0.999 * moved.max()
    # A track that near shows it; then the hand says nothing.
    shown = moved_sheet(residual, far < 0.001, is_held=True)
    np.testing.assert_allclose(shown, SHEET + residual, atol=2e-6)
