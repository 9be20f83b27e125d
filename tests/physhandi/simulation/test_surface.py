"""Surfaces of shapes whose area, volume and number of holes are known."""

import numpy as np
import pytest
from support.physics.measured_triangles import area, directed_edges, euler, grid, volume

from physhandi.simulation.surface import triangulate_nodes


def test_a_flat_sheet_becomes_one_disc_that_covers_it_once():
    x, y = grid()
    node = np.stack([x, y, 0 * x], axis=1)
    faces = triangulate_nodes(node)
    assert faces.dtype == np.int32
    assert len(faces) == 2 * 11 * 11
    assert euler(faces) == 1
    assert area(node, faces) == pytest.approx(1.0)
    # Neighbors run through their common edge in opposite directions: all normals agree.
    assert max(directed_edges(faces).values()) == 1
    normal = np.cross(node[faces[:, 1]] - node[faces[:, 0]], node[faces[:, 2]] - node[faces[:, 0]])
    assert abs(np.sign(normal[:, 2]).sum()) == len(faces)


def test_a_sheet_that_is_folded_stays_open_between_its_layers():
    x, y = grid(20)
    turn = np.pi * x
    node = np.stack([np.cos(turn), np.sin(turn), np.pi * y], axis=1)
    node += np.random.default_rng(1).normal(0, 0.005, node.shape)
    faces = triangulate_nodes(node)
    assert euler(faces) == 1
    assert area(node, faces) == pytest.approx(np.pi**2, rel=0.02)
    assert max(directed_edges(faces).values()) == 1


def test_a_block_is_closed_and_turned_outwards():
    line = np.linspace(0.0, 1.0, 7)
    node = np.stack(np.meshgrid(line, line, line), axis=-1).reshape(-1, 3)
    node += np.random.default_rng(2).normal(0, 0.01, node.shape)
    faces = triangulate_nodes(node)
    edges = directed_edges(faces)
    assert set(edges.values()) == {1}
    assert all((b, a) in edges for a, b in edges)
    assert euler(faces) == 2
    assert volume(node, faces) == pytest.approx(1.0, abs=0.06)
    inner = np.flatnonzero((np.abs(node - 0.5) < 0.3).all(axis=1))
    assert len(inner) == 27
    assert not np.isin(inner, faces).any()


@pytest.mark.parametrize(
    "node",
    [
        np.zeros((0, 3)),
        np.eye(3),
        np.zeros((9, 3)),
        np.linspace(0, 1, 40)[:, None] * [1.0, 2.0, 0.5],
        np.full((9, 3), np.nan),
    ],
    ids=["nothing", "three nodes", "one place", "a rope", "not finite"],
)
def test_what_has_no_surface_gets_none(node):
    assert triangulate_nodes(node).shape == (0, 3)
