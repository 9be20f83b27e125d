"""Which distances let springs form at frame 0, judged beside the springs that are built."""

import numpy as np
import pytest

from physhandi.data.observation import ObjectObservation
from physhandi.errors import FitError, UsageError
from physhandi.fitting.config import SearchConfig, SearchVariable
from physhandi.fitting.object_problem import ObjectProblem, build_problem
from physhandi.fitting.object_reconstruction import check_problem, check_springs
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.topology import build_model

NODE = np.array([[0.0, 0, 0], [0.01, 0, 0], [0.03, 0, 0]], np.float32)
CONTROL = np.array([[0.0, 0.004, 0], [0.0, 0.5, 0]], np.float32)


def problem(node: np.ndarray = NODE) -> ObjectProblem:
    """Two frames of an object that rests while two control nodes are somewhere."""
    seen = np.ones((2, len(node)), bool)
    return build_problem(
        name="lift",
        observation=ObjectObservation(
            point=np.stack([node, node]),
            is_visible=seen,
            is_motion_valid=seen,
            node_of_track=np.arange(len(node), dtype=np.int32),
        ),
        object_node=node,
        rest_node=node,
        control=np.stack([CONTROL, CONTROL]),
        hand_face=np.zeros((0, 3), np.int32),
        frame_count=2,
        frame_rate=30.0,
        ground_height=None,
        gravity=9.81,
    )


def searched(**highs: float) -> SearchConfig:
    intervals = {name: SearchVariable(low=1e-4, high=high) for name, high in highs.items()}
    return SearchConfig(variables=intervals)


@pytest.mark.parametrize("radius", [0.0039, 0.0041])
@pytest.mark.parametrize("is_searched", [True, False])
def test_controls_must_be_within_the_widest_radius(radius: float, is_searched: bool) -> None:
    start = SimulationParameters(virtual_connection_radius=1e-3 if is_searched else radius)
    config = searched(virtual_connection_radius=radius) if is_searched else SearchConfig()
    widest = start.replace(virtual_connection_radius=radius)
    holds = build_model(NODE, CONTROL, widest).virtual_spring_count > 0
    assert holds == (radius > 0.004)
    if holds:
        check_problem(problem(), start, config)
        return
    with pytest.raises(FitError, match=r"0\.004 m or more away .* reach 0\.0039 m at most"):
        check_problem(problem(), start, config)


@pytest.mark.parametrize("radius", [0.0099, 0.0101])
def test_nodes_must_be_within_the_widest_radius(radius: float) -> None:
    start = SimulationParameters(connection_radius=1e-3, virtual_connection_radius=0.01)
    config = searched(connection_radius=radius)
    widest = start.replace(connection_radius=radius)
    joins = build_model(NODE, CONTROL, widest).object_spring_count > 0
    assert joins == (radius > 0.01)
    if joins:
        check_problem(problem(), start, config)
        return
    with pytest.raises(FitError, match=r"3 object nodes are 0\.01 m or more apart"):
        check_problem(problem(), start, config)


def test_one_node_needs_no_spring_of_its_own() -> None:
    start = SimulationParameters(virtual_connection_radius=0.01)
    check_problem(problem(NODE[:1]), start, SearchConfig())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({}, None),
        ({"connection_radius": 0.009}, r"No object spring .* nearest nodes are 0\.01 m apart"),
        ({"max_neighbors": 0}, "No object spring .* max_neighbors is 0"),
        ({"virtual_connection_radius": 0.003}, r"No virtual spring .* is 0\.004 m from the object"),
        ({"virtual_max_neighbors": 0}, "No virtual spring .* virtual_max_neighbors is 0"),
    ],
)
def test_parameters_must_leave_springs(changes: dict[str, float], message: str | None) -> None:
    parameters = SimulationParameters.from_dict(changes)
    model = build_model(NODE, CONTROL, parameters)
    if message is None:
        check_springs("lift", model, parameters, CONTROL, NODE)
        return
    with pytest.raises(UsageError, match=message):
        check_springs("lift", model, parameters, CONTROL, NODE)


def test_an_object_without_controls_may_fall() -> None:
    parameters = SimulationParameters()
    model = build_model(NODE, CONTROL[:0], parameters)
    check_springs("lift", model, parameters, CONTROL[:0], NODE)
