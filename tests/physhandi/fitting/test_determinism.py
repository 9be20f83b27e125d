"""The same input gives the same bits, run after run, also where torch adds on several threads.

torch adds in parallel from 32,768 numbers on, so these problems are larger than that.
"""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from support.physics.hand_scene import grasping

from physhandi.fitting import artefacts
from physhandi.fitting.config import FirstOrderConfig, ObjectFitConfig, RefinementConfig
from physhandi.fitting.hand_refinement import (
    RefinedHands,
    Refinement,
    RefinementProblem,
    refine_hands,
)
from physhandi.fitting.hands.losses import depth_loss
from physhandi.fitting.hands.observed import DepthTarget
from physhandi.fitting.object_problem import ObjectProblem, build_problem
from physhandi.fitting.spring_optimisation import Material, SpringDescent
from physhandi.hand.loading import load_hand_model
from physhandi.hand.motion import HandMotion
from physhandi.progress import NullProgress
from physhandi.run import Run

NAME = "towel_fold"
FRAMES = 14


@pytest.fixture(autouse=True)
def two_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def run() -> Run:
    return Run.open(Path(__file__).parents[3] / "sequences/runs/towel_fold_quick")


@pytest.fixture(scope="module")
def problem(run: Run) -> ObjectProblem:
    folder = run.out / "sequences" / NAME
    built = build_problem(
        name=NAME,
        observation=artefacts.load_observation(run.out, NAME),
        object_node=np.load(folder / "object_node.npy"),
        rest_node=np.load(run.out / "object/rest_node.npy"),
        control=artefacts.load_control(run.out, NAME),
        hand_face=np.zeros((0, 3), np.int32),
        frame_count=FRAMES,
        frame_rate=30.0,
        ground_height=0.0,
        gravity=9.81,
    )
    assert built.is_valid[1:].sum() > 1000
    assert FRAMES * 3 * built.carrier.numel() > 32_768
    return built


@pytest.fixture(scope="module")
def held(run: Run, problem: ObjectProblem) -> RefinementProblem:
    initial = run.tensors(f"sequences/{NAME}/hand_right_initial.safetensors")
    return RefinementProblem(
        object_=problem,
        model=artefacts.load_model(run.out, NAME),
        parameters=artefacts.load_parameters(run.out),
        motions=(HandMotion.from_tensors(initial),),
        hand_models=(load_hand_model("right"),),
    )


def in_order(gradients: Callable[[], list[torch.Tensor]]) -> list[torch.Tensor]:
    """Compute gradients while torch refuses whatever it cannot add in a fixed order."""
    # As `use_deterministic_algorithms`, which imports PyTorch's compiler for seconds.
    torch.set_deterministic_debug_mode("error")
    try:
        return gradients()
    finally:
        torch.set_deterministic_debug_mode("default")


def assert_fixed(gradients: Callable[[], list[torch.Tensor]], repeats: int = 3) -> None:
    """Require the same bits every time, with and without torch's own determinism."""
    expected = in_order(gradients)
    assert all(float(value.abs().max()) > 0 for value in expected)
    for _ in range(repeats):
        for value, wanted in zip(gradients(), expected, strict=True):
            assert torch.equal(value, wanted)


def test_what_the_object_is_compared_with_pulls_in_a_fixed_order(problem: ObjectProblem) -> None:
    random = np.random.default_rng(0)
    still = np.repeat(problem.object_node[None], FRAMES, axis=0)
    node = torch.from_numpy(still + random.normal(0, 0.005, still.shape).astype(np.float32))

    def gradients() -> list[torch.Tensor]:
        moved = node.clone().requires_grad_()
        return list(torch.autograd.grad(problem.frame_losses(moved, first_frame=0).sum(), moved))

    assert_fixed(gradients, repeats=8)


def test_stage_1_pulls_the_hand_to_depth_in_a_fixed_order() -> None:
    model, motion = load_hand_model("right"), grasping(frames=12)
    random = np.random.default_rng(1)
    vertex = torch.from_numpy(motion.vertices(model)).float()
    seen = vertex[:, ::9] + torch.from_numpy(random.normal(0, 0.003, vertex[:, ::9].shape)).float()
    ray = torch.nn.functional.normalize(torch.tensor([[0.1, 0.2, 1.0]]), dim=1).expand_as(seen)
    faces = torch.from_numpy(model.faces)
    assert vertex.shape[0] * faces.numel() > 32_768

    def gradients() -> list[torch.Tensor]:
        target = DepthTarget(seen, ray, torch.full(seen.shape[:2], 1.0 / seen.shape[1]))
        moved = vertex.clone().requires_grad_()
        return list(torch.autograd.grad(depth_loss(moved, faces, target, 0.004), moved))

    assert_fixed(gradients)


def test_stage_2_pulls_the_springs_in_a_fixed_order(held: RefinementProblem) -> None:
    config = ObjectFitConfig(first_order=FirstOrderConfig(window=None, is_annealed=False))
    model, parameters = held.model, held.parameters
    state = torch.from_numpy(model.object_node), torch.from_numpy(model.initial_velocity)

    def gradients() -> list[torch.Tensor]:
        material = Material({NAME: model}, parameters, config.first_order)
        descent = SpringDescent(material, parameters, config)
        window = descent.fit_window(held.object_, model, (0, FRAMES - 1), state)
        assert window is not None
        return [value.grad for value in material.logarithms() if value.grad is not None]

    assert_fixed(gradients, repeats=2)


def test_stage_3_pulls_the_hands_in_a_fixed_order(held: RefinementProblem) -> None:
    refinement = Refinement(held, RefinementConfig(), "cpu")

    def gradients() -> list[torch.Tensor]:
        refinement.evaluate()
        return [
            value.grad for value in refinement.hands[0].value.values() if value.grad is not None
        ]

    assert_fixed(gradients, repeats=2)


def test_two_refinements_are_the_same_to_the_bit(held: RefinementProblem) -> None:
    # Two steps from a good fit gain less than the priors cost.
    config = RefinementConfig(iterations=2, prior_weight=0.0, smoothness_weight=0.0)

    def refined() -> RefinedHands:
        return refine_hands(held, config, NullProgress())

    one, other = refined(), refined()
    assert one.curve == other.curve
    np.testing.assert_array_equal(one.control, other.control)
    for first, second in zip(one.motions, other.motions, strict=True):
        np.testing.assert_array_equal(first.articulation, second.articulation)
    assert one.loss_after < one.loss_before
    assert np.abs(one.control - held.object_.control).max() > 5e-4
