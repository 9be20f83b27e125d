"""PhysTwin's experiment as a run: it moves as PhysTwin's own rollout, opens and simulates again."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.inputs.phystwin_case import FRAMES, Case, edit_pickle, save_pickle, write_case
from support.inputs.phystwin_experiment import (
    OPTIMUM,
    Experiment,
    save_checkpoint,
    write_experiment,
)
from support.inputs.sheet_sequence import write_sheet

from app.viewer.content.content import open_run_content
from physhandi import pipeline
from physhandi.data.importers.phystwin import import_phystwin
from physhandi.data.sequence import Sequence
from physhandi.errors import CancelledError, ImportFailedError, RunError
from physhandi.fitting.artefacts import load_model, load_observation, load_parameters
from physhandi.fitting.phystwin_run import REPORT, compare_rollouts, import_phystwin_run
from physhandi.progress import Progress
from physhandi.run import Run


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Case:
    return write_case(tmp_path_factory.mktemp("cases") / "single_lift_sloth", has_images=False)


@pytest.fixture(scope="module")
def sequence(case: Case, tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    return Sequence.load(import_phystwin(case.folder, tmp_path_factory.mktemp("out") / "sloth"))


@pytest.fixture(scope="module")
def experiment(case: Case, tmp_path_factory: pytest.TempPathFactory) -> Experiment:
    return write_experiment(case, tmp_path_factory.mktemp("experiments") / "sloth")


@pytest.fixture(scope="module")
def run(
    sequence: Sequence, experiment: Experiment, tmp_path_factory: pytest.TempPathFactory
) -> Run:
    return import_phystwin_run(
        sequence,
        experiment.optimum,
        experiment.checkpoint,
        tmp_path_factory.mktemp("runs") / "twin",
        device="cpu",
        inference=experiment.inference,
    )


def test_the_rollout_is_phystwins(run: Run, experiment: Experiment) -> None:
    """The oracle deals the stiffnesses out by plain loops and integrates in float64."""
    rollout = run.array("sequences/sloth/rollout.npy")
    assert rollout.shape == (FRAMES, 48, 3)
    motion = np.linalg.norm(experiment.position - experiment.position[0], axis=-1)
    assert motion[-1].max() > 0.01
    np.testing.assert_allclose(rollout, experiment.position, atol=1e-5)
    compared = run.json(REPORT)["inference"]
    assert compared["max_difference"] < 1e-5
    assert compared["largest_motion"] == pytest.approx(motion.max(), rel=1e-4)
    assert run.json("losses.json")["import"]["max_difference"] == compared["max_difference"]


def test_the_run_says_what_it_is(run: Run, experiment: Experiment) -> None:
    run.verify()
    assert (run.state, run.kind, run.name) == (
        "succeeded",
        "reconstruction",
        "PhysTwin: single_lift_sloth",
    )
    assert run.config["profile"]["profile"] == "phystwin"
    assert run.json("environment.json")["device"] == "cpu"
    report = run.json(REPORT)
    assert report["springs"] == {
        "object": experiment.object_count,
        "virtual": len(experiment.springs) - experiment.object_count,
        "global_stiffness": 9000.0,
        "epoch": 120,
    }
    assert report["truncates_damping"] is True
    assert report["self_collision"] is False
    assert [line.split()[0] for line in report["changed"]] == [
        "collide_elas",
        "collide_fric",
        "dashpot_damping",
        "drag_damping",
        "1",
    ]
    assert report["files"]["checkpoint"]["name"] == "best_120.pth"
    assert len(report["files"]["inference"]["sha256"]) == 64
    parameters = load_parameters(run.out)
    assert (parameters.drag, parameters.damping, parameters.max_neighbors) == (2.0, 83.0, 6)
    assert parameters.frame_rate == 30.0
    assert parameters.dt == pytest.approx(5e-5, rel=1e-9)


def test_it_is_measured_against_the_tracked_points(
    run: Run, case: Case, sequence: Sequence
) -> None:
    reconstruction = run.json("metrics.json")["sloth"]["reconstruction"]
    observation = load_observation(run.out, "sloth")
    assert [len(cloud) for cloud in observation.cloud] == case.is_visible.sum(axis=1).tolist()
    rollout = run.array("sequences/sloth/rollout.npy").astype(float)
    error = np.linalg.norm(np.asarray(sequence.marker) - rollout[:, :26], axis=-1)
    expected = np.nanmean(error[1:3], axis=1).mean()
    assert reconstruction["rollout"]["track_error"] == pytest.approx(expected, rel=1e-4)
    assert expected > 1e-4
    curve = run.json("sequences/sloth/frame_errors.json")["rollout"]["track_error"]
    assert curve[4] == pytest.approx(np.nanmean(error[4]), rel=1e-4)


def test_the_viewer_opens_it(run: Run, sequence: Sequence) -> None:
    class OneRun:
        def run(self, run_id: str) -> Run:
            return run

        def sequence(self, sequence_id: str) -> Sequence:
            return sequence

    content = open_run_content(OneRun(), run.id)
    assert (content.frame_count, content.reconstruction_count) == (FRAMES, 3)
    assert content.fitted is not None
    assert content.fitted.is_complete
    assert content.fitted.model.virtual_spring_count > 3
    assert content.observed is not None


def test_simulating_it_again_repeats_it(run: Run, sequence: Sequence, tmp_path: Path) -> None:
    again = Run.create(
        tmp_path / "again",
        name="again",
        kind="simulation",
        sequences=[str(sequence.folder)],
        config={"source": str(run.folder), "parameters": {}},
    )
    pipeline.run_job(again)
    rollout = "sequences/sloth/rollout.npy"
    np.testing.assert_array_equal(again.array(rollout), run.array(rollout))


def test_without_a_checkpoint_the_search_result_keeps_its_decimals(
    sequence: Sequence, experiment: Experiment, tmp_path: Path
) -> None:
    run = import_phystwin_run(sequence, experiment.optimum, None, tmp_path / "run", device="cpu")
    parameters = load_parameters(run.out)
    assert parameters.damping == pytest.approx(83.97, rel=1e-6)
    assert parameters.drag == pytest.approx(2.99, rel=1e-6)
    assert parameters.restitution == pytest.approx(0.4)
    model = load_model(run.out, "sloth")
    assert set(model.stiffness) == {np.float32(9000.0)}
    report = run.json(REPORT)
    assert (report["changed"], report["inference"]) == ([], None)
    again = import_phystwin_run(
        sequence,
        experiment.optimum,
        None,
        tmp_path / "truncated",
        device="cpu",
        truncates_damping=True,
    )
    assert (load_parameters(again.out).damping, load_parameters(again.out).drag) == (83.0, 2.0)
    rollouts = [r.array("sequences/sloth/rollout.npy") for r in (run, again)]
    assert np.abs(rollouts[0] - rollouts[1]).max() > 1e-4


def test_cloth_collides_with_itself(tmp_path: Path, experiment: Experiment) -> None:
    case = write_case(tmp_path / "single_lift_cloth_1", has_images=False)
    sequence = Sequence.load(import_phystwin(case.folder, tmp_path / "twin"))
    run = import_phystwin_run(
        sequence, experiment.optimum, experiment.checkpoint, tmp_path / "run", device="cpu"
    )
    parameters = load_parameters(run.out)
    assert parameters.self_collision
    assert parameters.collision_distance == pytest.approx(0.011)
    assert (parameters.self_restitution, parameters.self_friction) == pytest.approx((0.7, 0.3))
    assert run.json(REPORT)["self_collision"] is True
    position = run.array("sequences/twin/rollout.npy")
    assert np.abs(position - experiment.position).max() > 1e-4


def test_rollouts_are_compared_point_by_point() -> None:
    expected = np.zeros((3, 4, 3))
    expected[2, 1] = [0, 0, 0.5]
    rollout = expected.astype(np.float32)
    rollout[1, 3] = [0.03, 0.04, 0]
    assert compare_rollouts(rollout, expected) == pytest.approx(
        {
            "max_difference": 0.05,
            "mean_difference": 0.05 / 12,
            "frame": 1,
            "node": 3,
            "largest_motion": 0.5,
        }
    )


def refused(
    sequence: Sequence, experiment: Experiment, folder: Path, message: str, **options: Any
) -> None:
    with pytest.raises(ImportFailedError, match=message):
        import_phystwin_run(
            sequence,
            options.get("optimum", experiment.optimum),
            options.get("checkpoint", experiment.checkpoint),
            folder / "run",
            device="cpu",
            inference=options.get("inference"),
        )
    assert not (folder / "run").exists()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"drag_damping": None}, r"field 'drag_damping' \(1\) is missing"),
        ({"dashpot_damping": -1.0}, "dashpot_damping is -1.0; expected a number from 0 on"),
        ({"collide_elas": np.float32(np.nan)}, "collide_elas is nan; expected a finite number"),
        ({"global_spring_Y": "stiff"}, "global_spring_Y holds <U5"),
        ({"object_max_neighbours": 0}, "object_max_neighbours is 0.0; expected a number from 1 on"),
        ({"object_radius": np.zeros(2)}, r"object_radius has shape \(2,\)"),
    ],
)
def test_wrong_search_results_are_named(
    sequence: Sequence, experiment: Experiment, tmp_path: Path, fields: dict[str, Any], message: str
) -> None:
    optimum = tmp_path / "optimal_params.pkl"
    save_pickle(optimum, OPTIMUM)
    edit_pickle(optimum, **fields)
    refused(sequence, experiment, tmp_path, rf"optimal_params\.pkl: {message}", optimum=optimum)


def test_another_radius_than_the_checkpoints_is_refused(
    sequence: Sequence, experiment: Experiment, tmp_path: Path
) -> None:
    optimum = tmp_path / "optimal_params.pkl"
    save_pickle(optimum, OPTIMUM | {"object_radius": np.float32(0.016)})
    stored = f"{len(experiment.springs)} springs, {experiment.object_count} of them"
    refused(
        sequence, experiment, tmp_path, rf"best_120\.pth: has {stored}.* give ", optimum=optimum
    )


def test_wrong_checkpoints_and_rollouts_are_named(
    sequence: Sequence, experiment: Experiment, tmp_path: Path
) -> None:
    checkpoint, inference = tmp_path / "best_120.pth", tmp_path / "inference.pkl"
    own = replace(experiment, checkpoint=checkpoint, inference=inference)
    negative = own.stiffness.copy()
    negative[4] = -1
    save_checkpoint(own, negative)
    refused(sequence, own, tmp_path, r"best_120\.pth: spring_Y: spring 4 is -1")
    save_checkpoint(own, own.stiffness.reshape(1, -1))
    refused(sequence, own, tmp_path, r"best_120\.pth: spring_Y has shape")
    save_checkpoint(own, own.stiffness)
    position = own.position.copy()
    save_pickle(own.inference, position[1:])
    message = r"inference\.pkl: content has shape \(4, 48, 3\); expected \(5, 48, 3\)"
    refused(sequence, own, tmp_path, message, inference=own.inference)
    position[3, 2, 1] = np.nan
    save_pickle(own.inference, position)
    message = r"inference\.pkl: content: frame 3, node 2 is .*nan"
    refused(sequence, own, tmp_path, message, inference=own.inference)


def test_other_sequences_are_refused(experiment: Experiment, case: Case, tmp_path: Path) -> None:
    sheet = write_sheet(tmp_path / "sheet")
    refused(sheet, experiment, tmp_path, "'sheet' is not an imported PhysTwin case")
    folder = import_phystwin(case.folder, tmp_path / "bare")
    (folder / "control.npy").unlink()
    refused(Sequence.load(folder), experiment, tmp_path, "has no object nodes or controls")


def test_stopping_it_leaves_nothing(
    sequence: Sequence, experiment: Experiment, tmp_path: Path
) -> None:
    class Stopper(Progress):
        frames = 0

        def report(self, stage: str, iteration: int, *rest: Any, **more: Any) -> None:
            self.frames += stage == "rollout"

        def check_cancelled(self) -> None:
            if self.frames == 2:
                raise CancelledError("stopped")

    arguments = (sequence, experiment.optimum, experiment.checkpoint, tmp_path / "run")
    with pytest.raises(CancelledError):
        import_phystwin_run(*arguments, device="cpu", progress=Stopper())
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "precious.txt").write_text("data")
    with pytest.raises(RunError, match="exists already"):
        import_phystwin_run(*arguments, device="cpu")
    assert (tmp_path / "run" / "precious.txt").read_text() == "data"
