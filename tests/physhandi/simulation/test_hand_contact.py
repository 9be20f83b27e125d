"""The hand's surface that pushes: closed forms, a float64 oracle, central differences."""

from dataclasses import replace

import numpy as np
import pytest
from reference.gradients import (
    assert_gradients,
    directional_difference,
    gradients,
    loss_weights,
)
from reference.scenes import as_model, bare_scene, pressed_scene
from reference.spring_mass import simulate
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from physhandi.simulation.simulator import Simulator

PLATE = np.array([[-0.05, -0.05, 0.0], [0.05, -0.05, 0.0], [0.0, 0.08, 0.0]])
"""A triangle that is seen from above."""


def run(scene, device):
    return Simulator(*as_model(scene), device=device).rollout(scene.control)


def on_a_plate(node, *, moves=(0.0, 0.0, 0.0), frames=2, **changes):
    """Put a node beside a plate that moves by some way in each frame."""
    way = np.arange(frames)[:, None, None] * np.asarray(moves)
    return bare_scene(
        [node], control=PLATE + way, hand=np.array([[0, 1, 2]]), **{"substeps": 100} | changes
    )


def test_a_node_at_rest_sinks_in_as_far_as_its_weight_needs(device):
    # k depth = m g with m = 1 kg: 9.81 N / 1e4 N/m.
    scene = on_a_plate([0.0, 0.0, 0.0], gravity=9.81, push_stiffness=1e4, frames=40)
    rollout = run(scene, device)
    assert rollout.position[-1, 0, 2] == pytest.approx(-9.81e-4, rel=1e-3)
    assert abs(rollout.velocity[-1, 0, 2]) < 1e-5


def given_back(speed, load=0.0):
    """Speed at which a node leaves: what it does on the way in and out, divided, adds up to 0.

    v dv / (1 - v / s) = -k depth d(depth), with s = 0.1 m/s, from `speed` and k depth²/2 = `load`.
    """

    def work(v):
        return 0.01 * (-np.log1p(-v / 0.1) - v / 0.1)

    return brentq(lambda v: work(v) - work(speed) - load, 0.0, 0.1 - 1e-12)


def test_a_node_inside_comes_out_slowly(device):
    scene = on_a_plate([0.0, 0.0, -0.001], frames=3, substeps=1000)
    velocity = run(scene, device).velocity[:, 0, 2]
    assert velocity[-1] == pytest.approx(given_back(0.0, 1e5 * 1e-6 / 2), rel=1e-3)


def test_a_moving_hand_takes_a_node_along(device):
    # The hand comes at 3 mm a frame and gives more than half of its speed on top.
    scene = on_a_plate([0.0, 0.0, 0.001], moves=[0.0, 0.0, 0.003], frames=4, substeps=500)
    speed = 0.09 + given_back(-0.09)
    assert speed == pytest.approx(0.1458, abs=1e-4)
    assert run(scene, device).velocity[-1, 0, 2] == pytest.approx(speed, rel=2e-3)
    # Weight brings it back: then it moves with the hand.
    lifted = on_a_plate(
        [0.0, 0.0, 0.001], moves=[0.0, 0.0, 0.003], frames=8, gravity=9.81, substeps=700
    )
    heavy = run(lifted, device)
    assert heavy.velocity[-1, 0, 2] == pytest.approx(0.09, rel=1e-3)
    assert heavy.position[-1, 0, 2] == pytest.approx(7 * 0.003 - 9.81e-5, abs=1e-5)
    # A hand that goes away leaves it alone.
    way = scene.control - scene.control[0]
    away = run(replace(scene, control=scene.control[0] - way), device)
    assert not away.velocity.any()


@pytest.mark.parametrize(("friction", "speed"), [(0.1, 0.9 - 0.1 * 9.81 * 0.1), (2.0, 0.0)])
def test_friction_on_a_level_hand_is_coulombs(device, friction, speed):
    # Three frames of 1/30 s at mu g, or stopped; the node is where its weight is carried.
    depth = 9.81 / 1e5
    scene = on_a_plate(
        [-0.03, -0.02, -depth], velocity=[[0.9 if speed else 0.2, 0.0, 0.0]], gravity=9.81,
        frames=4, hand_friction=friction,
    )  # fmt: skip
    velocity = run(scene, device).velocity[-1, 0]
    np.testing.assert_allclose(velocity, [speed, 0.0, 0.0], atol=2e-4)


@pytest.mark.parametrize(("friction", "moves"), [(0.5, False), (0.3, True)])
def test_a_node_stays_on_a_slope_whose_tangent_is_below_the_friction(device, friction, moves):
    slope = np.arctan(0.4)
    turn = Rotation.from_rotvec([0.0, slope, 0.0])
    normal = turn.apply([0.0, 0.0, 1.0])
    scene = bare_scene(
        [-normal * 9.81 * np.cos(slope) / 1e5], control=np.repeat(turn.apply(PLATE)[None], 7, 0),
        hand=np.array([[0, 1, 2]]), gravity=9.81, hand_friction=friction, substeps=100,
    )  # fmt: skip
    along = run(scene, device).velocity[-1, 0] @ turn.apply([1.0, 0.0, 0.0])
    # Downhill: g (sin - mu cos) for six frames.
    expected = 9.81 * (np.sin(slope) - friction * np.cos(slope)) * 6 / 30 if moves else 0.0
    assert along == pytest.approx(expected, abs=1e-3)


def test_a_ball_that_turns_and_pushes_agrees_with_the_oracle(device):
    scene, beside = pressed_scene(), []
    position, velocity = simulate(scene, beside=beside)
    assert [(number >= 0).sum() for number, _ in beside] == [15, 15, 15]
    without = simulate(replace(scene, hand=None))[0]
    assert np.abs(position - without).max() > 2e-3
    assert np.abs(position - simulate(replace(scene, hand_friction=0.0))[0]).max() > 3e-4
    rollout = run(scene, device)
    np.testing.assert_allclose(rollout.position, position, atol=2e-7)
    np.testing.assert_allclose(rollout.velocity, velocity, atol=5e-6)
    assert run(scene, device).position.tobytes() == rollout.position.tobytes()


def test_it_goes_together_with_self_collision(device):
    scene = pressed_scene(distance=0.015, blocks_rest=True)
    position = simulate(scene)[0]
    assert np.abs(position - simulate(replace(scene, distance=None))[0]).max() > 1e-4
    np.testing.assert_allclose(run(scene, device).position, position, atol=2e-7)


def test_what_a_spring_holds_is_not_pushed(device):
    # A spring from the node to the plate's first corner, as long as it is: nothing moves the node.
    scene = on_a_plate([0.0, 0.0, -0.001], springs=[[0, 1]], rest=[0.0707], stiffness=[1e-6],
                       damping=[0.0], frames=4)  # fmt: skip
    assert np.abs(run(scene, device).position[-1, 0] - scene.node[0]).max() < 1e-6
    # Once it lets go, the plate pushes.
    late = run(replace(scene, attached=np.array([[0, 2]])), device).position[:, 0, 2]
    np.testing.assert_allclose(late[:3], -0.001, atol=1e-6)
    assert late[3] > 0.001


def test_gradients_agree_with_central_differences_of_the_oracle(device):
    beside = []
    simulate(pressed_scene(), beside=beside)
    scene = pressed_scene(beside=beside)
    weights = loss_weights(scene)
    reverse = gradients(scene, device, weights)
    assert_gradients(scene, reverse, weights, picks=4, least=1e-3, tolerance=2e-4)
    rng = np.random.default_rng(2)
    for name in ("control", "log_stiffness", "initial_position", "initial_velocity"):
        direction = rng.normal(size=reverse[name].shape)
        expected = directional_difference(scene, weights, name, direction)
        assert float((reverse[name] * direction).sum()) == pytest.approx(expected, rel=2e-4), name
    without = gradients(replace(scene, hand=None), device, weights)["control"]
    assert np.abs(reverse["control"] - without).max() > 0.1 * np.abs(without).max()


def test_only_what_is_beside_the_surface_and_not_too_deep_is_pushed(device):
    # The longest edge is 139 mm: 0.7 of it aside, 3 of it deep, 6 of it high.
    small = replace(on_a_plate([0.0, 0.0, 0.0]), control=np.repeat(0.01 * PLATE[None], 2, 0))
    edge = np.linalg.norm(0.01 * (PLATE[2] - PLATE[0]))
    rim = 0.01 * PLATE[1, 0]
    for node, is_beside in (
        ([0.0, 0.0, -2.9 * edge], True),
        ([0.0, 0.0, -3.1 * edge], False),
        ([0.0, 0.0, 5.9 * edge], True),
        ([0.0, 0.0, 6.1 * edge], False),
        ([rim + 0.6 * edge, 0.01 * PLATE[1, 1], 0.0], True),
        ([rim + 0.8 * edge, 0.01 * PLATE[1, 1], 0.0], False),
    ):
        simulator = Simulator(*as_model(replace(small, node=np.array([node]))), device=device)
        simulator.rollout(small.control)
        assert (simulator.hand_contact.face.numpy()[0] >= 0) == is_beside, node


def test_it_is_switched_on_and_off_live(device):
    scene = pressed_scene()
    model, parameters = as_model(scene)
    simulator = Simulator(model, parameters.replace(hand_pushes=False), device=device)
    off = simulator.rollout(scene.control).position
    simulator.set_parameters(parameters)
    np.testing.assert_allclose(
        simulator.rollout(scene.control).position, simulate(scene)[0], atol=2e-7
    )
    simulator.set_parameters(parameters.replace(push_stiffness=1e4, hand_friction=0.0))
    softer = simulate(replace(scene, push_stiffness=1e4, hand_friction=0.0))[0]
    np.testing.assert_allclose(simulator.rollout(scene.control).position, softer, atol=2e-7)
    simulator.set_parameters(parameters.replace(hand_pushes=False))
    assert simulator.rollout(scene.control).position.tobytes() == off.tobytes()
