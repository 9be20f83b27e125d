"""The zeroth-order search finds known optima and survives divergence."""

import math
import warnings
from collections.abc import Callable
from typing import Any

import pytest

from physhandi.errors import CancelledError, FitError, SettingsError
from physhandi.fitting.config import SearchConfig, SearchVariable, load_profile
from physhandi.fitting.search import (
    Evaluate,
    search_parameters,
)
from physhandi.progress import NullProgress, Progress
from physhandi.simulation.parameters import SimulationParameters

VARIABLES = {
    "stiffness": SearchVariable(low=1e2, high=1e5, scale="log"),
    "drag": SearchVariable(low=0.0, high=20.0),
    "max_neighbors": SearchVariable(low=1.0, high=80.0, scale="integer"),
}
START = SimulationParameters(stiffness=3e4, drag=15.0, max_neighbors=10)


def bowl(parameters: SimulationParameters) -> float:
    return (
        math.log(parameters.stiffness / 2e3) ** 2
        + (parameters.drag - 4.0) ** 2 / 100
        + (parameters.max_neighbors - 40) ** 2 / 1000
    )


def each(evaluate: Callable[[SimulationParameters], float]) -> Evaluate:
    """Evaluate one candidate after the other."""
    return lambda candidates: [(candidate, evaluate(candidate)) for candidate in candidates]


def test_search_finds_the_bottom_of_a_bowl() -> None:
    config = SearchConfig(generations=60, population=10, variables=VARIABLES)
    result = search_parameters(each(bowl), START, config, NullProgress())
    assert result.loss_before == pytest.approx(bowl(START))
    assert result.loss_after < 0.01 < result.loss_before
    assert result.parameters.stiffness == pytest.approx(2e3, rel=0.15)
    assert result.parameters.drag == pytest.approx(4.0, abs=1.0)
    assert abs(result.parameters.max_neighbors - 40) <= 3
    losses = [loss for _, loss in result.curve]
    assert losses == sorted(losses, reverse=True)


def test_the_same_seed_gives_the_same_answer() -> None:
    config = SearchConfig(generations=4, variables=VARIABLES)
    first = search_parameters(each(bowl), START, config, NullProgress())
    assert search_parameters(each(bowl), START, config, NullProgress()) == first


def test_divergent_candidates_do_not_stop_the_search() -> None:
    def cliff(parameters: SimulationParameters) -> float:
        return math.inf if parameters.stiffness > 5e3 else bowl(parameters)

    config = SearchConfig(generations=40, population=10, variables=VARIABLES)
    result = search_parameters(each(cliff), START, config, NullProgress())
    assert math.isinf(result.loss_before)
    assert result.loss_after < 0.1


def test_nothing_but_divergence_is_an_error() -> None:
    config = SearchConfig(generations=2, variables=VARIABLES)
    with pytest.raises(FitError, match=r"diverged.*stiffness"):
        search_parameters(each(lambda _: math.inf), START, config, NullProgress())


def test_tied_parameters_follow() -> None:
    config = SearchConfig(
        generations=2,
        variables={"stiffness": VARIABLES["stiffness"]},
        tied={"virtual_stiffness": "stiffness"},
    )
    result = search_parameters(each(bowl), START, config, NullProgress())
    assert result.parameters.virtual_stiffness == result.parameters.stiffness != START.stiffness


def test_without_generations_the_start_is_the_answer() -> None:
    result = search_parameters(each(bowl), START, SearchConfig(generations=0), NullProgress())
    assert result.parameters == START


def test_search_stops_when_told() -> None:
    class Impatient(Progress):
        def check_cancelled(self) -> None:
            raise CancelledError

    with pytest.raises(CancelledError):
        search_parameters(
            each(bowl), START, SearchConfig(generations=1, variables=VARIABLES), Impatient()
        )


@pytest.mark.parametrize(
    ("variable", "unit", "value"),
    [
        (SearchVariable(low=1.0, high=100.0, scale="log"), 0.5, 10.0),
        (SearchVariable(low=2.0, high=4.0), 0.25, 2.5),
        (SearchVariable(low=1.0, high=5.0, scale="integer"), 0.3, 2),
        (SearchVariable(low=9.0, high=49.0, scale="integer"), 0.999, 48),
    ],
)
def test_intervals_are_walked_as_they_say(
    variable: SearchVariable, unit: float, value: float
) -> None:
    assert variable.from_unit(unit) == pytest.approx(value)
    if variable.scale != "integer":
        assert variable.to_unit(value) == pytest.approx(unit)


def test_an_empty_interval_is_refused() -> None:
    with pytest.raises(SettingsError, match="low end must be lower"):
        SearchVariable(low=2.0, high=1.0)
    with pytest.raises(SettingsError, match="log scale it must begin above 0"):
        SearchVariable(low=0.0, high=1.0, scale="log")


@pytest.mark.parametrize(("name", "generations"), [("phystwin", 20), ("paper", 100)])
def test_cma_is_set_up_as_phystwins(
    monkeypatch: pytest.MonkeyPatch, name: str, generations: int
) -> None:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Could not import matplotlib")
        import cma

    given: dict[str, Any] = {}
    strategy = cma.CMAEvolutionStrategy

    def spy(x0: Any, sigma0: float, options: dict[str, Any]) -> Any:
        given.update(options, x0=[float(x) for x in x0], sigma0=sigma0)
        return strategy(x0, sigma0, options)

    monkeypatch.setattr(cma, "CMAEvolutionStrategy", spy)
    profile = load_profile(name)
    seen: list[SimulationParameters] = []

    def evaluate(parameters: SimulationParameters) -> float:
        seen.append(parameters)
        return abs(parameters.drag - 7.0)

    search_parameters(each(evaluate), profile.simulation, profile.object_.search, NullProgress())
    # physics.md §4.2; 4 + ⌊3 ln 12⌋ = 11, and the start is looked at once before.
    x0 = [0.3, 0.25, 0.5, 3 / 7, 4 / 7, 0.5, 0.15, 0.7, 0.15, 0.25, 0.15, 0.5]
    if name == "paper":
        x0[3:5] = [1 / 79, 2 / 79]
    assert given["x0"] == pytest.approx(x0, abs=1e-9)
    assert given["sigma0"] == pytest.approx(1 / 6)
    assert (given["popsize"], given["seed"], given["bounds"]) == (11, 42, [0, 1])
    # pycma's own choice where there are bounds.
    own = strategy(x0, 1 / 6, {"bounds": [0.0, 1.0], "seed": 42, "verbose": -9, "verb_log": 0})
    assert own.popsize == 11
    assert given["maxstd"] == pytest.approx(float(own.opts["maxstd"][0]))
    assert len(seen) == 1 + 11 * generations
    stiffness = [parameters.stiffness for parameters in seen[1:]]
    # Walked linearly from 0 N on: a uniform cloud over a log interval would hardly go above 5e4.
    assert 0.0 <= min(stiffness) < 1e4
    assert 9e4 < max(stiffness) <= 1e5
    assert all(parameters.virtual_stiffness == parameters.stiffness for parameters in seen)


def test_the_start_is_returned_only_if_it_may_be() -> None:
    def jealous(parameters: SimulationParameters) -> float:
        return 0.0 if parameters == START else 1.0 + parameters.drag

    config = SearchConfig(generations=2, variables=VARIABLES)
    kept = search_parameters(each(jealous), START, config, NullProgress())
    assert (kept.parameters, kept.loss_after) == (START, 0.0)
    config = SearchConfig(generations=2, variables=VARIABLES, keeps_start=False)
    best = search_parameters(each(jealous), START, config, NullProgress())
    assert best.parameters != START
    assert best.loss_after == 1.0 + best.parameters.drag > best.loss_before == 0.0


def test_a_bounded_step_stays_near_the_start() -> None:
    seen: list[float] = []

    def downhill(parameters: SimulationParameters) -> float:
        seen.append(parameters.drag)
        return parameters.drag

    two = {name: VARIABLES[name] for name in ("drag", "max_neighbors")}
    config = SearchConfig(
        generations=1, population=20, sigma=1 / 6, longest_step=1e-3, variables=two
    )
    search_parameters(each(downhill), START, config, NullProgress())
    # The drag's interval is 20 wide: a step of at most a thousandth of it is 0.02.
    assert 0.005 < max(abs(drag - START.drag) for drag in seen) < 0.1
