import hashlib
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.inputs.clicked_disc import FRAMES, disc_click, write_disc

import physhandi
from physhandi.data.sequence import Sequence
from physhandi.errors import CancelledError, UsageError
from physhandi.perception import annotation
from physhandi.perception.annotation import Correction, annotate, correct_masks, lacks_masks
from physhandi.perception.lifting import observe_object
from physhandi.perception.segmentation import Click
from physhandi.progress import Progress


def content(folder: Path) -> dict[str, str]:
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.fixture(scope="module")
def annotated_held(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A disc under a hand with masks and tracks that were made here, to copy."""
    sequence, _ = write_disc(tmp_path_factory.mktemp("held") / "disc", hand=True, frames=3)
    return annotate(sequence.folder, [Click(*disc_click())]).folder


@pytest.fixture(scope="module")
def annotated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same of a disc alone."""
    sequence, _ = write_disc(tmp_path_factory.mktemp("alone") / "disc", frames=4)
    return annotate(sequence.folder, [Click(*disc_click())]).folder


def copied(folder: Path, place: Path) -> Sequence:
    return Sequence.load(Path(shutil.copytree(folder, place / folder.name)))


def test_one_click_makes_a_sequence_whose_object_can_be_observed(tmp_path):
    sequence, true = write_disc(tmp_path / "disc", hand=True, frames=3)
    assert sequence.missing("object") == ["mask"]
    view, frame, x, y = disc_click()
    before = content(sequence.folder)
    done = annotate(sequence.folder, [Click(view, frame, x, y)])
    done.validate()
    assert done.missing("object", "track") == []
    about = {
        "source": "built-in",
        "clicks": [{"view": "top", "frame": 0, "x": x, "y": y}],
        "version": physhandi.__version__,
    }
    assert done.provenance["masks"] == done.provenance["tracks"] == about
    for one in done.views:
        both = [(one.mask(f) == 1) & (true[one.name][f] == 1) for f in range(3)]
        assert np.sum(both) > 0.85 * (true[one.name] == 1).sum()
    cloud = np.concatenate(observe_object(done).cloud)
    assert abs(np.median(cloud[:, 2]) - 0.03) < 0.003
    after = content(sequence.folder)
    kept = [name for name in before if name != "sequence.yaml"]
    assert all(after[name] == before[name] for name in kept)
    assert not [name for name in after if ".tmp" in name]


def test_masks_that_were_made_here_are_replaced_and_tracks_go_with_their_object(
    tmp_path, annotated_held
):
    before = copied(annotated_held, tmp_path)
    assert all(view.track is not None for view in before.views)
    done = annotate(before.folder, [])
    done.validate()
    assert done.provenance["masks"]["clicks"] == []
    assert "tracks" not in done.provenance
    assert all(view.track is None for view in done.views)
    assert all((view.mask(2) != 1).all() for view in done.views)


def test_given_masks_are_only_replaced_when_that_is_asked_for(tmp_path):
    sequence, _ = write_disc(tmp_path / "disc", masks=True, frames=2)
    before = content(sequence.folder)
    with pytest.raises(UsageError, match="has masks that were not made here"):
        annotate(sequence.folder, [Click(*disc_click())])
    assert content(sequence.folder) == before
    done = annotate(sequence.folder, [Click(*disc_click())], overwrite=True)
    assert done.provenance["masks"]["source"] == "built-in"


def test_a_cancelled_or_refused_annotation_leaves_what_was_there(tmp_path):
    class UntilTracking(Progress):
        def report(self, stage, iteration, total, loss=None, message=""):
            if stage == "point_tracking":
                raise CancelledError("enough")

    sequence, _ = write_disc(tmp_path / "disc", frames=2)
    before = content(sequence.folder)
    with pytest.raises(CancelledError):
        annotate(sequence.folder, [Click(*disc_click())], UntilTracking())
    with pytest.raises(UsageError, match="there is no view 'up'"):
        annotate(sequence.folder, [Click("up", 0, 1, 1)])
    with pytest.raises(UsageError, match="names no hand, and there is no click"):
        annotate(sequence.folder, [])
    assert content(sequence.folder) == before
    assert Sequence.load(sequence.folder).provenance == {}


def overlap(found: np.ndarray, true: np.ndarray) -> float:
    """Intersection over union of the object."""
    a, b = found == 1, true == 1
    return float((a & b).sum() / (a | b).sum())


def labels(sequence: Sequence, view: str = "top") -> np.ndarray:
    one = next(one for one in sequence.views if one.name == view)
    return np.stack([one.mask(frame) for frame in range(one.frame_count)])


def test_a_corrected_mask_stands_alone_or_is_carried_on_until_the_next_one(tmp_path):
    sequence, true = write_disc(tmp_path / "disc", hand=True, masks=True)
    wrong = np.zeros_like(true["top"])
    for frame in range(FRAMES):
        path = sequence.folder / f"views/top/mask/{frame:05d}.png"
        path.write_bytes(cv2.imencode(".png", wrong[frame])[1].tobytes())
    done = correct_masks(sequence.folder, [Correction("top", 2, true["top"][2])])
    assert np.array_equal(labels(done)[2], true["top"][2])
    assert not labels(done)[np.arange(FRAMES) != 2].any()
    assert np.array_equal(labels(done, "side"), true["side"])
    assert done.provenance["masks"] == {
        "source": "unknown",
        "corrections": [{"view": "top", "frame": 2, "carried_on": False}],
    }
    assert "tracks" not in done.provenance
    done = correct_masks(sequence.folder, [Correction("top", 5, true["top"][5])], carries_on=True)
    found = labels(done)
    done.validate()
    assert np.array_equal(found[5], true["top"][5])
    assert not found[:2].any()  # Frame 2 was corrected before: what lies behind it stays.
    assert np.array_equal(found[2], true["top"][2])
    assert min(overlap(found[frame], true["top"][frame]) for frame in range(2, FRAMES)) > 0.85
    assert ((found[FRAMES - 1] == 2) & (true["top"][FRAMES - 1] == 2)).sum() > 50
    assert [entry["frame"] for entry in done.provenance["masks"]["corrections"]] == [2, 5]
    again = correct_masks(sequence.folder, [Correction("top", 5, true["top"][5])])
    assert again.provenance["masks"]["corrections"][1]["carried_on"] is False


def test_tracks_that_were_made_here_follow_the_corrected_mask(tmp_path, annotated):
    done = sequence = copied(annotated, tmp_path)
    side = np.load(sequence.folder / "views/side/track.npy")
    nothing = np.zeros_like(labels(done)[3])
    done = correct_masks(sequence.folder, [Correction("top", 3, nothing)])
    top = next(view for view in done.views if view.name == "top")
    assert top.track_visible is not None
    assert not top.track_visible[3].any()
    assert top.track_visible[2].any()
    kept = np.load(sequence.folder / "views/side/track.npy")
    assert np.array_equal(kept, side, equal_nan=True)
    assert done.provenance["masks"]["clicks"] == done.provenance["tracks"]["clicks"]
    with pytest.raises(UsageError, match="no masks that could be corrected"):
        correct_masks(sequence.folder, [Correction("left", 0, nothing)])
    with pytest.raises(UsageError, match="no frame 4"):
        correct_masks(sequence.folder, [Correction("top", 4, nothing)])
    with pytest.raises(UsageError, match=r"labels \[0, 1\], not 120x96 px of \[2\]"):
        correct_masks(sequence.folder, [Correction("top", 0, nothing + 2)])
    with pytest.raises(UsageError, match="not 119x96 px"):
        correct_masks(sequence.folder, [Correction("top", 0, nothing[:, 1:])])


def test_tracks_of_the_users_model_are_hidden_where_a_correction_shows_no_object(
    tmp_path, annotated
):
    done = sequence = copied(annotated, tmp_path)
    path = sequence.folder / "sequence.yaml"
    head, tracks = path.read_text().split("  tracks:\n")
    tracks = tracks.replace("source: built-in", "source: tapnext\n    model_sha256: abc")
    path.write_text(f"{head}  tracks:\n{tracks}")
    before = {view.name: (view.track, view.track_visible) for view in done.views}
    label = labels(done)[2].copy()
    label[:, : int(disc_click()[2])] = 0
    done = correct_masks(sequence.folder, [Correction("top", 2, label)])
    assert done.provenance["tracks"]["source"] == "tapnext"
    for view in done.views:
        pixel, visible = before[view.name]
        np.testing.assert_array_equal(view.track, pixel)
        hidden = visible & ~view.track_visible
        assert hidden.any() == (view.name == "top")
        assert not hidden[[0, 1, 3]].any()
        assert not (view.track_visible & ~visible).any()
        if view.name == "top":
            column, row = pixel[2, view.track_visible[2]].round().astype(int).T
            assert (label[row, column] == 1).all()


class _Killed(BaseException):
    """Stands for the end of a process: nothing is cleared away after it."""


def once(find: Callable[..., object]) -> Callable[..., object]:
    """Let a function find something the first time, and give it again whatever is asked then."""
    found: list[object] = []

    def call(*asked: object) -> object:
        found.extend([] if found else [find(*asked)])
        return found[0]

    return call


@pytest.fixture
def whole_test() -> Iterator[pytest.MonkeyPatch]:
    """Patches that stay when those of `monkeypatch` are undone midway."""
    with pytest.MonkeyPatch.context() as patch:
        yield patch


@pytest.mark.parametrize("clicks", [[Click(*disc_click())], []], ids=["first time", "hands alone"])
def test_masks_and_tracks_can_be_made_again_wherever_their_storing_ended(
    tmp_path, monkeypatch, whole_test, annotated_held, clicks
):
    if clicks:
        sequence, _ = write_disc(tmp_path / "disc", hand=True, frames=3)
    else:  # Tracks are there that are to go.
        sequence = copied(annotated_held, tmp_path)
    stored = iter(range(100))
    moves = Path.rename

    def killed_at(last: int) -> None:
        def rename(path: Path, target: Path) -> Path:
            if next(stored) == last:
                raise _Killed
            return moves(path, target)

        monkeypatch.setattr(Path, "rename", rename)
        monkeypatch.setattr(annotation.shutil, "rmtree", lambda *_, **__: None)

    # What is found is the same each time, and most of the work.
    for finder in ("segment", "track_points"):
        whole_test.setattr(annotation, finder, once(getattr(annotation, finder)))
    ends = 0
    for last in range(20):
        folder = Path(shutil.copytree(sequence.folder, tmp_path / f"copy{last}"))
        stored = iter(range(100))
        killed_at(last)
        try:
            annotate(folder, clicks)
        except _Killed:
            ends += 1
        else:
            break
        finally:
            monkeypatch.undo()
        assert lacks_masks(folder)
        done = annotate(folder, clicks)
        done.validate()
        assert not lacks_masks(folder)
        assert "unfinished" not in done.provenance["masks"]
        assert all(view.has_mask for view in done.views)
        assert all((view.track is not None) == bool(clicks) for view in done.views)
    assert ends >= 6


def test_masks_whose_correction_ended_midway_are_not_made_again_unasked(
    tmp_path, monkeypatch, annotated_held
):
    sequence = copied(annotated_held, tmp_path)
    folder = sequence.folder
    meta = folder / "sequence.yaml"
    meta.write_text(meta.read_text().replace("source: built-in", "source: by hand"))
    view = sequence.views[0].name
    painted = np.ones_like(Sequence.load(folder).views[0].mask(1))

    def killed(*_: object) -> None:
        raise _Killed

    monkeypatch.setattr(annotation, "_put_in_place", killed)
    with pytest.raises(_Killed):
        correct_masks(folder, [Correction(view, 1, painted)])
    monkeypatch.undo()
    assert Sequence.load(folder).meta.has_unfinished_masks
    assert not lacks_masks(folder)
    with pytest.raises(UsageError, match="masks that were not made here"):
        annotate(folder, [Click(*disc_click())])
    done = correct_masks(folder, [Correction(view, 1, painted)])
    assert not done.meta.has_unfinished_masks
    assert (done.views[0].mask(1) == 1).all()
