"""The mass that is estimated for an object, against bodies whose mass is known."""

import numpy as np
import pytest

from physhandi.data.object_mass import estimated_mass, given_mass
from physhandi.synthetic.bodies.bodies import Body, make_body
from physhandi.triangles import triangle_areas

SPACING = 0.011


def size_of(body: Body) -> float:
    """Length, area or volume of a body [m, m², m³]."""
    if body.dimension == 1:
        return float(np.linalg.norm(np.diff(body.node, axis=0), axis=1).sum())
    if body.dimension == 2:
        return float(triangle_areas(body.node, body.faces).sum())
    a, b, c = (body.node[body.faces[:, corner]] for corner in range(3))
    return float(np.einsum("fd,fd->", a, np.cross(b, c)) / 6.0)


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("cloth", "sheet"),
        ("towel", "sheet"),
        ("rope", "rope"),
        ("plush", "solid"),
        ("pouch", "shell"),
    ],
)
def test_made_up_bodies_weigh_what_is_estimated_within_a_factor_of_two(name, shape):
    body = make_body(name, np.random.default_rng(3), resolution="tiny")
    dimension = {"rope": 1, "sheet": 2, "shell": 2, "solid": 3}[shape]
    count = round(size_of(body) / SPACING**dimension)
    mass = estimated_mass({"shape": shape, "node_count": count, "node_spacing": SPACING})
    assert mass is not None
    assert 0.5 * body.mass < mass.kilograms < 2.0 * body.mass


def test_an_estimate_says_what_it_comes_from():
    mass = estimated_mass({"shape": "sheet", "node_count": 140, "node_spacing": 0.014})
    assert mass is not None
    assert mass.kilograms == pytest.approx(0.0082)
    assert mass.text == "8.2 g"
    assert mass.source == "estimated: a sheet of 274 cm² with 0.3 kg/m²"
    assert mass.force_factor(140) == pytest.approx(5.857e-5, rel=1e-3)
    assert given_mass(2.5).text == "2.5 kg"


@pytest.mark.parametrize(
    "changes",
    [
        {"shape": "blob"},
        {"shape": None},
        {"node_count": 0},
        {"node_count": True},
        {"node_spacing": float("nan")},
        {"node_spacing": "far"},
        {"node_spacing": 1e9},
    ],
)
def test_what_makes_no_sense_is_not_estimated(changes):
    shape = {"shape": "solid", "node_count": 300, "node_spacing": 0.01}
    assert estimated_mass(shape) is not None
    assert estimated_mass(shape | changes) is None
