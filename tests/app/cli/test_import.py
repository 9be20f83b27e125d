"""The commands that turn other programs' files into ours."""

import re
import shutil
import signal
import subprocess
import sys

import numpy as np
import pytest
from support.inputs.clicked_disc import write_disc
from support.inputs.mano_file import write_mano
from support.inputs.phystwin_case import write_case
from support.inputs.phystwin_experiment import write_experiment
from support.inputs.raw_capture import CAMERAS, RawCapture, ball, find_no_hand, picture

from app import cli
from physhandi.data.sequence import Sequence
from physhandi.hand.loading import load_hand_model
from physhandi.perception import segmentation
from physhandi.run import Run


def call(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as end:
        cli.main([str(argument) for argument in arguments])
    return int(end.value.code or 0), *capsys.readouterr()


def test_a_phystwin_case_and_what_it_was_fitted_to_are_imported(tmp_path, capsys):
    case = write_case(tmp_path / "case")
    experiment = write_experiment(case, tmp_path / "experiment")
    code, out, error = call(
        capsys,
        *("import", "phystwin", case.folder, "--out", tmp_path / "block", "--device", "cpu"),
        *("--optimal-params", experiment.optimum, "--checkpoint", experiment.checkpoint),
        *("--inference", experiment.inference),
    )
    assert code == 0, error
    sequence = Sequence.load(tmp_path / "block")
    assert sequence.object_node is not None
    assert np.ptp(sequence.object_node, axis=0).min() > 0
    run = Run.open(tmp_path / "block_phystwin")
    assert run.is_published
    moved = run.array("sequences/block/rollout.npy")
    assert np.abs(moved[-1] - moved[0]).max() > 0.01
    report = run.json("import.json")
    assert f"run: {run.folder}" in out
    for name in report:
        assert name in out


def test_a_case_alone_becomes_a_sequence_and_no_run(tmp_path, capsys):
    case = write_case(tmp_path / "case")
    code, out, _ = call(capsys, "import", "phystwin", case.folder, "--out", tmp_path / "block")
    assert (code, out) == (0, f"sequence: {tmp_path / 'block'}\n")
    assert [path.name for path in tmp_path.iterdir() if path.name != "case"] == ["block"]


def test_a_checkpoint_without_the_search_result_is_refused_before_anything_is_written(
    tmp_path, capsys
):
    case = write_case(tmp_path / "case")
    code, out, error = call(
        capsys,
        *("import", "phystwin", case.folder, "--out", tmp_path / "block"),
        *("--checkpoint", tmp_path / "best.pth"),
    )
    assert code == 2
    assert "--optimal-params" in error
    assert out == ""
    assert not (tmp_path / "block").exists()


def test_mano_is_imported_where_fits_look_for_it(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("PHYSHANDI_HANDS", str(tmp_path / "hands"))
    source = write_mano(tmp_path)
    code, out, error = call(capsys, "import", "mano", source)
    assert code == 0, error
    assert "mano_right.npz" in out
    assert load_hand_model("right", "mano").vertex_count == 778
    assert [path.name for path in (tmp_path / "hands").iterdir()] == ["mano_right.npz"]


def test_every_option_of_a_motion_capture_import_can_be_given(tmp_path, capsys):
    rope = np.zeros((40, 5, 3), np.float32)
    rope[..., 1] = 1000 * (1 + np.arange(40)[:, None] / 100)
    rope[..., 0] = 80 * np.arange(5)
    np.save(tmp_path / "rope.npy", rope)
    command = ("import", "mocap", tmp_path / "rope.npy", "--out", tmp_path / "out")
    code, _, error = call(capsys, *command)
    assert (code, "--controlled-markers" in error) == (1, True)
    code, _, error = call(capsys, *command, "--controlled-markers")
    assert (code, "markers []" in error) == (1, True)
    options = ("--controlled-markers", 0, 4, "--recording-rate", 60, "--frame-rate", 20)
    options += ("--node-spacing", 0.02, "--rest-shape", "first_frame", "--up", "y", "--unit", "mm")
    code, _, error = call(capsys, *command, *options)
    assert code == 0, error
    sequence = Sequence.load(tmp_path / "out" / "rope")
    assert (sequence.frame_rate, sequence.frame_count) == (20.0, 14)
    assert sequence.object_node is not None
    np.testing.assert_allclose(sequence.object_node[[0, -1]], [[0, 0, 1], [0, 0.32, 1]], atol=1e-6)
    assert call(capsys, *command, *options)[0] != 0
    assert call(capsys, *command, *options, "--overwrite")[0] == 0


def test_a_raw_recording_is_imported_and_what_was_assumed_is_told(tmp_path, capsys):
    raw = RawCapture(tmp_path / "raw").write(4)
    code, out, error = call(
        capsys,
        *("import", "capture", raw.folder, "--out", tmp_path / "ball"),
        *("--depth-scale", 0.001, "--frame-rate", 20, "--every", 2, "--hands", "left"),
        *("--hands", "right"),
    )
    assert code == 0, error
    sequence = Sequence.load(tmp_path / "ball")
    assert (sequence.frame_count, sequence.frame_rate) == (2, 10.0)
    assert sequence.hands == ("left", "right")
    assert "left on right" in out
    assert "aligned to color" in out


def test_a_raw_recording_needs_a_board_that_makes_sense(tmp_path, capsys):
    raw = RawCapture(tmp_path / "raw").write(2)
    code, _, error = call(
        capsys, "import", "capture", raw.folder, "--out", tmp_path / "x", "--charuco", "7x5,40"
    )
    assert code == 2
    assert "in metres" in error
    for board, words in (
        (("--april-grid", "6x6,0.03"), "6x6,0.03,0.009"),
        (("--april-grid", "6x6,30,9"), "in metres"),
        (("--april-grid", "6x6,0.03,0.009", "--charuco", "7x5,0.04"), "two boards"),
    ):
        code, _, error = call(
            capsys, "import", "capture", raw.folder, "--out", tmp_path / "x", *board
        )
        assert code == 2
        assert words in error
    assert not (tmp_path / "x").exists()


def test_a_capture_is_imported_or_made_but_not_both(tmp_path, capsys):
    code, _, error = call(capsys, "import", "capture", tmp_path, "--example", tmp_path / "x")
    assert (code, "give it alone" in error) == (2, True)
    code, _, error = call(capsys, "import", "capture", tmp_path)
    assert (code, "--out" in error) == (2, True)


def test_a_click_with_the_import_makes_masks_and_tracks_at_once(tmp_path, capsys):
    raw = RawCapture(tmp_path / "raw").write(3)
    x, y = CAMERAS["left"].project(ball(1)[0]).round()
    command = ("import", "capture", raw.folder, "--depth-scale", 0.001, "--out")
    code, out, error = call(capsys, *command, tmp_path / "ball", "--click", f"left,1,{x:g},{y:g}")
    assert code == 0, error
    assert "frames with object: 3" in out
    assert re.search(r"frames with hands: 0\b", out)  # So `find_no_hand` tells the truth.
    sequence = Sequence.load(tmp_path / "ball")
    sequence.validate()
    assert sequence.missing("mask", "track") == []
    assert sequence.provenance["masks"]["source"] == "built-in"
    assert sequence.provenance["importer"] == "capture"
    for name, view in CAMERAS.items():
        found = next(view for view in sequence.views if view.name == name).mask(2) == 1
        true = (picture(view, 2)[0] == [200, 60, 50]).all(axis=-1)
        assert (found & true).sum() > 0.85 * (found | true).sum()


@pytest.mark.parametrize(
    ("click", "words"),
    [
        ("left,3,3,3", "there is no frame 3. Name one from 0 to 2."),
        ("top,0,3,3", "Views are: left, right."),
        ("left,0,96,3", "x goes from 0 to 95, y to 71"),
        ("right,0,3,3", "view 'right' has no depth"),
        ("left,0", "does not name a place"),
    ],
)
def test_a_click_where_nothing_can_be_is_refused_before_images_are_read(
    tmp_path, capsys, click, words
):
    raw = RawCapture(tmp_path / "raw").write(3)
    shutil.rmtree(raw.folder / "right" / "depth")
    out = tmp_path / "ball"
    code, _, error = call(capsys, "import", "capture", raw.folder, "--out", out, "--click", click)
    assert (code, words in error) == (2, True), error
    assert sorted(path.name for path in tmp_path.iterdir()) == ["raw"]


KILLED_WHILE_IT_FINDS_MASKS = """
import os, signal, sys
from app import cli
from physhandi.perception import annotation
annotation.segment = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
cli.main(sys.argv[1:])
"""


def test_an_import_that_was_killed_while_it_found_masks_goes_on(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(segmentation, "detect_view", find_no_hand)
    raw = RawCapture(tmp_path / "raw").write(3)
    x, y = CAMERAS["left"].project(ball(1)[0]).round()
    command = ("import", "capture", raw.folder, "--out", tmp_path / "ball")
    click = ("--click", f"left,1,{x:g},{y:g}")
    words = [str(word) for word in (*command, *click)]
    killed = subprocess.run(
        [sys.executable, "-c", KILLED_WHILE_IT_FINDS_MASKS, *words], check=False
    )
    assert killed.returncode == -signal.SIGKILL
    begun = Sequence.load(tmp_path / "ball")
    assert begun.missing("mask") == ["mask"]
    imported = [path.stat().st_mtime_ns for path in begun.folder.rglob("*.png")]
    for other in ((), ("--every", 2, *click), ("--depth-scale", 0.0011, *click)):
        code, _, error = call(capsys, *command, *other)
        assert (code, "exists already" in error) == (1, True)
    code, out, error = call(capsys, *command, *click)
    assert code == 0, error
    assert "frames with object: 3" in out
    done = Sequence.load(tmp_path / "ball")
    done.validate()
    assert done.missing("mask", "track") == []
    images = done.folder.glob("views/*/[cd]*/*.png")
    assert sorted(path.stat().st_mtime_ns for path in images) == sorted(imported)
    code, _, error = call(capsys, *command, *click)  # Now it is whole.
    assert (code, "exists already" in error) == (1, True)


def test_a_click_beside_the_object_leaves_an_import_that_another_click_completes(
    tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(segmentation, "detect_view", find_no_hand)
    raw = RawCapture(tmp_path / "raw").write(3)
    command = ("import", "capture", raw.folder, "--out", tmp_path / "ball")
    code, _, error = call(capsys, *command, "--click", "left,1,2,2")
    assert code == 2
    assert "left" in error
    assert "click again with physhandi annotate" in error
    assert Sequence.load(tmp_path / "ball").missing("mask") == ["mask"]
    x, y = CAMERAS["left"].project(ball(1)[0]).round()
    code, out, error = call(capsys, *command, "--click", f"left,1,{x:g},{y:g}")
    assert code == 0, error
    assert "frames with object: 3" in out


def test_hands_that_another_method_found_become_keypoints(tmp_path, capsys):
    sequence, _ = write_disc(tmp_path / "disc", frames=2)
    text = (sequence.folder / "sequence.yaml").read_text()
    (sequence.folder / "sequence.yaml").write_text(text.replace("hands: []", "hands: [right]"))
    results = tmp_path / "hands.npz"
    shown = np.full((1, 21, 2), 40.0)
    fields = {"format": "physhandi-hands/1", "frame": [1], "side": "right", "view": "top"}
    np.savez(results, keypoint=shown, **fields)
    code, out, error = call(capsys, "import", "hands", sequence.folder, results)
    assert code == 0, error
    assert "right: 1" in out
    assert Sequence.load(sequence.folder).views[0].keypoint[1, 0, 20].tolist() == [40, 40, 1]
    results.write_bytes(b"")
    code, _, error = call(capsys, "import", "hands", sequence.folder, results)
    assert code == 1
    assert "cannot be read as .npz" in error
