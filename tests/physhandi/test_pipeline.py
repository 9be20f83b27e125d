"""The pipeline end to end on a small recording: fit, stop, go on, simulate again."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import KDTree
from support.inputs.sheet_sequence import FITTED, FRAMES, NODE, sheet_config, write_sheet
from support.physics.stopped_fits import Stopper, write_always

from app.jobs.views import loss_curves
from physhandi import pipeline
from physhandi.data.run_folder import artefacts, read_events
from physhandi.data.sequence import Sequence
from physhandi.errors import CancelledError, MissingInputError, RunError, UsageError
from physhandi.fitting.artefacts import load_model, load_parameters
from physhandi.fitting.config import PipelineConfig
from physhandi.fitting.contact_detection import find_contacts
from physhandi.progress import Progress
from physhandi.run import Run
from physhandi.simulation.contact_intervals import NEVER
from physhandi.simulation.simulator import Simulator


def small_config() -> PipelineConfig:
    return sheet_config(generations=8, population=8, iterations=8)


def brief_config() -> PipelineConfig:
    """As long as it takes to be stopped in the middle."""
    return sheet_config(generations=6, population=4, iterations=8)


def new_run(folder: Path, sequences: list[Path], config: dict[str, Any] | None = None) -> Run:
    return Run.create(
        folder,
        name="test",
        kind="reconstruction",
        sequences=[str(path) for path in sequences],
        config={"profile": config or small_config().to_dict()},
    )


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("sequences")
    write_sheet(root / "low", lift=0.12)
    write_sheet(root / "high", lift=0.2)
    write_sheet(root / "other", lift=0.16)
    return root


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory, recordings: Path) -> Run:
    run = new_run(
        tmp_path_factory.mktemp("runs") / "fit", [recordings / "low", recordings / "high"]
    )
    pipeline.run_job(run)
    return Run.open(run.folder)


def test_every_stage_tells_its_loss_and_lowers_it(fitted: Run) -> None:
    fitted.verify()
    assert fitted.state == "succeeded"
    losses = fitted.json("losses.json")
    assert list(losses) == list(pipeline.STAGES)
    for stage in (pipeline.SEARCH, pipeline.SPRINGS):
        assert 0 < losses[stage]["after"] < losses[stage]["before"]
        assert len(losses[stage]["curve"]) > 2


def test_the_kind_of_object_is_stored_with_the_run_and_told(
    tmp_path: Path, fitted: Run, recordings: Path
) -> None:
    shape = fitted.yaml("object/shape.yaml")
    assert (shape["shape"], shape["is_given"], shape["node_count"]) == ("sheet", False, len(NODE))
    assert shape["node_spacing"] == pytest.approx(0.05)
    assert (shape["removed"], shape["warnings"]) == ([], [])
    told = fitted.json("losses.json")[pipeline.OBSERVATION]["note"]
    assert told.startswith("sheet (")
    assert told.endswith("25 nodes")
    said = [event["message"] for event in read_events(fitted.folder)[0]]
    assert told in said
    again = simulate(tmp_path / "copy", fitted, recordings / "low")
    assert again.yaml("object/shape.yaml") == shape


def test_point_controllers_are_not_refined(fitted: Run) -> None:
    assert fitted.json("losses.json")[pipeline.REFINEMENT] == {"curve": []}
    for folder in fitted.sequences:
        given = np.load(Path(folder) / "control.npy")
        stored = fitted.array(f"sequences/{Path(folder).name}/control.npy")
        np.testing.assert_array_equal(stored, given.astype(np.float32))
        assert not fitted.has(f"sequences/{Path(folder).name}/attachment.npy")


def test_the_fit_beats_standing_still(fitted: Run) -> None:
    metrics = fitted.json("metrics.json")
    assert set(metrics) == {"low", "high"}
    for name in metrics:
        rollout = fitted.array(f"sequences/{name}/rollout.npy")
        marker = np.load(Path(fitted.sequences[0]).parent / name / "marker.npy")
        assert rollout.shape == (FRAMES, len(NODE), 3)
        future = slice(FITTED, FRAMES)
        error = np.linalg.norm(rollout - marker, axis=2)[future].mean()
        static = np.linalg.norm(marker[:1] - marker, axis=2)[future].mean()
        assert error < 0.4 * static
        assert static > 0.03


def test_prediction_starts_where_the_last_fitted_frame_was_seen(
    fitted: Run, recordings: Path, tmp_path: Path
) -> None:
    last = FITTED - 1
    for name in ("low", "high"):
        object_ = fitted.object_in(name)
        restart = object_.fitted.restart
        marker = np.load(recordings / name / "marker.npy")
        assert restart is not None
        assert (restart.frame, restart.strain_frames) == (last, 1)
        # Every node has a marker, which outweighs those around it by far.
        np.testing.assert_allclose(restart.position, marker[last], atol=2e-5)
        rollout = fitted.array(f"sequences/{name}/rollout.npy")
        assert np.abs(rollout[last] - marker[last]).max() > 1e-4
        model, parameters = object_.model, object_.parameters
        motion = Simulator(model, parameters).rollout(object_.fitted.control, restart)
        np.testing.assert_array_equal(rollout, motion.position)
        plain = Simulator(model, parameters).rollout(object_.fitted.control).position
        gap, plain_gap = (
            np.linalg.norm(nodes - marker, axis=2)[FITTED:].mean() for nodes in (rollout, plain)
        )
        assert gap < 0.95 * plain_gap
        # One changed parameter, simulated as a run of its own, keeps the observed state.
        again = simulate(
            tmp_path / name, fitted, recordings / name, substeps_per_frame=70
        ).object_in(name)
        assert again.fitted.restart is not None
        np.testing.assert_array_equal(again.fitted.restart.position, restart.position)
        moved = object_.simulate(substeps_per_frame=70)
        np.testing.assert_array_equal(again.fitted.position, moved.position)


def test_both_sequences_share_one_object(fitted: Run) -> None:
    low, high = (load_model(fitted.out, name) for name in ("low", "high"))
    count = low.object_spring_count
    assert count == high.object_spring_count > 50
    np.testing.assert_array_equal(low.stiffness[:count], high.stiffness[:count])
    assert np.ptp(np.log(low.stiffness[:count])) > 0.05


def simulate(folder: Path, source: Run, sequence: Path, **changes: float) -> Run:
    run = Run.create(
        folder,
        name="again",
        kind="simulation",
        sequences=[str(sequence)],
        config={"source": str(source.folder), "parameters": changes},
    )
    pipeline.run_job(run)
    return Run.open(run.folder)


def test_contacts_over_time_are_stored_and_kept_with_other_radii(
    tmp_path: Path, recordings: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kinds: list[str] = []

    def find(*observed: Any, **options: Any) -> Any:
        kinds.append(options["kind"])
        return find_contacts(*observed, **options)

    monkeypatch.setattr(pipeline, "find_contacts", find)
    late = tmp_path / "late"
    shutil.copytree(recordings / "low", late)
    control = np.load(late / "control.npy")
    control[:1] += np.array([0.0, 0.0, 0.2], np.float32)
    np.save(late / "control.npy", control)
    config = sheet_config(generations=1, population=4, iterations=1)
    config = config.replace(object_=config.object_.replace(contact_over_time=True))
    run = new_run(tmp_path / "fit", [late], config.to_dict())
    pipeline.run_job(run)
    assert set(kinds) == {"sheet"}
    run = Run.open(run.folder)
    object_ = run.object_in("low")
    contacts, model = object_.contacts, object_.model
    assert contacts is not None
    assert object_.fitted.restart is not None
    assert object_.fitted.restart.shifts_nodes
    assert object_.fitted.restart.averages_in_air
    assert object_.fitted.restart.grip_strength > 0.0
    assert model.virtual_spring_count > 0
    assert set(model.attached[:, 0].tolist()) == {1}
    assert set(model.attached[:, 1].tolist()) == {NEVER}
    # Nothing holds the sheet until then, and afterwards it goes where the hand goes.
    rollout = run.array("sequences/low/rollout.npy")
    assert np.abs(object_.fitted.forces(1)).max() == 0.0
    assert np.abs(object_.fitted.forces(2)).max() > 0.0
    wider = object_.parameters.virtual_connection_radius * 1.5
    again = simulate(tmp_path / "wide", run, late, virtual_connection_radius=wider)
    now = again.object_in("low")
    expected = contacts.chosen(wider, object_.parameters.virtual_max_neighbors)
    assert now.model.virtual_spring_count == int(expected.sum())
    assert now.contacts is not None
    np.testing.assert_array_equal(now.contacts.interval, contacts.interval)
    same = simulate(tmp_path / "same", run, late)
    np.testing.assert_array_equal(same.array("sequences/low/rollout.npy"), rollout)


def test_simulating_unchanged_repeats_the_motion(
    tmp_path: Path, fitted: Run, recordings: Path
) -> None:
    again = simulate(tmp_path / "same", fitted, recordings / "low")
    np.testing.assert_array_equal(
        again.array("sequences/low/rollout.npy"), fitted.array("sequences/low/rollout.npy")
    )


def test_another_radius_gives_the_springs_that_scipy_counts(
    tmp_path: Path, fitted: Run, recordings: Path
) -> None:
    again = simulate(
        tmp_path / "wide", fitted, recordings / "low", connection_radius=0.055, max_neighbors=24
    )
    model = load_model(again.out, "low")
    expected = len(KDTree(NODE.astype(np.float32)).query_pairs(0.055))
    assert model.object_spring_count == expected == 40
    difference = again.array("sequences/low/rollout.npy") - fitted.array(
        "sequences/low/rollout.npy"
    )
    assert np.abs(difference).max() > 1e-4
    assert load_parameters(again.out).connection_radius == 0.055


def test_the_object_moves_in_a_sequence_it_was_not_fitted_on(
    tmp_path: Path, fitted: Run, recordings: Path
) -> None:
    again = simulate(tmp_path / "unseen", fitted, recordings / "other")
    rollout = again.array("sequences/other/rollout.npy")
    marker = np.load(recordings / "other" / "marker.npy")
    error = np.linalg.norm(rollout - marker, axis=2)[1:].mean()
    static = np.linalg.norm(marker[:1] - marker, axis=2)[1:].mean()
    assert error < 0.4 * static
    assert "other" in again.json("metrics.json")


def test_unknown_parameters_are_named(tmp_path: Path, fitted: Run, recordings: Path) -> None:
    with pytest.raises(UsageError, match="stiffnes"):
        simulate(tmp_path / "typo", fitted, recordings / "low", stiffnes=2.0)
    assert Run.open(tmp_path / "typo").state == "failed"


def test_evaluating_again_gives_the_stored_metrics(fitted: Run) -> None:
    sequences = [Sequence.load(folder) for folder in fitted.sequences]
    assert pipeline.evaluate(fitted, sequences) == fitted.json("metrics.json")


def test_errors_of_every_frame_are_stored_for_charts(
    tmp_path: Path, fitted: Run, recordings: Path
) -> None:
    again = simulate(tmp_path / "charted", fitted, recordings / "high")
    for run in (fitted, again):
        errors = run.json("sequences/high/frame_errors.json")
        assert errors["frames"] == list(range(FRAMES))
        marker = np.load(recordings / "high" / "marker.npy")
        distance = np.linalg.norm(run.array("sequences/high/rollout.npy") - marker, axis=2)
        assert errors["rollout"]["marker_error"] == pytest.approx(distance.mean(axis=1), abs=2e-7)
        assert errors["static"]["track_error"][-1] > 2 * errors["rollout"]["track_error"][-1] > 0


def test_a_sequence_with_nothing_to_fit_says_what_is_missing(
    tmp_path: Path, recordings: Path
) -> None:
    bare = write_sheet(tmp_path / "bare")
    for file in ("marker.npy", "marker_node.npy"):
        (bare.folder / file).unlink()
    run = new_run(tmp_path / "nothing", [bare.folder])
    with pytest.raises(MissingInputError, match="'bare' lacks depth, mask"):
        pipeline.run_job(run)


def test_points_that_move_an_object_cannot_push_it(tmp_path: Path, recordings: Path) -> None:
    pushing = small_config().replace(simulation=small_config().simulation.replace(hand_pushes=True))
    run = new_run(tmp_path / "pushing", [recordings / "low"], pushing.to_dict())
    with pytest.raises(MissingInputError, match="'low' has no hand whose surface could push"):
        pipeline.run_job(run)
    assert not list((run.folder / "attempts").glob("*/out/sequences"))


def test_a_run_without_an_object_cannot_be_simulated(tmp_path: Path, recordings: Path) -> None:
    empty = new_run(tmp_path / "empty", [recordings / "low"])
    empty.begin_attempt().publish()
    with pytest.raises(RunError, match="no fitted object"):
        simulate(tmp_path / "again", empty, recordings / "low")


def test_a_stopped_run_ends_with_the_bits_of_an_undisturbed_one(
    tmp_path: Path, recordings: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_always(monkeypatch)
    config = brief_config().to_dict()
    runs = [new_run(tmp_path / name, [recordings / "low"], config) for name in ("one", "two")]
    pipeline.run_job(runs[0])
    for stage, at in ((pipeline.SEARCH, 3), (pipeline.SEARCH, 2)):
        with pytest.raises(CancelledError):
            pipeline.run_job(runs[1], Stopper(at, stage=stage))

    class Asks(Progress):
        def report(self, stage: str, iteration: int, *rest: Any, **more: Any) -> None:
            if (stage, iteration) == (pipeline.SPRINGS, 5):
                runs[1].request_cancel()

    with pytest.raises(CancelledError):
        pipeline.run_job(runs[1], Asks())
    assert Run.open(runs[1].folder).state == "cancelled"
    runs[1].clear_cancel()
    last = Stopper()
    pipeline.run_job(runs[1], last)
    # Stages that had ended are not repeated.
    assert pipeline.SEARCH not in {report[0] for report in last.reports}
    fitted = [report for report in last.reports if report[0] == pipeline.SPRINGS]
    assert [report[1] for report in fitted] == [5, 6, 7, 8]
    assert fitted[0][3] == "Resumed after iteration 5."
    assert Run.open(runs[1].folder).state == "succeeded"
    for run in runs:
        Run.open(run.folder).verify()
    outs = [run.out for run in runs]
    files = [rel for rel, _ in artefacts(outs[0]) if rel != "environment.json"]
    assert files == [rel for rel, _ in artefacts(outs[1]) if rel != "environment.json"]
    for rel in files:
        assert (outs[0] / rel).read_bytes() == (outs[1] / rel).read_bytes(), rel
    # Curves have no gap, and no checkpoint is left, counted as a result or published.
    whole, stopped = (loss_curves(run)[0] for run in runs)
    assert whole == stopped
    assert list(tmp_path.rglob("ckpt")) == []


def test_a_checkpoint_of_other_settings_is_not_used(
    tmp_path: Path,
    recordings: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    write_always(monkeypatch)
    run = new_run(tmp_path / "fit", [recordings / "low"], brief_config().to_dict())
    with pytest.raises(CancelledError):
        pipeline.run_job(run, Stopper(2, stage=pipeline.SEARCH))
    job = run.folder / "job.yaml"
    job.write_text(job.read_text().replace("seed: 42", "seed: 43"))
    again = Stopper(1, stage=pipeline.SEARCH)
    with pytest.raises(CancelledError):
        pipeline.run_job(Run.open(run.folder), again)
    assert "it was made with other settings." in caplog.text
    assert again.reports[0][1] == 1
