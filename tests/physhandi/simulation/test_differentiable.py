"""Gradients of the float32 adjoint against float64 central differences of the oracle."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from reference.gradients import (
    assert_gradients,
    directional_difference,
    gradients,
    loss_weights,
)
from reference.scenes import as_model, cube_scene, held_in_turns, in_float32
from reference.spring_mass import simulate

from physhandi.simulation import differentiable
from physhandi.simulation.simulator import Simulator

SCENES = {
    "ground": {},
    "no control velocity": {"moves": False},
    "slippery": {"friction": 0.05, "restitution": 0.9, "ground": 0.003},
    "no ground": {"ground": None},
    "clearance": {"clearance": np.linspace(-0.001, 0.006, 8)},
    "attached for some frames": {"attached": held_in_turns().attached},
}


@pytest.mark.parametrize("changes", SCENES.values(), ids=SCENES.keys())
def test_gradients_agree_with_central_differences_of_the_oracle(device, changes):
    scene = cube_scene(**changes)
    weights = loss_weights(scene)
    found = gradients(scene, device, weights)
    assert_gradients(scene, found, weights, picks=5, least=1e-12, tolerance=2e-5)
    for name, gradient in found.items():
        acts = "self" not in name
        acts = acts and (scene.ground is not None or name not in ("restitution", "friction"))
        assert (np.abs(gradient).max() > 1e-4) == acts, name


def test_a_whole_gradient_vector_points_the_right_way(device):
    scene = cube_scene()
    weights = loss_weights(scene)
    found = gradients(scene, device, weights)
    rng = np.random.default_rng(2)
    for name in ("control", "log_stiffness", "damping"):
        direction = rng.normal(size=found[name].shape)
        expected = directional_difference(scene, weights, name, direction)
        assert float((found[name] * direction).sum()) == pytest.approx(expected, rel=1e-4), name


def test_control_velocity_has_its_own_part_in_the_gradient(device):
    weights = loss_weights(cube_scene())
    with_velocity = gradients(cube_scene(), device, weights)["control"]
    without = gradients(cube_scene(moves=False), device, weights)["control"]
    assert np.abs(with_velocity - without).max() > 0.1


def test_a_window_of_one_frame_sees_only_that_frame(device):
    # Each frame's loss by itself, started from the state that the frame before reached.
    scene = cube_scene()
    position, velocity = simulate(scene)
    whole = gradients(scene, device, loss_weights(scene), window=1)
    expected = np.zeros_like(whole["log_stiffness"])
    for frame in (1, 2, 3):
        piece = replace(
            scene,
            node=position[frame - 1],
            velocity=velocity[frame - 1],
            control=scene.control[frame - 1 : frame + 1],
        )
        weights = tuple(np.stack([0.0 * w[0], w[frame]]) for w in loss_weights(scene))
        expected += gradients(piece, device, weights)["log_stiffness"]
    np.testing.assert_allclose(whole["log_stiffness"], expected, atol=1e-5 * np.abs(expected).max())
    full = gradients(scene, device, loss_weights(scene))["log_stiffness"]
    assert np.abs(full - whole["log_stiffness"]).max() > 0.1 * np.abs(full).max()


def truncated_difference(scene, weights, window, name, direction):
    """Differentiate the oracle's loss of each window, whose start is given, and add them up."""
    position, velocity = simulate(scene)
    last, total = len(scene.control) - 1, 0.0
    for begin in range(0, last, window):
        if begin > 0 and name.startswith("initial"):
            break
        part = slice(begin, min(begin + window, last) + 1)
        start = {"node": position[begin], "velocity": velocity[begin]} if begin else {}
        # A frame's own loss belongs to the window that ends in it.
        own = tuple(np.concatenate([(begin == 0) * w[:1], w[part][1:]]) for w in weights)
        along = direction[part] if name == "control" else direction
        piece = replace(scene, control=scene.control[part], **start)
        total += directional_difference(piece, own, name, along)
    return total


@pytest.mark.parametrize("window", [1, 3])
def test_a_window_s_gradient_is_that_of_truncated_backpropagation(device, window):
    path = 0.004 * np.sin(np.arange(8))[:, None, None] * np.array([1.0, -0.5, 0.3])
    scene = cube_scene()
    scene = in_float32(replace(scene, control=scene.control[:1] + path, substeps=20))
    weights = loss_weights(scene)
    found, whole = (gradients(scene, device, weights, window=w) for w in (window, None))
    rng = np.random.default_rng(4)
    for name in ("control", "log_stiffness", "damping", "drag", "friction", "initial_velocity"):
        direction = rng.normal(size=found[name].shape)
        along, far = (float((values[name] * direction).sum()) for values in (found, whole))
        expected = truncated_difference(scene, weights, window, name, direction)
        assert along == pytest.approx(expected, rel=2e-4), name
        assert abs(far - along) > 0.01 * abs(along), name


def test_a_window_cuts_every_so_many_frames(device):
    scene = cube_scene()
    last = loss_weights(scene, frames=3)
    cut_at_two = gradients(scene, device, last, window=2)
    assert np.abs(cut_at_two["control"][2:]).max() > 1e-3
    assert not cut_at_two["control"][:2].any()
    assert not cut_at_two["initial_position"].any()
    for window in (3, 4, 100):
        longer = gradients(scene, device, last, window=window)
        np.testing.assert_array_equal(longer["control"], gradients(scene, device, last)["control"])
    assert np.abs(gradients(scene, device, last)["control"][:2]).max() > 1e-3


def test_gradients_are_the_same_bits_each_time(device):
    scene = cube_scene()
    weights = loss_weights(scene)
    first, second = gradients(scene, device, weights), gradients(scene, device, weights)
    for name in first:
        assert first[name].tobytes() == second[name].tobytes(), name


def test_the_forward_pass_is_the_simulator_s(device):
    scene = cube_scene()
    model, parameters = as_model(scene)
    position, velocity = differentiable.rollout(
        model, parameters, torch.tensor(scene.control), device=device
    )
    rollout = Simulator(model, parameters, device=device).rollout(scene.control)
    np.testing.assert_allclose(position.numpy(), rollout.position, atol=1e-7)
    np.testing.assert_allclose(velocity.numpy(), rollout.velocity, atol=2e-6)


def test_backward_uses_the_material_of_its_own_forward(device):
    scene = cube_scene()
    model, parameters = as_model(scene)
    control = torch.tensor(scene.control)

    def forward(scale):
        log = torch.tensor(np.log(model.stiffness * scale), requires_grad=True)
        return log, differentiable.rollout(
            model, parameters, control, log_stiffness=log, device=device
        )[0]

    log, position = forward(1.0)
    position[-1].sum().backward()
    expected = log.grad.clone()
    log, position = forward(1.0)
    forward(3.0)
    position[-1].sum().backward()
    np.testing.assert_array_equal(log.grad.numpy(), expected.numpy())
    assert float(expected.abs().max()) > 1e-4


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"damping": torch.zeros(3)}, r"damping has shape \(3,\); expected \(33,\)"),
        ({"drag": torch.zeros(1)}, r"drag has shape \(1,\); expected \(\)"),
        ({"initial_position": torch.zeros(2, 3)}, "initial_position has shape"),
        ({"window": 0}, "window is 0; expected at least one frame"),
    ],
    ids=["damping", "drag", "initial_position", "window"],
)
def test_tensors_that_do_not_fit_are_refused(device, change, message):
    scene = cube_scene()
    with pytest.raises(ValueError, match=message):
        differentiable.rollout(
            *as_model(scene), torch.tensor(scene.control), device=device, **change
        )
