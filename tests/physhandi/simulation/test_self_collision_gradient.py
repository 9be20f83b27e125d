"""Gradients through collisions against float64 central differences and a closed form."""

import numpy as np
import pytest
import torch
from reference.gradients import (
    arguments,
    assert_gradients,
    directional_difference,
    gradients,
    loss_weights,
    oracle_loss,
)
from reference.scenes import as_model, bare_scene, crossing_scene

from physhandi.simulation import differentiable, self_collision

SCENES = {
    "as it is": ({}, 10),
    "dull": ({"self_restitution": 0.2}, 13),
    "smooth": ({"self_friction": 0.05}, 11),
    "all pairs": ({"distance": 0.03, "blocks_rest": True}, 1472),
    "clearance": ({"clearance": np.linspace(0.0, 0.008, 18)}, 22),
}


@pytest.mark.parametrize(("changes", "count"), SCENES.values(), ids=SCENES.keys())
def test_gradients_agree_with_central_differences_of_the_oracle(device, changes, count):
    scene, counts = crossing_scene(**changes), []
    weights = loss_weights(scene)
    oracle_loss(scene, weights, arguments(scene), counts)
    assert sum(counts) == count
    found = gradients(scene, device, weights)
    assert_gradients(scene, found, weights, picks=3, least=1e-3, tolerance=1e-4)
    for name in ("self_restitution", "self_friction"):
        assert abs(found[name]) > 1e-3, name


def test_whole_gradient_vectors_point_the_right_way(device):
    scene = crossing_scene(self_restitution=0.2)
    weights = loss_weights(scene)
    found = gradients(scene, device, weights)
    rng = np.random.default_rng(2)
    for name in ("control", "log_stiffness", "initial_position", "initial_velocity"):
        direction = rng.normal(size=found[name].shape)
        expected = directional_difference(scene, weights, name, direction)
        assert float((found[name] * direction).sum()) == pytest.approx(expected, rel=1e-4), name


def test_collisions_have_a_part_in_the_gradient(device):
    weights = loss_weights(crossing_scene())
    with_them = gradients(crossing_scene(), device, weights)["initial_velocity"]
    without = gradients(crossing_scene(distance=None), device, weights)["initial_velocity"]
    assert np.abs(with_them - without).max() > 0.1 * np.abs(without).max()


def test_gradients_of_one_collision_are_the_closed_form(device):
    scene = bare_scene(
        [[0.0, 0, 0], [0.005, 0, 0]], velocity=[[0, 0, 0], [-0.2, 0, 0.5]],
        distance=0.01, blocks_rest=True, self_restitution=0.5, self_friction=0.4, substeps=1,
    )  # fmt: skip
    weights = np.zeros((2, 2, 3)), np.zeros((2, 2, 3))
    weights[1][1, 0] = [1.0, 0.0, 10.0]
    found = gradients(scene, device, weights)
    # v_1' = (1 + e) / 2 · (-0.2, 0, μ · 0.2), so that the loss is (1 + e) (-0.1 + μ).
    assert found["self_restitution"] == pytest.approx(-0.1 + 0.4, abs=1e-6)
    assert found["self_friction"] == pytest.approx(1.5, abs=1e-6)
    # The speed of approach enters as (1 + e) (0.5 - 5 μ) times v_x of the second node.
    assert found["initial_velocity"][1, 0] == pytest.approx(1.5 * (0.5 - 5 * 0.4), abs=1e-5)
    assert found["initial_velocity"][1, 2] == pytest.approx(0.0, abs=1e-6)
    # The first node's own velocity: 1 and 10 of keeping it, less what the second's gains.
    np.testing.assert_allclose(found["initial_velocity"][0], [1.0 + 2.25, 0.0, 10.0], atol=1e-5)


def test_a_coefficient_out_of_bounds_has_no_gradient(device):
    scene = crossing_scene(self_restitution=0.9, self_friction=1.5)
    model, parameters = as_model(scene)
    values = {"self_restitution": 1.1, "self_friction": 2.1}
    tensors = {name: torch.tensor(value, requires_grad=True) for name, value in values.items()}
    position, _ = differentiable.rollout(
        model, parameters, torch.tensor(scene.control), device=device, **tensors
    )
    (position[-1] ** 2).sum().backward()
    assert [float(tensor.grad) for tensor in tensors.values()] == [0.0, 0.0]
    clamped = differentiable.rollout(
        model, parameters, torch.tensor(scene.control), device=device,
        self_restitution=torch.tensor(1.0), self_friction=torch.tensor(2.0),
    )[0]  # fmt: skip
    assert torch.equal(position, clamped)


def test_gradients_are_the_same_bits_each_time_and_after_making_room(device, monkeypatch):
    scene = crossing_scene(distance=0.03, blocks_rest=True)
    weights = loss_weights(scene)
    first = gradients(scene, device, weights)
    monkeypatch.setattr(self_collision, "FIRST_CAPACITY", 1)
    for other in (gradients(scene, device, weights), gradients(scene, device, weights)):
        for name in first:
            assert first[name].tobytes() == other[name].tobytes(), name
