from pathlib import Path

import cv2
import numpy as np
import pytest
from support.inputs.clicked_disc import FRAMES, TOP, cameras, center, write_disc

from physhandi.data.camera import PinholeCamera
from physhandi.data.sequence import Sequence, ViewMeta
from physhandi.data.sequence_meta import SequenceMeta
from physhandi.data.sequence_writer import write_sequence
from physhandi.errors import CancelledError
from physhandi.perception import point_tracking
from physhandi.perception.point_tracking import track_points
from physhandi.progress import Progress


@pytest.fixture(scope="module")
def disc(tmp_path_factory):
    return write_disc(tmp_path_factory.mktemp("track") / "disc")


@pytest.fixture(scope="module")
def found(disc):
    """The tracks of all of it."""
    return track_points(*disc)


def true_paths(view: str, pixel: np.ndarray, is_seen: np.ndarray) -> np.ndarray:
    """Where the points of the disc that tracks begin on are in every frame [px]."""
    camera = cameras()[view]
    eye = camera.T_world_camera[:3, 3]
    begin = is_seen.argmax(axis=0)
    start = pixel[begin, np.arange(pixel.shape[1])].astype(float)
    ray = camera.unproject(start, np.ones(len(start))) - eye
    place = eye + ray * ((TOP - eye[2]) / ray[:, 2])[:, None]
    paths = np.zeros(pixel.shape)
    for frame in range(len(pixel)):
        moved = place.copy()
        for track, first in enumerate(begin):
            moved[track, :2] += center(frame) - center(int(first))
        paths[frame] = camera.project(moved)
    return paths


def test_tracks_follow_the_surface_to_a_part_of_a_pixel(found):
    assert set(found) == {"top", "side"}
    for view, (pixel, is_seen) in found.items():
        assert pixel.dtype == np.float32
        np.testing.assert_array_equal(np.isfinite(pixel).all(axis=-1), is_seen)
        moved = np.linalg.norm(true_paths(view, pixel, is_seen)[-1] - pixel[0], axis=-1)
        assert np.nanmedian(moved) > 8
        error = np.linalg.norm(true_paths(view, pixel, is_seen) - pixel, axis=-1)
        assert np.median(error[is_seen]) < 0.2
        assert np.percentile(error[is_seen], 90) < 0.8
        assert is_seen.all(axis=0).sum() > 50


def test_enough_tracks_live_in_every_frame_and_none_off_the_object(disc, found):
    _, labels = disc
    for view, (pixel, is_seen) in found.items():
        assert 600 < (labels[view] == 1).sum(axis=(1, 2)).min() < 900
        assert is_seen.sum(axis=1).min() >= 150
        for frame in range(FRAMES):
            column, row = pixel[frame, is_seen[frame]].round().astype(int).T
            assert (labels[view][frame, row, column] == 1).all()


def test_tracks_end_under_a_hand_and_new_ones_begin_elsewhere(disc):
    sequence, labels = disc
    covered = {view: label.copy() for view, label in labels.items()}
    for frame in range(4, FRAMES):
        covered["top"][frame, :, : covered["top"].shape[2] // 2][
            covered["top"][frame, :, : covered["top"].shape[2] // 2] == 1
        ] = 2
    pixel, is_seen = track_points(sequence, covered)["top"]
    left = pixel[3, :, 0] < 50
    assert left[is_seen[3]].sum() > 10
    assert not is_seen[4:, left & is_seen[3]].any()
    assert (is_seen[-1] & ~is_seen[0]).any()


def test_a_jump_in_depth_ends_a_track(disc, monkeypatch):
    sequence, labels = disc
    view = sequence.views[0]
    read = type(view).depth

    def deeper(self, frame):
        depth = read(self, frame)
        return depth + np.float32(0.2) * (frame >= 5)

    monkeypatch.setattr(type(view), "depth", deeper)
    _, is_seen = track_points(sequence, labels)["top"]
    assert (is_seen[4] & is_seen[3]).sum() > 50
    assert not (is_seen[5] & is_seen[4]).any()
    assert is_seen[5].sum() > 50


def test_tracks_that_slide_over_the_surface_end_since_it_cannot_stretch_so(tmp_path, monkeypatch):
    """A tenth of the matches hangs on something else, which moves 0.9 px a frame faster."""
    sequence, labels = write_disc(tmp_path / "disc", frames=14)
    found = point_tracking._follow
    hung: list[np.ndarray] = []

    def dragged(before, now, start, size, guess=None, *, returns=0.3):
        if guess is not None:  # Where they began, the same hangs on them.
            return guess, np.ones(len(start), dtype=bool)
        end, is_found = found(before, now, start, size, returns=returns)
        where = hung.pop() if hung else start[::10]
        slides = np.linalg.norm(start[:, None] - where, axis=-1).min(axis=1, initial=9.0) < 1e-3
        end = end + np.float32(0.9) * np.stack([slides, 0 * slides], axis=-1)
        hung.append(end[slides])
        return end, is_found | slides

    monkeypatch.setattr(point_tracking, "_follow", dragged)

    def survivors() -> tuple[int, int]:
        hung.clear()
        pixel, is_seen = track_points(sequence, {"top": labels["top"]})["top"]
        error = np.linalg.norm(pixel - true_paths("top", pixel, is_seen), axis=-1)
        return int((is_seen & (error > 6)).sum()), int((is_seen & (error < 1)).sum())

    slid, stayed = survivors()
    monkeypatch.setattr(point_tracking, "_TORN", 2.0)
    all_slid, all_stayed = survivors()
    assert all_slid > 20
    assert slid < 0.6 * all_slid
    assert stayed > 0.95 * all_stayed


def write_shadowed_disc(folder: Path) -> tuple[Sequence, dict[str, np.ndarray]]:
    """Film the disc, fainter, under the edge of a shadow that stays while it slides below that."""
    sequence, labels = write_disc(folder, frames=14)
    row, column = np.mgrid[: labels["top"].shape[1], : labels["top"].shape[2]].astype(float)
    shade = 0.8 + 0.2 * np.tanh((column + 0.4 * row - 75) / 2)
    for path in sorted((sequence.folder / "views" / "top" / "color").iterdir()):
        image = cv2.imread(str(path)).astype(float)
        plain = 0.6 * image.mean(axis=(0, 1)) + 0.4 * image
        cv2.imwrite(str(path), (plain * shade[..., None]).round().astype(np.uint8))
    return Sequence.load(sequence.folder), {"top": labels["top"]}


def test_tracks_that_hang_on_a_shadow_end_since_their_beginning_is_not_there(tmp_path, monkeypatch):
    sequence, labels = write_shadowed_disc(tmp_path / "disc")

    def slid() -> tuple[float, int]:
        """Share of the points that are 3 px and more off, and how many are right to 1 px."""
        pixel, is_seen = track_points(sequence, labels)["top"]
        error = np.linalg.norm(pixel - true_paths("top", pixel, is_seen), axis=-1)[is_seen]
        return float((error > 3).mean()), int((error < 1).sum())

    share, right = slid()
    assert share < 0.2
    assert right > 2000

    def anything(
        _tracker: object, _images: object, _frame: int, end: np.ndarray, *_: float
    ) -> np.ndarray:
        return np.ones(len(end), dtype=bool)

    monkeypatch.setattr(point_tracking._Tracker, "_laid_onto_beginning", anything)
    share, right = slid()
    assert share > 0.4
    assert right < 1500


def write_strip(folder: Path, step: tuple[float, float]) -> tuple[Sequence, dict[str, np.ndarray]]:
    """Film a strip, three pixels wide, that slides by a step a frame [px] on a spotted table.

    A camera looks straight down, so its pixels move as the strip does. The table's spots have far
    more contrast than what is painted along the strip.
    """
    frames, height, width = 13, 64, 128
    row, column = np.mgrid[:height, :width].astype(float)
    random = np.random.default_rng(4)
    spots = cv2.GaussianBlur(random.normal(size=(height, width)), (0, 0), 1.2)
    wave = random.uniform(0, 2 * np.pi, 6)
    images: dict[str, np.ndarray] = {}
    label = np.zeros((frames, height, width), dtype=np.uint8)
    for frame in range(frames):
        x, y = column - frame * step[0], row - frame * step[1]
        paint = sum(np.sin(2 * np.pi * x / (9 + 4 * n) + phase) for n, phase in enumerate(wave))
        share = np.clip(2.0 - np.abs(y - 30), 0, 1) * np.clip(48 - np.abs(x - 60), 0, 1)
        gray = (1 - share) * (130 + 120 * spots) + share * (150 + 6 * paint)
        gray += random.normal(size=gray.shape)
        label[frame] = share > 0.5
        depth = np.where(label[frame], 480, 500).astype(np.uint16)
        images[f"views/top/color/{frame:05d}.png"] = np.repeat(
            gray.clip(0, 255).round().astype(np.uint8)[..., None], 3, axis=-1
        )
        images[f"views/top/depth/{frame:05d}.png"] = depth
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = 0.5
    K = np.array([[200, 0, width / 2], [0, 200, height / 2], [0, 0, 1]])
    camera = PinholeCamera(K=K, T_world_camera=pose, width=width, height=height)
    meta = SequenceMeta(
        name=folder.name,
        frame_rate=30.0,
        frame_count=frames,
        ground_height=0.0,
        hands=(),
        views=(ViewMeta(name="top", camera=camera),),
    )
    return write_sequence(folder, meta, {}, images=images), {"top": label}


@pytest.mark.parametrize("step", [(0.6, 0.0), (-0.5, 0.3)])
def test_tracks_of_a_thin_thing_go_along_with_it_and_do_not_stay_on_the_table(
    tmp_path, monkeypatch, step
):
    """What is seen around a thin thing fills most of what is matched, and does not move."""
    sequence, labels = write_strip(tmp_path / "strip", step)

    def left_behind() -> tuple[np.ndarray, np.ndarray]:
        """How far points are from where the strip carries them, along it and across it [px]."""
        pixel, is_seen = track_points(sequence, labels)["top"]
        is_old = is_seen[:-1].sum(axis=0) >= 5
        begin = is_seen.argmax(axis=0)
        age = np.arange(len(pixel))[:, None] - begin
        start = pixel[begin, np.arange(len(begin))]
        away = pixel - start - age[..., None] * np.asarray(step)
        assert is_seen.sum(axis=1).min() > 15
        lasting = is_seen & is_old & (age >= 4)
        assert lasting.sum() > 60
        return away[lasting, 0], away[lasting, 1]

    along, across = left_behind()
    assert np.median(np.abs(along)) < 0.3
    assert np.percentile(np.abs(along), 90) < 1.0
    assert np.percentile(np.abs(across), 90) < 0.5
    monkeypatch.setattr(point_tracking, "_own_pixels", lambda gray, _: gray)
    along, _ = left_behind()
    assert np.median(np.abs(along)) > 2.0


def test_a_view_without_an_object_has_no_tracks(disc):
    sequence, labels = disc
    nothing = {**labels, "side": np.zeros_like(labels["side"])}
    assert set(track_points(sequence, nothing)) == {"top"}
    assert track_points(sequence, {}) == {}


def test_tracking_can_be_cancelled(disc):
    class Impatient(Progress):
        def check_cancelled(self):
            raise CancelledError("now")

    with pytest.raises(CancelledError):
        track_points(*disc, Impatient())


def test_150_tracks_are_kept_where_more_than_half_end_in_every_frame(tmp_path, monkeypatch):
    sequence, labels = write_strip(tmp_path / "table", (0.0, 0.0))
    spotted = np.zeros_like(labels["top"])
    spotted[:, 4:60, 4:124] = 1
    follow, luck = point_tracking._follow, np.random.default_rng(0)

    def losing(before, now, start, size, guess=None, **options):
        end, is_found = follow(before, now, start, size, guess, **options)
        return end, is_found & (luck.random(len(end)) < 0.48) if guess is None else is_found

    monkeypatch.setattr(point_tracking, "_follow", losing)
    _, is_seen = track_points(sequence, {"top": spotted})["top"]
    # The first two frames have no older tracks, and in the last two none begins that is kept.
    assert is_seen[2:-2].sum(axis=1).min() >= 150
