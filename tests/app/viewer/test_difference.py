"""Differences against an oracle that looks at points one by one, in float64."""

from dataclasses import replace

import numpy as np
import pytest
from numpy import ndarray
from scipy.optimize import minimize
from viewer_world import FRAMES, PARAMETERS, content_of, controls, sheet

from app.viewer.color.difference import (
    compare_frames,
    rollout_difference,
    summarize,
    surface_difference,
    triangle_distance,
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
        spring_nodes=np.zeros((0, 2), np.int32),
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


def brute(point: ndarray, corner: ndarray) -> float:
    """The nearest point of a triangle, found by descent over its two coordinates."""
    a, b, c = corner

    def at(uv: ndarray) -> float:
        u, v = uv
        return float(np.sum((a + u * (b - a) + v * (1 - u) * (c - a) - point) ** 2))

    starts = [(x, y) for x in (0.1, 0.5, 0.9) for y in (0.1, 0.5, 0.9)]
    found = [minimize(at, start, bounds=[(0, 1), (0, 1)], tol=1e-14).fun for start in starts]
    return float(np.sqrt(min(found)))


def test_the_distance_to_a_triangle_is_that_of_its_nearest_point() -> None:
    rng = np.random.default_rng(2)
    point, corner = rng.normal(size=(12, 3)), rng.normal(size=(12, 3, 3))
    point[0] = [0.2, 0.3, 2.5]
    corner[0] = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    found = triangle_distance(point, *corner.transpose(1, 0, 2))
    assert found[0] == pytest.approx(2.5)
    expected = [brute(p, c) for p, c in zip(point, corner, strict=True)]
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    # All corners on a line: the triangle is that line.
    line = np.array([[[0.0, 0, 0], [1.0, 0, 0], [0.4, 0, 0]]]).transpose(1, 0, 2)
    assert triangle_distance(np.array([[0.5, 0.3, 0.4]]), *line) == pytest.approx([0.5])
    assert triangle_distance(np.array([[4.0, 0.0, 4.0]]), *line) == pytest.approx([5.0])


def test_few_or_no_nodes_are_a_surface_too() -> None:
    point = np.array([[0.0, 3.0, 4.0]])
    assert surface_difference(point, np.zeros((0, 3))) == [np.inf]
    assert surface_difference(point, np.zeros((1, 3))) == [5.0]
    ends = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    assert surface_difference(point, ends) == [5.0]
    assert np.isnan(summarize(np.zeros(0)).mean)
