"""The command that finds an object from clicks."""

import pytest
from support.inputs.clicked_disc import FRAMES, disc_click, write_disc
from support.inputs.made_models import write_cotracker

from app import cli
from physhandi.data.sequence import Sequence
from physhandi.perception import hand_size


def call(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as end:
        cli.main([str(argument) for argument in arguments])
    return int(end.value.code or 0), *capsys.readouterr()


def test_a_click_on_the_command_line_gives_masks_and_tracks(tmp_path, capsys):
    sequence, _ = write_disc(tmp_path / "disc", frames=2)
    view, frame, x, y = disc_click()
    place = f"{view},{frame},{x:g},{y:g}"
    code, out, error = call(capsys, "annotate", sequence.folder, "--click", place)
    assert code == 0, error
    assert "frames with object: 2" in out
    assert "least tracks in a frame: " in out
    assert "segmentation 4/4" in error
    assert "point_tracking 4/4" in error
    done = Sequence.load(sequence.folder)
    done.validate()
    assert done.missing("mask", "track") == []
    assert done.provenance["masks"]["clicks"] == [{"view": view, "frame": 0, "x": x, "y": y}]


@pytest.mark.parametrize(
    ("place", "told"),
    [
        ("top,0,40", "write view,frame,x,y"),
        ("top,first,40,40", "write view,frame,x,y"),
        (f"top,{FRAMES},40,40", f"there is no frame {FRAMES}"),
        ("front,0,40,40", "there is no view 'front'"),
    ],
)
def test_a_click_that_makes_no_sense_is_bad_usage(tmp_path, capsys, place, told):
    sequence, _ = write_disc(tmp_path / "disc")
    code, out, error = call(capsys, "annotate", sequence.folder, "--click", place)
    assert (code, out) == (2, "")
    assert told in error
    assert not any(view.has_mask for view in Sequence.load(sequence.folder).views)


def test_given_masks_stay_unless_overwriting_is_allowed(tmp_path, capsys):
    sequence, _ = write_disc(tmp_path / "disc", masks=True, frames=2)
    view, frame, x, y = disc_click()
    command = ("annotate", sequence.folder, "--click", f"{view},{frame},{x:g},{y:g}")
    code, _, error = call(capsys, *command)
    assert code == 2
    assert "not made here" in error
    assert call(capsys, *command, "--overwrite")[0] == 0


def test_models_of_the_user_are_named_by_their_folders(tmp_path, capsys):
    sequence, _ = write_disc(tmp_path / "disc", frames=2)
    view, frame, x, y = disc_click()
    command = ("annotate", sequence.folder, "--click", f"{view},{frame},{x:g},{y:g}")
    code, _, error = call(capsys, *command, "--mask-model", tmp_path)
    assert code == 2
    assert "is no folder of a mask model" in error
    folder = write_cotracker(tmp_path / "tracker")
    code, _, error = call(capsys, *command, "--track-model", folder)
    assert code == 2
    assert "--trust-model-code" in error


def test_options_of_networks_that_would_be_ignored_are_refused(tmp_path, capsys):
    sequence, _ = write_disc(tmp_path / "disc", frames=2)
    view, frame, x, y = disc_click()
    click = ("--click", f"{view},{frame},{x:g},{y:g}")
    capture = ("import", "capture", tmp_path, "--out", tmp_path / "out")
    tracker = ("--track-model", tmp_path)
    for command in (("annotate", sequence.folder), capture):
        for options, message in (
            (tracker, "--track-model follows what --click names"),
            ((*click, "--trust-model-code"), "the code of a --track-model"),
        ):
            code, _, error = call(capsys, *command, *options)
            assert code == 2
            assert message in error
    code, _, error = call(capsys, *capture, "--mask-model", tmp_path)
    assert code == 2
    assert "--mask-model finds what --click names" in error
    assert not (tmp_path / "out").exists()


def test_hands_of_an_impossible_size_are_told_at_once(tmp_path, capsys, monkeypatch):
    sequence, _ = write_disc(tmp_path / "disc", hand=True, frames=2)
    view, frame, x, y = disc_click()
    command = ("annotate", sequence.folder, "--click", f"{view},{frame},{x:g},{y:g}")
    assert "problems" not in call(capsys, *command)[1]
    monkeypatch.setattr(hand_size, "PALM_LENGTHS", (0.2, 0.3))
    code, out, error = call(capsys, *command)
    assert code == 0, error
    assert "View 'side': by its depth hands measure 5." in out
    assert "To do: multiply its depth images by 1.7" in out
