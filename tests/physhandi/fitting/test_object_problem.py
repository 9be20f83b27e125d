"""How observations are attached to nodes."""

import numpy as np
import pytest
import torch

from physhandi.data.observation import ObjectObservation
from physhandi.errors import FitError
from physhandi.fitting.object_problem import ObjectProblem, build_problem, initial_velocity

NODE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0.5, 0.5, 1]], np.float32)


def observe(point: np.ndarray, **more: object) -> ObjectObservation:
    visible = np.isfinite(point).all(axis=2)
    valid = visible.copy()
    valid[0] = False
    return ObjectObservation(
        point=point.astype(np.float32), is_visible=visible, is_motion_valid=valid, **more
    )


def problem(observation: ObjectObservation, **more: object) -> ObjectProblem:
    settings = {
        "name": "made_up",
        "object_node": NODE,
        "rest_node": NODE,
        "control": np.zeros((4, 1, 3), np.float32),
        "hand_face": np.zeros((0, 3), np.int32),
        "frame_count": 3,
        "frame_rate": 30.0,
        "ground_height": 0.0,
        "gravity": 9.81,
    }
    return build_problem(observation=observation, **(settings | more))


def test_tracks_stay_on_the_surface_that_carries_them() -> None:
    track = np.repeat(np.array([[[0.2, 0.1, 0.05], [0.9, 0.8, 0.0]]]), 4, axis=0)
    moved = problem(observe(track))
    shift = torch.tensor([0.0, 0.3, -0.2])
    node = torch.from_numpy(NODE)[None] + shift
    expected = torch.from_numpy(track[:1].astype(np.float32)) + shift
    np.testing.assert_allclose(moved.predict_tracks(node), expected, rtol=1e-6, atol=1e-5)
    losses = moved.frame_losses(node, track_weight=1.0)
    # Every track is off by |shift|² = 0.13; there is no cloud.
    assert losses.tolist() == pytest.approx([0.13])


def test_identified_tracks_are_their_nodes() -> None:
    track = np.repeat(NODE[None, [3, 1]], 4, axis=0) + 0.01
    node_of_track = np.array([3, 1], np.int32)
    carried = problem(observe(track, node_of_track=node_of_track))
    node = torch.arange(15.0).reshape(1, 5, 3)
    assert carried.predict_tracks(node)[0].tolist() == [[9, 10, 11], [3, 4, 5]]


def test_frames_to_predict_are_never_looked_at() -> None:
    track = np.repeat(NODE[None], 4, axis=0).copy()
    changed = track.copy()
    changed[3] += 7.0
    first, second = problem(observe(track)), problem(observe(changed))
    assert first.frame_count == 3
    assert torch.equal(first.track, second.track)


def test_clouds_are_padded_and_thinned() -> None:
    track = np.full((4, 1, 3), np.nan)
    clouds = (np.zeros((0, 3)), np.full((7, 3), 0.5), np.ones((500, 3)), np.ones((9, 3)))
    padded = problem(observe(track, cloud=clouds), cloud_points=50)
    assert padded.is_observed.sum(dim=1).tolist() == [0, 7, 50]
    node = torch.full((2, 1, 3), 1.0)
    assert padded.frame_losses(node).tolist() == pytest.approx([0.75, 0.0])


def test_an_object_that_is_never_seen_is_an_error() -> None:
    with pytest.raises(FitError, match=r"made_up.*no frame"):
        problem(observe(np.full((4, 2, 3), np.nan)))


def test_comparing_with_tracks_needs_tracks() -> None:
    unseen = observe(np.full((4, 2, 3), np.nan), cloud=(np.ones((9, 3)),) * 4)
    with pytest.raises(FitError, match=r"made_up.*no tracks.*chamfer_points: cloud"):
        problem(unseen, chamfer_points="tracks")


def test_initial_velocity_reads_two_frames_only() -> None:
    track = np.repeat(NODE[None], 4, axis=0).astype(float)
    track[1, :, 0] += 0.1
    track[2:] += 50.0
    node_of_track = np.arange(5, dtype=np.int32)
    velocity = initial_velocity(observe(track, node_of_track=node_of_track), NODE, 30.0)
    np.testing.assert_allclose(velocity, np.tile([3.0, 0.0, 0.0], (5, 1)), atol=1e-4)
    assert not initial_velocity(observe(track), NODE, 30.0).any()


def test_chamfer_sees_the_surface_alone() -> None:
    track = np.repeat(np.array([[[0.5, 0.5, 0.9]]]), 4, axis=0)
    clouds = (track[0],) * 4
    node = torch.from_numpy(NODE)[None]
    inside = problem(observe(track, cloud=clouds))
    # The fifth node is 0.1 above; without it the nearest is 0.5² + 0.5² + 0.9² away.
    assert inside.frame_losses(node, track_weight=0.0).tolist() == pytest.approx([0.01])
    outside = problem(observe(track, cloud=clouds), surface_count=4)
    assert outside.frame_losses(node, track_weight=0.0).tolist() == pytest.approx([1.31])


def test_visible_tracks_can_be_what_chamfer_compares_with() -> None:
    track = np.repeat(NODE[None], 4, axis=0).astype(float)
    track[1, :2] = np.nan
    track[2:] += [0.0, 0.0, 0.3]
    clouds = (np.full((9, 3), 7.0),) * 4
    node = torch.from_numpy(NODE)[None].repeat(2, 1, 1)
    seen = problem(observe(track, cloud=clouds), chamfer_points="tracks")
    assert seen.is_observed.sum(dim=1).tolist() == [5, 3, 5]
    # The lowest four are 0.3 above their nodes, the fifth 0.3 above its own.
    assert seen.frame_losses(node, track_weight=0.0).tolist() == pytest.approx([0.0, 0.09])
    frozen = seen.frame_losses(node, track_weight=0.0, freeze_counts=True)
    assert frozen.tolist() == pytest.approx([0.0, 0.09 * 5 / 3])
    few = problem(observe(track), chamfer_points="tracks", cloud_points=2)
    assert few.is_observed.sum(dim=1).tolist() == [2, 2, 2]


def test_all_points_of_a_cloud_can_be_kept() -> None:
    track = np.full((4, 1, 3), np.nan)
    clouds = (np.ones((500, 3)),) * 4
    kept = problem(observe(track, cloud=clouds), cloud_points=None)
    assert kept.is_observed.sum(dim=1).tolist() == [500] * 3


def test_an_object_can_be_taken_to_rest() -> None:
    track = np.repeat(NODE[None], 4, axis=0) + np.arange(4)[:, None, None] * 0.1
    observation = observe(track, node_of_track=np.arange(5, dtype=np.int32))
    np.testing.assert_allclose(problem(observation).initial_velocity, 3.0, atol=1e-4)
    assert not problem(observation, starts_at_rest=True).initial_velocity.any()


def test_a_node_that_is_first_seen_later_counts_from_then_on() -> None:
    track = np.repeat(NODE[None], 4, axis=0).astype(float)
    track[0, 1] = np.nan
    track[2, 1] += [0.0, 0.4, 0.0]
    seen = problem(observe(track, node_of_track=np.arange(5, dtype=np.int32)))
    node = torch.from_numpy(NODE)[None].repeat(2, 1, 1)
    assert seen.frame_losses(node).tolist() == pytest.approx([0.0, 0.16 / 5])
