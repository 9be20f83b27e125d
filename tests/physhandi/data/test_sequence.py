"""Sequences: what is written comes back; what is wrong is refused by name."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from physhandi.data.camera import PinholeCamera
from physhandi.data.sequence import Sequence
from physhandi.data.sequence_meta import SequenceMeta, ViewMeta, safe_name
from physhandi.data.sequence_writer import SequenceWriter, write_sequence
from physhandi.errors import SequenceError

FRAMES, WIDTH, HEIGHT = 5, 32, 24


def make_meta(name: str = "lift", views: tuple[str, ...] = ("front",)) -> SequenceMeta:
    camera = PinholeCamera(
        np.array([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]]), np.eye(4), WIDTH, HEIGHT
    )
    return SequenceMeta(
        name=name,
        frame_rate=30.0,
        frame_count=FRAMES,
        description="A cube is lifted",
        ground_height=0.25,
        hands=("right",),
        views=tuple(ViewMeta(name=view, camera=camera) for view in views),
        reconstruction=3,
        controlled_markers=(1,),
        provenance={"origin": "made up"},
    )


def make_arrays() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    marker = rng.normal(size=(FRAMES, 2, 3)).astype(np.float32)
    marker[2, 0] = np.nan
    track = rng.uniform(0, 20, (FRAMES, 7, 2)).astype(np.float32)
    visible = np.ones((FRAMES, 7), bool)
    visible[1, 3] = False
    track[1, 3] = np.nan
    return {
        "control.npy": rng.normal(size=(FRAMES, 4, 3)).astype(np.float32),
        "marker.npy": marker,
        "marker_node.npy": np.array([0, 8], np.int32),
        "object_node.npy": rng.normal(size=(9, 3)).astype(np.float32),
        "rest_node.npy": rng.normal(size=(9, 3)).astype(np.float32),
        "views/front/keypoint.npy": rng.normal(size=(FRAMES, 1, 21, 3)).astype(np.float32),
        "views/front/track.npy": track,
        "views/front/track_visible.npy": visible,
    }


def make_images() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    images: dict[str, np.ndarray] = {}
    for frame in range(FRAMES):
        images[f"views/front/color/{frame:05d}.png"] = rng.integers(
            0, 255, (HEIGHT, WIDTH, 3), np.uint8
        )
        images[f"views/front/depth/{frame:05d}.png"] = rng.integers(
            0, 5000, (HEIGHT, WIDTH), np.uint16
        )
        images[f"views/front/mask/{frame:05d}.png"] = rng.integers(0, 4, (HEIGHT, WIDTH), np.uint8)
    return images


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_sequence(
        tmp_path / "lift", make_meta(), make_arrays(), images=make_images()
    ).folder


def edit(folder: Path, **fields: object) -> None:
    path = folder / "sequence.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | fields))


@pytest.mark.parametrize(
    ("name", "options", "safe"),
    [
        ("left (2)/é", {}, "left__2___"),
        ("left (2)/é", {"joins_unsafe": True}, "left_2_"),
        ("a" * 65, {}, "a" * 64),
        ("a" * 65, {"longest": None}, "a" * 65),
        ("a..b", {"longest": 3, "joins_unsafe": True}, "a_b"),
        ("Fold-2_b", {}, "Fold-2_b"),
        ("", {}, ""),
    ],
)
def test_letters_that_no_folder_may_have_are_replaced(
    name: str, options: dict[str, Any], safe: str
) -> None:
    assert safe_name(name, **options) == safe


def test_everything_written_comes_back(folder: Path) -> None:
    sequence = Sequence.load(folder)
    sequence.validate()
    arrays, images = make_arrays(), make_images()
    for part in ("control", "marker", "marker_node", "object_node", "rest_node"):
        np.testing.assert_array_equal(getattr(sequence, part), arrays[f"{part}.npy"])
    view = sequence.views[0]
    np.testing.assert_array_equal(view.keypoint, arrays["views/front/keypoint.npy"])
    np.testing.assert_array_equal(view.track, arrays["views/front/track.npy"])
    np.testing.assert_array_equal(view.track_visible, arrays["views/front/track_visible.npy"])
    for frame in (4, 0, 2):
        np.testing.assert_array_equal(
            view.color(frame), images[f"views/front/color/{frame:05d}.png"]
        )
        depth = images[f"views/front/depth/{frame:05d}.png"]
        assert view.depth(frame) == pytest.approx(depth / 1000.0)
        assert view.depth(frame).dtype == np.float32
        np.testing.assert_array_equal(view.mask(frame), images[f"views/front/mask/{frame:05d}.png"])
    assert sequence.meta == replace(make_meta(), views=sequence.meta.views)
    assert view.camera.to_dict() == make_meta().views[0].camera.to_dict()
    assert list(sequence.reconstruction_frames) == [0, 1, 2]
    assert list(sequence.future_frames) == [3, 4]
    assert (sequence.ground_height, sequence.gravity, sequence.hands) == (0.25, 9.81, ("right",))


@pytest.mark.parametrize(("frames", "fitted"), [(1, 1), (2, 1), (5, 3), (60, 42), (90, 63)])
def test_a_split_that_is_not_named_holds_out_the_last_30_percent(
    tmp_path: Path, frames: int, fitted: int
) -> None:
    meta = SequenceMeta(name="s", frame_rate=30.0, frame_count=frames)
    sequence = write_sequence(tmp_path / "s", meta)
    assert sequence.reconstruction_frames == range(fitted)
    assert sequence.future_frames == range(fitted, frames)
    text = (sequence.folder / "sequence.yaml").read_text().split("\n")
    kept = [line for line in text if "split" not in line and "reconstruction" not in line]
    (sequence.folder / "sequence.yaml").write_text("\n".join(kept))
    assert Sequence.load(sequence.folder).reconstruction_frames == range(fitted)


def test_video_frames_can_be_read_in_any_order(tmp_path: Path) -> None:
    video = tmp_path / "clip.mp4"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"mp4v"), 30, (64, 48))
    for frame in range(30):
        writer.write(np.full((48, 64, 3), (0, 0, 8 * frame), np.uint8))
    writer.release()
    camera = PinholeCamera(np.array([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]]), np.eye(4), 64, 48)
    meta = SequenceMeta(
        name="clip",
        frame_rate=30.0,
        frame_count=30,
        views=(ViewMeta(name="a", camera=camera),),
    )
    with SequenceWriter(tmp_path / "clip") as sequence_writer:
        sequence_writer.copy("views/a/color.mp4", video)
        sequence = sequence_writer.finish(meta)
    for frame in (7, 29, 28, 0, 15, 3):
        image = sequence.views[0].color(frame)
        assert image[..., 0].mean() == pytest.approx(8 * frame, abs=4)
        assert image[..., 2].mean() < 5
    with pytest.raises(IndexError, match="frame 30 is outside"):
        sequence.views[0].color(30)
    edit(sequence.folder, frame_count=31, split={})
    with pytest.raises(SequenceError, match=r"'a': color.mp4 has 30 frames, .* has 31"):
        Sequence.load(sequence.folder)


def test_missing_parts_are_listed(tmp_path: Path, folder: Path) -> None:
    assert Sequence.load(folder).missing("color", "depth", "control", "hands") == []
    bare = write_sequence(
        tmp_path / "bare", replace(make_meta("bare"), views=(), hands=(), controlled_markers=())
    )
    parts = ("views", "hands", "color", "track", "marker", "object_node")
    assert bare.missing(*parts) == list(parts)
    assert bare.control is None
    with pytest.raises(ValueError, match="'colour' is not a part"):
        bare.missing("colour")


def test_fingerprint_follows_content_and_not_place(tmp_path: Path, folder: Path) -> None:
    first = Sequence.load(folder).fingerprint()
    again = write_sequence(
        tmp_path / "b" / "lift", make_meta(), make_arrays(), images=make_images()
    )
    assert again.fingerprint() == first
    changed = make_arrays()
    changed["control.npy"][0, 0, 0] += 1e-3
    other = write_sequence(tmp_path / "c" / "lift", make_meta(), changed, images=make_images())
    assert other.fingerprint() != first


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"format": "physhandi-sequence/9"}, "format is 'physhandi-sequence/9'; expected"),
        ({"frame_rat": 30}, "field 'frame_rat' is not known"),
        ({"frame_rate": 0}, "frame_rate is 0; expected a finite number above 0"),
        ({"frame_rate": "fast"}, "frame_rate is 'fast'; expected a finite number"),
        ({"frame_rate": True}, "frame_rate is True"),
        ({"frame_count": 2.5}, "frame_count is 2.5; expected a whole number from 1"),
        ({"gravity": float("nan")}, "gravity is nan"),
        ({"hands": ["both"]}, "hands is 'both'"),
        ({"split": {"reconstruction": 6}}, "split.reconstruction is 6; expected at most"),
        ({"split": {"test": 6}}, "split: field 'test' is not known"),
        ({"name": "../up"}, "name is '../up'"),
        ({"views": [{"name": "../../etc", "camera": {}}]}, r"views\[0\]: name is"),
        ({"views": [{"name": "front", "camera": {"K": 3}}]}, "camera of view 'front': field"),
        ({"controlled_markers": [5]}, "controlled_markers 5, but marker.npy has 2"),
        ({"controlled_markers": [-1]}, "controlled_markers is -1"),
        ({"shape": "blob"}, r"'lift': sequence\.yaml: shape is 'blob'; expected one of sheet, sol"),
        ({"shape": ["rope"]}, "shape is .'rope'.; expected one of"),
        ({"mass": 0}, "mass is 0.0; expected the object's mass in kilograms, 1e-06 to 10000"),
        ({"mass": "light"}, "mass is 'light'; expected a finite number"),
    ],
)
def test_wrong_fields_are_named(folder: Path, fields: dict[str, object], message: str) -> None:
    edit(folder, **fields)
    with pytest.raises(SequenceError, match=message):
        Sequence.load(folder)


@pytest.mark.parametrize(
    ("file", "array", "message"),
    [
        ("control.npy", np.zeros((4, 4, 3), np.float32), r"expected frame = 5"),
        ("control.npy", np.zeros((5, 4, 3), int), "expected floating-point numbers"),
        ("rest_node.npy", np.zeros((8, 3)), "expected node = 9"),
        ("marker_node.npy", np.array([0, 9]), "names nodes 0 to 9"),
        ("marker_motion_valid.npy", np.zeros((5, 3), bool), "expected marker = 2"),
        ("marker_motion_valid.npy", np.zeros((5, 2)), "expected boolean numbers"),
        ("validation_track.npy", np.zeros((4, 2, 3)), "expected frame = 5"),
        ("views/front/track.npy", np.zeros((5, 6, 2)), "expected track = 6"),
        ("views/front/keypoint.npy", np.zeros((5, 2, 21, 3)), "expected hand = 1"),
    ],
)
def test_wrong_arrays_are_named(folder: Path, file: str, array: np.ndarray, message: str) -> None:
    np.save(folder / file, array)
    with pytest.raises(SequenceError, match=message):
        Sequence.load(folder)


def test_pickles_and_torn_files_are_refused(folder: Path) -> None:
    np.save(folder / "control.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(SequenceError, match=r"control.npy is not a readable .npy file"):
        Sequence.load(folder)
    np.save(folder / "control.npy", np.zeros((5, 4, 3), np.float32))
    content = (folder / "control.npy").read_bytes()
    for torn in (b"", content[:60], content[:-1]):
        (folder / "control.npy").write_bytes(torn)
        with pytest.raises(SequenceError, match=r"control.npy is not a readable .npy file"):
            Sequence.load(folder)
    (folder / "sequence.yaml").write_text("!!python/object/apply:os.system ['true']")
    with pytest.raises(SequenceError, match="cannot be read as YAML"):
        Sequence.load(folder)


def test_values_are_checked_frame_by_frame(folder: Path) -> None:
    control = make_arrays()["control.npy"]
    control[3, 2, 1] = np.nan
    np.save(folder / "control.npy", control)
    with pytest.raises(SequenceError, match=r"control.npy is nan at frame 3, control 2"):
        Sequence.load(folder).validate()
    np.save(folder / "control.npy", make_arrays()["control.npy"])
    cv2.imwrite(str(folder / "views/front/mask/00004.png"), np.full((HEIGHT, WIDTH), 9, np.uint8))
    with pytest.raises(SequenceError, match=r"view 'front': mask of frame 4 has label 9"):
        Sequence.load(folder).validate()
    cv2.imwrite(str(folder / "views/front/mask/00004.png"), np.zeros((HEIGHT, 9), np.uint8))
    with pytest.raises(SequenceError, match=r"mask of frame 4 is 9x24 px, but .* says 32x24"):
        Sequence.load(folder).validate()
    (folder / "views/front/mask/00004.png").write_bytes(b"no image")
    with pytest.raises(SequenceError, match=r"mask of frame 4 cannot be decoded"):
        Sequence.load(folder).validate()


def test_trusted_motions_need_both_positions(folder: Path) -> None:
    # Marker 0 is lost in frame 2, so neither its motion to 2 nor that to 3 was seen.
    is_valid = np.ones((FRAMES, 2), bool)
    is_valid[0] = False
    is_valid[2:4, 0] = False
    np.save(folder / "marker_motion_valid.npy", is_valid)
    sequence = Sequence.load(folder)
    sequence.validate()
    np.testing.assert_array_equal(sequence.marker_motion_valid, is_valid)
    for frame in (0, 2, 3):
        wrong = is_valid.copy()
        wrong[frame, 0] = True
        np.save(folder / "marker_motion_valid.npy", wrong)
        with pytest.raises(SequenceError, match=f"motion of marker 0 to frame {frame}"):
            Sequence.load(folder).validate()
    (folder / "marker.npy").unlink()
    edit(folder, controlled_markers=[])
    with pytest.raises(SequenceError, match=r"there is no marker\.npy"):
        Sequence.load(folder).validate()


def test_a_given_shape_is_read_and_is_no_other_recording(folder: Path) -> None:
    before = Sequence.load(folder)
    assert before.shape is None
    assert "shape" not in before.meta.to_dict()
    edit(folder, shape="rope")
    named = Sequence.load(folder)
    assert (named.shape, named.meta.to_dict()["shape"]) == ("rope", "rope")
    assert named.content_fingerprint() == before.content_fingerprint()
    edit(folder, shape=None)
    assert Sequence.load(folder).shape is None


def test_a_given_mass_is_read_and_is_no_other_recording(folder: Path) -> None:
    before = Sequence.load(folder)
    assert before.mass is None
    assert "mass" not in before.meta.to_dict()
    edit(folder, mass=0.012)
    weighed = Sequence.load(folder)
    assert (weighed.mass, weighed.meta.to_dict()["mass"]) == (0.012, 0.012)
    assert weighed.content_fingerprint() == before.content_fingerprint()


def test_surface_nodes_are_among_the_object_nodes(folder: Path) -> None:
    assert Sequence.load(folder).surface_node_count is None
    edit(folder, surface_node_count=9)
    assert Sequence.load(folder).surface_node_count == 9
    for count, message in ((10, "but object_node.npy has 9"), (-1, "a whole number from 0 on")):
        edit(folder, surface_node_count=count)
        with pytest.raises(SequenceError, match=message):
            Sequence.load(folder)


def test_absent_frames_are_named(folder: Path) -> None:
    (folder / "views/front/depth/00002.png").unlink()
    with pytest.raises(SequenceError, match=r"view 'front': depth of frame 2 is missing"):
        Sequence.load(folder)


def test_an_invalid_sequence_is_never_published(tmp_path: Path) -> None:
    arrays = make_arrays() | {"control.npy": np.full((FRAMES, 4, 3), np.inf)}
    with pytest.raises(SequenceError, match=r"control.npy is inf at frame 0"):
        write_sequence(tmp_path / "lift", make_meta(), arrays, images=make_images())
    assert list(tmp_path.iterdir()) == []


def test_a_sequence_is_replaced_only_when_asked(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(SequenceError, match="exists already"):
        write_sequence(folder, make_meta())
    meta = replace(make_meta(), views=(), hands=(), controlled_markers=())
    assert write_sequence(folder, meta, overwrite=True).missing("control") == ["control"]
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "precious.txt").write_text("data")
    with pytest.raises(SequenceError, match="is not a sequence"):
        write_sequence(tmp_path / "other", meta, overwrite=True)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["lift", "other"]


def test_a_killed_replacement_is_undone(folder: Path, tmp_path: Path) -> None:
    folder.rename(tmp_path / ".lift.replaced")
    with pytest.raises(SequenceError, match="exists already"):
        SequenceWriter(folder)
    assert Sequence.load(folder).frame_count == FRAMES


@pytest.mark.parametrize("rel", ["../x.npy", "/etc/x.npy", "a/../../x.npy", ".hidden.npy", ""])
def test_files_cannot_leave_the_sequence(tmp_path: Path, rel: str) -> None:
    with (
        SequenceWriter(tmp_path / "lift") as writer,
        pytest.raises(SequenceError, match="not a file name inside"),
    ):
        writer.save_array(rel, np.zeros(3))


def test_wrong_images_are_named(folder: Path) -> None:
    depth = folder / "views/front/depth/00001.png"
    cv2.imwrite(str(depth), np.zeros((HEIGHT, WIDTH), np.uint8))
    with pytest.raises(SequenceError, match=r"depth of frame 1 is uint8.*expected 16-bit"):
        Sequence.load(folder).validate()
    cv2.imwrite(str(depth), np.zeros((HEIGHT, WIDTH), np.uint16))
    mask = folder / "views/front/mask/00001.png"
    cv2.imwrite(str(mask), np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    with pytest.raises(SequenceError, match=r"mask of frame 1 is uint8.*expected 8-bit"):
        Sequence.load(folder).validate()
    extra = folder / "views/front/color/00007.png"
    extra.write_bytes(b"x")
    with pytest.raises(SequenceError, match=r"color has color/00007, but .* only 5 frames"):
        Sequence.load(folder)
    extra.rename(extra.with_name("00002.jpg"))
    with pytest.raises(SequenceError, match="has a frame twice"):
        Sequence.load(folder)
    (folder / "views/front/color/00002.jpg").unlink()
    (folder / "views/front/color.mp4").write_bytes(b"x")
    with pytest.raises(SequenceError, match=r"is there twice: color.mp4 and color/"):
        Sequence.load(folder)


def test_tracks_and_views_must_be_whole(folder: Path) -> None:
    track = np.load(folder / "views/front/track.npy")
    track[4, 2] = np.nan
    np.save(folder / "views/front/track.npy", track)
    with pytest.raises(SequenceError, match=r"track.npy is NaN at frame 4, track 2"):
        Sequence.load(folder).validate()
    (folder / "views/front/track_visible.npy").unlink()
    with pytest.raises(SequenceError, match=r"needs both track.npy and track_visible.npy"):
        Sequence.load(folder)
    (folder / "views/front").rename(folder / "views/back")
    with pytest.raises(SequenceError, match=r"views/front is missing, but sequence.yaml lists it"):
        Sequence.load(folder)


def test_what_an_object_needs_is_listed(tmp_path: Path, folder: Path) -> None:
    assert Sequence.load(folder).missing("object") == []
    bare = replace(make_meta("bare"), hands=(), views=(), controlled_markers=())
    assert write_sequence(tmp_path / "bare", bare).missing("object") == ["depth", "mask", "control"]


@pytest.mark.parametrize("text", ["", "- a list", "text", "null", "frame_count: 3"])
def test_yaml_of_another_kind_is_refused(folder: Path, text: str) -> None:
    (folder / "sequence.yaml").write_text(text)
    with pytest.raises(SequenceError, match=r"sequence.yaml"):
        Sequence.load(folder)


@pytest.mark.parametrize(
    ("told", "message"),
    [
        ("at: !!timestamp 2026-01-01", "'provenance.at' is a date"),
        ("at: .nan", "'provenance.at' is nan"),
        ("at: !!binary aGk=", "'provenance.at' is a bytes"),
        ("at: &a [*a]", "nested too deeply"),
        ("at: {1: 2}", "name in field 'provenance.at' is no text"),
    ],
)
def test_where_a_sequence_comes_from_is_told_in_plain_data(
    folder: Path, told: str, message: str
) -> None:
    path = folder / "sequence.yaml"
    kept = {k: v for k, v in yaml.safe_load(path.read_text()).items() if k != "provenance"}
    begin = yaml.safe_dump(kept)
    path.write_text(f"{begin}provenance: {{at: 2026-01-01}}\n")
    assert Sequence.load(folder).provenance == {"at": "2026-01-01"}
    path.write_text(f"{begin}provenance:\n  {told}\n")
    with pytest.raises(SequenceError, match=message):
        Sequence.load(folder)
