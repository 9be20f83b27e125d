"""Intervals follow the size of the object, and give way where the search ends at their bound."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from physhandi.data.observation import ObjectObservation
from physhandi.fitting.config import (
    INTERVALS,
    SearchConfig,
    SearchVariable,
    apply_overrides,
    load_profile,
)
from physhandi.fitting.object_problem import ObjectProblem, build_problem
from physhandi.fitting.search import Evaluate, search_parameters
from physhandi.fitting.search_bounds import (
    bounds_met,
    fit_intervals,
    measure_object,
    object_length,
    widened,
)
from physhandi.progress import NullProgress
from physhandi.simulation.contact_intervals import NEVER, ContactIntervals
from physhandi.simulation.parameters import SimulationParameters

STIFFNESS = SearchVariable(low=1e2, high=1e4, scale="log")
DRAG = SearchVariable(low=0.0, high=10.0)


def rope(count: int, spacing: float, *, is_bow: bool = False) -> np.ndarray:
    """Nodes along a line, or along three quarters of a circle of the same length [m]."""
    way = spacing * np.arange(count)
    if not is_bow:
        return np.stack([way, 0 * way, 0 * way], axis=1)
    radius = way[-1] / (1.5 * np.pi)
    return radius * np.stack([np.cos(way / radius), np.sin(way / radius), 0 * way], axis=1)


def held(node: np.ndarray, control: np.ndarray, gravity: float = 9.81) -> ObjectProblem:
    motion = np.repeat(node[None].astype(np.float32), 3, axis=0)
    seen = np.ones(motion.shape[:2], bool)
    return build_problem(
        name="rope",
        observation=ObjectObservation(point=motion, is_visible=seen, is_motion_valid=seen),
        object_node=node,
        rest_node=node,
        control=np.repeat(control[None].astype(np.float32), 3, axis=0),
        hand_face=np.zeros((0, 3), np.int32),
        frame_count=3,
        frame_rate=30.0,
        ground_height=None,
        gravity=gravity,
    )


@pytest.mark.parametrize("is_bow", [False, True])
def test_a_rope_is_as_long_in_a_bow_as_when_it_is_straight(is_bow: bool) -> None:
    node = rope(61, 0.01, is_bow=is_bow)
    assert object_length(node, 0.01) == pytest.approx(0.6, rel=0.01)
    shuffled = np.random.default_rng(0).permutation(node)
    assert object_length(shuffled, 0.01) == pytest.approx(0.6, rel=0.01)


def test_of_an_object_in_pieces_the_largest_counts() -> None:
    node = np.concatenate([rope(10, 0.01) + np.array([0, 5, 0]), rope(31, 0.01)])
    assert object_length(node, 0.01) == pytest.approx(0.3)


def test_an_object_is_measured_with_its_grip() -> None:
    node = rope(61, 0.01)
    size = measure_object([held(node, np.array([[0.0, 0.0, 0.03], [0.0, 0.025, 0.02]]))])
    assert size.spacing == pytest.approx(0.01 * 62 / 61)  # Those at the ends have 1 and 2.
    assert size.length == pytest.approx(0.6, rel=0.01)
    assert size.gap == pytest.approx(0.03)
    assert size.grip == pytest.approx(np.hypot(0.025, 0.01))
    far = measure_object([held(node, np.array([[0.0, 0.0, 0.03], [0.6, 0.0, 0.03]]))])
    assert far.grip == pytest.approx(3 * far.spacing)
    dense = measure_object([held(node, rope(300, 0.002) + np.array([0.0, 0.001, 0.0]))])
    assert dense.grip == dense.spacing


@pytest.mark.parametrize(
    ("touches", "holds", "gap"),
    [
        pytest.param((0, 0), (1, NEVER), 0.03, id="for a moment"),
        pytest.param((0, 1), (2, NEVER), 0.004, id="for most of the time"),
        pytest.param((1, NEVER), (0, NEVER), 0.004, id="beside what holds from farther away"),
        pytest.param((2, 2), (7, NEVER), 0.004, id="where else nothing holds"),
        pytest.param((7, 9), (7, NEVER), 0.0, id="after the fitted frames"),
    ],
)
def test_the_gap_is_that_of_what_holds_most_of_the_time(
    touches: tuple[int, int], holds: tuple[int, int], gap: float
) -> None:
    """One of two contacts began 4 mm from the hand, the other one 30 mm; of three frames."""
    contacts = ContactIntervals(
        node=np.array([3, 5], np.int32),
        control=np.array([0, 1], np.int32),
        distance=np.array([0.004, 0.03], np.float32),
        rank=np.zeros(2, np.int32),
        interval=np.array([touches, holds], np.int32),
    )
    problem = held(rope(61, 0.01), np.array([[0.0, 0.0, 0.004], [0.0, 0.0, 0.03]]))
    assert measure_object([replace(problem, contacts=contacts)]).gap == pytest.approx(gap)


def test_intervals_go_with_the_object() -> None:
    """The same rope three times as large, in moon gravity, against the closed form."""
    control = np.array([[0.0, 0.0, 0.008], [0.0, 0.02, 0.0]])
    small = measure_object([held(rope(61, 0.01), control)])
    variables = load_profile("default").object_.search.variables
    config = SearchConfig(
        reference_spacing=small.spacing, reference_length=small.length, variables=variables
    )
    start = SimulationParameters(connection_radius=0.02, stiffness=3e4, drag=3.0)
    same, unchanged = fit_intervals(config, start, small)
    for name, variable in variables.items():
        if name != "virtual_connection_radius":
            assert same.variables[name].low == pytest.approx(variable.low)
            assert same.variables[name].high == pytest.approx(variable.high)
    assert unchanged == start
    large = measure_object([held(3 * rope(61, 0.01), 3 * control, gravity=1.62)])
    scaled, begin = fit_intervals(config, start, large)
    lunar = 1.62 / 9.81
    for name, factor in {
        "connection_radius": 3.0,
        "stiffness": lunar,
        "virtual_stiffness": lunar,
        "damping": math.sqrt(lunar * 3) / 3,
        "drag": 1.0,
        "max_neighbors": 1.0,
    }.items():
        for end in ("low", "high"):
            expected = factor * getattr(variables[name], end)
            assert getattr(scaled.variables[name], end) == pytest.approx(expected), name
    # 20 mm is below the interval that begins at 30 mm, 3e4 N beyond the one that ends at 1.65e4.
    assert begin.connection_radius == pytest.approx(0.06)
    assert begin.stiffness == pytest.approx(3e4 * lunar)
    assert begin.drag == start.drag


def test_virtual_springs_are_looked_for_as_far_as_the_controls_are() -> None:
    node = rope(61, 0.01)
    config = SearchConfig(
        reference_spacing=0.01,
        variables={
            "virtual_connection_radius": SearchVariable(
                low=4e-3, high=1.6e-2, scale="log", is_scaled=True
            )
        },
    )

    def ends(control: np.ndarray) -> tuple[float, float]:
        size = measure_object([held(node, control)])
        intervals = fit_intervals(config, SimulationParameters(), size)[0].variables
        radius = intervals["virtual_connection_radius"]
        return radius.low, radius.high

    def widest(control: np.ndarray) -> float:
        return ends(control)[1]

    h = 0.01 * 62 / 61
    beside = np.array([0.0, 1.0, 0.0])
    dense = rope(301, 0.002)
    assert widest(dense + 0.001 * beside) == pytest.approx(1.6 * h)
    assert widest(dense + 0.02 * beside) == pytest.approx(2 * 0.02 + h / 2)
    assert widest(dense + 0.5 * beside) == pytest.approx(8 * h)
    # 20 mm apart, but for those at the ends.
    assert widest(rope(31, 0.02) + 0.001 * beside) == pytest.approx(1.5 * 0.02 * 32 / 31)
    assert widest(rope(2, 0.6) + 0.001 * beside) == pytest.approx(1.5 * 3 * h)
    # All of it reaches those that are away, unless they are too far away for any.
    for gap, low in ((0.001, 0.4 * h), (0.015, 0.4 * h), (0.02, 0.02 + h / 2), (0.5, 0.4 * h)):
        assert ends(dense + gap * beside)[0] == pytest.approx(low)


def test_an_interval_that_a_user_gives_is_taken_as_it_is() -> None:
    base = load_profile("quick")
    given = {"low": 0.02, "high": 0.04, "scale": "log"}
    search = apply_overrides(base, {f"{INTERVALS}.connection_radius": given}).object_.search
    size = measure_object([held(rope(61, 0.03), np.zeros((1, 3)))])
    intervals = fit_intervals(search, base.simulation, size)[0].variables
    assert intervals["connection_radius"].to_dict() == {**given, "is_scaled": False}
    assert intervals["stiffness"].high > 1.5 * search.variables["stiffness"].high
    one_end = apply_overrides(base, {f"{INTERVALS}.connection_radius.high": 0.06})
    assert one_end.object_.search.variables["connection_radius"].is_scaled


def test_without_a_reference_nothing_is_scaled() -> None:
    size = measure_object([held(rope(61, 0.03), np.zeros((1, 3)))])
    for name in ("phystwin", "paper"):
        profile = load_profile(name)
        search = profile.object_.search
        assert fit_intervals(search, profile.simulation, size) == (search, profile.simulation)
        assert search.widening_generations == 0


def test_a_bound_is_met_where_the_parameter_could_go_on() -> None:
    intervals = {
        "stiffness": STIFFNESS,
        "drag": DRAG,
        "friction": SearchVariable(low=0.0, high=2.0),
        "max_neighbors": SearchVariable(low=3, high=80, scale="integer"),
        "virtual_max_neighbors": SearchVariable(low=1, high=80, scale="integer"),
    }
    inside = SimulationParameters(
        stiffness=1e3, drag=5.0, friction=1.0, max_neighbors=20, virtual_max_neighbors=6
    )
    assert bounds_met(inside, intervals) == {}
    # 1.09e2 is 1.9 % of the way from 1e2 to 1e4 on a log scale, 1.11e2 is 2.3 %.
    assert bounds_met(inside.replace(stiffness=109.0), intervals) == {"stiffness": 1e2}
    assert bounds_met(inside.replace(stiffness=111.0), intervals) == {}
    assert bounds_met(inside.replace(stiffness=9.9e3), intervals) == {"stiffness": 1e4}
    assert bounds_met(inside.replace(drag=0.0), intervals) == {}
    assert bounds_met(inside.replace(drag=9.9), intervals) == {"drag": 10.0}
    assert bounds_met(inside.replace(friction=2.0), intervals) == {}
    assert bounds_met(inside.replace(max_neighbors=79), intervals) == {"max_neighbors": 80}
    assert bounds_met(inside.replace(max_neighbors=3), intervals) == {"max_neighbors": 3}
    assert bounds_met(inside.replace(virtual_max_neighbors=1), intervals) == {}


def test_intervals_are_lengthened_by_half_and_not_beyond_the_parameter() -> None:
    intervals = {"stiffness": STIFFNESS, "drag": SearchVariable(low=4.0, high=10.0)}
    high = widened(intervals, {"stiffness": 1e4, "drag": 10.0})
    assert (high["stiffness"].low, high["stiffness"].high) == pytest.approx((1e2, 1e5))
    assert (high["drag"].low, high["drag"].high) == pytest.approx((4.0, 13.0))
    low = widened(intervals, {"stiffness": 1e2})
    assert (low["stiffness"].low, low["stiffness"].high) == pytest.approx((1e1, 1e4))
    assert low["drag"] == intervals["drag"]
    near_zero = {"drag": SearchVariable(low=1.0, high=9.0)}
    assert widened(near_zero, {"drag": 1.0})["drag"].low == 0.0


def valley(best: float) -> Callable[[SimulationParameters], float]:
    return lambda parameters: math.log(parameters.stiffness / best) ** 2


def each(evaluate: Callable[[SimulationParameters], float]) -> Evaluate:
    return lambda candidates: [(candidate, evaluate(candidate)) for candidate in candidates]


def test_a_search_that_ends_at_a_bound_goes_on_beyond_it() -> None:
    config = SearchConfig(
        generations=12, population=8, variables={"stiffness": STIFFNESS, "drag": DRAG}
    )
    start = SimulationParameters(stiffness=1e3)
    stopped = search_parameters(each(valley(5e4)), start, config, NullProgress())
    assert stopped.parameters.stiffness == pytest.approx(1e4, rel=0.1)
    assert stopped.widened == ()
    assert stopped.note == ""
    config = config.replace(widening_generations=8)
    result = search_parameters(each(valley(5e4)), start, config, NullProgress())
    assert result.widened == ("stiffness",)
    assert result.intervals["stiffness"].high == pytest.approx(1e5)
    assert result.intervals["drag"] == DRAG
    assert result.parameters.stiffness == pytest.approx(5e4, rel=0.2)
    assert result.loss_after < 0.1 * stopped.loss_after
    assert len(result.curve) == 1 + 12 + 8
    assert "stiffness to 100 to 1e+05 N" in result.note
    inside = search_parameters(each(valley(1e3)), start, config, NullProgress())
    assert inside.widened == ()
    assert len(inside.curve) == 1 + 12
    assert replace(inside, curve=[]).intervals == config.variables
