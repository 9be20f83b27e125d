from pathlib import Path
from typing import Any

import numpy as np
import pytest

from physhandi.data.sequence_meta import SequenceMeta
from physhandi.data.sequence_writer import write_sequence
from physhandi.errors import CancelledError, MissingInputError
from physhandi.perception.lifting import fuse, hand_points, observe_object, surface_points
from physhandi.progress import Progress


class Counting(Progress):
    def __init__(self, stop_at: int = 99) -> None:
        self.reports: list[int] = []
        self.stop_at = stop_at

    def report(self, *told: Any) -> None:
        self.reports.append(told[1])

    def check_cancelled(self) -> None:
        if len(self.reports) >= self.stop_at:
            raise CancelledError("stopped")


def test_tracks_of_a_rising_plate_are_lifted_to_where_they_are(plate):
    observation = observe_object(plate)
    assert observation.point.shape == (3, 2 * 17 * 9, 3)
    assert observation.is_visible.all()
    expected = np.stack(np.meshgrid(np.arange(-8, 9) * 0.01, np.arange(-4, 5) * 0.01), -1)
    for frame in range(3):
        height = np.full((153, 1), 0.01 * frame)
        truth = np.tile(np.concatenate([expected.reshape(-1, 2), height], axis=1), (2, 1))
        np.testing.assert_allclose(observation.point[frame], truth, atol=1e-5)
    assert not observation.is_motion_valid[0].any()
    assert observation.is_motion_valid[1:].all()


def test_tracks_that_come_into_view_later_are_kept_apart(plate):
    known = observe_object(plate)
    for view in plate.views:
        visible = np.ones(view.track.shape[:2], dtype=bool)
        visible[0, 4] = visible[:2, 9] = visible[:, 5] = False
        object.__setattr__(view, "track_visible", visible)
    observation = observe_object(plate)
    shown = [track for track in range(2 * 153) if track % 153 not in {4, 5, 9}]
    np.testing.assert_array_equal(observation.point, known.point[:, shown])
    late = known.point[:, [4, 9, 153 + 4, 153 + 9]].copy()
    late[0] = late[1, 1::2] = np.nan
    np.testing.assert_array_equal(observation.late, late)
    assert known.late.shape == (3, 0, 3)


def test_cloud_covers_the_plate_once_at_voxel_spacing(plate):
    cloud = observe_object(plate).cloud
    assert len(cloud) == 3
    for frame, points in enumerate(cloud):
        np.testing.assert_allclose(points[:, 2], 0.01 * frame, atol=1e-5)
        np.testing.assert_allclose(np.ptp(points[:, :2], axis=0), [0.2, 0.12], atol=0.009)
        cells = 0.2 * 0.12 / 0.0045**2
        assert 0.75 * cells < len(points) < 1.3 * cells


def test_hand_points_are_those_of_the_hands_label(held_plate):
    (right,) = hand_points(held_plate)
    assert len(right) == 3
    for frame, points in enumerate(right):
        np.testing.assert_allclose(points[:, 2], 0.01 * frame + 0.03, atol=1e-5)
        assert points[:, 0].min() > 0.045
        assert len(points) > 100


def test_object_cloud_leaves_out_what_the_hand_covers(held_plate):
    points = observe_object(held_plate).cloud[0]
    in_hand = (points[:, 0] > 0.06) & (abs(points[:, 1]) < 0.02)
    assert not in_hand.any()
    assert len(points) > 500


def test_mixed_pixels_at_an_edge_are_not_lifted(plate):
    view = plate.views[0]
    depth, label = view.depth(0), view.mask(0) == 1
    depth = depth.copy()
    row, column = np.argwhere(label)[0] + [4, 4]
    depth[row, column] = 0.57
    points = surface_points(view, depth, label)
    assert len(points) > 1000
    assert np.abs(points[:, 2]).max() < 1e-6


def test_a_rope_of_two_pixels_above_a_table_is_lifted_without_the_table(plate):
    view = plate.views[0]
    rows, columns = np.indices(view.depth(0).shape)
    # One row further every two columns: half of its pixels have four beside them that show it.
    above_line = rows - 40 - columns // 2
    is_inside = (columns >= 20) & (columns < 80)
    rope = is_inside & (above_line >= 0) & (above_line < 2)
    label = is_inside & (above_line >= 0) & (above_line < 3)
    depth = np.where(rope, 0.5, 0.6).astype(np.float32)
    depth[rope & (columns == 50)] = 0.55
    points = surface_points(view, depth, label)
    found = view.camera.camera_depth(points)
    assert 0.9 * rope.sum() < (abs(found - 0.5) < 1e-6).sum() <= rope.sum() - 2
    assert not ((found > 0.51) & (found < 0.59)).any()
    assert (found > 0.59).sum() < 0.2 * rope.sum()


def test_fuse_averages_a_voxel_and_drops_lonely_points():
    grid = np.stack(np.meshgrid(np.arange(10), np.arange(10), [0.0]), -1).reshape(-1, 3) * 0.0045
    grid += 0.0022
    lift = np.array([0, 0, 0.001])
    above, below = grid + lift, grid - lift
    fused = fuse([above, below, np.array([[0.5, 0.5, 0.5]])])
    assert fused.shape == (100, 3)
    np.testing.assert_allclose(fused[:, 2], 0.0022, atol=1e-6)
    # So many voxels lie between these that no number is large enough for all.
    far = np.array([[9e6, -9e6, 9e6], [-9e6, 9e6, -9e6]])
    np.testing.assert_array_equal(fuse([above, below, far]), fused)
    assert fuse([]).shape == (0, 3)


def test_progress_hears_each_frame_and_may_stop(plate):
    progress = Counting()
    observe_object(plate, progress)
    assert progress.reports == [1, 2, 3]
    with pytest.raises(CancelledError):
        observe_object(plate, Counting(stop_at=1))


def test_markers_become_identified_tracks(tmp_path: Path):
    marker = np.zeros((3, 2, 3), dtype=np.float32)
    marker[:, 1] = 0.5
    marker[1, 1] = np.nan
    sequence = write_sequence(
        tmp_path / "mocap",
        SequenceMeta(name="mocap", frame_rate=60.0, frame_count=3),
        {
            "marker.npy": marker,
            "marker_node.npy": np.array([2, 0], dtype=np.int32),
            "object_node.npy": np.eye(3, dtype=np.float32),
            "control.npy": np.zeros((3, 1, 3), dtype=np.float32),
        },
    )
    observation = observe_object(sequence)
    assert observation.node_of_track is not None
    assert observation.node_of_track.tolist() == [2, 0]
    assert observation.is_visible.tolist() == [[True, True], [True, False], [True, True]]
    assert observation.is_motion_valid.tolist() == [[False, False], [True, False], [True, False]]
    assert observation.cloud == ()
    with pytest.raises(MissingInputError, match="no view has both"):
        hand_points(sequence)


def test_judged_markers_are_the_cloud_and_keep_their_judgement(tmp_path: Path):
    marker = 0.1 * np.arange(3 * 4 * 3, dtype=np.float32).reshape(3, 4, 3)
    marker[1, 1] = marker[2, 3] = np.nan
    # Seen in both frames: all but markers 1 (twice) and 3 (frame 2); marker 0 slipped to frame 1.
    is_valid = np.array([[0, 0, 0, 0], [0, 0, 1, 1], [1, 0, 1, 0]], dtype=bool)
    sequence = write_sequence(
        tmp_path / "twin",
        SequenceMeta(name="twin", frame_rate=30.0, frame_count=3),
        {
            "marker.npy": marker,
            "marker_motion_valid.npy": is_valid,
            "marker_node.npy": np.arange(4, dtype=np.int32),
            "object_node.npy": marker[0],
            "control.npy": np.zeros((3, 1, 3), dtype=np.float32),
        },
    )
    observation = observe_object(sequence)
    assert observation.is_motion_valid.tolist() == is_valid.tolist()
    assert [len(cloud) for cloud in observation.cloud] == [4, 3, 3]
    np.testing.assert_array_equal(observation.cloud[1], marker[1, [0, 2, 3]])
    with pytest.raises(CancelledError):
        observe_object(sequence, Counting(stop_at=0))


def test_missing_input_names_the_view_and_the_part(tmp_path: Path, plate):
    meta = plate.meta
    color = np.zeros((101, 121, 3), dtype=np.uint8)
    images = {f"views/{view}/color/{frame:05d}.png": color for view in "ab" for frame in range(3)}
    sequence = write_sequence(tmp_path / "plate", meta, images=images)
    with pytest.raises(
        MissingInputError, match=r"'plate'.*a: depth/ and mask/; b: depth/ and mask/"
    ):
        observe_object(sequence)
