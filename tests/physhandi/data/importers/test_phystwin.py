"""Importing a PhysTwin case: what it means in our world, and every way in which it can be wrong."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.inputs.phystwin_case import (
    FRAMES,
    HEIGHT,
    TRAIN,
    WIDTH,
    Case,
    color_of,
    depth_of,
    edit_json,
    edit_pickle,
    masks_of,
    pixel_of,
    save_pickle,
    write_case,
    write_video,
)

from physhandi.data.importers.phystwin import import_phystwin
from physhandi.data.sequence import Sequence
from physhandi.errors import CancelledError, ImportFailedError, SequenceError
from physhandi.perception.lifting import observe_object
from physhandi.progress import Progress

UP = np.array([1.0, -1.0, -1.0])
"""Turns a world whose z points down about its x axis."""


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Case:
    return write_case(tmp_path_factory.mktemp("cases") / "single_lift_sloth")


@pytest.fixture(scope="module")
def sequence(case: Case, tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    return Sequence.load(import_phystwin(case.folder, tmp_path_factory.mktemp("out") / "sloth"))


@pytest.fixture
def copied(case: Case, tmp_path: Path) -> Path:
    return Path(shutil.copytree(case.folder, tmp_path / "case"))


def test_points_stand_above_the_ground_and_keep_their_handedness(
    case: Case, sequence: Sequence
) -> None:
    assert (sequence.ground_height, sequence.gravity) == (0.0, 9.8)
    assert sequence.object_node is not None
    assert sequence.object_node[:, 2].min() > 0.001
    # A mirrored world would turn right hands into left ones: the rotation must have det +1.
    corner, turned = case.node[:4], sequence.object_node[:4].astype(float)
    volume = [np.linalg.det(nodes[1:] - nodes[0]) for nodes in (corner, turned)]
    assert volume[1] == pytest.approx(volume[0], rel=1e-4)
    assert abs(volume[0]) > 1e-8
    np.testing.assert_array_equal(sequence.control, (case.control * UP).astype(np.float32))


def test_nodes_are_tracked_then_surface_then_interior(case: Case, sequence: Sequence) -> None:
    np.testing.assert_array_equal(sequence.object_node, (case.node * UP).astype(np.float32))
    assert sequence.surface_node_count == 26 + 12
    np.testing.assert_array_equal(sequence.marker_node, np.arange(26))


def test_invisible_points_are_nan_and_never_the_origin(case: Case, sequence: Sequence) -> None:
    marker = np.asarray(sequence.marker)
    assert 10 < (~case.is_visible).sum() < 60
    np.testing.assert_array_equal(np.isnan(marker).all(axis=-1), ~case.is_visible)
    seen = (case.point * UP).astype(np.float32)[case.is_visible]
    np.testing.assert_array_equal(marker[case.is_visible], seen)


def test_motion_flags_move_to_the_frame_where_the_motion_ends(
    case: Case, sequence: Sequence
) -> None:
    is_valid = np.asarray(sequence.marker_motion_valid)
    assert not is_valid[0].any()
    for frame in range(1, FRAMES):
        np.testing.assert_array_equal(is_valid[frame], case.motion_valid[frame - 1])
    assert not np.array_equal(is_valid[2], case.motion_valid[2])
    observation = observe_object(sequence)
    np.testing.assert_array_equal(observation.is_motion_valid, is_valid)
    assert [len(cloud) for cloud in observation.cloud] == case.is_visible.sum(axis=1).tolist()


def test_split_and_rate_are_taken_over(sequence: Sequence) -> None:
    assert (sequence.frame_count, sequence.frame_rate) == (FRAMES, 30.0)
    assert len(sequence.reconstruction_frames) == TRAIN
    assert sequence.provenance["z_axis_pointed"] == "down"
    assert sequence.provenance["serial_numbers"] == ["sn0", "sn1", "sn2"]


def test_annotated_tracks_are_kept_apart(case: Case, sequence: Sequence) -> None:
    expected = (case.validation * UP).astype(np.float32)
    np.testing.assert_array_equal(sequence.validation_track, expected)
    assert np.isnan(expected[1, 2]).all()
    assert sequence.missing("validation_track", "rest_node") == ["rest_node"]


def test_cameras_see_the_markers_where_the_tracks_are(case: Case, sequence: Sequence) -> None:
    assert [view.name for view in sequence.views] == ["view0", "view1", "view2"]
    for camera, view in enumerate(sequence.views):
        assert (view.camera.width, view.camera.height) == (WIDTH, HEIGHT)
        assert view.camera.K[0, 0] == 110 + camera
        assert view.camera.T_world_camera[2, 3] == pytest.approx(0.35)
        expected, depth = pixel_of(case, camera)
        assert view.track is not None
        np.testing.assert_allclose(view.track, expected, atol=1e-4)
        np.testing.assert_array_equal(view.track_visible, case.is_visible)
        seen = case.is_visible
        marker = np.asarray(sequence.marker, np.float64)[seen]
        np.testing.assert_allclose(view.camera.project(marker), view.track[seen], atol=1e-3)
        np.testing.assert_allclose(view.camera.camera_depth(marker), depth[seen], atol=1e-6)
        # Rows and columns differ by enough to tell a swap.
        assert np.abs(expected[..., 0] - expected[..., 1]).mean() > 5


def test_images_come_back_as_they_were(case: Case, sequence: Sequence) -> None:
    for camera, view in enumerate(sequence.views):
        for frame in (0, FRAMES - 1):
            np.testing.assert_array_equal(view.color(frame), color_of(camera, frame))
            expected = depth_of(case, camera, frame).astype(np.float32) * np.float32(1e-3)
            np.testing.assert_array_equal(view.depth(frame), expected)
            masks = masks_of(frame)
            label = np.where(masks["10"], 3, np.where(masks["0"], 2, masks["2"]))
            np.testing.assert_array_equal(view.mask(frame), label)
            assert set(np.unique(label)) == {0, 1, 2, 3}


def test_a_board_whose_z_points_up_is_not_turned(tmp_path: Path) -> None:
    case = write_case(tmp_path / "case", z_down=False, camera_count=2)
    sequence = Sequence.load(import_phystwin(case.folder, tmp_path / "out"))
    np.testing.assert_array_equal(sequence.object_node, case.node.astype(np.float32))
    assert sequence.provenance["z_axis_pointed"] == "up"
    assert len(sequence.views) == 2
    np.testing.assert_allclose(sequence.views[1].camera.T_world_camera, case.pose[1])


def test_without_images_and_shape_prior_the_motion_is_left(tmp_path: Path) -> None:
    case = write_case(tmp_path / "case", has_prior=False, has_images=False)
    edit_pickle(case.folder / "final_data.pkl", interior_points=None, surface_points=np.zeros(0))
    sequence = Sequence.load(import_phystwin(case.folder, tmp_path / "out"))
    assert sequence.views == ()
    assert sequence.object_node is not None
    assert len(sequence.object_node) == sequence.surface_node_count == 26
    assert sequence.missing("object") == []
    assert sequence.provenance["frame_rate_was_given"] is False
    (case.folder / "calibrate.pkl").unlink()
    (case.folder / "split.json").unlink()
    bare = Sequence.load(import_phystwin(case.folder, tmp_path / "bare"))
    np.testing.assert_array_equal(bare.marker, sequence.marker)
    assert len(bare.reconstruction_frames) == 3  # floor(0.7 · 5)


def test_images_alone_make_a_sequence_of_views(copied: Path, tmp_path: Path) -> None:
    for name in ("final_data.pkl", "split.json", "gt_track_3d.pkl"):
        (copied / name).unlink()
    edit_json(copied / "metadata.json", frame_num=None, recording=None)
    sequence = Sequence.load(import_phystwin(copied, tmp_path / "out"))
    assert sequence.frame_count == FRAMES
    assert sequence.missing("color", "depth", "mask", "track") == []
    assert sequence.missing("control", "marker", "object_node") == [
        "control",
        "marker",
        "object_node",
    ]
    assert sequence.provenance["z_axis_pointed"] == "down"


def test_videos_and_cleaned_masks_take_the_place_of_images(copied: Path, tmp_path: Path) -> None:
    for camera in range(3):
        write_video(copied, camera)
        shutil.rmtree(copied / f"mask/{camera}")
    masks: list[Any] = [
        {
            camera: {"object": masks_of(frame)["2"], "controller": masks_of(frame)["0"]}
            for camera in range(3)
        }
        for frame in range(FRAMES)
    ]
    save_pickle(copied / "mask/processed_masks.pkl", dict(enumerate(masks)))
    sequence = Sequence.load(import_phystwin(copied, tmp_path / "out"))
    for view in sequence.views:
        assert view.color(3).mean() == pytest.approx(120, abs=4)
        expected = np.where(masks[4][0]["controller"], 2, masks[4][0]["object"])
        np.testing.assert_array_equal(view.mask(4), expected)
    del masks[2][1]
    for wrong, where in ((masks, "frame 2, camera 1"), (masks[:1], "frame 1, camera 0"), (3, "0")):
        save_pickle(copied / "mask/processed_masks.pkl", wrong)
        with pytest.raises(ImportFailedError, match=rf"processed_masks\.pkl: .*{where} is missing"):
            import_phystwin(copied, tmp_path / "again")


def test_each_camera_may_lack_parts(copied: Path, tmp_path: Path) -> None:
    shutil.rmtree(copied / "depth/1")
    shutil.rmtree(copied / "mask/1")
    (copied / "cotracker/1.npz").unlink()
    for name in ("color", "depth", "mask"):
        shutil.rmtree(copied / name / "2")
    (copied / "cotracker/2.npz").unlink()
    first, second, third = Sequence.load(import_phystwin(copied, tmp_path / "out")).views
    parts = [(v.has_color, v.has_depth, v.has_mask, v.track is not None) for v in (second, third)]
    assert parts == [(True, False, False, False), (False, False, False, False)]
    assert (first.has_color, first.has_depth, first.has_mask) == (True, True, True)
    np.testing.assert_array_equal(second.color(4), color_of(1, 4))


def test_progress_is_told_and_may_stop_it(case: Case, tmp_path: Path) -> None:
    class Stopper(Progress):
        told: list[tuple[int, int]] = []  # noqa: RUF012 - one test, one list

        def report(self, stage: str, iteration: int, total: int, *rest: Any) -> None:
            self.told.append((iteration, total))

        def check_cancelled(self) -> None:
            if len(self.told) == 4:
                raise CancelledError("stopped")

    with pytest.raises(CancelledError):
        import_phystwin(case.folder, tmp_path / "out", Stopper())
    assert Stopper.told == [(1, 15), (2, 15), (3, 15), (4, 15)]
    assert list(tmp_path.iterdir()) == []


def test_a_sequence_is_replaced_only_when_asked(tmp_path: Path) -> None:
    case = write_case(tmp_path / "case", has_images=False)
    import_phystwin(case.folder, tmp_path / "out")
    with pytest.raises(SequenceError, match="exists already"):
        import_phystwin(case.folder, tmp_path / "out")
    import_phystwin(case.folder, tmp_path / "out", overwrite=True)


def test_a_file_in_place_of_a_case_is_refused(case: Case, tmp_path: Path) -> None:
    with pytest.raises(ImportFailedError, match="is not a folder"):
        import_phystwin(case.folder / "final_data.pkl", tmp_path / "out")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ImportFailedError, match=r"neither final_data\.pkl nor metadata\.json"):
        import_phystwin(tmp_path / "empty", tmp_path / "out")
