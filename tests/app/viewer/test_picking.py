"""Clicks at places of which it is known what lies there."""

from dataclasses import replace

import numpy as np
import pytest
from support.viewer.viewer_world import content_of, controls

from app.viewer.content.layers import Layers
from app.viewer.inspect.picking import Pick, Ray, Target, first_triangle, nearest_on_segments, pick
from physhandi.simulation.object_surface import lay_surface

EYE = np.array([0.0, 0.0, 1.0])


def ray_to(target, eye=EYE, pixel=1e-3):
    way = np.asarray(target, dtype=np.float64) - eye
    return Ray(origin=np.asarray(eye), direction=way / np.linalg.norm(way), pixel=pixel)


@pytest.fixture(scope="module")
def world():
    """A sheet at z = 0.05 m below 30 controls and a hand of two triangles at z = 0.2 m."""
    vertex = np.array([[-1, -1, 0.2], [1, -1, 0.2], [1, 1, 0.2], [-1, 1, 0.2]], np.float32)
    face = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return content_of({"right": (vertex, face)}, controls((0, 0, 1)))


def target_of(world, layers, spacing=0.025):
    return Target(
        content=world,
        rollout=world.fitted,
        frame=0,
        rollout_frame=0,
        layers=layers,
        spacing=spacing,
    )


def click(world, target, *, layers, **options):
    return pick(ray_to(target), target_of(world, layers), **options)


def test_a_click_on_a_node_finds_it_through_the_hand(world):
    node = world.fitted.position[0]
    for index in (0, 40, 80):
        found = click(world, node[index], layers=Layers(controls=False, virtual_springs=False))
        assert found == Pick(kind="node", index=index)
    only_hand = click(world, node[40], layers=Layers(), prefers_hand=True)
    assert only_hand == Pick(kind="hand", index=0, side="right") or only_hand.kind == "hand"


def test_what_is_hidden_cannot_be_clicked(world):
    target = world.fitted.position[0][40]
    nothing = Layers(hands=False, nodes=False, controls=False, virtual_springs=False)
    assert click(world, target, layers=nothing) is None
    hand = click(world, target, layers=Layers(nodes=False, controls=False, virtual_springs=False))
    assert hand.kind == "hand"


def test_a_click_between_two_nodes_finds_their_spring(world):
    model = world.fitted.model
    layers = Layers(hands=False, controls=False, virtual_springs=False, object_springs=True)
    lengths = np.round(model.rest_length[: model.object_spring_count], 4)
    spring = int(np.argmin(lengths))
    ends = world.fitted.position[0][model.spring_nodes[spring]]
    found = click(world, ends.mean(axis=0), layers=layers)
    assert found.kind == "spring"
    assert found.index < model.object_spring_count
    got = world.fitted.position[0][model.spring_nodes[found.index]]
    np.testing.assert_allclose(got.mean(axis=0), ends.mean(axis=0), atol=1e-6)


def test_a_control_node_is_found_where_it_holds_the_object(world):
    model = world.fitted.model
    held = np.unique(model.spring_nodes[model.object_spring_count :].max(axis=1)) - model.node_count
    target = world.fitted.control[0][held[3]]
    layers = Layers(nodes=False, hands=False)
    assert click(world, target, layers=layers) == Pick(kind="control", index=int(held[3]))


def test_on_the_surface_the_nearest_node_counts_unless_a_hand_is_before_it(world):
    layers = Layers(nodes=False, controls=False, virtual_springs=False, hands=False, surface=True)
    node = world.fitted.position[0]
    shown = replace(world, surface=lay_surface(node, kind="sheet"))
    inside = 0.6 * node[20] + 0.2 * node[11] + 0.2 * node[12]
    assert click(shown, inside, layers=layers) == Pick(kind="node", index=20)
    assert click(shown, node[80] + [0.1, 0.1, 0.0], layers=layers) is None
    assert click(world, inside, layers=layers) is None
    # The hand is a sheet above the object.
    assert click(shown, inside, layers=replace(layers, hands=True)).kind == "hand"


def test_a_click_beside_everything_finds_nothing(world):
    assert click(world, [5.0, 5.0, 0.0], layers=Layers()) is None


def test_the_nearer_of_two_nodes_in_a_line_is_meant(world):
    layers = Layers(hands=False, controls=False, virtual_springs=False)
    node = world.fitted.position[0]
    edge_on = ray_to(node[4], eye=node[4] + [0.0, -1.0, 0.001])
    found = pick(edge_on, target_of(world, layers, spacing=0.001))
    assert found == Pick(kind="node", index=4)


def test_pixels_and_depths_of_points():
    ray = Ray(origin=np.zeros(3), direction=np.array([1.0, 0, 0]), pixel=0.01)
    pixels, depth = ray.offsets(np.array([[2.0, 0.1, 0.0], [-1.0, 0.0, 0.0], [5.0, 0, 0]]))
    assert pixels.tolist() == pytest.approx([5.0, np.inf, 0.0])
    assert depth.tolist() == [2.0, -1.0, 5.0]


def test_the_nearest_point_of_a_segment_and_the_first_triangle():
    ray = Ray(origin=np.zeros(3), direction=np.array([1.0, 0, 0]), pixel=0.01)
    ends = np.array([[[2, -1, 1], [2, 3, 1]], [[3, 1, 0], [3, 2, 0]], [[1, 0, 0], [4, 0, 0.0]]])
    np.testing.assert_allclose(nearest_on_segments(ray, ends)[:2], [[2, 0, 1], [3, 1, 0]])
    vertex = np.array([[4.0, -1, -1], [4, 3, -1], [4, -1, 3], [2, -1, -1], [2, 3, -1], [2, -1, 3]])
    face = np.array([[0, 1, 2], [3, 5, 4]])
    assert first_triangle(ray, vertex, face) == (1, pytest.approx(2.0))
    assert first_triangle(ray, vertex + np.array([0, 5, 0]), face) is None
    assert first_triangle(ray, -vertex, face) is None
