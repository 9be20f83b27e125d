"""Stage 3 on the bundled sequence: how much of a known hand error the object's motion gives back.

Nodes, observations and grip are the bundled run's; global parameters are those of one quick fit,
written down here so that a new bundled run moves no figure. With the true hand the tracks of this
object err by 5 mm. The hand is the true one plus an error. No keypoints are used, so all that is
recovered was seen in the object. All 42 reconstruction frames, 18 iterations.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.inputs.bundled_sequence import FRAME_RATE
from support.physics.refinement_world import mpjpe, mpvpe, with_error

from physhandi.fitting import artefacts, hand_refinement
from physhandi.fitting.hand_refinement import (
    RefinedHands,
    RefinementConfig,
    RefinementProblem,
    refine_hands,
)
from physhandi.fitting.object_problem import build_problem
from physhandi.hand.loading import load_hand_model
from physhandi.hand.motion import HandMotion
from physhandi.progress import NullProgress
from physhandi.run import Run
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.topology import build_model
from physhandi.synthetic.bodies.sheets import fold_motion

SEQUENCES = Path(__file__).parents[3] / "sequences"
NAME = "towel_fold"
ERROR = 0.010
FITTED = slice(0, 42)
FREE = RefinementConfig(
    iterations=18, decay=0.99, prior_weight=0.05, smoothness_weight=0.03, keypoint_weight=0.0
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


@pytest.fixture(scope="module")
def truth() -> HandMotion:
    """The hand that moved the towel, drawn from the bundled sequence's random numbers."""
    return fold_motion(load_hand_model("right"), 60, FRAME_RATE, np.random.default_rng([2, 1]))


@pytest.fixture(scope="module")
def wrong(truth: HandMotion) -> HandMotion:
    """The hand with an error of `ERROR` that is smooth in time."""
    return with_error(truth, ERROR, 0, width=6.0, frames=FITTED)


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
        hand_face=np.zeros((0, 3), np.int32),
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


def test_the_injected_error_has_the_size_that_it_says(truth: HandMotion, wrong: HandMotion) -> None:
    assert mpjpe(wrong, truth, FITTED) == pytest.approx(ERROR, rel=1e-4)
    change = np.diff(wrong.wrist_translation - truth.wrist_translation, axis=0)
    assert np.linalg.norm(change, axis=1).mean() < 0.002


@pytest.mark.slow
@pytest.mark.no_cover  # test_hand_refinement.py goes through the same lines.
def test_a_third_of_a_random_hand_error_is_recovered(
    run: Run, truth: HandMotion, wrong: HandMotion
) -> None:
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
    wrong: HandMotion,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rollout = hand_refinement.differentiable.rollout

    def blind(*args: Any, **more: Any) -> Any:
        node, velocity = rollout(*args, **more)
        return node.detach() + 0.0 * args[2].sum(), velocity.detach()

    monkeypatch.setattr(hand_refinement.differentiable, "rollout", blind)
    # With gradients, 5 iterations recover three tenths already.
    right = refine(run, wrong, FREE.replace(iterations=5)).motions[0]
    assert mpjpe(right, truth, FITTED) > 0.95 * mpjpe(wrong, truth, FITTED)
