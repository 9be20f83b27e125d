"""A painted rope on a spotted table, filmed from above: where each part of it is, is known."""

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial import KDTree

import physhandi
from physhandi.data.camera import PinholeCamera
from physhandi.data.sequence import Sequence, ViewMeta
from physhandi.data.sequence_meta import SequenceMeta
from physhandi.data.sequence_writer import write_sequence
from physhandi.data.view import View
from physhandi.perception import thin_tracking
from physhandi.perception.annotation import Correction, correct_masks
from physhandi.perception.point_tracking import PixelTracks, track_points
from physhandi.perception.thin_tracking import is_thin, thin_tracks
from physhandi.perception.tracks import lift_pixels
from physhandi.progress import NullProgress

HEIGHT, WIDTH = 120, 240
FRAMES = 16
FOCAL, EYE, TOP = 300.0, 0.6, 0.02
"""Focal length [px], height of the camera and of the rope's upper side [m]."""
PIXEL = (EYE - TOP) / FOCAL
"""What a pixel is wide on the rope [m]."""
HALF_WIDTH = 0.004
DRAWN = 0.004
"""How far the rope is drawn along itself in a frame [m]."""

Path2 = Callable[[np.ndarray], np.ndarray]


def bent(along: np.ndarray) -> np.ndarray:
    """A path that swings to both sides, by the length along it [m]."""
    fine = np.linspace(-0.3, 0.3, 2000)
    place = np.stack([fine, 0.03 * np.sin(14 * fine)], axis=1)
    return by_length(place, along)


def loop(along: np.ndarray) -> np.ndarray:
    """A path that crosses itself."""
    turn = np.linspace(-1, 1, 2000) * 1.5 * np.pi
    place = np.stack([0.03 * turn / np.pi + 0.06 * np.sin(turn), 0.06 * np.cos(turn)], axis=1)
    return by_length(place, along)


def by_length(place: np.ndarray, along: np.ndarray) -> np.ndarray:
    length = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(place, axis=0), axis=1)))
    length -= length[-1] / 2
    return np.stack([np.interp(along, length, place[:, axis]) for axis in (0, 1)], axis=1)


def film(
    folder: Path,
    path: Path2 = bent,
    *,
    ends: tuple[float, float] = (-0.17, 0.2),
    drawn: float = DRAWN,
    stretched: float = 0.0,
    hands: tuple[tuple[float, float], ...] = ((0.1, 0.17),),
    frames: int = FRAMES,
) -> tuple[Sequence, dict[str, np.ndarray]]:
    """Film a rope that is drawn along its path, and is hidden by hands between places in x [m]."""
    row, column = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    random = np.random.default_rng(4)
    spots = cv2.GaussianBlur(random.normal(size=(HEIGHT, WIDTH)), (0, 0), 1.2)
    wave = random.uniform(0, 2 * np.pi, 6)
    x, y = PIXEL * (column - WIDTH / 2), -PIXEL * (row - HEIGHT / 2)
    images: dict[str, np.ndarray] = {}
    label = np.zeros((frames, HEIGHT, WIDTH), dtype=np.uint8)
    for frame in range(frames):
        material = np.linspace(*ends, 1500)
        line = path(material * (1 + stretched * frame / FRAMES) + frame * drawn)
        # Farther away none of the rope is in a pixel; to look for what is nearest takes long there.
        distance, nearest = KDTree(line).query(
            np.stack([x, y], axis=-1), distance_upper_bound=HALF_WIDTH + PIXEL
        )
        nearest = material[np.minimum(nearest, len(material) - 1)]
        share = np.clip((HALF_WIDTH - distance) / PIXEL + 0.5, 0, 1)
        paint = sum(
            np.sin(2 * np.pi * nearest / (PIXEL * (9 + 4 * n)) + phase)
            for n, phase in enumerate(wave)
        )
        gray = (1 - share) * (130 + 120 * spots) + share * (150 + paint)
        gray += random.normal(size=gray.shape)
        far = np.where(share > 0.5, EYE - TOP, EYE) + 0.001 * random.normal(size=gray.shape)
        label[frame] = share > 0.5
        for low, high in hands:
            is_hand = (x > low) & (x < high)
            label[frame][is_hand] = 2
            far[is_hand], gray[is_hand] = EYE - 0.1, 90
        images[f"views/top/color/{frame:05d}.png"] = np.repeat(
            gray.clip(0, 255).round().astype(np.uint8)[..., None], 3, axis=-1
        )
        images[f"views/top/depth/{frame:05d}.png"] = (1000 * far).round().astype(np.uint16)
        images[f"views/top/mask/{frame:05d}.png"] = label[frame]
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = EYE
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    camera = PinholeCamera(K=K, T_world_camera=pose, width=WIDTH, height=HEIGHT)
    meta = SequenceMeta(
        name=folder.name,
        frame_rate=30.0,
        frame_count=frames,
        ground_height=0.0,
        hands=("right",),
        views=(ViewMeta(name="top", camera=camera),),
        provenance={
            "masks": {"source": "built-in"},
            "tracks": {"source": "built-in", "method": "unknown"},
        },
    )
    return write_sequence(folder, meta, {}, images=images), {"top": label}


@pytest.fixture(scope="module")
def rope(tmp_path_factory: pytest.TempPathFactory) -> tuple[Sequence, dict[str, np.ndarray]]:
    """The film that tests share, which none of them changes."""
    return film(tmp_path_factory.mktemp("film") / "rope")


@pytest.fixture(scope="module")
def followed(rope: tuple[Sequence, dict[str, np.ndarray]]) -> tuple[PixelTracks, str]:
    return follow(*rope)


def follow(sequence: Sequence, labels: dict[str, np.ndarray]) -> tuple[PixelTracks, str]:
    assert is_thin(labels)
    return thin_tracks(sequence.views, labels, sequence.frame_rate, NullProgress())


def slip(
    tracks: PixelTracks, path: Path2 = bent, drawn: float = DRAWN
) -> tuple[np.ndarray, np.ndarray]:
    """How far points of tracks are along the rope [px] from the part on which they began.

    Returns:
        Of all points after the first of each track, and how old each is [frames].
    """
    pixel, is_seen = tracks["top"]
    fine = np.linspace(-0.3, 0.3, 4000)
    line = path(fine)
    place = PIXEL * (pixel - [WIDTH / 2, HEIGHT / 2]) * [1, -1]
    part = np.full(is_seen.shape, np.nan)
    for frame in range(FRAMES):
        nearest = KDTree(line).query(place[frame, is_seen[frame]])[1]
        part[frame, is_seen[frame]] = fine[nearest] - frame * drawn
    begin = is_seen.argmax(axis=0)
    age = np.arange(FRAMES)[:, None] - begin
    away = (part - part[begin, np.arange(len(begin))]) / PIXEL
    return away[is_seen & (age > 0)], age[is_seen & (age > 0)]


def test_tracks_go_along_with_a_rope_that_is_drawn_along_itself_under_a_hand(rope, followed):
    """It is drawn by 31 px in all; flow lags, as what is beside the rope stays."""
    sequence, labels = rope
    tracks, trouble = followed
    assert trouble == ""
    pixel, is_seen = tracks["top"]
    assert pixel.dtype == np.float32
    np.testing.assert_array_equal(np.isfinite(pixel).all(axis=-1), is_seen)
    for frame in range(FRAMES):
        column, row = pixel[frame, is_seen[frame]].round().astype(int).T
        assert (labels["top"][frame, row, column] == 1).all()
    assert is_seen.sum(axis=1).min() >= 150
    away, age = slip(tracks)
    assert (age >= 10).sum() > 300
    assert np.median(np.abs(away[age >= 10])) < 0.7
    assert np.percentile(np.abs(away), 95) < 1.5
    lagging, old = slip(track_points(sequence, labels))
    assert np.median(lagging[old >= 10]) < -3.0


def test_places_are_interpolated_where_no_line_is_found_but_the_object_is_seen(
    rope, followed, monkeypatch
):
    sequence, labels = rope
    view, find = sequence.views[0], thin_tracking.centre_lines
    whole, _ = followed[0]["top"]
    lacking, hole = {5, 9, 10, 11, 12}, 60
    frames = iter(range(FRAMES))
    monkeypatch.setattr(
        thin_tracking,
        "centre_lines",
        lambda cloud, cell: () if next(frames) in lacking else find(cloud, cell),
    )
    monkeypatch.setattr(thin_tracking, "_MEASURED_FRAMES", 0.5)
    read = type(view).depth

    def depth(self: View, frame: int) -> np.ndarray:
        image = np.array(read(self, frame))
        image[:, :hole] *= frame != 5
        return image

    monkeypatch.setattr(type(view), "depth", depth)
    pixel, is_seen = follow(sequence, labels)[0]["top"]
    assert not is_seen[9:13].any()
    assert is_seen[[8, 13]].any(axis=1).all()
    assert pixel.shape == whole.shape
    both = is_seen[5] & np.isfinite(whole[5]).all(axis=-1)
    assert both.sum() > 100
    assert np.linalg.norm(pixel[5] - whole[5], axis=-1)[both].max() < 1.0
    assert np.nanmin(pixel[5, :, 0]) > hole - 2
    assert np.nanmin(whole[5, :, 0]) < hole - 10


def test_points_lie_where_depth_lifts_them(rope, monkeypatch):
    sequence, labels = rope
    view = sequence.views[0]
    read, holes = type(view).depth, np.random.default_rng(2)
    depth = [read(view, f) * (holes.random((HEIGHT, WIDTH)) > 0.15) for f in range(FRAMES)]
    monkeypatch.setattr(type(view), "depth", lambda _self, frame: depth[frame])

    def lifted() -> int:
        pixel, _ = follow(sequence, labels)[0]["top"]
        places = [
            lift_pixels(view.camera, depth[f], labels["top"][f] == 1, pixel[f].astype(float))
            for f in range(FRAMES)
        ]
        return int(np.isfinite(places).all(axis=-1).sum())

    many = lifted()
    monkeypatch.setattr(thin_tracking, "_BESIDE", np.zeros(1))
    assert many > 1.3 * lifted()


def test_what_comes_out_beyond_the_hand_is_measured_from_the_other_end(tmp_path):
    sequence, labels = film(tmp_path / "rope", ends=(-0.2, 0.13), hands=((0.0, 0.05),))
    tracks, trouble = follow(sequence, labels)
    assert trouble == ""
    pixel, is_seen = tracks["top"]
    middle = WIDTH / 2 + 0.025 / PIXEL
    right = np.nanmean(np.where(is_seen, pixel[..., 0], np.nan), axis=0) > middle
    assert right.sum() > 30
    assert (~right).sum() > 30
    for side in (right, ~right):
        away, age = slip({"top": (pixel[:, side], is_seen[:, side])})
        assert (age >= 8).sum() > 50
        assert np.percentile(np.abs(away), 90) < 1.5


@pytest.mark.parametrize(
    ("how", "why"),
    [
        (
            {"path": loop, "ends": (-0.25, 0.25), "drawn": 0.0, "hands": (), "frames": 6},
            "crosses or touches itself",
        ),
        ({"stretched": 0.15, "drawn": 0.0, "ends": (-0.16, 0.16), "hands": ()}, "stretches"),
    ],
)
def test_a_rope_whose_lengths_are_not_known_gets_no_such_tracks(tmp_path, how, why):
    tracks, trouble = follow(*film(tmp_path / "rope", **how))
    assert tracks == {}
    assert why in trouble


def test_corrected_masks_give_a_rope_tracks_along_it_and_say_so(rope, followed, tmp_path):
    sequence, labels = rope
    folder = shutil.copytree(sequence.folder, tmp_path / "rope")
    done = correct_masks(folder, [Correction("top", 3, labels["top"][3])])
    assert done.provenance["tracks"] == {
        "source": "built-in",
        "method": "lengths along it from its ends",
    }
    pixel, is_seen = done.views[0].track, done.views[0].track_visible
    assert pixel is not None
    assert is_seen is not None
    expected, _ = followed
    np.testing.assert_array_equal(pixel, expected["top"][0])
    np.testing.assert_array_equal(is_seen, expected["top"][1])


def test_a_rope_with_hidden_ends_is_followed_by_flow_and_provenance_says_why(tmp_path):
    sequence, labels = film(tmp_path / "rope", hands=((-0.3, -0.1), (0.1, 0.3)), frames=6)
    done = correct_masks(sequence.folder, [Correction("top", 3, labels["top"][3])])
    method = done.provenance["tracks"]["method"]
    assert method == "optical flow, since neither of its ends is seen often enough"
    pixel = done.views[0].track
    np.testing.assert_array_equal(pixel, track_points(sequence, labels)["top"][0])
    assert physhandi.load(done.folder).provenance["tracks"]["method"] == method
