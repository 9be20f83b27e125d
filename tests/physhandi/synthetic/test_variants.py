"""What methods are given in place of a recording, against the recording's own files."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.hostile.header_bombs import png

from physhandi.data.camera import PinholeCamera
from physhandi.data.sequence import Sequence, ViewMeta
from physhandi.data.sequence_meta import SequenceMeta
from physhandi.data.sequence_writer import SequenceWriter, write_sequence
from physhandi.errors import MissingInputError
from physhandi.synthetic.suite import variants
from physhandi.synthetic.suite.variants import VARIANTS, make_variant, noise_seed

FRAMES = 3
SIZE = (60, 80)


def camera(x: float) -> PinholeCamera:
    pose = np.array([[1.0, 0, 0, x], [0, -1, 0, 0], [0, 0, -1, 1], [0, 0, 0, 1]])
    K = np.array([[100.0, 0, 40], [0, 100.0, 30], [0, 0, 1]])
    return PinholeCamera(K=K, T_world_camera=pose, width=SIZE[1], height=SIZE[0])


@pytest.fixture
def recording(tmp_path: Path) -> Sequence:
    """Two cameras that look down on a flat object and a hand."""
    depth = np.full(SIZE, 1000, dtype=np.uint16)
    depth[:10] = 0
    mask = np.zeros(SIZE, dtype=np.uint8)
    mask[20:40, 20:40], mask[20:40, 45:60] = 1, 2
    views = tuple(ViewMeta(name=name, camera=camera(x)) for name, x in (("a", 0.0), ("b", 0.1)))
    arrays: dict[str, np.ndarray] = {}
    images: dict[str, np.ndarray] = {}
    for view in views:
        arrays[f"views/{view.name}/track.npy"] = np.full((FRAMES, 500, 2), 30.0, np.float32)
        arrays[f"views/{view.name}/track_visible.npy"] = np.ones((FRAMES, 500), bool)
        arrays[f"views/{view.name}/keypoint.npy"] = np.ones((FRAMES, 1, 21, 3), np.float32) * (
            np.array([25.0, 30.0, 0.9], np.float32)
        )
        for frame in range(FRAMES):
            images[f"views/{view.name}/depth/{frame:05d}.png"] = depth
            images[f"views/{view.name}/mask/{frame:05d}.png"] = mask
            images[f"truth/annotation/{view.name}/mask/{frame:05d}.png"] = np.minimum(mask, 1)
        for file in ("track", "track_visible"):
            exact = arrays[f"views/{view.name}/{file}.npy"][:, :7]
            arrays[f"truth/annotation/{view.name}/{file}.npy"] = exact
    rise = np.arange(FRAMES, dtype=np.float32)[:, None, None] / 100
    arrays["truth/hand_right_vertex.npy"] = np.ones((FRAMES, 7, 3), np.float32) * 0.1 + rise
    arrays["validation_track.npy"] = np.zeros((FRAMES, 2, 3), np.float32)
    for frame in range(FRAMES):
        images[f"truth/views/held_out/mask/{frame:05d}.png"] = mask
    meta = SequenceMeta(
        name="scene",
        frame_rate=30.0,
        frame_count=FRAMES,
        ground_height=0.25,
        description="A towel of 21 x 33 cm.",
        hands=("right",),
        views=views,
        provenance={"synthesize": {"seed": 4711}, "degradations": {"depth_noise": 0.5}},
    )
    with SequenceWriter(tmp_path / "scene") as writer:
        for rel, array in arrays.items():
            writer.save_array(rel, array)
        for rel, image in images.items():
            writer.save_image(rel, image)
        writer.save_yaml("truth/views/held_out/camera.yaml", camera(0.2).to_dict())
        return writer.finish(meta)


def files(sequence: Sequence) -> dict[str, bytes]:
    paths = [path for path in sequence.folder.rglob("*") if path.is_file()]
    return {path.relative_to(sequence.folder).as_posix(): path.read_bytes() for path in paths}


def test_nothing_but_truth_and_origin_is_kept_back(recording: Sequence, tmp_path: Path) -> None:
    whole = files(recording)
    made = make_variant(recording, "recording", tmp_path / "inputs")
    given = files(made)
    kept_back = {"truth/hand_right_vertex.npy", "validation_track.npy"}
    kept_back |= {f"truth/views/held_out/mask/{frame:05d}.png" for frame in range(FRAMES)}
    kept_back.add("truth/views/held_out/camera.yaml")
    kept_back |= {file for file in whole if file.startswith("truth/annotation/")}
    assert set(whole) - set(given) == kept_back
    assert [name for name in given if given[name] != whole[name]] == ["sequence.yaml"]
    assert made.meta.to_dict() == {
        **recording.meta.to_dict(),
        "provenance": {},
        "description": "",
    }
    assert made.name == recording.name
    assert files(recording) == whole


@pytest.mark.parametrize("name", VARIANTS)
def test_no_variant_tells_the_future_or_how_it_was_made(
    recording: Sequence, tmp_path: Path, name: str
) -> None:
    (recording.folder / "notes").mkdir()
    (recording.folder / "notes/validation.npy").write_bytes(b"the same under another name")
    made = make_variant(recording, name, tmp_path / "inputs")
    given = files(made)
    assert not [file for file in given if "truth" in file or "validation" in file]
    assert not [file for file in given if "held_out" in file]
    assert (len(recording.held_out_views), len(made.held_out_views)) == (1, 0)
    for told in (b"4711", b"synthesize", b"degradations", b"21 x 33"):
        assert told in files(recording)["sequence.yaml"]
        assert told not in given["sequence.yaml"]
    assert b"ground_height: 0.25" in given["sequence.yaml"]


def test_exact_masks_and_tracks_take_the_place_of_those_with_errors_and_nothing_else_does(
    recording: Sequence, tmp_path: Path
) -> None:
    made = make_variant(recording, "exact_annotation", tmp_path / "inputs")
    before, after = files(recording), files(made)
    changed = {file for file in after if after[file] != before[file]} - {"sequence.yaml"}
    assert {file.split("/")[2] for file in changed} == {"mask", "track.npy", "track_visible.npy"}
    assert set(np.unique(made.views[1].mask(2))) == {0, 1}
    track = made.views[0].track
    assert track is not None
    assert track.shape == (FRAMES, 7, 2)
    (recording.folder / "truth/annotation").rename(tmp_path / "gone")
    with pytest.raises(MissingInputError, match="not known without errors"):
        make_variant(Sequence.load(recording.folder), "exact_annotation", tmp_path / "other")


def test_what_other_code_made_is_not_used_again(
    recording: Sequence, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = make_variant(recording, "noisy_tracks", tmp_path / "inputs")
    asked: list[Any] = []

    def other(parts: tuple[str, ...]) -> str:
        asked.append(parts)
        return "0123456789abcdef"

    monkeypatch.setattr(variants, "code_version", other)
    assert make_variant(recording, "noisy_tracks", tmp_path / "inputs").folder != first.folder
    assert "synthetic/suite/variants.py" in asked[0]


def test_a_variant_is_made_once_and_anew_for_another_recording(
    recording: Sequence, tmp_path: Path
) -> None:
    first = make_variant(recording, "noisy_tracks", tmp_path / "inputs")
    stamp = first.folder.stat().st_mtime_ns
    again = make_variant(recording, "noisy_tracks", tmp_path / "inputs")
    assert (again.folder, again.folder.stat().st_mtime_ns) == (first.folder, stamp)
    np.save(recording.folder / "views/a/track.npy", np.zeros((FRAMES, 500, 2), np.float32))
    changed = Sequence.load(recording.folder)
    assert make_variant(changed, "noisy_tracks", tmp_path / "inputs").folder != first.folder


def test_the_true_hand_takes_the_place_of_the_hand_that_is_seen(
    recording: Sequence, tmp_path: Path
) -> None:
    made = make_variant(recording, "true_hand", tmp_path)
    truth = np.load(recording.folder / "truth/hand_right_vertex.npy")
    np.testing.assert_array_equal(made.control, truth)
    assert made.hands == ()
    assert made.views[0].keypoint is None
    assert made.views[1].has_depth


def test_all_frames_may_be_fitted(recording: Sequence, tmp_path: Path) -> None:
    assert len(recording.future_frames) == 1
    assert len(make_variant(recording, "all_frames", tmp_path).future_frames) == 0


def test_one_view_is_the_first_one(recording: Sequence, tmp_path: Path) -> None:
    made = make_variant(recording, "one_view", tmp_path)
    assert [view.name for view in made.views] == ["a"]
    assert not (made.folder / "views/b").exists()
    with pytest.raises(MissingInputError, match="has 1 views"):
        make_variant(made, "one_view", tmp_path / "again")


def test_noise_has_the_size_that_the_paper_names(recording: Sequence, tmp_path: Path) -> None:
    deep = make_variant(recording, "noisy_depth", tmp_path)
    for view in deep.views:
        depth = np.stack([view.depth(frame) for frame in range(FRAMES)])
        assert (depth[:, :10] == 0).all()
        measured = depth[:, 10:]
        # Whole millimetres add a twelfth to the variance.
        assert measured.std() == pytest.approx(np.hypot(0.001, 0.001 / 12**0.5), rel=0.03)
        assert measured.mean() == pytest.approx(1.0, abs=1e-4)
    tracked = make_variant(recording, "noisy_tracks", tmp_path)
    noise = np.stack([np.asarray(view.track) for view in tracked.views]) - 30.0
    assert noise.std() == pytest.approx(1.0, rel=0.03)
    assert abs(np.corrcoef(noise[0].ravel(), noise[1].ravel())[0, 1]) < 0.1
    np.testing.assert_array_equal(tracked.views[0].depth(0), recording.views[0].depth(0))


def test_a_depth_that_announces_too_much_is_named(recording: Sequence, tmp_path: Path) -> None:
    path = recording.folder / "views/a/depth/00001.png"
    path.write_bytes(png(100_000, 100_000, bits=16))
    with pytest.raises(MissingInputError, match=r"00001\.png cannot be decoded: it announces 1000"):
        make_variant(recording, "noisy_depth", tmp_path / "inputs")


@pytest.mark.parametrize("name", ["true_hand", "noisy_hand", "noisy_tracks"])
def test_what_a_recording_lacks_is_named(name: str, tmp_path: Path) -> None:
    bare = write_sequence(
        tmp_path / "bare", SequenceMeta(name="bare", frame_rate=30.0, frame_count=FRAMES)
    )
    assert name in VARIANTS
    with pytest.raises(MissingInputError, match="'bare' has no"):
        make_variant(bare, name, tmp_path / "inputs")


def test_markers_are_disturbed_by_as_much_as_a_pixel_is_wide(
    recording: Sequence, tmp_path: Path
) -> None:
    marker = np.zeros((FRAMES, 400, 3), np.float32)
    marker[:, :5] = np.nan
    np.save(recording.folder / "marker.npy", marker)
    made = make_variant(Sequence.load(recording.folder), "noisy_tracks", tmp_path)
    moved = np.asarray(made.marker)
    assert np.isnan(moved[:, :5]).all()
    # The camera is 1 m away, and 100 px wide there.
    assert moved[:, 5:].std() == pytest.approx(0.01, rel=0.05)
    deep = make_variant(Sequence.load(recording.folder), "noisy_depth", tmp_path)
    assert np.asarray(deep.marker)[:, 5:].std() == pytest.approx(0.001, rel=0.05)


@pytest.mark.parametrize(
    "change", [{"name": "second"}, {"provenance": {"synthesize": {"seed": 1}}}]
)
def test_recordings_are_disturbed_independently(
    recording: Sequence, tmp_path: Path, change: dict[str, Any]
) -> None:
    other = Sequence(recording.folder, replace(recording.meta, **change))
    tracks = [
        make_variant(one, "noisy_tracks", tmp_path / str(number)).views[0].track
        for number, one in enumerate((recording, other, recording))
    ]
    first, second, again = (np.asarray(track) - 30.0 for track in tracks)
    np.testing.assert_array_equal(first, again)
    correlation = np.corrcoef(first.ravel(), second.ravel())[0, 1]
    assert abs(correlation) < 4 / math.sqrt(first.size)
    seeds = {noise_seed(one, name) for one in (recording, other) for name in VARIANTS}
    assert len(seeds) == 2 * len(VARIANTS)
