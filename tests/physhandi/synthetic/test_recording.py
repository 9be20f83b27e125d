"""What a made-up recording holds of a stage, compared with the stage itself."""

import errno
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from support.physics.synthetic_world import bare_hands, distance_to_sheet, lifted_sheet

from physhandi.data.sequence import Sequence, ViewMeta
from physhandi.data.sequence_meta import SequenceMeta
from physhandi.data.sequence_writer import SequenceWriter
from physhandi.data.truth import read_truth
from physhandi.errors import CancelledError
from physhandi.perception.lifting import hand_points, observe_object
from physhandi.progress import NullProgress, Progress
from physhandi.synthetic.film.cameras import (
    Viewpoint,
    make_held_out_viewpoint,
    make_viewpoints,
    with_image_size,
)
from physhandi.synthetic.film.degradations import PRESETS, Degradations
from physhandi.synthetic.film.filmed_scene import make_filmed_scene, spread_points, surface_area
from physhandi.synthetic.film.recording import record
from physhandi.synthetic.film.rendering import resized

FRAMES = 4
CLEAN = PRESETS["clean"]


def write(
    folder: Path,
    level: Degradations = CLEAN,
    *,
    images: str = "none",
    sides: tuple[str, ...] = ("right",),
    seed: int = 1,
    delay: float = 0.0,
    held_out: bool = False,
    frames: int = FRAMES,
    progress: Progress | None = None,
) -> Sequence:
    """Record a lifted sheet with two cameras, in small images if there are any."""
    truth = lifted_sheet(frames, sides)
    stage = make_filmed_scene(truth, bare_hands(truth), level, seed)
    views = make_viewpoints(stage.extent(), 2, level, seed)
    beside = [make_held_out_viewpoint(stage.extent(), 2, seed)] if held_out else []
    if images == "all":
        views = tuple(
            replace(v, camera=resized(v.camera, 0.25), calibrated=resized(v.calibrated, 0.25))
            for v in views
        )
    if delay:
        views = tuple(replace(view, delay=delay) for view in views)
    with SequenceWriter(folder) as writer:
        record(
            writer,
            stage,
            views,
            level,
            seed=seed,
            images=images,
            held_out=[with_image_size(view, "half") for view in beside],
            progress=progress or NullProgress(),
        )
        return writer.finish(describe(folder.name, stage.hands, views, frames))


def describe(
    name: str, hands: tuple, views: tuple[Viewpoint, ...], frames: int = FRAMES
) -> SequenceMeta:
    return SequenceMeta(
        name=name,
        frame_rate=30.0,
        frame_count=frames,
        ground_height=0.0,
        hands=tuple(hand.side for hand in hands),
        views=tuple(ViewMeta(name=view.name, camera=view.calibrated) for view in views),
    )


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    return write(tmp_path_factory.mktemp("recording") / "clean", images="all")


@pytest.fixture(scope="module")
def imageless(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    return write(tmp_path_factory.mktemp("recording") / "imageless")


def test_a_clean_recording_shows_everything_where_it_is(clean):
    truth = lifted_sheet(FRAMES)
    assert clean.missing("color", "depth", "mask", "keypoint", "track") == []
    observation, hand = observe_object(clean), hand_points(clean)[0]
    known = read_truth(clean.folder)
    for frame in range(FRAMES):
        assert len(observation.cloud[frame]) > 400
        off = distance_to_sheet(truth, frame, observation.cloud[frame])
        assert np.median(np.abs(off)) < 0.001
        assert abs(np.median(off)) < 0.0005
        assert len(hand[frame]) > 100
        near = cKDTree(known.hand_vertex["right"][frame]).query(hand[frame])[0]
        assert np.percentile(near, 95) < 0.008
    # The far edge rises by 10 mm a frame: a picture of another frame would be off by half of it.
    rise = np.median(observation.cloud[3][:, 2]) - np.median(observation.cloud[0][:, 2])
    assert rise == pytest.approx(0.015, abs=0.003)
    assert observation.track_count > 200
    assert np.isfinite(observation.point[1:]).all(axis=-1).mean() > 0.7


def test_clean_keypoints_are_projections_of_the_true_ones(clean):
    known = read_truth(clean.folder).hand_keypoint["right"].astype(np.float64)
    for view in clean.views:
        assert view.keypoint.shape == (FRAMES, 1, 21, 3)
        np.testing.assert_allclose(
            view.keypoint[:, 0, :, :2], view.camera.project(known), atol=1e-3
        )
        hidden = view.keypoint[..., 2] < 0.7
        assert (~hidden).sum() > 0


def test_color_shows_the_cloth_and_the_hand_on_the_table(clean):
    view = clean.views[0]
    image, mask = view.color(2).astype(float), view.mask(2)
    cloth, hand, table = (np.median(image[mask == label], axis=0) for label in (1, 2, 0))
    assert cloth[2] > cloth[0] + 30
    assert hand[0] > hand[2] + 30
    assert np.ptp(hand) > np.ptp(table) + 10


def test_the_truth_is_told_in_world_places(clean, imageless):
    for sequence in (clean, imageless):
        known, truth = read_truth(sequence.folder), lifted_sheet(FRAMES)
        np.testing.assert_array_equal(known.object_point, truth.position)
        np.testing.assert_array_equal(known.object_face, truth.body.faces)
        np.testing.assert_array_equal(known.contact, truth.contact)
        assert 0 < known.contact[0].sum() < 20
        wrist = known.hand_keypoint["right"][:, 0]
        np.testing.assert_allclose(wrist[:, 2], 0.06 + 0.01 * np.arange(FRAMES), atol=0.001)
        path = sequence.validation_track
        assert path.shape == (FRAMES, 200, 3)
        for frame in range(FRAMES):
            assert np.abs(distance_to_sheet(truth, frame, path[frame])).max() < 0.001
        assert np.abs(path[3, :, 2] - path[0, :, 2]).max() > 0.02


def test_without_images_the_lifted_tracks_are_markers(imageless):
    assert imageless.missing("color", "depth", "mask") == ["color", "depth", "mask"]
    assert not any(imageless.folder.rglob("*.png"))
    observation = observe_object(imageless)
    assert observation.cloud[0].shape[0] > 150
    for frame in range(FRAMES):
        off = distance_to_sheet(lifted_sheet(FRAMES), frame, observation.cloud[frame])
        assert np.abs(off).max() < 0.0005
    assert observation.is_motion_valid[1:].mean() > 0.5
    assert imageless.views[0].keypoint.shape == (FRAMES, 1, 21, 3)


def test_a_held_out_view_shows_without_errors_what_the_others_show_with_them(tmp_path):
    level = replace(PRESETS["hard"], hand_error=0.03)
    sequence = write(tmp_path / "held", level, held_out=True)
    assert [view.name for view in sequence.views] == ["camera0", "camera1"]
    (view,) = sequence.held_out_views
    assert (view.camera.width, view.camera.height) == (424, 240)
    known = read_truth(sequence.folder)
    for frame in (0, 3):
        mask, depth = view.mask(frame), view.depth(frame)
        row, column = np.nonzero((mask == 1) & (depth > 0))
        point = view.camera.unproject(
            np.stack([column, row], axis=1).astype(np.float64), depth[row, column]
        )
        assert len(point) > 300
        # Depth is whole millimetres.
        assert np.abs(distance_to_sheet(lifted_sheet(FRAMES), frame, point)).max() < 0.0008
        row, column = np.nonzero((mask == 2) & (depth > 0))
        point = view.camera.unproject(
            np.stack([column, row], axis=1).astype(np.float64), depth[row, column]
        )
        assert len(point) > 100
        # The others find the hand 30 mm beside where it is.
        near = cKDTree(known.hand_vertex["right"][frame]).query(point)[0]
        assert np.percentile(near, 95) < 0.008
    color, mask = view.color(2).astype(float), view.mask(2)
    cloth, table = (np.median(color[mask == label], axis=0) for label in (1, 0))
    assert cloth[2] - cloth[0] > table[2] - table[0] + 30
    # The others are what they are without it.
    without = write(tmp_path / "without", level)
    for one, other in zip(sequence.views, without.views, strict=True):
        assert one.camera.to_dict() == other.camera.to_dict()
        np.testing.assert_array_equal(one.keypoint, other.keypoint)
    np.testing.assert_array_equal(sequence.marker, without.marker)
    np.testing.assert_array_equal(observe_object(sequence).point, observe_object(without).point)


def test_smaller_pictures_have_the_same_errors_in_the_world(tmp_path):
    truth = lifted_sheet(FRAMES)
    level = Degradations(keypoint_noise=3.0)
    stage = make_filmed_scene(truth, bare_hands(truth), level, 1)
    (full,) = make_viewpoints(stage.extent(), 1, level, 1)
    known = np.stack([hand.keypoint for hand in stage.hands], axis=1)
    spread = []
    for size in ("full", "half", "quarter"):
        view = with_image_size(full, size)
        with SequenceWriter(tmp_path / size) as writer:
            record(writer, stage, [view], level, seed=1, images="none", progress=NullProgress())
            made = writer.finish(describe(size, stage.hands, (view,)))
        seen = made.views[0].keypoint
        off = (seen[..., :2] - view.camera.project(known))[np.isfinite(seen[..., 0])]
        spread.append(off.std() / view.camera.width)
    # 3 px of 848 where a keypoint is seen, 6 where it is hidden.
    assert 3 / 848 < spread[0] < 6 / 848
    np.testing.assert_allclose(spread[1:], spread[0], rtol=0.15)


def test_noise_and_a_wrong_calibration_are_in_the_markers(tmp_path, imageless):
    truth = lifted_sheet(FRAMES)
    noisy = write(tmp_path / "noisy", Degradations(depth_noise=0.08))
    off = distance_to_sheet(truth, 0, observe_object(noisy).cloud[0])
    # 0.7 to 1.9 mm along lines of sight that meet the sheet at 30 to 55 degrees.
    assert 0.0004 < off.std() < 0.0014
    turned = write(tmp_path / "turned", Degradations(camera_shift=0.002))
    marker, exact = turned.marker[0], imageless.marker[0]
    both = np.isfinite(marker).all(axis=1) & np.isfinite(exact).all(axis=1)
    distance = np.linalg.norm(marker - exact, axis=1)[both]
    np.testing.assert_allclose(distance, 0.002, atol=1e-5)


def test_a_late_camera_sees_a_later_time(tmp_path):
    truth = lifted_sheet(FRAMES)
    late = write(tmp_path / "late", delay=0.020)
    cloud = observe_object(late).cloud[1]
    assert np.abs(distance_to_sheet(truth, 1.6, cloud)).max() < 0.0005
    assert np.abs(distance_to_sheet(truth, 1, cloud)).max() > 0.004
    keypoint = read_truth(late.folder).hand_keypoint["right"].astype(np.float64)
    between = 0.4 * keypoint[1] + 0.6 * keypoint[2]
    view = late.views[1]
    np.testing.assert_allclose(view.keypoint[1, 0, :, :2], view.camera.project(between), atol=1e-3)


def test_two_hands_are_labelled_apart(tmp_path):
    sequence = write(tmp_path / "two", images="all", sides=("left", "right"), frames=1)
    assert sequence.hands == ("right", "left")
    known = read_truth(sequence.folder).hand_keypoint
    assert known["right"][0, :, 1].mean() > 0.05 > -0.05 > known["left"][0, :, 1].mean()
    for hand, side in ((0, 1), (1, -1)):
        points = hand_points(sequence)[hand][0]
        assert len(points) > 60
        assert (side * points[:, 1] > 0).mean() > 0.97
    labels = np.unique(np.concatenate([view.mask(0).ravel() for view in sequence.views]))
    assert labels.tolist() == [0, 1, 2, 3]


def test_a_misplaced_hand_is_filmed_where_it_is_found_but_told_where_it_is(tmp_path, clean):
    sequence = write(tmp_path / "off", Degradations(hand_error=0.010), images="all", frames=2)
    known = read_truth(sequence.folder).hand_keypoint["right"]
    np.testing.assert_array_equal(known, read_truth(clean.folder).hand_keypoint["right"][:2])
    view, before = sequence.views[0], clean.views[0]
    moved = np.linalg.norm(view.keypoint[..., :2] - before.keypoint[:2, ..., :2], axis=-1)
    assert 0.5 < np.median(moved) < 2.7  # 10 mm are at most 1.7 px at this size.
    assert (view.mask(0) == 2).sum() > 100
    assert ((view.mask(0) == 2) != (before.mask(0) == 2)).any()


def test_soft_tissue_thickens_the_filmed_hand_only():
    truth = lifted_sheet(2)
    bare = make_filmed_scene(truth, bare_hands(truth), CLEAN, 1).hands[0]
    soft = make_filmed_scene(truth, bare_hands(truth), PRESETS["default"], 1).hands[0]
    distance = np.linalg.norm(soft.vertex - bare.vertex, axis=-1)
    assert distance.min() > 0.0008
    assert 0.0010 < distance.mean() < 0.0020
    np.testing.assert_array_equal(soft.keypoint, bare.keypoint)


def test_the_same_seed_gives_the_same_bytes_and_another_does_not(tmp_path):
    level = PRESETS["hard"]
    one, same, other = (
        write(tmp_path / name, level, seed=seed, frames=2)
        for name, seed in (("one", 3), ("same", 3), ("other", 4))
    )
    files = [path.relative_to(one.folder) for path in one.folder.rglob("*.npy")]
    assert len(files) > 8
    for file in files:
        assert (one.folder / file).read_bytes() == (same.folder / file).read_bytes()
    assert one.marker.shape != other.marker.shape or not np.array_equal(one.marker, other.marker)


def test_a_full_disk_leaves_nothing_and_is_told(tmp_path, monkeypatch):
    real, count = Path.write_bytes, 0

    def write_until_full(path: Path, data: bytes) -> int:
        nonlocal count
        count += 1
        if count > 3:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(path, data)

    monkeypatch.setattr(Path, "write_bytes", write_until_full)
    with pytest.raises(OSError, match=r"No space left.*00001\.png"):
        write(tmp_path / "full", images="all", frames=2)
    assert count == 4
    assert list(tmp_path.iterdir()) == []


def test_a_stop_while_it_is_filmed_leaves_nothing(tmp_path):
    told = []

    class Stops(Progress):
        def report(self, stage, iteration, total, loss=None, message=""):
            told.append((stage, iteration, total))

        def check_cancelled(self):
            if len(told) == 2:
                raise CancelledError("stopped")

    with pytest.raises(CancelledError):
        write(tmp_path / "half", progress=Stops())
    assert told == [("filming", 1, 2 * FRAMES), ("filming", 2, 2 * FRAMES)]
    assert list(tmp_path.iterdir()) == []


def test_spread_points_leave_no_part_of_a_surface_out():
    truth = lifted_sheet(1)
    node, faces = truth.body.node, truth.body.faces
    assert surface_area(node, faces) == pytest.approx(0.20 * 0.15)
    points = spread_points(node, faces, 120, np.random.default_rng(0))
    place = points.at(node)
    np.testing.assert_allclose(place[:, 2], 0.002, atol=1e-12)
    nearest = cKDTree(place).query(place, k=2)[0][:, 1]
    # Evenly laid, 120 points on 0.03 m² are 16 mm apart; drawn at random half of that.
    assert nearest.min() > 0.009
    assert cKDTree(place).query(node)[0].max() < 0.018
