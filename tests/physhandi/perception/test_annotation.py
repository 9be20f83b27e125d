import hashlib
from pathlib import Path

import numpy as np
import pytest
from clicked_disc import FRAMES, disc_click, write_disc

import physhandi
from physhandi.data.sequence import Sequence
from physhandi.errors import CancelledError, UsageError
from physhandi.perception.annotation import annotate
from physhandi.perception.lifting import observe_object
from physhandi.perception.segmentation import Click
from physhandi.progress import Progress


def content(folder: Path) -> dict[str, str]:
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_one_click_makes_a_sequence_whose_object_can_be_observed(tmp_path):
    sequence, true = write_disc(tmp_path / "disc", hand=True)
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
        both = [(one.mask(f) == 1) & (true[one.name][f] == 1) for f in range(FRAMES)]
        assert np.sum(both) > 0.85 * (true[one.name] == 1).sum()
    cloud = np.concatenate(observe_object(done).cloud)
    assert abs(np.median(cloud[:, 2]) - 0.03) < 0.003
    after = content(sequence.folder)
    kept = [name for name in before if name != "sequence.yaml"]
    assert all(after[name] == before[name] for name in kept)
    assert not [name for name in after if ".tmp" in name]


def test_masks_that_were_made_here_are_replaced_and_tracks_go_with_their_object(tmp_path):
    sequence, _ = write_disc(tmp_path / "disc", hand=True, frames=3)
    annotate(sequence.folder, [Click(*disc_click())])
    done = annotate(sequence.folder, [])
    done.validate()
    assert done.provenance["masks"]["clicks"] == []
    assert "tracks" not in done.provenance
    assert all(view.track is None for view in done.views)
    assert all((view.mask(2) != 1).all() for view in done.views)


def test_given_masks_are_only_replaced_when_that_is_asked_for(tmp_path):
    sequence, _ = write_disc(tmp_path / "disc", masks=True, frames=3)
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

    sequence, _ = write_disc(tmp_path / "disc", frames=3)
    before = content(sequence.folder)
    with pytest.raises(CancelledError):
        annotate(sequence.folder, [Click(*disc_click())], UntilTracking())
    with pytest.raises(UsageError, match="there is no view 'up'"):
        annotate(sequence.folder, [Click("up", 0, 1, 1)])
    with pytest.raises(UsageError, match="names no hand, and there is no click"):
        annotate(sequence.folder, [])
    assert content(sequence.folder) == before
    assert Sequence.load(sequence.folder).provenance == {}
