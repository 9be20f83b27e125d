"""Gradients of the differentiable rollout, and central differences of the oracle beside them."""

from dataclasses import replace

import numpy as np
import torch
from reference.scenes import as_model
from reference.spring_mass import rest_shape, simulate

from physhandi.simulation import differentiable

FIELDS = {
    "control": "control",
    "log_stiffness": "stiffness",
    "damping": "damping",
    "drag": "drag",
    "restitution": "restitution",
    "friction": "friction",
    "self_restitution": "self_restitution",
    "self_friction": "self_friction",
    "initial_position": "node",
    "initial_velocity": "velocity",
}
"""Argument of `rollout` -> field of the oracle's scene."""


def loss_weights(scene, frames=slice(None)):
    """Weigh every coordinate of every frame differently, frame 0 too."""
    rng = np.random.default_rng(7)
    shape = (len(scene.control), len(scene.node), 3)
    weights = rng.normal(size=shape), 0.05 * rng.normal(size=shape)
    keep = np.zeros((len(scene.control), 1, 1))
    keep[frames] = 1.0
    return weights[0] * keep, weights[1] * keep


def arguments(scene):
    """Give what `rollout` takes, in float64 but rounded to float32."""
    values = {
        name: np.asarray(getattr(scene, field), dtype=float) for name, field in FIELDS.items()
    }
    values["log_stiffness"] = np.log(values["log_stiffness"])
    return {name: value.astype(np.float32).astype(float) for name, value in values.items()}


def gradients(scene, device, weights, window=None, memory=None):
    """Differentiate the weighted sum of positions and velocities by every argument."""
    model, parameters = as_model(scene)
    tensors = {
        name: torch.tensor(value, requires_grad=True) for name, value in arguments(scene).items()
    }
    options = {"device": device, "window": window, "memory": memory}
    state = differentiable.rollout(model, parameters, **options, **tensors)
    loss = sum(
        (torch.tensor(w) * value.double()).sum() for w, value in zip(weights, state, strict=True)
    )
    loss.backward()
    return {name: tensor.grad.numpy() for name, tensor in tensors.items()}


def oracle_loss(scene, weights, values, counts=None):
    """Give the same sum as the oracle has it, and the number of colliding pairs if asked."""
    changes = {
        FIELDS[name]: np.exp(value) if name == "log_stiffness" else value
        for name, value in values.items()
    }
    moved = replace(scene, rest_shape=rest_shape(scene), **changes)
    position, velocity = simulate(moved, counts)
    return (weights[0] * position + weights[1] * velocity).sum((-3, -2, -1))


def finite_differences(scene, weights, places, step=1e-6):
    """Differentiate by single numbers, told by argument and index; all are simulated at once."""
    signs = np.array([1.0, -1.0])
    values = {
        name: np.broadcast_to(value, (2, len(places), *value.shape)).copy()
        for name, value in arguments(scene).items()
    }
    for place, (name, index) in enumerate(places):
        values[name][(slice(None), place, *index)] += signs * step
    loss = oracle_loss(scene, weights, values)
    return (loss[0] - loss[1]) / (2.0 * step)


def assert_gradients(scene, found, weights, *, picks, least, tolerance):
    """Compare some numbers of every gradient with differences; relative to the largest of each.

    Args:
        scene: What was simulated.
        found: The gradients of its arguments.
        weights: Of the loss.
        picks: Numbers of each gradient.
        least: What a gradient is taken to be at least.
        tolerance: Largest difference, as a part of that.
    """
    rng = np.random.default_rng(1)
    places = [
        (name, np.unravel_index(pick, gradient.shape))
        for name, gradient in found.items()
        for pick in rng.permutation(gradient.size)[:picks]
    ]
    expected = finite_differences(scene, weights, places)
    for (name, index), difference in zip(places, expected, strict=True):
        atol = tolerance * max(np.abs(found[name]).max(), least)
        np.testing.assert_allclose(found[name][index], difference, atol=atol, err_msg=name)


def directional_difference(scene, weights, name, direction, step=1e-6):
    """Differentiate along a direction; refuse to step over a change of the colliding pairs."""
    values, counts = arguments(scene), []
    values[name] = np.stack([values[name] + sign * step * direction for sign in (1.0, -1.0)])
    loss = oracle_loss(scene, weights, values, counts)
    assert all(above == below for above, below in counts), "the step changes which nodes collide"
    return (loss[0] - loss[1]) / (2.0 * step)
