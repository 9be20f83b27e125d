"""Stage 2 recovers a made-up object, alone and from several sequences."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.physics.stopped_fits import ORIGIN, check_resumed, same_bits, write_always

from physhandi.data.checkpoint import Checkpointer, FileCheckpointer
from physhandi.data.observation import ObjectObservation
from physhandi.errors import CancelledError, FitError
from physhandi.fitting.config import FirstOrderConfig, ObjectFitConfig, SearchConfig, SearchVariable
from physhandi.fitting.object_problem import (
    ObjectProblem,
    build_problem,
    build_problem_model,
    mean_loss,
    settle_substeps,
)
from physhandi.fitting.object_reconstruction import search_object
from physhandi.fitting.spring_optimisation import optimise_springs
from physhandi.progress import NullProgress, Progress
from physhandi.simulation import differentiable
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.topology import build_model

PARAMETERS = SimulationParameters(
    connection_radius=0.16,
    max_neighbors=8,
    virtual_connection_radius=0.03,
    virtual_max_neighbors=1,
    stiffness=300.0,
    virtual_stiffness=3000.0,
    damping=5.0,
    drag=1.0,
    ground_height=None,
    substeps_per_frame=40,
)
FRAMES = 9
AXIS = np.arange(4) * 0.1
NODE = np.stack([*np.meshgrid(AXIS, AXIS, indexing="ij"), np.zeros((4, 4))], axis=-1).reshape(-1, 3)


def held_sheet(name: str, lift: float, scale: float = 1.0) -> ObjectProblem:
    """A sheet held at two corners that rise; one half is three times as stiff as the other."""
    corner = NODE[[0, 3]] + [0.0, 0.0, 0.01]
    rise = np.linspace(0, 1, FRAMES)[:, None, None] * np.array([0.0, 0.0, lift])
    control = (corner[None] + rise).astype(np.float32)
    model = build_model(NODE, control[0], PARAMETERS)
    middle = NODE[np.minimum(model.spring_nodes, len(NODE) - 1)].mean(axis=1)
    stiffness = np.where(middle[:, 0] < 0.15, 600.0, 200.0).astype(np.float32)
    stiffness[model.object_spring_count :] = 3000.0
    finely = PARAMETERS.replace(substeps_per_frame=round(40 * scale**0.5))
    truth = Simulator(replace(model, stiffness=scale * stiffness), finely)
    position = truth.rollout(control).position
    visible = np.ones(position.shape[:2], bool)
    valid = visible.copy()
    valid[0] = False
    observation = ObjectObservation(point=position, is_visible=visible, is_motion_valid=valid)
    return build_problem(
        name=name,
        observation=observation,
        object_node=NODE,
        rest_node=NODE,
        control=control,
        hand_face=np.zeros((0, 3), np.int32),
        frame_count=FRAMES,
        frame_rate=30.0,
        ground_height=None,
        gravity=9.81,
    )


def config(**first_order: Any) -> ObjectFitConfig:
    settings: dict[str, Any] = {"iterations": 20, "learning_rate": 0.1, "is_annealed": False}
    return ObjectFitConfig(
        search=SearchConfig(
            generations=3,
            population=6,
            variables={"stiffness": SearchVariable(low=50.0, high=2000.0, scale="log")},
        ),
        first_order=FirstOrderConfig(**(settings | first_order)),
    )


def test_springs_of_two_halves_are_told_apart() -> None:
    problems = [held_sheet("slow", 0.2), held_sheet("fast", 0.5)]
    result = optimise_springs(problems, PARAMETERS, config(), NullProgress())
    assert result.loss_after < 0.2 * result.loss_before
    slow, fast = result.models["slow"], result.models["fast"]
    count = slow.object_spring_count
    np.testing.assert_array_equal(slow.stiffness[:count], fast.stiffness[:count])
    middle = NODE[slow.spring_nodes[:count]].mean(axis=1)
    near, far = (
        slow.stiffness[:count][side] for side in (middle[:, 0] < 0.15, middle[:, 0] > 0.15)
    )
    assert np.median(near) > 1.3 * np.median(far)
    stored = mean_loss(problems, result.models, PARAMETERS, config(), "cpu")
    assert stored == pytest.approx(result.loss_after, rel=1e-6)


def test_springs_are_judged_by_what_the_next_pass_simulates(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem, settings = held_sheet("slow", 0.2), config(iterations=5)
    simulated, plain = [], differentiable.rollout

    def counted(*given: Any, **named: Any) -> Any:
        simulated.append(named["window"])
        return plain(*given, **named)

    monkeypatch.setattr(differentiable, "rollout", counted)
    result = optimise_springs([problem], PARAMETERS, settings, NullProgress())
    assert len(simulated) == 5
    losses = [loss for _, loss in result.curve]
    assert losses == sorted(losses, reverse=True)
    assert result.loss_after == losses[-1]
    # The last springs are simulated once more; stopped one pass earlier, their loss is the same.
    for count in (2, 4):
        fewer = config(iterations=count)
        short = optimise_springs([problem], PARAMETERS, fewer, NullProgress())
        assert short.loss_after == pytest.approx(losses[count], rel=1e-5)
        assert short.loss_after != pytest.approx(losses[count - 1], rel=1e-3)


def test_springs_that_stiffen_get_the_substeps_that_they_need() -> None:
    problem = held_sheet("stiff", 0.2, scale=1000.0)
    soft = PARAMETERS.replace(stiffness=1e4, virtual_stiffness=1e5)
    automatic = config(iterations=8, learning_rate=0.5).replace(automatic_substeps=True)
    result = optimise_springs([problem], soft, automatic, NullProgress())
    first = settle_substeps([build_problem_model(problem, soft)], soft, automatic, safety=1.25**2)
    needed = settle_substeps(list(result.models.values()), soft, automatic)
    assert needed.substeps_per_frame > first.substeps_per_frame
    assert result.parameters.substeps_per_frame == needed.substeps_per_frame
    problems = [problem]
    stored = mean_loss(problems, result.models, result.parameters, automatic, "cpu")
    assert stored == result.loss_after < result.loss_before


def test_a_start_that_needs_many_substeps_is_searched_all_the_same() -> None:
    problem = held_sheet("slow", 0.2)
    few = config().replace(automatic_substeps=True, most_substeps=1)
    result = search_object([problem], PARAMETERS, few, NullProgress())
    needed = settle_substeps([build_problem_model(problem, PARAMETERS)], PARAMETERS, few)
    assert needed.substeps_per_frame > 1
    assert 1 < result.parameters.substeps_per_frame <= 2 * needed.substeps_per_frame
    assert result.loss_after < result.loss_before < np.inf


@pytest.mark.parametrize("window", [1, 4])
def test_short_windows_also_descend(window: int) -> None:
    problems = [held_sheet("slow", 0.2)]
    settings = config(window=window, iterations=6, learning_rate=0.05)
    result = optimise_springs(problems, PARAMETERS, settings, NullProgress())
    assert result.loss_after < 0.9 * result.loss_before


def test_without_learned_damping_it_stays() -> None:
    problems = [held_sheet("slow", 0.2)]
    settings = config(learns_damping=False, iterations=4)
    result = optimise_springs(problems, PARAMETERS, settings, NullProgress())
    np.testing.assert_allclose(result.models["slow"].damping, PARAMETERS.damping, rtol=1e-5)
    assert result.loss_after < result.loss_before


def test_annealing_ends_on_the_whole_sequence() -> None:
    problems = [held_sheet("slow", 0.2)]
    result = optimise_springs(problems, PARAMETERS, config(is_annealed=True), NullProgress())
    assert result.loss_after < 0.3 * result.loss_before


def test_search_improves_a_wrong_start() -> None:
    problems = [held_sheet("slow", 0.2)]
    start = PARAMETERS.replace(stiffness=2000.0)
    result = search_object(problems, start, config(), NullProgress())
    assert 100.0 < result.parameters.stiffness < 900.0
    assert result.loss_after < 0.3 * result.loss_before


def test_a_search_that_finds_nothing_slow_looks_for_what_is_fast_and_stable() -> None:
    problems = [held_sheet("slow", 0.2)]
    slow = PARAMETERS.replace(stiffness=2000.0, speed_limit=0.01)
    found = search_object(problems, slow, config(), NullProgress())
    assert found.parameters.speed_limit == 1000.0
    # The same candidates as a search that was told so, and their substeps are as fine.
    fast = search_object(problems, slow.replace(speed_limit=1000.0), config(), NullProgress())
    assert found.parameters == fast.parameters
    assert found.loss_after == fast.loss_after < np.inf
    usual = search_object(problems, slow.replace(speed_limit=50.0), config(), NullProgress())
    assert usual.parameters == fast.parameters.replace(speed_limit=50.0)
    unstable = config().replace(automatic_substeps=False)
    stiff = PARAMETERS.replace(stiffness=1e6, substeps_per_frame=1, speed_limit=0.01)
    search = unstable.search.replace(
        variables={"stiffness": SearchVariable(low=5e5, high=2e6, scale="log")}
    )
    with pytest.raises(FitError, match="candidates diverged"):
        search_object(problems, stiff, unstable.replace(search=search), NullProgress())


def test_a_search_that_cannot_simulate_anything_says_why_and_ends() -> None:
    settings = config()
    evaluations = 1 + settings.search.generations * settings.search.population
    frugal = settings.replace(automatic_substeps=False, most_substeps=9)
    start = PARAMETERS.replace(substeps_per_frame=10)
    with pytest.raises(FitError, match=f": {evaluations} need more than 9 substeps a frame"):
        search_object([held_sheet("slow", 0.2)], start, frugal, NullProgress())
    # Near enough for a spring, but no neighbor is allowed.
    bare = PARAMETERS.replace(max_neighbors=0, virtual_max_neighbors=0)
    with pytest.raises(FitError, match=f": {evaluations} form no springs"):
        search_object([held_sheet("slow", 0.2)], bare, settings, NullProgress())


def test_objects_that_differ_are_refused() -> None:
    first, second = held_sheet("slow", 0.2), held_sheet("fast", 0.2)
    stretched = replace(second, rest_node=(NODE * [1.0, 2.5, 1.0]).astype(np.float32))
    with pytest.raises(FitError, match="'fast' connects"):
        optimise_springs([first, stretched], PARAMETERS, config(), NullProgress())


def test_a_start_that_diverges_is_an_error() -> None:
    stiff = PARAMETERS.replace(stiffness=1e6)
    with pytest.raises(FitError, match="diverge"):
        optimise_springs([held_sheet("slow", 0.2)], stiff, config(), NullProgress())


def test_cancelling_stops_between_iterations() -> None:
    class Impatient(Progress):
        def __init__(self) -> None:
            self.seen: list[int] = []

        def report(self, stage: str, iteration: int, *rest: object, **more: object) -> None:
            self.seen.append(iteration)

        def check_cancelled(self) -> None:
            if len(self.seen) >= 2:
                raise CancelledError

    progress = Impatient()
    with pytest.raises(CancelledError):
        optimise_springs([held_sheet("slow", 0.2)], PARAMETERS, config(), progress)
    assert progress.seen == [1, 2]


def test_a_stopped_search_goes_on_to_the_same_bits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    write_always(monkeypatch)
    problem, settings = held_sheet("low", 0.1), config()
    # The best stiffness is beyond the interval, so that the search goes on with a wider one.
    stiffness = SearchVariable(low=50.0, high=100.0, scale="log")
    search = settings.search.replace(
        generations=3, widening_generations=2, variables={"stiffness": stiffness}
    )
    settings = settings.replace(search=search)

    whole = []

    def fit(progress: Progress, checkpointer: Checkpointer | None) -> Any:
        found = search_object([problem], PARAMETERS, settings, progress, checkpointer=checkpointer)
        whole.append(found)
        return found

    reports = check_resumed(fit, tmp_path, (2, 3))
    # The second attempt repeated the second generation, told of it, and computed two more.
    assert [report[1] for report in reports] == [4, 5]
    assert [found.widened for found in whole] == [("stiffness",)] * 2
    # Losses of other candidates, as of another version of the strategy, are not taken for theirs.
    other = settings.replace(search=search.replace(seed=7))
    checkpointer = FileCheckpointer(tmp_path, ORIGIN)
    seeded = search_object([problem], PARAMETERS, other, NullProgress(), checkpointer=checkpointer)
    assert "asks for other candidates" in caplog.text
    same_bits(seeded, search_object([problem], PARAMETERS, other, NullProgress()))


@pytest.mark.parametrize("window", [None, 3])
def test_a_stopped_descent_goes_on_to_the_same_bits(
    window: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_always(monkeypatch)
    problems = [held_sheet("low", 0.1), held_sheet("high", 0.2)][: 1 if window is None else 2]
    settings = config(iterations=6, window=window, learns_contact=window is not None)

    def fit(progress: Progress, checkpointer: Checkpointer | None) -> Any:
        return optimise_springs(problems, PARAMETERS, settings, progress, checkpointer=checkpointer)

    reports = check_resumed(fit, tmp_path, (1, 4))
    assert [report[1] for report in reports] == [4, 5, 6]
