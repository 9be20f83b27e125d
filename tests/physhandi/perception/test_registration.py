"""A known object laid onto a cloud: found again when turned, and bent when it is bent there."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from physhandi.perception.registration import bend_object, lay_object

SPACING = 0.01


def test_a_turned_object_is_found_again() -> None:
    random = np.random.default_rng(0)
    template = np.stack(
        [random.uniform(0, 0.3, 300), random.uniform(0, 0.1, 300), np.zeros(300)], axis=1
    )
    template[:, 2] = 0.05 * (template[:, 0] > 0.2)
    turn = Rotation.from_euler("zyx", [2.0, 0.1, -0.05])
    expected = turn.apply(template) + np.array([0.4, -0.2, 0.1])
    cloud = expected[random.permutation(300)[:200]] + random.normal(0, 1e-4, (200, 3))
    laid = lay_object(template.astype(np.float32), cloud)
    assert np.linalg.norm(laid - expected, axis=1).mean() < 2e-3
    assert np.linalg.norm(template - expected, axis=1).mean() > 0.2


def rolled(flat, radius=0.08, begin=0.1):
    """Roll a flat sheet upwards from x = `begin` on, about a cylinder: no length in it changes."""
    way = np.maximum(flat[:, 0] - begin, 0.0)
    x = np.minimum(flat[:, 0], begin) + radius * np.sin(way / radius)
    z = radius * (1.0 - np.cos(way / radius))
    return np.column_stack([x, flat[:, 1], z])


def sheet(spacing, length=0.24, width=0.12):
    x, y = np.meshgrid(np.arange(0, length, spacing), np.arange(0, width, spacing))
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])


def seen(bend, noise=0.001, count=1200):
    """Points anywhere on the bent sheet, with the errors of a sensor."""
    random = np.random.default_rng(4)
    flat = random.uniform([-0.005, -0.005, 0.0], [0.235, 0.115, 0.0], (count, 3))
    return bend(flat) + random.normal(0.0, noise, flat.shape)


@pytest.fixture(scope="module")
def bent():
    return bend_object(sheet(SPACING), seen(rolled))


def test_a_flat_sheet_is_bent_to_a_rolled_one(bent) -> None:
    flat, expected = sheet(SPACING), rolled(sheet(SPACING))
    assert np.linalg.norm(expected - flat, axis=1).max() > 0.07
    error = np.linalg.norm(bent - expected, axis=1)
    assert error.mean() < 0.0055
    assert error.max() < 0.008
    assert bent.dtype == np.float32


def test_it_bends_but_hardly_stretches(bent) -> None:
    flat = sheet(SPACING)
    pairs = np.argwhere(np.triu(np.linalg.norm(flat[:, None] - flat, axis=2) < 1.5 * SPACING, 1))
    before, after = (
        np.linalg.norm(node[pairs[:, 0]] - node[pairs[:, 1]], axis=1) for node in (flat, bent)
    )
    assert np.abs(after / before - 1.0).mean() < 0.03


def test_what_is_hidden_follows_its_surroundings() -> None:
    cloud = seen(rolled)
    is_hidden = (np.abs(cloud[:, 1] - 0.06) < 0.025) & (cloud[:, 2] > 0.01)
    assert is_hidden.mean() > 0.1
    node = bend_object(sheet(SPACING), cloud[~is_hidden])
    error = np.linalg.norm(node - rolled(sheet(SPACING)), axis=1)
    assert error.mean() < 0.0055
    assert error.max() < 0.012


def test_no_node_is_bent_below_the_ground() -> None:
    cloud = seen(np.asarray, noise=0.003, count=400) + np.array([0.0, 0.0, 0.3])
    start = sheet(2 * SPACING) + np.array([0.0, 0.0, 0.29])
    assert bend_object(start, cloud)[:, 2].min() < 0.2995
    assert bend_object(start, cloud, 0.3)[:, 2].min() == pytest.approx(0.3, abs=1e-6)
