"""The stage that fits an object's look, from the order to the scores of its pictures."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.inputs.filmed_sheet import write_filmed_sheet
from support.inputs.lpips_weights import write_lpips
from support.inputs.sheet_sequence import FRAMES, NODE, sheet_config
from support.physics.stopped_fits import Stopper, write_always

from physhandi import pipeline
from physhandi.appearance.splats import Splats
from physhandi.data.layout import SPLATS_FILE
from physhandi.errors import CancelledError, UsageError
from physhandi.fitting.config import APPEARANCE, EVALUATION, STAGES, PipelineConfig
from physhandi.run import Run

ITERATIONS = 24


def config_of(**changes: Any) -> PipelineConfig:
    config = sheet_config(generations=2, population=4, iterations=2)
    look = {"enabled": True, "splat_count": 300, "iterations": ITERATIONS} | changes
    return config.replace(appearance=config.appearance.replace(**look))


def new_run(folder: Path, recording: Path, config: PipelineConfig) -> Run:
    return Run.create(
        folder,
        name="test",
        kind="reconstruction",
        sequences=[str(recording)],
        config={"profile": config.to_dict()},
    )


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_filmed_sheet(tmp_path_factory.mktemp("sequences") / "sheet").folder


@pytest.fixture(scope="module")
def told() -> Stopper:
    """Everything that the fit reports."""
    return Stopper()


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory, recording: Path, told: Stopper) -> Run:
    run = new_run(tmp_path_factory.mktemp("runs") / "fit", recording, config_of())
    pipeline.run_job(run, told)
    return Run.open(run.folder)


def look_of(run: Run) -> Splats:
    return Splats.from_tensors(run.tensors(SPLATS_FILE))


def test_the_stage_comes_before_the_last_and_takes_its_own_time(fitted: Run, told: Stopper) -> None:
    fitted.verify()
    stages = {stage["name"]: stage for stage in fitted.stages()}
    assert list(stages) == [*STAGES[:-1], APPEARANCE, EVALUATION]
    assert list(stages[APPEARANCE]["files"]) == [SPLATS_FILE]
    assert stages[APPEARANCE]["seconds"] > 0
    losses = fitted.json("losses.json")[APPEARANCE]
    assert losses["after"] < 0.7 * losses["before"]
    assert len(losses["curve"]) == ITERATIONS
    reported = [iteration for stage, iteration, _, _ in told.reports if stage == APPEARANCE]
    assert reported == list(range(1, ITERATIONS + 1))
    drawn = [message for stage, _, _, message in told.reports if stage == EVALUATION]
    assert drawn.count("compares pictures") == FRAMES


def test_splats_lie_on_the_object_and_are_bound_to_its_nodes(fitted: Run) -> None:
    look = look_of(fitted)
    np.testing.assert_array_equal(look.rest_node, NODE.astype(np.float32))
    assert 50 < len(look.center) <= 300
    assert np.abs(look.center[:, 2] - NODE[0, 2]).max() < 0.03
    low, high = look.center[:, :2].min(axis=0), look.center[:, :2].max(axis=0)
    np.testing.assert_allclose(low, 0.0, atol=0.02)
    np.testing.assert_allclose(high, 0.2, atol=0.02)


def test_metrics_have_both_definitions_in_every_split_and_those_of_the_held_out_view(
    fitted: Run,
) -> None:
    scores = fitted.metrics["sheet"]
    look = scores["photometric"]
    assert look["frame"] == 0
    assert look["proper"]["iou"] > 0.85
    assert look["held_out"]["psnr"] > 16.0
    for split in ("reconstruction", "future"):
        found = scores[split]["rollout"]["photometric"]
        assert list(found) == ["phystwin", "proper", "held_out"]
        for of_definition in found.values():
            assert list(of_definition) == ["psnr", "ssim", "iou"]
        assert 0.2 < found["phystwin"]["iou"] < 1.0
        assert found["proper"]["psnr"] < look["proper"]["psnr"]
        assert "photometric" not in scores[split]["static"]
    measured = pipeline.evaluate(fitted, [_sequence(fitted)])
    assert measured["sheet"] == scores
    without = pipeline.evaluate(fitted, [_sequence(fitted)], draws=False)["sheet"]
    assert "photometric" not in without
    assert without["future"]["static"] == scores["future"]["static"]


def test_lpips_is_measured_with_the_weights_of_the_user(
    fitted: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PHYSHANDI_LPIPS", str(write_lpips(tmp_path)))
    measured = pipeline.evaluate(fitted, [_sequence(fitted)])["sheet"]
    for split in ("reconstruction", "future"):
        found = measured[split]["rollout"]["photometric"]
        before = fitted.metrics["sheet"][split]["rollout"]["photometric"]
        for definition, scores in found.items():
            assert scores.pop("lpips") > 0.001
            assert scores == before[definition]
    assert measured["photometric"]["held_out"]["lpips"] > 0.001


def test_weights_that_cannot_be_used_stop_a_fit_before_it_begins(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PHYSHANDI_LPIPS", str(tmp_path / "none"))
    told = Stopper()
    with pytest.raises(UsageError, match=r"PHYSHANDI_LPIPS: .*none must hold one file alexnet\*"):
        pipeline.run_job(new_run(tmp_path / "fit", recording, config_of()), told)
    assert told.reports == []


def _sequence(run: Run) -> pipeline.Sequence:
    return pipeline.Sequence.load(Path(run.sequences[0]))


def test_a_stopped_fit_goes_on_to_the_same_bits(
    fitted: Run, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_always(monkeypatch)
    run = new_run(tmp_path / "stopped", recording, config_of())
    with pytest.raises(CancelledError):
        pipeline.run_job(run, Stopper(ITERATIONS // 2, stage=APPEARANCE))
    assert [stage["name"] for stage in Run.open(run.folder).stages()] == list(STAGES[:-1])
    last = Stopper()
    pipeline.run_job(run, last)
    assert last.reports[0][0] == APPEARANCE
    assert "Resumed after iteration" in last.reports[0][3]
    again = Run.open(run.folder)
    for name, array in fitted.tensors(SPLATS_FILE).items():
        assert again.tensors(SPLATS_FILE)[name].tobytes() == array.tobytes()
    assert again.metrics == fitted.metrics


def test_a_simulation_has_the_splats_of_its_fit_and_its_own_scores(
    fitted: Run, recording: Path, tmp_path: Path
) -> None:
    run = Run.create(
        tmp_path / "again",
        name="again",
        kind="simulation",
        sequences=[str(recording)],
        config={"source": str(fitted.folder), "parameters": {"drag": 9.0}},
    )
    pipeline.run_job(run)
    again = Run.open(run.folder)
    np.testing.assert_array_equal(look_of(again).center, look_of(fitted).center)
    own, other = (
        run.metrics["sheet"]["future"]["rollout"]["photometric"]["proper"]["iou"]
        for run in (fitted, again)
    )
    assert own != other


def test_without_color_nothing_is_fitted_and_the_run_says_so(
    recording: Path, tmp_path: Path
) -> None:
    folder = shutil.copytree(recording, tmp_path / "sheet")
    for view in (folder / "views").iterdir():
        shutil.rmtree(view / "color")
    run = new_run(tmp_path / "dark", folder, config_of())
    pipeline.run_job(run)
    dark = Run.open(run.folder)
    assert not dark.has(SPLATS_FILE)
    told = dark.json("losses.json")[APPEARANCE]["note"]
    assert told == "Left out: 'sheet' lacks color and mask in one view."
    assert "photometric" not in dark.metrics["sheet"]


def test_nobody_who_did_not_ask_has_the_stage(recording: Path, tmp_path: Path) -> None:
    run = new_run(tmp_path / "plain", recording, config_of(enabled=False))
    told = Stopper()
    pipeline.run_job(run, told)
    plain = Run.open(run.folder)
    assert [stage["name"] for stage in plain.stages()] == list(STAGES)
    assert not plain.has(SPLATS_FILE)
    assert "photometric" not in plain.metrics["sheet"]
    assert APPEARANCE not in {stage for stage, *_ in told.reports}
