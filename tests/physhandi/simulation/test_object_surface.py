"""Smooth surfaces of shapes whose vertices, areas and volumes are known, and how they move."""

import numpy as np
import pytest
from support.physics.measured_triangles import area, directed_edges, euler, grid, volume

from physhandi.simulation.object_surface import lay_surface

_OCTAHEDRON = np.concatenate([np.eye(3), -np.eye(3)])
_TURN = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])
"""A rotation."""


def sheet_nodes(count=12):
    x, y = grid(count)
    return np.stack([x, y, 0.0 * x], axis=1)


def block_nodes(count=6):
    line = np.linspace(0.0, 1.0, count)
    return np.stack(np.meshgrid(line, line, line), axis=-1).reshape(-1, 3)


def rope_nodes(count=60):
    """A rope one metre long whose nodes lie 2 cm apart, in turn on either side of its middle."""
    along = np.linspace(0.0, 1.0, count)
    aside = 0.004 * (-1.0) ** np.arange(count)
    return np.stack([along, aside, 0.2 + 0.0 * along], axis=1)


def test_a_flat_sheet_keeps_its_corners_and_straight_borders_and_looks_up():
    node = sheet_nodes()
    surface = lay_surface(node, kind="sheet")
    vertex = surface.place(node)
    assert surface.vertex_count == len(vertex) == 45**2  # Two levels, of three the last too many.
    assert area(vertex, surface.face) == pytest.approx(1.0, abs=1e-6)
    assert euler(surface.face) == 1
    a, b, c = (vertex[surface.face[:, k]] for k in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()


def test_a_subdivided_octahedron_has_loops_vertices():
    surface = lay_surface(_OCTAHEDRON, kind="solid", most_vertices=20)
    vertex = surface.place(_OCTAHEDRON)
    # Corners have four neighbors, whose mean is the middle: each step leaves 1 - 4 · 3/32 of them.
    np.testing.assert_allclose(vertex[:6], 0.625**2 * _OCTAHEDRON, atol=1e-6)
    # An edge's middle has 3/8 of both ends, and 1/8 of two that are opposite to each other.
    np.testing.assert_allclose(
        np.sort(np.abs(vertex[6:]), axis=1), np.tile([0, 0.234375, 0.234375], (12, 1)), atol=1e-6
    )
    assert volume(vertex.astype(float), surface.face) > 0.1


def test_a_block_becomes_a_closed_body_that_is_turned_outwards():
    node = block_nodes()
    surface = lay_surface(node, kind="solid")
    edges = directed_edges(surface.face)
    assert set(edges.values()) == {1}
    assert all((b, a) in edges for a, b in edges)
    assert euler(surface.face) == 2
    assert 0.8 < volume(surface.place(node).astype(float), surface.face) < 1.0


@pytest.mark.parametrize(
    ("node", "kind"), [(sheet_nodes(8), "sheet"), (block_nodes(5), "solid"), (rope_nodes(), "rope")]
)
def test_a_surface_moves_with_its_nodes(node, kind):
    surface = lay_surface(node, kind=kind)
    moved = surface.place(node @ _TURN.T + [0.3, -0.2, 0.1])
    expected = surface.place(node) @ _TURN.T + [0.3, -0.2, 0.1]
    if kind == "rope":  # About itself a tube may be turned: nodes on a line do not tell.
        moved, expected = (p[1:-1].reshape(-1, 12, 3).mean(axis=1) for p in (moved, expected))
    np.testing.assert_allclose(moved, expected, atol=1e-5)
    # Values of the nodes are carried along: linear ones stay linear where no border cuts them off.
    value = surface.carry(node[:, 0])
    offset = surface.place(node)[:, 0] - value
    assert np.abs(offset).max() < (0.02 if kind == "rope" else 1e-5)
    # None is beyond all others, which the ends of a rope would be.
    ends = (node[:, 0] > 0.9).astype(float)
    assert (surface.carry(ends).min(), surface.carry(ends).max()) == (0.0, 1.0)


def test_a_rope_becomes_a_tube_of_its_thickness():
    node = rope_nodes()
    surface = lay_surface(node, kind="rope", thickness=0.02)
    vertex = surface.place(node).astype(float)
    assert euler(surface.face) == 2
    middle = vertex[(vertex[:, 0] > 0.1) & (vertex[:, 0] < 0.9)]
    assert np.hypot(middle[:, 1], middle[:, 2] - 0.2) == pytest.approx(0.01, abs=1e-4)
    twelve = 12 * np.sin(np.pi / 6) / 2  # Area of its section, a regular polygon, in radii².
    assert volume(vertex, surface.face) == pytest.approx(twelve * 0.01**2 * 1.01, rel=0.02)


def test_a_rope_that_turns_back_is_not_pinched_or_twisted():
    node = rope_nodes(120)
    surface = lay_surface(node, kind="rope", thickness=0.02)
    turn = 1.5 * np.pi * node[:, 0]
    radius = 0.15 + node[:, 1]
    bent = np.stack([radius * np.cos(turn), radius * np.sin(turn), node[:, 2]], axis=1)
    vertex = surface.place(bent).astype(float)
    ring = vertex[1:-1].reshape(-1, 12, 3)[4:-4]
    middle = ring.mean(axis=1, keepdims=True)
    assert np.linalg.norm(ring - middle, axis=2) == pytest.approx(0.01, abs=1e-5)
    # A ring's vertex is ahead of the same one of the ring before: the bow is not turned about it.
    step, ahead = np.diff(ring, axis=0), np.diff(middle, axis=0)
    ahead /= np.linalg.norm(ahead, axis=2, keepdims=True)
    aside = step - np.sum(step * ahead, axis=2, keepdims=True) * ahead
    assert np.linalg.norm(aside, axis=2).max() < 3e-4


def test_a_thin_line_of_nodes_is_a_rope_without_being_told():
    surface = lay_surface(np.linspace(0, 1, 40)[:, None] * [1.0, 2.0, 0.5])
    assert surface.tube is not None
    assert surface.node_count == 40


def test_unknown_values_stay_unknown_around_their_nodes():
    node = sheet_nodes(8)
    surface = lay_surface(node, kind="sheet")
    value = np.where(node[:, 0] < 0.5, np.nan, 7.0)
    place, carried = surface.place(node), surface.carry(value)
    assert np.isnan(carried[place[:, 0] < 0.4]).all()
    np.testing.assert_allclose(carried[place[:, 0] > 0.6], 7.0, rtol=1e-5)


def test_a_shell_of_scattered_nodes_is_closed_and_keeps_its_inside_empty():
    index = np.arange(400) + 0.5
    height, turn = 1 - 2 * index / 400, np.pi * (1 + 5**0.5) * index
    ring = np.sqrt(1 - height**2)
    node = np.stack([ring * np.cos(turn), ring * np.sin(turn), height], axis=1)
    surface = lay_surface(node, kind="shell")
    vertex = surface.place(node).astype(float)
    assert euler(surface.face) == 2
    assert np.linalg.norm(vertex, axis=1) == pytest.approx(0.99, abs=0.01)
    assert volume(vertex, surface.face) == pytest.approx(4 / 3 * np.pi, rel=0.05)


@pytest.mark.parametrize(
    ("node", "kind"),
    [
        (np.zeros((0, 3)), None),
        (np.full((9, 3), np.nan), "sheet"),
        (np.stack([np.cos(a := np.linspace(0, 6.2, 50)), np.sin(a), 0 * a], axis=1), "rope"),
    ],
    ids=["nothing", "not finite", "a closed ring"],
)
def test_what_has_no_surface_gets_none(node, kind):
    assert lay_surface(node, kind=kind) is None


def test_a_thin_rope_of_few_nodes_is_a_tube_round_each_of_them():
    """Nodes at the markers of motion capture: 10 cm apart, two of them near in a grip."""
    angle = np.concatenate([[0.0, 0.08], np.linspace(0.4, 2.8, 7), [3.1]])
    node = 0.3 * np.stack([np.cos(angle), 0.0 * angle, np.sin(angle)], axis=1)
    surface = lay_surface(node, kind="rope", thickness=0.012)
    assert surface is not None
    swung = node + np.stack([0.0 * angle, 0.04 * angle**2, 0.0 * angle], axis=1)
    for moved in (node, swung):
        vertex = surface.place(moved).astype(float)
        nearest = np.linalg.norm(vertex[:, None] - moved, axis=2).min(axis=0)
        np.testing.assert_allclose(nearest, 0.006, atol=0.001)
    assert euler(surface.face) == 2
