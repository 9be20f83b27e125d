"""The benchmark of imports, on a scene of a few frames; fits are told by hand."""

import json
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.physics.synthetic_world import lifted_sheet
from support.waiting import LIMIT_S

from app import cli
from app.benchmarks import capture
from app.benchmarks.capture import CaptureOrder, ScenePlace
from physhandi import api
from physhandi.data.sequence import Sequence
from physhandi.data.truth import read_truth
from physhandi.errors import RunError
from physhandi.metrics.truth_metrics import true_surface
from physhandi.progress import NullProgress, Progress
from physhandi.synthetic import synthesize
from physhandi.synthetic.engines.truth import PhysicalTruth
from physhandi.synthetic.suite import suite
from physhandi.synthetic.suite.suite import Making, make_recording


def scored(error: float | None) -> dict[str, Any]:
    of_split = {"chamfer_l1_mm": error, "track_error_mm": error}
    return {"search_seed": 1, "fitted": of_split, "predicted": of_split}


def test_a_made_scene_is_captured_imported_and_scored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # MuJoCo would take 12 s to have a hand reach for the smallest cloth.
    def lifted(*_scripted: object, frame_count: int, **_how: object) -> PhysicalTruth:
        return lifted_sheet(frame_count)

    def with_two_cameras(making: Making, target: Path, progress: Progress) -> None:
        make_recording({**making, "cameras": 2}, target, progress)

    monkeypatch.setattr(synthesize, "simulate_truth", lifted)
    monkeypatch.setattr(suite, "make_recording", with_two_cameras)
    order = CaptureOrder(frames=2, image_size="half", resolution="tiny", fit="none")
    place = ScenePlace(tmp_path, "cloth/lift", order.seed)
    capture.make_scene(place, "cloth/lift", order, NullProgress())
    found = capture.import_scene(place, NullProgress()) | capture.score_import(place)
    assert found["click"].startswith("camera0,0,")
    assert found["import"]["peak_memory_mb"] > 50
    masks = found["masks"]
    assert masks["against_exact"]["object"] > 0.85
    # The recording's own masks err on purpose, and less than whoever has to find them.
    assert 0.9 < masks["recording_against_exact"]["object"] < 1.0
    assert found["cameras"]["shift_mm"] < 3.0
    assert found["cameras"]["turn_deg"] < 0.3
    assert found["tracks"]["points"] > 100
    assert found["tracks"]["median_mm"] < 5.0
    assert len(found["tracks"]["least_by_view"]) == 2
    assert set(capture.reached(found)) == set(capture.CAPTURE_GOALS) - {"chamfer_ratio"}
    fitted: list[tuple[Sequence, Path]] = []

    def fit(sequence: Sequence, *, out: Path, **_how: object) -> None:
        fitted.append((sequence, out))

    monkeypatch.setattr(api, "reconstruct", fit)
    for given in ("import", "exact", "exact_same_hands", "exact_same_hands"):
        capture.fit_scene(place, given, 7, order, NullProgress())
    imported, exact, same_hands, again = [sequence for sequence, _ in fitted]
    assert len({out for _, out in fitted}) == 3
    assert again.folder == same_hands.folder
    assert same_hands.fingerprint() != exact.fingerprint()
    for own, shown, true in zip(same_hands.views, imported.views, exact.views, strict=True):
        np.testing.assert_array_equal(own.keypoint, shown.keypoint)
        assert not np.array_equal(own.keypoint, true.keypoint, equal_nan=True)
        np.testing.assert_array_equal(own.track, true.track)
        np.testing.assert_array_equal(own.mask(1), true.mask(1))
    for name in ("track.npy", "track_visible.npy"):
        (place.imported / "views/camera1" / name).unlink()
    surface = true_surface(read_truth(place.recording))
    fewer = capture._track_figures(Sequence.load(place.imported), surface)
    assert fewer["least_by_view"][1] == 0
    assert fewer["least"] == fewer["least_by_view"][0] > 0


def test_the_ratio_is_that_of_mean_errors_and_unknown_if_a_fit_is_not_scored() -> None:
    fits = {"import": [scored(9.0), scored(11.0)], "exact": [scored(8.0), {"error": "diverged"}]}
    fits["exact_same_hands"] = [scored(10.0)]
    assert capture.ratios(fits, "exact")["fitted"] == {"chamfer_l1": 1.25, "track_error": 1.25}
    assert capture.ratios(fits, "exact_same_hands")["fitted"]["track_error"] == 1.0
    fits["exact"] = [scored(None)]
    assert capture.ratios(fits, "exact")["predicted"]["chamfer_l1"] is None
    nothing = {"import": [], "exact": []}
    assert capture.ratios(nothing, "exact")["fitted"]["chamfer_l1"] is None


def test_a_fit_that_fails_is_told_beside_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str, ...]] = []
    figures = {
        "masks": {"against_exact": {"object": 0.9, "hand": 0.7}},
        "tracks": {"median_mm": 3.0, "least": 400, "least_by_view": [260, 140]},
        "cameras": {"shift_mm": 1.0, "turn_deg": 0.4},
    }

    class Steps(capture._Steps):  # its processes are what is left out
        def do(self, scene: str, step: str, **about: Any) -> dict[str, Any]:
            given, seed = about.get("given", ""), about.get("search_seed", "")
            asked.append((step, given, str(seed), str(about.get("reference_seed", ""))))
            if (step, given, seed) == ("fit", "exact", 5):
                raise RunError("fit exact 5: all candidates diverged.")
            error = {"import": 9.0, "exact": 6.0, "exact_same_hands": 8.0}.get(given)
            of_step = {"score": figures, "score_fit": scored(error)}
            return {**of_step.get(step, {}), "step_seconds": 1.0}

    order = CaptureOrder(search_seeds=(5, 7))
    found = capture._measured("cloth/lift", tmp_path, order, Steps(1))
    assert found["fits"]["exact"][0]["error"] == "fit exact 5: all candidates diverged."
    assert found["ratio"]["fitted"]["chamfer_l1"] == 1.5
    assert found["ratio_same_hands"]["fitted"]["chamfer_l1"] == 1.125
    # All are scored against the cloud of the first fit from exact masks that there is.
    assert {seed for step, *_, seed in asked if step == "score_fit"} == {"7"}
    assert [name for name, is_reached in found["reached"].items() if not is_reached] == [
        *("hand_iou", "tracks_alive_in_each_view", "camera_turn_deg", "chamfer_ratio")
    ]
    assert json.loads((tmp_path / "capture.json").read_text()) == found


def test_a_scene_that_fails_is_named_and_costs_no_other(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    has_failed = threading.Event()

    def measured(scene: str, folder: Path, order: CaptureOrder, _steps: object) -> dict[str, Any]:
        if scene == "rope/lift":
            has_failed.set()
            raise RunError("import: nothing is seen.")
        assert has_failed.wait(LIMIT_S)
        return {"folder": folder.name, "seed": order.seed}

    monkeypatch.setattr(capture, "_measured", measured)
    arguments = ["benchmark", "capture", "--scenes", "rope/lift", "cloth/fold", "--seed", "3"]
    out = tmp_path / "out"
    arguments += ["--jobs", "2", "--fit", "none", "--device", "cpu", "--json", "--out", str(out)]
    with pytest.raises(SystemExit) as end:
        cli.main(arguments)
    assert end.value.code == 1
    printed = capsys.readouterr()
    result = json.loads(printed.out)
    assert result["scenes"] == {"cloth/fold": {"folder": "cloth_fold", "seed": 3}}
    assert result["failed"] == {"rope/lift": "import: nothing is seen."}
    assert "rope/lift: failed: import: nothing is seen." in printed.err
    assert json.loads((out / "capture.json").read_text()) == result
    assert {"commit", "processor", "device_name", "goals"} <= set(result)
    unknown = ["benchmark", "capture", "--scenes", "rope/knot", "--out", str(tmp_path / "new")]
    for wrong, told in ((arguments, "holds something"), (unknown, "There is no scene 'rope/knot'")):
        with pytest.raises(SystemExit) as end:
            cli.main(wrong)
        assert end.value.code == 2
        assert told in capsys.readouterr().err
