"""Stage 3 on the bundled sequence: how much of a known hand error the object's motion gives back.

Nodes, observations and grip are the bundled run's; global parameters are those of one quick fit,
written down here so that a new bundled run moves no figure. With the true hand the tracks of this
object err by 5 mm. The hand is the true one plus an error. No keypoints are used, so all that is
recovered was seen in the object. All 42 reconstruction frames, 30 iterations.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bundled_sequence import FRAME_RATE
from refinement_world import mpjpe, mpvpe, with_error

from physhandi import pipeline
from physhandi.data.layout import SPLATS_FILE
from physhandi.errors import CancelledError
from physhandi.fitting import artefacts, hand_refinement
from physhandi.fitting.config import PipelineConfig
from physhandi.fitting.hand_refinement import (
    RefinedHands,
    RefinementConfig,
    RefinementProblem,
    refine_hands,
)
from physhandi.fitting.object_problem import build_problem
from physhandi.hand.loading import load_hand_model
from physhandi.hand.motion import HandMotion
from physhandi.progress import NullProgress, Progress
from physhandi.run import Run
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.topology import build_model
from physhandi.synthetic.bodies.sheets import fold_motion

SEQUENCES = Path(__file__).parents[3] / "sequences"
NAME = "towel_fold"
ERROR = 0.010
FITTED = slice(0, 42)
FREE = RefinementConfig(
    iterations=30, decay=0.99, prior_weight=0.05, smoothness_weight=0.03, keypoint_weight=0.0
)
TOWEL = SimulationParameters(
    connection_radius=0.0316,
    max_neighbors=20,
    virtual_connection_radius=0.0081,
    virtual_max_neighbors=6,
    stiffness=2230.0,
    virtual_stiffness=1430.0,
    damping=27.4,
    drag=6.0,
    substeps_per_frame=70,
)
KEPT = {"keypoint.npy", "meta.yaml", "model.safetensors", "object_node.npy"}
"""What earlier stages leave of a sequence, beside hands, control nodes and observations."""


@pytest.fixture(scope="module")
def truth() -> HandMotion:
    """The hand that moved the towel, drawn from the bundled sequence's random numbers."""
    return fold_motion(load_hand_model("right"), 60, FRAME_RATE, np.random.default_rng([2, 1]))


@pytest.fixture(scope="module")
def disturbed(truth: HandMotion) -> dict[float, HandMotion]:
    """The hand with an error of `ERROR`, by the error's width in time [frames]."""
    return {w: with_error(truth, ERROR, 0, width=w, frames=FITTED) for w in (6.0, 0.0)}


@pytest.fixture(scope="module")
def run() -> Run:
    return Run.open(SEQUENCES / "runs" / "towel_fold_quick")


def unrefined(run: Run) -> HandMotion:
    """The hand as stage 1 of the bundled run left it."""
    return HandMotion.from_tensors(run.tensors(f"sequences/{NAME}/hand_right_initial.safetensors"))


def refine(run: Run, motion: HandMotion, config: RefinementConfig = FREE) -> RefinedHands:
    folder = run.out / "sequences" / NAME
    object_ = build_problem(
        name=NAME,
        observation=artefacts.load_observation(run.out, NAME),
        object_node=np.load(folder / "object_node.npy"),
        rest_node=np.load(run.out / "object/rest_node.npy"),
        control=np.load(folder / "control.npy"),
        frame_count=FITTED.stop,
        frame_rate=FRAME_RATE,
        ground_height=0.0,
        gravity=9.81,
        cloud_points=150,
    )
    problem = RefinementProblem(
        object_=object_,
        model=build_model(object_.object_node, artefacts.load_attachment(run.out, NAME), TOWEL),
        parameters=TOWEL,
        motions=(motion,),
        hand_models=(load_hand_model("right"),),
    )
    return refine_hands(problem, config, NullProgress())


def test_the_true_hand_is_the_one_that_was_filmed(run: Run, truth: HandMotion) -> None:
    fitted = unrefined(run)
    assert mpjpe(fitted, truth) < 0.002


@pytest.mark.parametrize("width", [6.0, 0.0])
def test_the_injected_error_has_the_size_that_it_says(
    truth: HandMotion, disturbed: dict[float, HandMotion], width: float
) -> None:
    wrong = disturbed[width]
    assert mpjpe(wrong, truth, FITTED) == pytest.approx(ERROR, rel=1e-4)
    change = np.diff(wrong.wrist_translation - truth.wrist_translation, axis=0)
    jump = np.linalg.norm(change, axis=1).mean()
    assert jump < 0.002 if width else jump > 0.006


@pytest.mark.slow
@pytest.mark.no_cover  # test_hand_refinement.py goes through the same lines.
@pytest.mark.parametrize("width", [6.0, 0.0], ids=["smooth in time", "frame by frame"])
def test_a_third_of_a_random_hand_error_is_recovered(
    run: Run, truth: HandMotion, disturbed: dict[float, HandMotion], width: float
) -> None:
    wrong = disturbed[width]
    result = refine(run, wrong)
    right = result.motions[0]
    assert mpjpe(right, truth, FITTED) < 0.7 * mpjpe(wrong, truth, FITTED)
    assert mpvpe(right, truth, FITTED) < 0.75 * mpvpe(wrong, truth, FITTED)
    assert result.loss_after < 0.3 * result.loss_before


@pytest.mark.slow
@pytest.mark.no_cover  # test_hand_refinement.py goes through the same lines.
def test_without_gradients_through_the_simulator_nothing_is_recovered(
    run: Run,
    truth: HandMotion,
    disturbed: dict[float, HandMotion],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rollout = hand_refinement.differentiable.rollout

    def blind(*args: Any, **more: Any) -> Any:
        node, velocity = rollout(*args, **more)
        return node.detach() + 0.0 * args[2].sum(), velocity.detach()

    monkeypatch.setattr(hand_refinement.differentiable, "rollout", blind)
    wrong = disturbed[6.0]
    # With gradients, 10 iterations recover three tenths already.
    right = refine(run, wrong, FREE.replace(iterations=10)).motions[0]
    assert mpjpe(right, truth, FITTED) > 0.95 * mpjpe(wrong, truth, FITTED)


class Impatient(Progress):
    """Asks to stop after so many reports of the refinement."""

    def __init__(self, patience: int) -> None:
        self.stages: list[str] = []
        self.patience = patience

    def report(self, stage: str, *rest: Any, **more: Any) -> None:
        self.stages.append(stage)

    def check_cancelled(self) -> None:
        if self.stages.count(pipeline.REFINEMENT) == self.patience:
            raise CancelledError


def control_of(motion: HandMotion) -> np.ndarray:
    return motion.vertices(load_hand_model("right")).astype(np.float32)


def fitted_until_refinement(run: Run, folder: Path) -> Run:
    """A run like the bundled one was before stage 3, with the hands of stage 1."""
    config = PipelineConfig.from_dict(run.config["profile"])
    config = config.replace(
        refinement=config.refinement.replace(iterations=4),
        appearance=config.appearance.replace(enabled=False),
        object_=config.object_.replace(follows_late_tracks=False),
    ).to_dict()
    later = Run.create(
        folder,
        name="later",
        kind="reconstruction",
        sequences=[str(SEQUENCES / NAME)],
        config={"profile": config},
    )
    folder = f"sequences/{NAME}"
    hand = unrefined(run)
    attempt = later.begin_attempt()
    for path in run.out.rglob("*.*"):
        rel = path.relative_to(run.out).as_posix()
        if rel == SPLATS_FILE:
            continue  # Its pictures would be drawn and compared.
        if rel.startswith("object/") or f"{folder}/observation" in rel or path.name in KEPT:
            (attempt.out / rel).parent.mkdir(parents=True, exist_ok=True)
            (attempt.out / rel).write_bytes(path.read_bytes())
    artefacts.save_motions(attempt, NAME, (hand,))
    attempt.save_array(f"{folder}/control.npy", hand.vertices(load_hand_model("right")))
    for stage in pipeline.STAGES[: pipeline.STAGES.index(pipeline.REFINEMENT)]:
        attempt.finish_stage(stage, {})
    attempt.cancelled()
    return later


@pytest.mark.slow
def test_the_pipeline_refines_stores_resumes_and_simulates_again(
    run: Run, truth: HandMotion, tmp_path: Path
) -> None:
    later = fitted_until_refinement(run, tmp_path / "later")
    with pytest.raises(CancelledError):
        pipeline.run_job(later, Impatient(2))
    finished = Impatient(1000)
    pipeline.run_job(later, finished)
    assert set(finished.stages) == {pipeline.REFINEMENT, pipeline.EVALUATION, "rollout"}
    later = Run.open(later.folder)
    later.verify()
    losses = later.json("losses.json")
    assert list(losses) == list(pipeline.STAGES)
    assert losses[pipeline.REFINEMENT]["after"] < losses[pipeline.REFINEMENT]["before"]

    folder = f"sequences/{NAME}"
    first, now = later.tensors(f"{folder}/hand_right_initial.safetensors"), later.out
    before = HandMotion.from_tensors(run.tensors(f"{folder}/hand_right_initial.safetensors"))
    (after,) = artefacts.load_motions(now, NAME)
    np.testing.assert_array_equal(first["wrist_translation"], before.wrist_translation)
    np.testing.assert_array_equal(first["articulation"], before.articulation)
    control = later.array(f"{folder}/control.npy")
    np.testing.assert_array_equal(control, control_of(after))
    np.testing.assert_array_equal(control, later.array(f"{folder}/hand_right_vertex.npy"))
    old = control_of(before)
    np.testing.assert_array_equal(later.array(f"{folder}/attachment.npy"), old[0])
    assert np.abs(control - old)[FITTED].max() > 2e-4
    # Hands of three views are better than an object that is wrong by 7 mm: they must stay so.
    assert mpjpe(after, truth) < mpjpe(before, truth) + 2e-4

    again = Run.create(
        tmp_path / "again",
        name="again",
        kind="simulation",
        sequences=[str(SEQUENCES / NAME)],
        config={"source": str(later.folder), "parameters": {}},
    )
    pipeline.run_job(again)
    repeated = Run.open(again.folder).array(f"{folder}/rollout.npy")
    np.testing.assert_allclose(repeated, later.array(f"{folder}/rollout.npy"), atol=1e-4)
    held = [artefacts.load_model(r.out, NAME) for r in (Run.open(again.folder), run)]
    np.testing.assert_allclose(held[0].rest_length, held[1].rest_length, rtol=1e-6)
