import os
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from support.inputs.clicked_disc import FRAMES, TOP, cameras, center, disc_click, write_disc
from support.inputs.made_models import BREAKS_OFF, write_cotracker, write_tapnext

from physhandi.errors import RunError, UsageError
from physhandi.perception.annotation import annotate
from physhandi.perception.segmentation import Click
from physhandi.perception.track_model import TrackModel
from physhandi.progress import Progress


def true_motion(view: str, start: np.ndarray, frame: int) -> np.ndarray:
    """Where points of the disc's face at pixels of a frame are in every frame [px]."""
    camera = cameras()[view]
    eye = camera.T_world_camera[:3, 3]
    ray = camera.unproject(start.astype(float), np.ones(len(start))) - eye
    point = eye + ray * ((TOP - eye[2]) / ray[:, 2])[:, None]
    move = [np.append(center(at) - center(frame), 0.0) for at in range(FRAMES)]
    return np.stack([camera.project(point + step) for step in move])


def test_a_tracker_of_the_user_makes_tracks_like_built_in_ones(tmp_path):
    frames = 5
    sequence, _ = write_disc(tmp_path / "disc", masks=True, frames=frames)
    folder = write_cotracker(tmp_path / "tracker")
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    done = annotate(
        sequence.folder,
        [Click(*disc_click())],
        overwrite=True,
        track_model=folder,
        trusts_model_code=True,
    )
    done.validate()
    about = done.provenance["tracks"]
    assert (about["source"], done.provenance["masks"]["source"]) == ("cotracker3", "built-in")
    assert len(about["model_sha256"]) == 64
    assert str(tmp_path) not in (sequence.folder / "sequence.yaml").read_text()
    for view in done.views:
        seen = view.track_visible
        assert seen.sum(axis=1).min() > 100
        (from_first,) = np.nonzero(seen[0])
        expected = true_motion(view.name, view.track[0, from_first], 0)[:frames]
        error = np.linalg.norm(view.track[:, from_first] - expected, axis=-1)[seen[:, from_first]]
        assert np.median(error) < 0.6
        for at in range(frames):
            column, row = view.track[at, seen[at]].round().astype(int).T
            assert (view.mask(at)[row, column] == 1).all()
    # It ran elsewhere, and nothing was left in its folder but what its own code wrote.
    (ran,) = folder.rglob("ran.txt")
    assert int(ran.read_text()) != os.getpid()
    assert "hubconf" not in sys.modules
    assert {path for path in folder.rglob("*") if path.is_file()} == {*before, ran}


def test_points_of_a_middle_frame_are_followed_both_ways_until_the_tracker_breaks_off(tmp_path):
    sequence, _ = write_disc(tmp_path / "disc")
    view = sequence.views[0]
    start = np.array(disc_click()[2:]) + np.array([[9, 0], [12, 3], [14, -4]])
    folder = write_tapnext(tmp_path / "tracker")
    with TrackModel(folder, sequence, is_trusted=True) as model:
        pixel, visible = model.follow(view, 4, start, Progress())
        assert model.provenance()["source"] == "tapnext"
        again, _ = model.follow(view, 0, start, Progress())
        (folder / BREAKS_OFF).touch()
        ended = r"tracker: .*process ended while it followed view 'top' from frame 3"
        with pytest.raises(RunError, match=ended):
            model.follow(view, 3, start, Progress())
    assert np.array_equal(pixel[4], start)
    assert visible.all()
    expected = true_motion("top", start, 4)
    assert np.linalg.norm(pixel - expected, axis=-1).max() < 1.2
    assert np.linalg.norm(expected[8] - expected[0], axis=-1).min() > 10
    assert np.linalg.norm(again - true_motion("top", start, 0), axis=-1).max() < 1.2


def test_foreign_code_is_only_executed_when_the_user_agrees(tmp_path):
    sequence, _ = write_disc(tmp_path / "disc", frames=2)
    folder = write_cotracker(tmp_path / "tracker")
    with pytest.raises(UsageError, match=r"Python code of others.*--trust-model-code"):
        annotate(sequence.folder, [Click(*disc_click())], track_model=folder)
    assert not list(folder.rglob("ran.txt"))
    assert not any(view.has_mask for view in sequence.views)


@pytest.mark.parametrize(
    ("damage", "told"),
    [
        (lambda folder: (folder / "hubconf.py").unlink(), "holds neither a hubconf.py"),
        (lambda folder: (folder / "hubconf.py").write_text(""), "with cotracker3_offline"),
        (lambda folder: (folder / "scaled_offline.pth").unlink(), "has no weights"),
        (
            lambda folder: [
                (folder / "scaled_offline.pth").rename(folder / "one.pth"),
                (folder / "two.pth").touch(),
            ],
            r"several files of weights \(one.pth, two.pth\)",
        ),
    ],
)
def test_a_folder_that_is_no_tracker_is_refused_by_name(tmp_path, damage, told):
    sequence, _ = write_disc(tmp_path / "disc", frames=1)
    folder = write_cotracker(tmp_path / "tracker")
    damage(folder)
    with pytest.raises(UsageError, match=told):
        TrackModel(folder, sequence, is_trusted=True)


class Deed:
    def __init__(self, mark: Path):
        self.mark = mark

    def __reduce__(self):
        return (Path.touch, (self.mark,))


def test_weights_execute_nothing_and_nothing_is_downloaded(tmp_path):
    sequence, _ = write_disc(tmp_path / "disc", frames=2)
    mark, said = tmp_path / "mark", tmp_path / "said"
    code = f"""
        import pathlib, torch
        try:
            torch.hub.load_state_dict_from_url("http://127.0.0.1:9/weights.pth")
        except Exception as error:
            pathlib.Path({str(said)!r}).write_text(str(error))
        """
    folder = write_cotracker(tmp_path / "maker", code)
    torch.save(Deed(mark), folder / "scaled_offline.pth")
    with (
        TrackModel(folder, sequence, is_trusted=True) as model,
        pytest.raises(UsageError, match=r"scaled_offline.pth cannot be read as plain tensors"),
    ):
        model.follow(sequence.views[0], 0, np.array([[40.0, 40.0]]), Progress())
    assert not mark.exists()
    assert "nothing is downloaded here" in said.read_text()
