from typing import get_args

import numpy as np
import pytest

from physhandi.errors import UsageError
from physhandi.synthetic.bodies.bodies import BodyName, make_body
from physhandi.synthetic.bodies.tubes import ROUND, tube_faces, tube_vertices

NAMES = get_args(BodyName)


def rng(seed=3):
    return np.random.default_rng(seed)


def volume(vertex, faces):
    a, b, c = (vertex[faces[:, corner]] for corner in range(3))
    return np.einsum("fd,fd->", a, np.cross(b, c)) / 6


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("resolution", ["fine", "tiny"])
def test_a_body_lies_on_the_ground_about_the_origin(name, resolution):
    body = make_body(name, rng(), resolution=resolution)
    assert body.node[:, 2].min() == pytest.approx(body.radius)
    assert np.abs((body.node.min(axis=0) + body.node.max(axis=0))[:2]).max() < 0.03
    assert body.size[0] >= body.size[1]
    np.testing.assert_allclose(np.ptp(body.node, axis=0), body.size)
    low, high = (40, 1000) if resolution == "fine" else (30, 441)
    assert low < body.node_count <= high
    assert set(np.unique(body.elements)) == set(range(body.node_count))
    assert len(body.element_stiffness) == len(body.elements)
    assert 0.009 < body.mass < 0.5


@pytest.mark.parametrize("name", NAMES)
def test_the_same_seed_gives_the_same_body_and_another_one_another(name):
    first, again, other = (make_body(name, rng(seed), resolution="tiny") for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.node, again.node)
    assert (first.stiffness, first.mass) == (again.stiffness, again.mass)
    assert first.stiffness != other.stiffness
    assert first.size != other.size


@pytest.mark.parametrize("name", ["plush", "pouch", "rope"])
def test_a_closed_skin_has_every_edge_twice_and_faces_outwards(name):
    body = make_body(name, rng())
    assert body.faces.max() + 1 == len(body.skin_node)
    edge = np.concatenate([body.faces[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])
    directed = {tuple(e) for e in edge.tolist()}
    assert len(directed) == len(edge)
    assert directed == {(b, a) for a, b in directed}
    skin = body.skin(body.node[None])[0]
    box = np.prod(np.ptp(skin, axis=0))
    share = volume(skin, body.faces) / box
    assert {"plush": 0.28, "pouch": 0.5, "rope": 0.1}[name] < share < 0.8


def test_tetrahedra_fill_the_plush():
    body = make_body("plush", rng())
    edge = body.node[body.elements[:, 1:]] - body.node[body.elements[:, :1]]
    each = np.linalg.det(edge) / 6
    assert each.min() > 0
    assert each.sum() == pytest.approx(volume(body.node, body.faces))
    assert 80 < body.mass / each.sum() < 140
    core = np.argmin(np.linalg.norm(body.node[body.elements].mean(axis=1)[:, :2], axis=1))
    tip = np.argmax(np.abs(body.node[body.elements].mean(axis=1)[:, 1]))
    assert body.element_stiffness[tip] == 1.0
    assert body.element_stiffness[core] > 1.8


def test_shells_cover_their_sheet():
    cloth = make_body("cloth", rng())
    a, b, c = (cloth.node[cloth.faces[:, corner]] for corner in range(3))
    area = np.cross(b - a, c - a)[:, 2].sum() / 2
    assert area == pytest.approx(cloth.size[0] * cloth.size[1])
    assert 0.15 < cloth.mass / area < 0.25


def test_a_rope_is_as_long_as_it_is_made_of_equal_pieces():
    rope = make_body("rope", rng())
    piece = np.linalg.norm(np.diff(rope.node, axis=0), axis=1)
    assert 0.55 < piece.sum() < 0.65
    assert piece.max() / piece.min() < 1.01
    assert piece.min() > rope.thickness
    assert rope.size[1] > 0.015


def test_unknown_names_are_told_with_the_known_ones():
    with pytest.raises(UsageError, match=r"'sock'.*cloth, towel, rope, plush, pouch"):
        make_body("sock", rng())
    with pytest.raises(UsageError, match="'huge'"):
        make_body("rope", rng(), resolution="huge")


def test_a_tube_is_round_and_as_large_as_it_should_be():
    line = np.column_stack([np.zeros(11), np.linspace(0, 0.5, 11), np.zeros(11)])
    vertex = tube_vertices(line[None], 0.02)[0]
    np.testing.assert_allclose(np.hypot(vertex[:, 0], vertex[:, 2]), 0.02)
    octagon = ROUND / 2 * np.sin(2 * np.pi / ROUND) * 0.02**2
    assert volume(vertex, tube_faces(11)) == pytest.approx(octagon * 0.5)


def test_a_tube_turns_with_its_line_and_keeps_its_side():
    line = np.column_stack([np.linspace(0, 1, 9), np.zeros(9), np.zeros(9)])
    angle = np.linspace(0, np.pi / 2, 31)
    turn = np.stack(
        [
            np.stack([np.cos(angle), -np.sin(angle), 0 * angle], 1),
            np.stack([np.sin(angle), np.cos(angle), 0 * angle], 1),
            np.stack([0 * angle, 0 * angle, 1 + 0 * angle], 1),
        ],
        axis=1,
    )
    vertex = tube_vertices(np.einsum("fij,nj->fni", turn, line), 0.1)
    np.testing.assert_allclose(vertex[-1], vertex[0] @ turn[-1].T, atol=1e-12)
