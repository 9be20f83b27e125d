"""Differences against an oracle that looks at points one by one, in float64."""

from dataclasses import replace

import numpy as np
import pytest
from numpy import ndarray
from support.viewer.viewer_world import FRAMES, PARAMETERS, content_of, controls, sheet

from app.viewer.color.difference import (
    compare_frames,
    rollout_difference,
    summarize,
    surface_difference,
    way_of,
)
from physhandi.object_rollout import ObjectRollout


def moved(offset: ndarray) -> tuple[ObjectRollout, ObjectRollout]:
    """A resting sheet, and one of which node `n` moves by `offset[n]` each frame."""
    first = content_of({}, controls((0.0, 0.0, 1.0))).fitted
    assert first is not None
    way = np.arange(FRAMES)[:, None, None] * offset
    second = replace(first, position=(first.position + way).astype(np.float64))
    return first, second


def test_nodes_of_one_object_are_compared_with_themselves() -> None:
    rng = np.random.default_rng(0)
    offset = rng.normal(size=(len(sheet()), 3)) * 0.003
    first, second = moved(offset)
    assert way_of(first, second) == "nodes"
    expected = np.array(
        [np.sqrt(sum((7 * offset[n, axis]) ** 2 for axis in range(3))) for n in range(len(sheet()))]
    )
    assert expected.mean() > 0.01
    found = rollout_difference(first, 3, second, 7)
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    # The frame counts: another one is not the same.
    assert abs(rollout_difference(first, 3, second, 6) - expected).max() > 1e-3
    told = compare_frames(first, 3, second, 7, "nodes")
    np.testing.assert_allclose(told.mean, expected.mean(), rtol=1e-5)
    np.testing.assert_allclose(told.largest, max(expected), rtol=1e-5)
    np.testing.assert_allclose(told.strong, np.sort(expected)[-5], rtol=0.05)


def test_other_nodes_are_compared_with_the_surface() -> None:
    first, _ = moved(np.zeros((len(sheet()), 3)))
    rng = np.random.default_rng(1)
    inside = rng.uniform(-0.09, 0.09, (50, 2))
    height = rng.uniform(-0.006, 0.006, 50)
    point = np.column_stack([inside, 0.05 + height])
    node = point.astype(np.float32)
    empty = np.zeros(0, np.float32)
    model = replace(
        first.model,
        object_node=node,
        initial_velocity=np.zeros_like(node),
        clearance=np.zeros(len(node), np.float32),
        spring_nodes=np.zeros((0, 2), np.int32),
        attached=np.zeros((0, 2), np.int32),
        rest_length=empty,
        stiffness=empty,
        damping=empty,
        object_spring_count=0,
    )
    second = ObjectRollout(
        model=model,
        parameters=PARAMETERS,
        control=first.control,
        position=np.repeat(point[None], FRAMES, axis=0),
        ready=FRAMES,
    )
    assert way_of(first, second) == "surface"
    # Above the inside of a flat sheet the surface is right below, however it is sampled.
    found = rollout_difference(second, 0, first, 0)
    np.testing.assert_allclose(found, abs(height), atol=1e-6)
    assert abs(found).max() > 5e-3
    # Both ways count: the sheet's own nodes are farther from the few points.
    there = rollout_difference(first, 0, second, 0)
    told = compare_frames(first, 0, second, 0, "surface")
    assert told.largest == max(found.max(), there.max())
    assert told.mean == pytest.approx(np.concatenate([found, there]).mean())


def test_few_or_no_nodes_are_a_surface_too() -> None:
    point = np.array([[0.0, 3.0, 4.0]])
    assert surface_difference(point, np.zeros((0, 3))) == [np.inf]
    assert surface_difference(point, np.zeros((1, 3))) == [5.0]
    ends = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    assert surface_difference(point, ends) == [5.0]
    assert np.isnan(summarize(np.zeros(0)).mean)
