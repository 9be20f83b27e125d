"""Hands measure the scale of depth: by stored keypoints, or by those that are detected."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.inputs.clicked_disc import disc_click, write_disc

import physhandi as ph
from physhandi.data.depth_scale import likely_scales
from physhandi.data.sequence import Sequence
from physhandi.data.view import View
from physhandi.fitting.checks.recording_check import depth_scale_problems
from physhandi.perception import annotation, segmentation
from physhandi.perception.annotation import annotate
from physhandi.perception.hand_size import is_impossible_palm, palm_length
from physhandi.perception.segmentation import Click

TOWEL = Path(__file__).parents[3] / "sequences/towel_fold"


@pytest.fixture
def scaled(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Let depth of all views, or of one, be wrong by a factor."""
    read = View.depth

    def scale(factor: float, name: str | None = None) -> None:
        def depth(view: View, frame: int) -> np.ndarray:
            measured = read(view, frame)
            is_wrong = name in {None, view.name}
            return (factor * measured).astype(measured.dtype) if is_wrong else measured

        monkeypatch.setattr(View, "depth", depth)

    return scale


def imported_with(folder: Path, scale: float) -> None:
    """Say that the depth of all views was imported with a scale."""
    path = folder / "sequence.yaml"
    meta = path.read_text().partition("\nprovenance:")[0]
    views = "".join(f"    {view}: {scale:f}\n" for view in ("front", "left", "right"))
    path.write_text(f"{meta}\nprovenance:\n  depth_scale:\n{views}")


@pytest.fixture
def towel(tmp_path: Path) -> Path:
    folder = Path(shutil.copytree(TOWEL, tmp_path / "towel"))
    imported_with(folder, 0.001)
    return folder


def told(folder: Path) -> list[str]:
    return [f"{one.file} {one.message} {one.remedy}" for one in ph.check(folder).problems]


def test_hands_of_the_right_size_say_nothing(towel):
    sequence = Sequence.load(towel)
    for view in sequence.views:
        assert 0.06 < palm_length(view, view.keypoint) < 0.08
    assert depth_scale_problems(sequence) == []


@pytest.mark.parametrize(
    ("factor", "scale", "right"),
    [(5.0, 0.001, "0.00025 or 0.0002"), (0.2, 0.0002, "0.001"), (0.1, 0.001, "0.01")],
)
def test_a_wrong_scale_is_named_with_the_likely_one(towel, scaled, factor, scale, right):
    scaled(factor, "left")
    imported_with(towel, scale)
    (problem,) = depth_scale_problems(Sequence.load(towel))
    assert "wrist to knuckles" in problem.message
    assert (problem.level, problem.file) == ("warning", "views/left/depth")
    measured, ratio = map(float, re.findall(r"([\d.]+) (?:cm|times)", problem.message)[:2])
    assert "View 'left': by its depth" in problem.message
    assert measured == pytest.approx(100 * 0.0681 * factor, rel=0.02)
    assert ratio == pytest.approx(measured / 8.5, rel=0.02)
    assert f"--depth-scale {right}, in the place of {scale:g}" in problem.remedy
    # The other views' hands are as large as hands, so the keypoints may be wrong as well.
    assert re.search(r"not on hands \(there are 7.* in 'front', \d.* in 'right'\)", problem.message)
    assert "look at its keypoints on the check page" in problem.remedy


@pytest.mark.parametrize("scale", [None, 1.0])
def test_a_scale_that_nobody_noted_or_that_cannot_be_given_is_told_as_a_factor(
    towel, scaled, scale
):
    """Above 1, a scale would be taken for units per metre: 5 for a fifth."""
    factor = 5.0 if scale is None else 0.2
    scaled(factor)
    if scale is None:
        text = (towel / "sequence.yaml").read_text()
        (towel / "sequence.yaml").write_text(text.partition("\nprovenance:")[0] + "\n")
    else:
        imported_with(towel, scale)
    remedies = [one.remedy for one in depth_scale_problems(Sequence.load(towel))]
    factors = [float(one.partition("multiply its depth images by ")[2]) for one in remedies]
    assert factors == pytest.approx([1.22 / factor] * 3, rel=0.1)  # Its palms are 7 of 8.5 cm.


@pytest.mark.parametrize(
    ("palm", "scale"), [("1.0e-300", "0.001"), ("0.42", "1.0e-323"), ("[]", "x")]
)
def test_figures_that_nobody_can_have_measured_do_no_harm(towel, palm, scale):
    (towel / "views/front/keypoint.npy").unlink()
    text = (towel / "sequence.yaml").read_text().partition("\nprovenance:")[0]
    provenance = f"  palm_length: {{front: {palm}}}\n  depth_scale: {{front: {scale}}}\n"
    (towel / "sequence.yaml").write_text(f"{text}\nprovenance:\n{provenance}")
    remedies = [one.remedy for one in depth_scale_problems(Sequence.load(towel))]
    # The keypoints of the two other views are stored, and on hands.
    looked = "look at its keypoints on the check page; if they are on hands, "
    assert remedies == ([f"{looked}multiply its depth images by 0.2"] if palm == "0.42" else [])


@pytest.mark.parametrize("lost", ["file", "hand", "depth", "metres"])
def test_without_keypoints_depth_or_metres_nothing_is_said(towel, scaled, lost):
    scaled(5.0)
    for view in towel.glob("views/*"):
        if lost == "file":
            (view / "keypoint.npy").unlink()
        elif lost == "hand":
            np.save(view / "keypoint.npy", np.full_like(np.load(view / "keypoint.npy"), np.nan))
        elif lost == "depth":
            shutil.rmtree(view / "depth")
    if lost == "metres":
        text = (towel / "sequence.yaml").read_text()
        text = text.replace("metric: true", "metric: false").replace(": m\n", ": palms\n")
        (towel / "sequence.yaml").write_text(text)
    assert depth_scale_problems(Sequence.load(towel)) == []


def test_keypoints_on_what_is_behind_the_hand_do_not_count(towel):
    view = Sequence.load(towel).views[0]
    off = np.array(view.keypoint)
    off[:, :, [5, 9], :2] += [60.0, -60.0]  # On the table, or beyond it.
    assert palm_length(view, off) == pytest.approx(palm_length(view, view.keypoint), abs=0.03)
    off[:, :, 0, 2] = 0.0
    assert palm_length(view, off) is None
    off[..., :2] += 1000.0
    assert palm_length(view, off) is None
    few = np.full_like(view.keypoint, np.nan)
    few[0] = view.keypoint[0]
    assert palm_length(view, few) is None


def test_what_detected_keypoints_measure_is_kept_with_the_masks(tmp_path, monkeypatch):
    sequence, _ = write_disc(tmp_path / "disc", hand=True, frames=2)
    stored = {view.name: np.array(view.keypoint) for view in sequence.views}
    for view in sequence.views:
        (view.folder / "keypoint.npy").unlink()
    monkeypatch.setattr(segmentation, "detect_view", lambda view, *_: stored[view.name])
    done = annotate(sequence.folder, [Click(*disc_click())])
    palms = done.provenance["palm_length"]
    assert set(palms) == {"top", "side"}
    assert all(0.045 < length < 0.06 for length in palms.values())
    assert not [line for line in told(done.folder) if "wrist to knuckles" in line]
    monkeypatch.setattr(annotation, "palm_length", lambda *_: 0.42)
    annotate(sequence.folder, [Click(*disc_click())])
    found = [line for line in told(done.folder) if "wrist to knuckles" in line]
    assert ["views/top/depth" in line or "views/side/depth" in line for line in found] == [True] * 2
    assert "42 cm" in found[0]
    for name, keypoint in stored.items():  # Those that are stored are looked at themselves.
        np.save(done.folder / f"views/{name}/keypoint.npy", keypoint)
    assert not [line for line in told(done.folder) if "wrist to knuckles" in line]
    assert "palm_length" not in annotate(sequence.folder, [Click(*disc_click())]).provenance


def test_the_scales_of_recorders_are_known():
    assert likely_scales(0.00019) == (0.0002, 0.00025)
    assert likely_scales(0.0011) == (0.001,)
    assert likely_scales(0.0044) == (0.004,)
    assert [is_impossible_palm(length) for length in (0.03, 0.05, 0.17, 0.2)] == [1, 0, 0, 1]
