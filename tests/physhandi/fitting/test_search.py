"""The zeroth-order search finds known optima and survives divergence."""

import math

import pytest

from physhandi.errors import CancelledError, FitError
from physhandi.fitting.search import SearchConfig, SearchVariable, search_parameters
from physhandi.progress import NullProgress, Progress
from physhandi.simulation.model import SimulationParameters

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


def test_search_finds_the_bottom_of_a_bowl() -> None:
    config = SearchConfig(generations=60, population=10, variables=VARIABLES)
    result = search_parameters(bowl, START, config, NullProgress())
    assert result.loss_before == pytest.approx(bowl(START))
    assert result.loss_after < 0.01 < result.loss_before
    assert result.parameters.stiffness == pytest.approx(2e3, rel=0.15)
    assert result.parameters.drag == pytest.approx(4.0, abs=1.0)
    assert abs(result.parameters.max_neighbors - 40) <= 3
    losses = [loss for _, loss in result.curve]
    assert losses == sorted(losses, reverse=True)


def test_the_same_seed_gives_the_same_answer() -> None:
    config = SearchConfig(generations=4, variables=VARIABLES)
    first = search_parameters(bowl, START, config, NullProgress())
    assert search_parameters(bowl, START, config, NullProgress()) == first


def test_divergent_candidates_do_not_stop_the_search() -> None:
    def cliff(parameters: SimulationParameters) -> float:
        return math.inf if parameters.stiffness > 5e3 else bowl(parameters)

    config = SearchConfig(generations=40, population=10, variables=VARIABLES)
    result = search_parameters(cliff, START, config, NullProgress())
    assert math.isinf(result.loss_before)
    assert result.loss_after < 0.1


def test_nothing_but_divergence_is_an_error() -> None:
    config = SearchConfig(generations=2, variables=VARIABLES)
    with pytest.raises(FitError, match=r"diverged.*stiffness"):
        search_parameters(lambda _: math.inf, START, config, NullProgress())


def test_tied_parameters_follow() -> None:
    config = SearchConfig(
        generations=2,
        variables={"stiffness": VARIABLES["stiffness"]},
        tied={"virtual_stiffness": "stiffness"},
    )
    result = search_parameters(bowl, START, config, NullProgress())
    assert result.parameters.virtual_stiffness == result.parameters.stiffness != START.stiffness


def test_without_generations_the_start_is_the_answer() -> None:
    result = search_parameters(bowl, START, SearchConfig(generations=0), NullProgress())
    assert result.parameters == START


def test_search_stops_when_told() -> None:
    class Impatient(Progress):
        def check_cancelled(self) -> None:
            raise CancelledError

    with pytest.raises(CancelledError):
        search_parameters(
            bowl, START, SearchConfig(generations=1, variables=VARIABLES), Impatient()
        )


@pytest.mark.parametrize(
    ("variable", "unit", "value"),
    [
        (SearchVariable(low=1.0, high=100.0, scale="log"), 0.5, 10.0),
        (SearchVariable(low=2.0, high=4.0), 0.25, 2.5),
        (SearchVariable(low=1.0, high=5.0, scale="integer"), 0.3, 2),
    ],
)
def test_intervals_are_walked_as_they_say(
    variable: SearchVariable, unit: float, value: float
) -> None:
    assert variable.from_unit(unit) == pytest.approx(value)
    if variable.scale != "integer":
        assert variable.to_unit(value) == pytest.approx(unit)


def test_an_empty_interval_is_refused() -> None:
    with pytest.raises(ValueError, match="empty"):
        SearchVariable(low=2.0, high=1.0)
    with pytest.raises(ValueError, match="log"):
        SearchVariable(low=0.0, high=1.0, scale="log")
