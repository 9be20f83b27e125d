"""Profile `phystwin` against what PhysTwin's own code computed: motion, losses, gradients.

Nothing of PhysTwin is rewritten here: what is compared is what the fitting code does under the
profile's switches. Only the data is turned from z down to z up, and its flags of motion t → t+1
move to the frame that the motion ends in.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from physhandi.data.observation import ObjectObservation
from physhandi.fitting.config import ObjectFitConfig, PipelineConfig, load_profile
from physhandi.fitting.object_problem import (
    ObjectProblem,
    build_problem,
    build_problem_model,
    mean_loss,
    simulate_problem,
)
from physhandi.fitting.spring_optimisation import Material, SpringDescent
from physhandi.simulation.model import SpringMassModel

UP = np.array([1.0, -1.0, -1.0], np.float32)
NAME = "scene"
SCENES = pytest.mark.parametrize("scene", ["plush_lift", "plush_ground"])
Case = dict[str, np.ndarray]


def problem_of(case: Case, config: PipelineConfig) -> ObjectProblem:
    """Reduce a recorded scene as the pipeline does."""
    valid = np.zeros_like(case["is_motion_valid"])
    valid[1:] = case["is_motion_valid"][:-1]
    problem = build_problem(
        name=NAME,
        observation=ObjectObservation(
            point=case["observed"] * UP,
            is_visible=case["is_visible"],
            is_motion_valid=valid,
            node_of_track=np.arange(case["observed"].shape[1], dtype=np.int32),
        ),
        object_node=case["position_0"] * UP,
        rest_node=case["position_0"] * UP,
        control=case["control"] * UP,
        hand_face=np.zeros((0, 3), np.int32),
        frame_count=len(case["position"]),
        frame_rate=30.0,
        ground_height=0.0,
        gravity=9.81,
        surface_count=len(case["position_0"]),
        chamfer_points=config.object_.chamfer_points,
        cloud_points=config.object_.cloud_points,
        starts_at_rest=config.object_.starts_at_rest,
    )
    assert not problem.initial_velocity.any()
    # One of the scenes is thrown, which no case of PhysTwin's is.
    return replace(problem, initial_velocity=case["velocity"][0] * UP)


def model_of(case: Case, problem: ObjectProblem, config: PipelineConfig) -> SpringMassModel:
    """Build the springs by the profile, and put them into the recording's order and last digits.

    Bounces amplify rounding: with another order of additions, or rest lengths one unit of float32
    apart, the thrown object ends 0.1 mm away. PhysTwin had them of points in float64.
    """
    built = build_problem_model(problem, config.simulation)
    springs, own_springs = (ordered(m["spring_nodes"]) for m in (case, built.to_tensors()))
    np.testing.assert_array_equal(own_springs[0], springs[0])
    own_length, length = built.rest_length[own_springs[1]], case["rest_length"][springs[1]]
    np.testing.assert_allclose(own_length, length, rtol=0, atol=4e-9)
    is_object = (case["spring_nodes"] < built.node_count).all(axis=1)
    assert built.object_spring_count == is_object.sum() == 3948
    recorded = {name: case[name] for name in ("spring_nodes", "rest_length", "stiffness")}
    return replace(built, **recorded)


def ordered(spring_nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Springs with their nodes and themselves in ascending order, and where each one was."""
    pair = np.sort(spring_nodes, axis=1)
    order = np.lexsort(pair.T[::-1])
    return pair[order], order


@pytest.fixture
def made(shared_array: Any, scene: str) -> tuple[Case, PipelineConfig, ObjectProblem]:
    case = shared_array(f"phystwin_parity/{scene}.npz")
    config = load_profile("phystwin")
    return case, config, problem_of(case, config)


def test_a_frame_lasts_667_substeps_of_50_microseconds() -> None:
    simulation = load_profile("phystwin").simulation
    assert simulation.dt == pytest.approx(5e-5, rel=1e-9)
    for rate in (15.0, 30.0, 60.0):
        inside = simulation.in_world(frame_rate=rate, ground_height=None, gravity=9.81)
        assert inside.dt * inside.substeps_per_frame == pytest.approx(0.03335, rel=1e-9)
        assert inside.gravity == 9.8


@SCENES
def test_all_frames_and_losses_agree_with_phystwin(device: str, made: Any) -> None:
    case, config, problem = made
    model = model_of(case, problem, config)
    node, _ = simulate_problem(problem, model, config.simulation, device)
    moved = np.abs(case["position"][-1] - case["position"][0]).max()
    assert moved > 0.04
    np.testing.assert_allclose(node.numpy(), case["position"] * UP, atol=1e-5)

    chamfer = frame_losses(problem, node, config.object_, track_weight=0.0)
    track = frame_losses(problem, node, config.object_) - chamfer
    assert case["loss"][:, :2].min() > 9e-7
    np.testing.assert_allclose(chamfer, case["loss"][:, 0], rtol=1e-3)
    np.testing.assert_allclose(track, case["loss"][:, 1], rtol=1e-3)
    total = mean_loss([problem], {NAME: model}, config.simulation, config.object_, device)
    assert total == pytest.approx(case["loss"][:, :2].sum(axis=1).mean(), rel=1e-3)


def frame_losses(
    problem: ObjectProblem,
    node: torch.Tensor,
    config: ObjectFitConfig,
    *,
    track_weight: float | None = None,
) -> np.ndarray:
    weight = config.track_weight if track_weight is None else track_weight
    counted = {"freeze_counts": config.freezes_counts}
    return problem.frame_losses(node[1:], track_weight=weight, **counted).numpy()


@pytest.mark.parametrize("scene", ["plush_lift"])
def test_counts_are_those_of_frame_1(made: Any) -> None:
    case, config, problem = made
    assert int(problem.is_observed[1].sum()) == 561 == int(case["is_visible"][1].sum())
    assert int(problem.is_valid[1].sum()) == 475 == int(case["is_motion_valid"][0].sum())
    node = torch.from_numpy(case["position"] * UP)
    own = config.object_.replace(freezes_counts=False)
    off = np.abs(frame_losses(problem, node, own) / case["loss"][:, :2].sum(axis=1) - 1.0)
    # Without the switch only the first frame would agree.
    assert off[0] < 1e-3
    assert off.max() > 0.02


@SCENES
@pytest.mark.parametrize("start", ["own", "recorded"])
def test_one_frame_gradients_agree_with_phystwin(device: str, made: Any, start: str) -> None:
    case, config, problem = made
    model = model_of(case, problem, config)
    material = Material({NAME: model}, config.simulation, config.object_.first_order)
    descent = SpringDescent(material, config.simulation, config.object_, device)
    assert config.object_.first_order.window == 1
    state = torch.from_numpy(model.object_node), torch.from_numpy(model.initial_velocity)
    for frame, expected in enumerate(case["grad_log_stiffness"]):
        if start == "recorded":
            state = tuple(torch.from_numpy(case[k][frame] * UP) for k in ("position", "velocity"))
        window = descent.fit_window(problem, model, (frame, frame + 1), state)
        assert window is not None
        state = window.state
        total = case["loss"][frame, :2].sum()
        assert float(window.frame_losses[0]) == pytest.approx(total, rel=1e-3)
        gradient = material.gradient(NAME).numpy()
        steepest = np.abs(expected).max()
        assert steepest > 2e-8
        assert np.linalg.norm(gradient - expected) < 1e-3 * np.linalg.norm(expected)
        np.testing.assert_allclose(gradient, expected, rtol=1e-3, atol=1e-3 * steepest)
        # Of the entries that rounding does not reach; it grows from frame to frame.
        is_large = np.abs(expected) > 0.1 * steepest
        assert is_large.sum() > 20
        tolerance = 1e-3 if start == "recorded" else 3e-3
        np.testing.assert_allclose(gradient[is_large], expected[is_large], rtol=tolerance)
