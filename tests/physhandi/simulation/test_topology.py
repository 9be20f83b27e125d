"""δ and d_max against brute force, floors, and what a new topology keeps."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import TypeCheckError
from support.property_tests import SAME_EVERYWHERE

from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.topology import (
    build_model,
    half_edges,
    object_springs,
    retopologize,
    split_rows,
    virtual_springs,
)

PARAMETERS = SimulationParameters(
    connection_radius=0.15, max_neighbors=5, virtual_connection_radius=0.2
)


def cloud(seed, count):
    return np.random.default_rng(seed).uniform(0.0, 0.3, (count, 3))


def brute_force(query, node, radius, most, *, is_same):
    """Propose, for each query point, its nearest nodes by a plain scan."""
    proposals = []
    for i, point in enumerate(query):
        distance = [(np.sqrt(((other - point) ** 2).sum()), j) for j, other in enumerate(node)]
        others = sorted(item for item in distance if not (is_same and item[1] == i))
        proposals += [(i, j) for length, j in others[:most] if length < radius]
    return proposals


@settings(SAME_EVERYWHERE, max_examples=40)
@given(
    st.integers(0, 10_000), st.integers(0, 40), st.floats(0.01, 0.3), st.integers(0, 45)
)  # fmt: skip
def test_object_springs_are_the_union_of_what_nodes_propose(seed, count, radius, most):
    node = cloud(seed, count)
    springs, length = object_springs(node, radius, most)
    expected = {tuple(sorted(pair)) for pair in brute_force(node, node, radius, most, is_same=True)}
    assert [tuple(pair) for pair in springs.tolist()] == sorted(expected)
    np.testing.assert_allclose(
        length, [np.linalg.norm(node[i] - node[j]) for i, j in springs], rtol=1e-12
    )


@settings(SAME_EVERYWHERE, max_examples=40)
@given(
    st.integers(0, 10_000),
    st.integers(0, 30),
    st.integers(0, 8),
    st.floats(0.01, 0.3),
    st.integers(0, 12),
)
def test_virtual_springs_are_what_control_nodes_propose(seed, count, controls, radius, most):
    node, control = cloud(seed, count), cloud(seed + 1, controls)
    springs, length = virtual_springs(control, node, radius, most)
    expected = brute_force(control, node, radius, most, is_same=False)
    assert [tuple(pair) for pair in springs.tolist()] == sorted((j, count + i) for i, j in expected)
    ends = [np.linalg.norm(node[i] - control[j - count]) for i, j in springs]
    np.testing.assert_allclose(length, ends, rtol=1e-12)


def test_a_row_of_nodes_gets_the_springs_one_expects():
    node = np.arange(5.0)[:, None] * np.array([1.0, 0.0, 0.0])
    assert object_springs(node, 1.0, 4)[0].tolist() == [], "the radius itself is excluded"
    assert object_springs(node, 1.001, 4)[0].tolist() == [[0, 1], [1, 2], [2, 3], [3, 4]]
    assert len(object_springs(node, 9.0, 4)[0]) == 10
    # d_max limits what a node proposes, not what it gets: the middle one is in all its ends' lists.
    springs, _ = object_springs(
        np.array([[0.0, 0, 0], [1, 0, 0], [-1.1, 0, 0], [0, 1.2, 0]]), 9.0, 1
    )
    assert springs.tolist() == [[0, 1], [0, 2], [0, 3]]


def test_nodes_on_top_of_each_other_are_not_joined():
    node = np.array([[0.0, 0, 0], [0, 0, 0], [0, 0, 0.9e-4], [0, 0, 0.01]])
    springs, length = object_springs(node, 0.02, 3)
    assert springs.tolist() == [[0, 3], [1, 3], [2, 3]]
    np.testing.assert_allclose(length, [0.01, 0.01, 0.00991])


def test_a_model_has_floors_and_global_values():
    node = np.array([[0.0, 0, 0], [0, 0, 5e-4], [0, 0, 0.1]])
    control = np.array([[0.0, 0, 0], [0, 0, 0.099], [9, 9, 9]])
    parameters = PARAMETERS.replace(
        stiffness=10.0, virtual_stiffness=20.0, damping=3.0, virtual_max_neighbors=1,
        rest_length_floor=1e-3, virtual_rest_length_floor=2e-3,
    )  # fmt: skip
    model = build_model(node, control, parameters)
    assert model.spring_nodes.tolist() == [[0, 1], [0, 2], [1, 2], [0, 3], [2, 4]]
    np.testing.assert_allclose(model.rest_length, [1e-3, 0.1, 0.0995, 2e-3, 2e-3], rtol=1e-6)
    assert model.stiffness.tolist() == [10, 10, 10, 20, 20]
    assert model.damping.tolist() == [3] * 5
    assert (model.object_spring_count, model.virtual_spring_count, model.control_count) == (3, 2, 3)
    bare = build_model(
        node, control, parameters.replace(rest_length_floor=0.0, virtual_rest_length_floor=0.0)
    )
    np.testing.assert_allclose(bare.rest_length, [5e-4, 0.1, 0.0995, 1e-6, 1e-3], rtol=1e-4)


def test_a_spring_without_stiffness_is_off_with_its_dashpot():
    node = np.array([[0.0, 0, 0], [0, 0, 0.05]])
    control = np.array([[0.0, 0, 0.01]])
    parameters = PARAMETERS.replace(stiffness=0.0, virtual_stiffness=20.0, damping=3.0)
    model = build_model(node, control, parameters.replace(virtual_max_neighbors=1))
    assert model.stiffness.tolist() == [0, 20]
    assert model.damping.tolist() == [0, 3]


def test_the_rest_shape_decides_object_springs_but_not_virtual_ones():
    rest = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.4, 0, 0]])
    node = rest * 2.0
    model = build_model(node, np.array([[0.8, 0.05, 0.0]]), PARAMETERS, rest_node=rest)
    assert model.spring_nodes.tolist() == [[0, 1], [2, 3]]
    np.testing.assert_allclose(model.rest_length, [0.1, 0.05], rtol=1e-6)
    np.testing.assert_array_equal(model.object_node, node.astype(np.float32))


def test_the_same_nodes_give_the_same_springs_each_time():
    grid = np.stack(np.meshgrid(*[np.arange(6) * 0.01] * 3), axis=-1).reshape(-1, 3)
    first = build_model(grid, grid[:3], PARAMETERS.replace(connection_radius=0.02))
    second = build_model(grid.copy(), grid[:3].copy(), PARAMETERS.replace(connection_radius=0.02))
    assert len(first.spring_nodes) > 500
    assert first.spring_nodes.tobytes() == second.spring_nodes.tobytes()


def test_a_new_topology_keeps_what_was_fitted_as_a_ratio():
    node, control = cloud(3, 30), cloud(4, 4)
    fitted = PARAMETERS.replace(stiffness=100.0, virtual_stiffness=50.0, damping=2.0)
    built = build_model(node, control, fitted)
    factor = np.random.default_rng(5).uniform(0.5, 2.0, len(built.spring_nodes)).astype(np.float32)
    model = replace(
        built, stiffness=built.stiffness * factor, damping=built.damping / factor,
        initial_velocity=np.full((30, 3), 0.1, dtype=np.float32),
        clearance=np.linspace(0.0, 0.01, 30, dtype=np.float32),
    )  # fmt: skip
    changed = fitted.replace(connection_radius=0.12, max_neighbors=7, stiffness=300.0, damping=5.0)
    new = retopologize(model, changed, control, fitted=fitted)
    known = {
        frozenset(pair): value
        for pair, value in zip(built.spring_nodes.tolist(), factor, strict=True)
    }
    ratio = np.array([known.get(frozenset(pair), 1.0) for pair in new.spring_nodes.tolist()])
    assert 20 < np.sum(ratio != 1.0) < len(ratio)
    is_object = np.arange(len(ratio)) < new.object_spring_count
    np.testing.assert_allclose(new.stiffness, ratio * np.where(is_object, 300.0, 50.0), rtol=1e-6)
    np.testing.assert_allclose(new.damping, 5.0 / ratio, rtol=1e-6)
    np.testing.assert_array_equal(new.initial_velocity, model.initial_velocity)
    np.testing.assert_array_equal(new.clearance, model.clearance)
    same = retopologize(model, fitted, control, fitted=fitted)
    np.testing.assert_array_equal(same.spring_nodes, model.spring_nodes)
    np.testing.assert_allclose(same.stiffness, model.stiffness, rtol=1e-6)


def test_half_edges_list_each_spring_at_both_of_its_nodes():
    start, entry = half_edges(np.array([[0, 1], [0, 3], [1, 3]], dtype=np.int32), 4)
    assert start.tolist() == [0, 2, 4, 4, 6]
    assert [sorted(entry[a:b].tolist()) for a, b in pairwise(start)] == [
        [0, 1], [-1, 2], [], [-3, -2]
    ]  # fmt: skip


def test_long_sums_are_cut_into_rows_that_cover_every_entry_once():
    row, first = split_rows(np.array([0, 5, 5, 9, 10], dtype=np.int32), 2)
    assert row.tolist() == [0, 2, 4, 5, 7, 9, 10]
    assert first.tolist() == [0, 3, 3, 5, 6]


def test_a_rest_shape_of_another_size_is_refused():
    with pytest.raises((ValueError, TypeCheckError), match="rest_node"):
        build_model(cloud(0, 3), cloud(0, 0), PARAMETERS, rest_node=cloud(0, 2))
