"""Fitting how a rope bends: on motion of the simulator's own rope, whose numbers are known."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from support.physics.stopped_fits import check_resumed, write_always

from physhandi.data.checkpoint import Checkpointer
from physhandi.data.importers.mocap import held_point
from physhandi.data.observation import ObjectObservation
from physhandi.errors import FitError
from physhandi.fitting.config import load_profile
from physhandi.fitting.object_problem import (
    ObjectProblem,
    build_problem,
    problem_parameters,
    simulate_problem,
)
from physhandi.fitting.rope.bending import (
    Bending,
    bent,
    gripped,
    rope_model,
    rope_parameters,
)
from physhandi.fitting.rope.fit import fit_rope, start_rope
from physhandi.fitting.rope.moments import balance_moments
from physhandi.fitting.spring_optimisation import FirstOrderResult
from physhandi.progress import NullProgress, Progress
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.rod import Rod
from physhandi.simulation.simulator import Simulator

STEP = 0.1
HELD = [0, 1, 6, 7]
CONFIG = load_profile("quick")
TRUE = Bending(
    stiffness=0.03,
    damping=0.03,
    drag=0.5,
    twist_stiffness=0.03,
    curvature=np.array([[1.0, 0.0], [2.0, 1.0], [2.0, 2.0], [1.0, 3.0], [0.0, 3.0], [0.0, 1.0]]),
)


def problem_of(marker: np.ndarray, rate: float) -> ObjectProblem:
    """What is seen of a rope whose first and last two of eight markers are held."""
    seen = np.ones(marker.shape[:2], bool)
    valid = seen.copy()
    valid[0] = False
    rest = np.zeros((8, 3))
    rest[:, 0] = STEP * np.arange(8)
    held = held_point(marker, tuple(HELD))
    assert held is not None
    return build_problem(
        name="rope",
        observation=ObjectObservation(
            point=marker.astype(np.float32),
            is_visible=seen,
            is_motion_valid=valid,
            node_of_track=np.arange(8),
        ),
        object_node=marker[0],
        rest_node=rest,
        control=np.concatenate([marker[:, HELD], held[:, None]], axis=1),
        hand_face=np.zeros((0, 3), np.int32),
        frame_count=len(marker),
        frame_rate=rate,
        ground_height=None,
        gravity=9.81,
    )


def rod_of(model: SpringMassModel) -> Rod:
    assert model.rod is not None
    return model.rod


def moved_rope(marker: np.ndarray, rate: float, true: Bending) -> np.ndarray:
    """Let the rope follow the held ones among markers that were only drawn."""
    drawn = problem_of(marker, rate)
    parameters = rope_parameters(drawn, CONFIG.simulation)
    parameters = parameters.replace(substeps_per_frame=max(10, round(4200 / rate)))
    model = replace(rope_model(drawn, parameters, true), initial_velocity=0 * drawn.object_node)
    world = problem_parameters(parameters, drawn).replace(drag=true.drag)
    node = Simulator(model, world).rollout(drawn.control).position.astype(np.float64)
    node[:, HELD] = marker[:, HELD]
    return node


@cache
def swung_rope(rate: float, speed: float, twist_stiffness: float) -> ObjectProblem:
    """A rope that hangs in two grippers, then is swung for a second, as if it were recorded."""
    true = replace(TRUE, twist_stiffness=twist_stiffness)
    angle = np.linspace(-1.2, 1.2, 8)
    drawn = 0.3 * np.stack([np.sin(angle), 0.0 * angle, 1.2 - np.cos(angle)], axis=1)
    resting = moved_rope(np.repeat(drawn[None], 60, axis=0), 60.0, replace(true, drag=6.0))[-1]
    time = np.arange(round(rate)) / rate
    way = 0.1 * np.minimum(time / 0.3, 1.0) ** 3
    swing = np.stack(
        [0.0 * time, way * np.sin(speed * time), way * (1 - np.cos(speed * time))], axis=1
    )
    return problem_of(moved_rope(resting + swing[:, None], rate, true), rate)


def test_a_balance_of_moments_finds_a_rope_without_a_simulation():
    problem = swung_rope(600.0, 12.0, 3.0)
    found = balance_moments([problem], rope_parameters(problem, CONFIG.simulation))
    assert found is not None
    assert found.stiffness == pytest.approx(TRUE.stiffness, rel=0.02)
    assert found.damping == pytest.approx(TRUE.damping, rel=0.05)
    assert found.drag == pytest.approx(TRUE.drag, abs=0.1)
    np.testing.assert_allclose(found.curvature, TRUE.curvature, atol=0.2)


def test_a_balance_of_moments_needs_every_node_in_every_frame():
    problem = swung_rope(60.0, 12.0, 0.03)
    parameters = rope_parameters(problem, CONFIG.simulation)
    assert balance_moments([problem], parameters) is not None
    track = problem.track.clone()
    track[7, 3] = torch.nan
    assert balance_moments([replace(problem, track=track)], parameters) is None


def test_a_fitted_rope_predicts_how_it_moves_when_it_is_swung_otherwise():
    problem = swung_rope(60.0, 12.0, 0.03)
    config = CONFIG.object_.replace(rope_steps=2)
    started = start_rope([problem], CONFIG.simulation, config, NullProgress())
    assert started.loss_after < 0.5 * started.loss_before
    fit = fit_rope([problem], started.parameters, config, NullProgress())
    assert fit.loss_before == pytest.approx(started.loss_after)
    assert fit.loss_after == min(loss for _, loss in fit.curve) < 0.02 * fit.loss_before
    rod = rod_of(fit.models["rope"])
    unseen = swung_rope(60.0, 8.0, 0.03)
    model = rope_model(unseen, fit.parameters, Bending.straight(8))

    def error(moved) -> float:
        node = simulate_problem(unseen, moved, fit.parameters, "cpu")[0]
        return float((node - unseen.track).norm(dim=2)[1:, 2:6].mean())

    assert error(model) > 0.01
    # The lengths at its vertices are this recording's, the other numbers the rope's.
    assert error(replace(model, rod=replace(rod, length=rod_of(model).length))) < 0.002


def test_a_stopped_fit_of_a_rope_goes_on_to_the_same_bits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    write_always(monkeypatch)
    problem = problem_of(swung_rope(60.0, 12.0, 0.03).track[:12].double().numpy(), 60.0)
    config = CONFIG.object_.replace(rope_steps=2)

    def fit(progress: Progress, checkpointer: Checkpointer | None) -> FirstOrderResult:
        return fit_rope([problem], CONFIG.simulation, config, progress, checkpointer=checkpointer)

    # Within the steps over windows, and within those over whole rollouts.
    reports = check_resumed(fit, tmp_path, (1, 3))
    assert [report[1] for report in reports] == [3, 4]


def test_grips_decide_the_lengths_beside_them():
    problem = swung_rope(60.0, 12.0, 0.03)
    parameters = rope_parameters(problem, CONFIG.simulation)
    node = problem.object_node.copy()
    node[:2] -= [[0.01, 0.0, 0.0]]
    model = rope_model(replace(problem, object_node=node), parameters, TRUE)
    seen = np.linalg.norm(np.diff(node, axis=0), axis=1)
    assert seen[1] > 1.05 * STEP
    expected = np.array([seen[0], seen[1], STEP, STEP, STEP, seen[5], seen[6]])
    np.testing.assert_allclose(model.rest_length[:7], expected, rtol=1e-6)
    np.testing.assert_allclose(
        rod_of(model).length[1:-1], 0.5 * (expected[:-1] + expected[1:]), rtol=1e-6
    )
    springs_only = replace(model, rod=None)
    assert gripped(springs_only) is springs_only
    # One kilogram a node: EI by the mass of a metre, divided by their distance.
    assert bent(model, TRUE).stiffness == pytest.approx(0.03 / expected.mean())


def test_a_rope_that_nothing_holds_is_refused():
    problem = swung_rope(60.0, 12.0, 0.03)
    far = replace(problem, control=problem.control + np.float32(0.3))
    with pytest.raises(FitError, match="no control node lies on a node of the rope"):
        start_rope([far], CONFIG.simulation, CONFIG.object_, NullProgress())
