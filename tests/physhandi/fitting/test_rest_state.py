"""What lies on the ground stays where it was seen: clearances of sheets, ropes and solids."""

from dataclasses import replace

import numpy as np
import pytest

from physhandi.fitted_object import FittedObject
from physhandi.fitting.rest_state import resting_clearance
from physhandi.object_rollout import ObjectRollout
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.topology import build_model

GROUND = 0.3
PARAMETERS = SimulationParameters(
    connection_radius=0.024,
    max_neighbors=20,
    stiffness=3000.0,
    damping=20.0,
    substeps_per_frame=150,
    ground_height=GROUND,
)


def sheet(rise=0.0):
    """Lay a sheet of 12 by 8 nodes 4 to 6 mm above the ground; its last rows rise steeply."""
    x, y = (0.01 * axis.ravel() for axis in np.mgrid[:12, :8])
    wave = 0.005 + 0.001 * np.sin(90.0 * x + 40.0 * y)
    lifted = np.maximum(x - 0.08, 0.0)
    return np.column_stack([x - 0.5 * lifted, y, GROUND + wave + rise * lifted]).astype(np.float32)


def block(layers=4):
    """Stack layers of 6 by 6 nodes, the lowest of them half a layer above the ground."""
    place = np.stack([axis.ravel() for axis in np.mgrid[:6, :6, :layers]], axis=1)
    return (0.01 * place + np.array([0.0, 0.0, GROUND + 0.005])).astype(np.float32)


def test_a_sheet_keeps_each_node_as_high_as_it_was_seen():
    node = sheet()
    clearance = resting_clearance(node, GROUND)
    assert clearance.dtype == np.float32
    assert 0.0039 < clearance.min() < 0.0045
    assert 0.0055 < clearance.max() < 0.0061
    np.testing.assert_allclose(clearance, node[:, 2] - GROUND, atol=1e-6)


def test_lifted_nodes_of_a_sheet_come_to_lie_as_high_as_the_others():
    node = sheet(rise=1.5)
    height = node[:, 2] - GROUND
    clearance = resting_clearance(node, GROUND)
    lifted = height > 0.015
    assert 8 <= lifted.sum() < 40
    resting = np.isclose(clearance, height, atol=1e-7)
    assert resting.sum() > 60
    np.testing.assert_allclose(clearance[lifted], np.median(height[resting]), atol=1e-6)


def test_a_rope_is_thin_too():
    x = 0.01 * np.arange(40)
    height = 0.008 + np.where(x > 0.3, 0.6 * (x - 0.3), 0.0)
    clearance = resting_clearance(np.column_stack([x, 0.2 * x, GROUND + height]), GROUND)
    np.testing.assert_allclose(clearance, 0.008, atol=1e-3)
    assert height.max() > 0.06


def test_only_the_lowest_nodes_of_a_solid_have_a_clearance():
    node = block()
    clearance = resting_clearance(node, GROUND)
    is_lowest = node[:, 2] < GROUND + 0.01
    np.testing.assert_allclose(clearance[is_lowest], 0.005, atol=1e-6)
    assert is_lowest.sum() == 36
    assert not clearance[~is_lowest].any()


@pytest.mark.parametrize("ground", [None, GROUND - 0.1])
def test_what_does_not_lie_on_the_ground_has_no_clearance(ground):
    for node in (sheet(), block()):
        np.testing.assert_array_equal(resting_clearance(node, ground), np.zeros(len(node)))


def test_nodes_below_the_ground_do_not_sink():
    node = sheet() - np.float32([0.0, 0.0, 0.005])
    assert node[:, 2].min() < GROUND
    clearance = resting_clearance(node, GROUND)
    assert clearance.min() == 0.0
    np.testing.assert_allclose(clearance, np.maximum(node[:, 2] - GROUND, 0.0), atol=1e-6)


def test_a_sheet_that_nobody_touches_does_not_move(device):
    node = sheet()
    model = build_model(node, np.zeros((0, 3)), PARAMETERS)
    still = np.zeros((61, 0, 3), np.float32)
    fallen = Simulator(model, PARAMETERS, device=device).rollout(still).position
    model = replace(model, clearance=resting_clearance(node, GROUND))
    kept = Simulator(model, PARAMETERS, device=device).rollout(still).position
    assert np.linalg.norm(fallen - node, axis=2).max() > 0.004
    assert np.linalg.norm(kept - node, axis=2).max() < 1e-4


def test_other_parameters_and_other_controls_keep_the_clearance():
    node = sheet()
    control = np.repeat(node[None, :4] + np.float32([0.0, 0.0, 0.004]), 3, axis=0)
    clearance = resting_clearance(node, GROUND)
    model = replace(build_model(node, control[0], PARAMETERS), clearance=clearance)
    fitted = FittedObject(ObjectRollout.empty(model, PARAMETERS, control))
    for changes, chosen in (
        ({}, None),
        ({"stiffness": 5000.0}, None),
        ({"connection_radius": 0.015}, None),
        ({"virtual_connection_radius": 0.015}, [0, 2]),
    ):
        rollout = fitted.begin(PARAMETERS.replace(**changes), controls=chosen)
        assert np.array_equal(rollout.model.clearance, clearance), changes
