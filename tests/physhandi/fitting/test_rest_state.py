"""What lies on the ground stays where it was seen: clearances, and springs that carry weight."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from physhandi.fitted_object import FittedObject
from physhandi.fitting.rest_state import hold_still, resting_clearance
from physhandi.object_rollout import ObjectRollout
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.stability import with_stable_substeps
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
    clearance = resting_clearance(node, GROUND, "sheet")
    assert clearance.dtype == np.float32
    assert 0.0039 < clearance.min() < 0.0045
    assert 0.0055 < clearance.max() < 0.0061
    np.testing.assert_allclose(clearance, node[:, 2] - GROUND, atol=1e-6)


def test_lifted_nodes_of_a_sheet_come_to_lie_as_high_as_the_others():
    node = sheet(rise=1.5)
    height = node[:, 2] - GROUND
    clearance = resting_clearance(node, GROUND, "sheet")
    lifted = height > 0.015
    assert 8 <= lifted.sum() < 40
    resting = np.isclose(clearance, height, atol=1e-7)
    assert resting.sum() > 60
    np.testing.assert_allclose(clearance[lifted], np.median(height[resting]), atol=1e-6)


def test_a_rope_is_thin_too():
    x = 0.01 * np.arange(40)
    height = 0.008 + np.where(x > 0.3, 0.6 * (x - 0.3), 0.0)
    clearance = resting_clearance(np.column_stack([x, 0.2 * x, GROUND + height]), GROUND, "rope")
    np.testing.assert_allclose(clearance, 0.008, atol=1e-3)
    assert height.max() > 0.06


def test_no_node_begins_below_its_clearance():
    # On the flank of a rope one node stands above another, and both are lower than most.
    x = 0.01 * np.arange(40)
    node = np.column_stack([x, 0.0 * x, np.full(40, GROUND + 0.009)])
    node[20, 2] = GROUND + 0.005
    node = np.vstack([node, [x[20], 0.002, GROUND + 0.008], [x[30], 0.002, GROUND + 0.013]])
    for kind in ("rope", "sheet"):
        clearance = resting_clearance(node, GROUND, kind)
        expected = np.append(np.full(40, 0.009), [0.008, 0.009])
        expected[20] = 0.005
        np.testing.assert_allclose(clearance, expected, atol=1e-6)


def test_a_thick_rope_rests_although_its_nodes_are_far_above_the_ground():
    x = 0.01 * np.arange(40)
    node = np.column_stack([x, 0.2 * x, np.full(40, GROUND + 0.02)])
    assert not resting_clearance(node, GROUND, "rope").any()
    found = resting_clearance(node, GROUND, "rope", thickness=0.022)
    np.testing.assert_allclose(found, 0.02, atol=1e-6)
    assert not resting_clearance(node, GROUND, "sheet", thickness=0.022).any()


@pytest.mark.parametrize("kind", ["solid", "shell"])
def test_only_the_lowest_nodes_of_a_solid_have_a_clearance(kind):
    node = block()
    clearance = resting_clearance(node, GROUND, kind)
    is_lowest = node[:, 2] < GROUND + 0.01
    np.testing.assert_allclose(clearance[is_lowest], 0.005, atol=1e-6)
    assert is_lowest.sum() == 36
    assert not clearance[~is_lowest].any()


@pytest.mark.parametrize("ground", [None, GROUND - 0.1])
def test_what_does_not_lie_on_the_ground_has_no_clearance(ground):
    for node, kind in ((sheet(), "sheet"), (block(), "solid")):
        np.testing.assert_array_equal(resting_clearance(node, ground, kind), np.zeros(len(node)))


def test_nodes_below_the_ground_do_not_sink():
    node = sheet() - np.float32([0.0, 0.0, 0.005])
    assert node[:, 2].min() < GROUND
    clearance = resting_clearance(node, GROUND, "sheet")
    assert clearance.min() == 0.0
    np.testing.assert_allclose(clearance, np.maximum(node[:, 2] - GROUND, 0.0), atol=1e-6)


def test_a_sheet_that_nobody_touches_does_not_move(device):
    node = sheet()
    model = build_model(node, np.zeros((0, 3)), PARAMETERS)
    still = np.zeros((61, 0, 3), np.float32)
    fallen = Simulator(model, PARAMETERS, device=device).rollout(still).position
    model = replace(model, clearance=resting_clearance(node, GROUND, "sheet"))
    kept = Simulator(model, PARAMETERS, device=device).rollout(still).position
    assert np.linalg.norm(fallen - node, axis=2).max() > 0.004
    assert np.linalg.norm(kept - node, axis=2).max() < 1e-4


def test_other_parameters_and_other_controls_keep_the_clearance():
    node = sheet()
    control = np.repeat(node[None, :4] + np.float32([0.0, 0.0, 0.004]), 3, axis=0)
    clearance = resting_clearance(node, GROUND, "sheet")
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


def nobody(count=0):
    return np.zeros((count, 3), np.float32)


def moved(model, parameters, control=None, frames=60):
    """Simulate two seconds in which nobody touches the object; give how far each node moves."""
    control = nobody() if control is None else control
    parameters = with_stable_substeps(parameters, model, control)
    path = np.repeat(control[None], frames + 1, axis=0)
    position = Simulator(model, parameters).rollout(path).position
    return np.linalg.norm(position - model.object_node, axis=2).max(axis=0)


def laid(node, parameters, control=None, kind="solid"):
    model = build_model(node, nobody() if control is None else control, parameters)
    return replace(model, clearance=resting_clearance(node, parameters.ground_height, kind))


def test_springs_of_a_hanging_chain_carry_what_hangs_on_them():
    node = np.float32([[0.0, 0.0, -0.01 * (i + 1)] for i in range(6)])
    control = nobody(1)
    parameters = PARAMETERS.replace(
        ground_height=None, connection_radius=0.012, virtual_connection_radius=0.012,
        virtual_stiffness=8000.0, stiffness_scale=0.5,
    )  # fmt: skip
    held = hold_still(laid(node, parameters, control), control, parameters)
    # The spring above node i carries its weight and that of all below: r = L / (1 + F / Y).
    carried = 9.81 * np.array([5.0, 4.0, 3.0, 2.0, 1.0])
    np.testing.assert_allclose(held.rest_length[:5], 0.01 / (1.0 + carried / 1500.0), rtol=1e-5)
    assert held.rest_length[5] == pytest.approx(0.01 / (1.0 + 6 * 9.81 / 4000.0), rel=1e-5)
    assert moved(held, parameters, control).max() < 1e-5
    assert moved(laid(node, parameters, control), parameters, control).max() > 1e-3


def test_a_sheet_held_by_its_border_is_loaded_as_statics_says():
    # A strip of 5 nodes sags between two walls: H y'' = -w gives the tension of a parabola.
    x = 0.01 * np.arange(-2, 3)
    sag = 0.5 * (x / 0.02) ** 2 * 0.005
    node = np.column_stack([x, 0.0 * x, 0.5 + sag]).astype(np.float32)
    wall = np.float32([[-0.03, 0.0, 0.505625], [0.03, 0.0, 0.505625]])
    parameters = PARAMETERS.replace(
        ground_height=None, connection_radius=0.0115, virtual_connection_radius=0.012,
        virtual_stiffness=3000.0, max_neighbors=2,
    )  # fmt: skip
    held = hold_still(laid(node, parameters, wall), wall, parameters)
    ends = np.concatenate([node, wall])[held.spring_nodes].astype(float)
    offset = ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(offset, axis=1)
    tension = 3000.0 * (length / held.rest_length - 1.0)
    # Each node turns the slope by 0.125, so that the tension's level part is g / 0.125.
    np.testing.assert_allclose(tension * np.abs(offset[:, 0]) / length, 9.81 / 0.125, rtol=1e-3)
    assert moved(held, parameters, wall, frames=6).max() < 2e-4


@pytest.mark.parametrize("stiffness", [300.0, 1e4])
def test_a_block_that_nobody_touches_does_not_sink(stiffness):
    parameters = PARAMETERS.replace(stiffness=stiffness)
    model = laid(block(6), parameters)
    held = hold_still(model, nobody(), parameters)
    sunk = moved(model, parameters).max()
    assert sunk > 0.3 / stiffness
    assert moved(held, parameters).max() < min(1e-4, 0.2 * sunk)
    np.testing.assert_array_equal(held.clearance, model.clearance)


def test_the_bundled_towel_does_not_move_before_it_is_touched():
    run = Path(__file__).parents[3] / "sequences/runs/towel_fold_quick"
    node = FittedObject.of(run).model.object_node
    parameters = PARAMETERS.replace(connection_radius=0.03, ground_height=0.0)
    held = hold_still(laid(node, parameters, kind="sheet"), nobody(), parameters)
    assert held.clearance.min() > 0.0
    assert moved(held, parameters).max() < 5e-4


def test_no_rest_length_changes_beyond_the_bounds_and_none_below_its_floor():
    node = np.float32([[0.0, 0.0, -0.01 * (i + 1)] for i in range(6)])
    control = np.float32([[0.0, 0.0, -0.0095]])
    parameters = PARAMETERS.replace(
        ground_height=None, connection_radius=0.012, stiffness=400.0, virtual_stiffness=400.0,
        virtual_connection_radius=0.012, virtual_max_neighbors=2, virtual_rest_length_floor=0.001,
    )  # fmt: skip
    model = laid(node, parameters, control)
    held = hold_still(model, control, parameters)
    change = held.rest_length / model.rest_length
    assert 0.95 - 1e-6 <= change.min() < 0.999
    assert change.max() <= 1.05 + 1e-6
    shorter = model.rest_length == np.float32(0.001)
    assert shorter.sum() == 1
    assert np.array_equal(held.rest_length[shorter], model.rest_length[shorter])


def test_what_springs_cannot_carry_deforms_nothing_else():
    # Nothing holds the end of the sheet that is in the air.
    node = sheet(rise=1.5)
    parameters = PARAMETERS.replace(stiffness=1000.0)
    model = laid(node, parameters, kind="sheet")
    held = hold_still(model, nobody(), parameters)
    flat = node[:, 0] < 0.05
    assert moved(held, parameters).max() > 0.01
    assert moved(held, parameters)[flat].max() < 1e-3 + moved(model, parameters)[flat].max()


def test_another_sequence_keeps_the_object_and_carries_it_by_its_grip_alone():
    node = np.float32([[0.0, 0.0, -0.01 * (i + 1)] for i in range(3)])
    parameters = PARAMETERS.replace(
        ground_height=None, connection_radius=0.012, virtual_connection_radius=0.012
    )
    model = laid(node, parameters, nobody(1))
    held = hold_still(model, nobody(1), parameters, keeps_object=True)
    np.testing.assert_array_equal(held.rest_length[:2], model.rest_length[:2])
    assert held.rest_length[2] < model.rest_length[2]


def test_other_parameters_keep_the_springs_that_carry_the_object():
    parameters = PARAMETERS.replace(stiffness=300.0, damping=5.0)
    model = laid(block(6), parameters)
    held = hold_still(model, nobody(), parameters)
    path = np.zeros((3, 0, 3), np.float32)
    fitted = FittedObject(ObjectRollout.empty(held, parameters, path), rest_node=model.object_node)
    wider = fitted.begin(parameters.replace(max_neighbors=21)).model
    assert len(wider.spring_nodes) > len(held.spring_nodes)
    was = dict(zip(map(tuple, held.spring_nodes.tolist()), held.rest_length, strict=True))
    now = dict(zip(map(tuple, wider.spring_nodes.tolist()), wider.rest_length, strict=True))
    # Of neighbors that are equally far, another limit may choose others.
    common = [ends for ends in was if ends in now]
    assert len(common) > 0.95 * len(was)
    kept, given = (np.array([springs[ends] for ends in common]) for springs in (now, was))
    np.testing.assert_allclose(kept, given, rtol=2e-5)
    assert (np.abs(np.array(held.rest_length) / model.rest_length - 1.0) > 1e-3).mean() > 0.5
    plain = FittedObject(ObjectRollout.empty(model, parameters, path), rest_node=model.object_node)
    same = plain.begin(parameters.replace(max_neighbors=21)).model
    built = build_model(model.object_node, nobody(), parameters.replace(max_neighbors=21))
    assert same.rest_length.tobytes() == built.rest_length.tobytes()
