"""The switches of the first-order stage: what it starts from, and which iteration it returns."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from physhandi.data.observation import ObjectObservation
from physhandi.fitting import spring_optimisation
from physhandi.fitting.config import FirstOrderConfig, ObjectFitConfig, SearchConfig, SearchVariable
from physhandi.fitting.object_problem import (
    ObjectProblem,
    build_problem,
    build_problem_model,
    mean_loss,
)
from physhandi.fitting.object_reconstruction import search_object
from physhandi.fitting.spring_optimisation import (
    FirstOrderResult,
    Material,
    SpringDescent,
    optimise_springs,
)
from physhandi.progress import NullProgress
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters

FRAMES = 4
PARAMETERS = SimulationParameters(
    connection_radius=0.15,
    max_neighbors=2,
    stiffness=100.0,
    damping=83.97,
    drag=2.99,
    friction=0.3,
    restitution=0.0,
    ground_height=0.0,
    substeps_per_frame=100,
)


def sliding_pair(friction: float, *, speed: float = 2.0) -> ObjectProblem:
    """Two nodes at rest length that slide on the ground and slow down by Coulomb's law."""
    node = np.array([[0.0, 0.0, 0.0], [0.0, 0.1, 0.0]], np.float32)
    time = np.arange(FRAMES)[:, None] / 30.0
    path = speed * time - 0.5 * friction * 9.81 * time**2
    point = node + path[..., None] * np.array([1.0, 0.0, 0.0])
    seen = np.ones((FRAMES, 2), bool)
    problem = build_problem(
        name="pair",
        observation=ObjectObservation(
            point=point.astype(np.float32),
            is_visible=seen,
            is_motion_valid=seen,
            node_of_track=np.arange(2, dtype=np.int32),
        ),
        object_node=node,
        rest_node=node,
        control=np.zeros((FRAMES, 0, 3), np.float32),
        hand_face=np.zeros((0, 3), np.int32),
        frame_count=FRAMES,
        frame_rate=30.0,
        ground_height=0.0,
        gravity=9.81,
        starts_at_rest=True,
    )
    velocity = np.tile(np.array([speed, 0.0, 0.0], np.float32), (2, 1))
    return replace(problem, initial_velocity=velocity)


def config(**settings: object) -> ObjectFitConfig:
    first_order = {"iterations": 1, "learning_rate": 1e-3, "window": 1, "steepest": None}
    return ObjectFitConfig(first_order=FirstOrderConfig(**(first_order | settings)))


@pytest.mark.parametrize(("observed", "change"), [(0.8, 2.745e-3), (0.0, -2.745e-3)])
def test_friction_is_learned_by_a_step_a_frame(observed: float, change: float) -> None:
    # The error grows as t², and so do the one-frame gradients: 1, 4, 9. With Adam's decays of 0.9
    # and 0.99 three steps of 1e-3 then go 1, 2.579 / √8.538 and 4.948 / √32.94 of it: 2.745.
    settings = config(learns_contact=True, judges_online=True)
    still = PARAMETERS.replace(drag=0.0)
    result = optimise_springs([sliding_pair(observed)], still, settings, NullProgress())
    assert result.parameters.friction == pytest.approx(0.3 + change, abs=1e-5)
    assert result.parameters.self_friction == pytest.approx(PARAMETERS.self_friction)
    assert result.loss_after < result.loss_before
    kept = optimise_springs([sliding_pair(observed)], still, config(), NullProgress())
    assert kept.parameters.friction == 0.3


def test_damping_and_drag_lose_their_fraction_only_if_asked_for() -> None:
    problem = sliding_pair(0.3)
    result = optimise_springs([problem], PARAMETERS, config(truncates_damping=True), NullProgress())
    assert (result.parameters.damping, result.parameters.drag) == (83.0, 2.0)
    whole = PARAMETERS.replace(damping=83.0, drag=2.0)
    models = {"pair": build_problem_model(problem, whole)}
    expected = mean_loss([problem], models, whole, config(), "cpu")
    assert result.loss_before == expected
    kept = optimise_springs([problem], PARAMETERS, config(), NullProgress())
    assert (kept.parameters.damping, kept.parameters.drag) == (83.97, 2.99)
    assert kept.loss_before != pytest.approx(expected, rel=1e-3)


def test_what_cannot_be_held_still_begins_as_the_search_judged_it(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    problem, told = sliding_pair(0.3), []

    def torn(model: SpringMassModel, *_: object, **__: object) -> SpringMassModel:
        return replace(model, rest_length=1e-3 * model.rest_length)

    monkeypatch.setattr(spring_optimisation, "hold_still", torn)
    monkeypatch.setattr(NullProgress, "report", lambda *report: told.append(report[-1]))
    searched = optimise_springs([problem], PARAMETERS, config(), NullProgress())
    assert searched.loss_before > 0.0
    assert told == [""]
    held = config().replace(holds_still=True)
    result = optimise_springs([problem], PARAMETERS, held, NullProgress())
    assert (result.loss_before, result.loss_after) == (searched.loss_before, searched.loss_after)
    assert "hold the object still" in told[1]
    assert told[1] in caplog.messages[0]


def returned_iteration(
    monkeypatch: pytest.MonkeyPatch, losses: list[float], **settings: object
) -> tuple[int, FirstOrderResult]:
    """Walk without simulating: each pass stiffens by a tenth and meets the next of the losses."""
    waiting = iter(losses)

    def fit_pass(self: SpringDescent, *_: object) -> float:
        with torch.no_grad():
            self.material.logarithms()[0][0] += 0.1
        return next(waiting)

    def simulated(*_: object, **__: object) -> float:
        return 2.0

    monkeypatch.setattr(SpringDescent, "fit_pass", fit_pass)
    monkeypatch.setattr(spring_optimisation, "mean_loss", simulated)
    chosen = config(iterations=len(losses), **settings)
    result = optimise_springs([sliding_pair(0.3)], PARAMETERS, chosen, NullProgress())
    passes = math.log(float(result.models["pair"].stiffness[0]) / 100.0) / 0.1
    return round(passes) - 1, result


@pytest.mark.parametrize(
    ("every", "losses", "iteration"),
    [
        (1, [5.0, 4.0, 3.0, 0.5, 4.0], 3),
        (2, [5.0, 4.0, 3.0, 0.5, 4.0], 2),
        (20, [5.0, 4.0, 3.0, 0.5, 4.0], 4),
        (20, [3.0, 1.0, 1.0, 0.5, 4.0], 0),
    ],
)
def test_iterations_are_ranked_by_what_they_met(
    monkeypatch: pytest.MonkeyPatch, every: int, losses: list[float], iteration: int
) -> None:
    # All of these are worse than the start's 2.0 somewhere; the start is no candidate.
    found, result = returned_iteration(monkeypatch, losses, judges_online=True, judged_every=every)
    assert found == iteration
    assert result.loss_after == 2.0
    assert [loss for _, loss in result.curve] == [2.0, *losses]


def test_the_start_stays_when_simulating_again_finds_nothing_better(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found, result = returned_iteration(monkeypatch, [0.1, 0.2])
    assert found == -1
    assert [loss for _, loss in result.curve] == [2.0, 2.0, 2.0]


def test_a_gradient_that_is_lost_on_the_way_ends_the_descent_with_the_best_so_far(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    told: list[str] = []

    class Heard(NullProgress):
        def report(self, *about: object, **_: object) -> None:
            told.append(str(about[4]))

    met: list[float | None] = [1.5, 1.0, 1.2, None]
    waiting = iter(met)

    def fit_pass(self: SpringDescent, *_: object) -> float | None:
        with torch.no_grad():
            self.material.logarithms()[0][0] += 0.1
        return next(waiting)

    monkeypatch.setattr(SpringDescent, "fit_pass", fit_pass)
    monkeypatch.setattr(spring_optimisation, "mean_loss", lambda *_, **__: 2.0)
    chosen = config(iterations=50, judges_online=True, judged_every=1)
    result = optimise_springs([sliding_pair(0.3)], PARAMETERS, chosen, Heard())
    assert float(result.models["pair"].stiffness[0]) == pytest.approx(100.0 * math.exp(0.2))
    assert [loss for _, loss in result.curve] == [2.0, 1.5, 1.0, 1.2]
    assert result.stopped.startswith("Stopped after 3 of 50 iterations. No sequence has a usable")
    assert told[-1] == result.stopped
    assert result.stopped in caplog.text
    monkeypatch.setattr(SpringDescent, "fit_pass", lambda *_: None)
    result = optimise_springs([sliding_pair(0.3)], PARAMETERS, chosen, NullProgress())
    assert result.stopped.startswith("Stopped after 0 of 50 iterations. No sequence has a usable")
    assert result.models["pair"].stiffness.tolist() == [100.0]


def test_the_limit_on_gradients_can_be_lifted() -> None:
    problem = sliding_pair(0.3)
    taut = replace(problem, rest_node=problem.object_node * np.float32(0.9))
    kept = optimise_springs([taut], PARAMETERS, config(steepest=1e-3), NullProgress())
    assert kept.stopped.startswith("Stopped after 0 of")
    assert kept.loss_after == kept.loss_before
    result = optimise_springs([taut], PARAMETERS, config(), NullProgress())
    assert result.loss_after < result.loss_before
    assert result.stopped == ""


def test_a_walk_tells_the_mean_loss_it_met() -> None:
    problem = sliding_pair(0.8)
    still = PARAMETERS.replace(drag=0.0)
    model = build_problem_model(problem, still)
    settings = config(learning_rate=1e-9)
    material = Material({"pair": model}, still, settings.first_order)
    met = SpringDescent(material, still, settings).fit_pass(problem, model, FRAMES)
    # Chamfer sees nothing; a track is off by half (0.8 - 0.3) g t², squared.
    time = np.arange(1, FRAMES) / 30.0
    assert met == pytest.approx(np.mean((0.25 * 9.81 * time**2) ** 2), rel=0.05)


def falling_node() -> ObjectProblem:
    problem = sliding_pair(0.0, speed=0.0)
    up = np.array([0.0, 0.0, 5.0], np.float32)
    node = problem.object_node + up
    return replace(
        problem, object_node=node, rest_node=node, track=problem.track + torch.from_numpy(up)
    )


def test_acceleration_counts_in_the_search_alone() -> None:
    # Fall with drag: v' = q (v - g dt) each substep, so frame t changes v by G Q^(t-1) (1 - Q) and
    # the change itself changes by G (1 - Q)² Q^(t-2), from frame 2 on; smooth L1 halves its square.
    problem = falling_node()
    parameters = PARAMETERS.replace(drag=8.0, gravity=9.81)
    step = parameters.dt
    q = math.exp(-8.0 * step)
    limit, frame = 9.81 * step * q / (1.0 - q), q**parameters.substeps_per_frame
    jerk = [0.0] + [limit * (1 - frame) ** 2 * frame ** (t - 2) for t in range(2, FRAMES)]
    expected = 0.01 * np.mean([0.5 * value**2 / 3.0 for value in jerk])
    assert expected > 1e-6
    settings = config().replace(
        acceleration_weight=0.01,
        search=SearchConfig(generations=0, variables={"drag": SearchVariable(low=0.0, high=20.0)}),
    )
    searched = search_object([problem], parameters, settings, NullProgress()).loss_before
    plain = optimise_springs([problem], parameters, settings, NullProgress()).loss_before
    assert searched - plain == pytest.approx(expected, rel=1e-3)
