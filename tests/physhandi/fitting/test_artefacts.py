"""What a run keeps of an observation comes back."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from support.physics.hand_scene import grasping, looking_at_hand, write_scene
from support.server.run_world import make_run

from physhandi.data.observation import ObjectObservation
from physhandi.fitting.artefacts import (
    STORED_CLOUD,
    STORED_HAND,
    copy_hand_observation,
    lifted_hand_points,
    load_observation,
    save_hand_points,
    save_observation,
)
from physhandi.hand.loading import load_hand_model
from physhandi.progress import NullProgress
from physhandi.run import Run


@pytest.mark.parametrize("is_identified", [True, False])
def test_clouds_of_identified_points_are_kept_whole(tmp_path: Path, *, is_identified: bool) -> None:
    count = STORED_CLOUD + 100
    point = np.random.default_rng(0).normal(size=(3, count, 3)).astype(np.float32)
    point[2, 7] = np.nan
    seen = np.isfinite(point).all(axis=-1)
    late = np.full((3, 2, 3), np.nan, np.float32)
    late[1:, 0], late[2, 1] = point[1:, 0], point[2, 1]
    observation = ObjectObservation(
        point=point,
        is_visible=seen,
        is_motion_valid=np.zeros_like(seen),
        cloud=tuple(p[s] for p, s in zip(point, seen, strict=True)),
        node_of_track=np.arange(count, dtype=np.int32) if is_identified else None,
        late=None if is_identified else late,
    )
    with make_run(tmp_path / "run").begin_attempt() as attempt:
        save_observation(attempt, "lift", observation)
        again = load_observation(attempt.out, "lift")
        attempt.publish()
    sizes = [len(cloud) for cloud in again.cloud]
    assert sizes == ([count, count, count - 1] if is_identified else [STORED_CLOUD] * 3)
    np.testing.assert_array_equal(again.cloud[2][0], point[2, 0])
    np.testing.assert_array_equal(again.cloud[2][-1], point[2, -1])
    np.testing.assert_array_equal(again.point, point)
    if is_identified:
        assert again.late is None
    else:
        np.testing.assert_array_equal(again.late, late)


def test_measured_hand_points_lie_on_the_hand_of_their_frame(tmp_path: Path) -> None:
    motion = grasping(frames=3)
    cameras = [looking_at_hand(0.0), looking_at_hand(2.0)]
    sequence = write_scene(tmp_path / "lift", [motion], cameras, None, depth=True)
    vertex = motion.vertices(load_hand_model("right"))
    run = make_run(tmp_path / "run")
    with run.begin_attempt() as attempt:
        save_hand_points(attempt, sequence, NullProgress())
        attempt.publish()
    folder = "sequences/lift/observation"
    point, end = (run.array(f"{folder}/{name}.npy") for name in ("hand_point", "hand_point_end"))
    assert end.shape == (1, 3)
    assert point.shape == (end[0, -1], 3)
    frames = np.split(point, end[0, :-1])
    assert [len(points) for points in frames] == [STORED_HAND] * 3
    for number, points in enumerate(frames):
        assert np.median(cKDTree(vertex[number]).query(points)[0]) < 0.003
    assert np.median(cKDTree(vertex[0]).query(frames[2])[0]) > 0.004
    with make_run(tmp_path / "other").begin_attempt() as attempt:
        copy_hand_observation(Run.open(run.folder), "lift", attempt)
        attempt.publish()
    other = Run.open(tmp_path / "other")
    np.testing.assert_array_equal(other.array(f"{folder}/hand_point.npy"), point)
    assert not other.has("sequences/lift/keypoint.npy")


def test_views_without_depth_measure_no_hand_points(tmp_path: Path) -> None:
    motion = grasping(frames=2)
    keypoint = np.zeros((1, 2, 1, 21, 3))
    sequence = write_scene(tmp_path / "lift", [motion], [looking_at_hand(0.0)], keypoint)
    assert lifted_hand_points(sequence) is None
