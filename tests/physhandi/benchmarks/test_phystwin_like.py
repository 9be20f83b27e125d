"""The baseline moves as our simulator does, and differentiates each frame as it does."""

from dataclasses import replace

import numpy as np
import torch
from reference.scenes import as_model, cube_scene

from physhandi.benchmarks.phystwin_like import PhysTwinLike
from physhandi.simulation import differentiable
from physhandi.simulation.simulator import Simulator


def world():
    """A cube that is thrown at the ground and pulled; what the baseline does not know is off."""
    scene = cube_scene(moves=False, damping=np.full(33, 2.0))
    model, parameters = as_model(scene)
    return model, parameters, scene.control.astype(np.float32)


def test_it_simulates_the_same_motion_again_and_again(device):
    model, parameters, control = world()
    expected = Simulator(model, parameters, device=device).rollout(control).position
    assert np.abs(expected[-1] - expected[0]).max() > 0.02
    baseline = PhysTwinLike(model, parameters, device)
    for _ in range(2):
        baseline.rollout(control)
        np.testing.assert_allclose(baseline.position.numpy(), expected[-1], atol=2e-6)


def test_its_gradient_is_ours_cut_after_every_frame(device):
    model, parameters, control = world()
    log_stiffness = torch.from_numpy(np.log(model.stiffness)).requires_grad_()
    position, _ = differentiable.rollout(
        model,
        parameters,
        torch.from_numpy(control),
        log_stiffness=log_stiffness,
        device=device,
        window=1,
    )
    (expected,) = torch.autograd.grad(position[1:, :, 2].sum(), log_stiffness)
    size = float(expected.norm())
    assert size > 1e-3
    baseline = PhysTwinLike(model, parameters, device)
    for _ in range(2):
        baseline.rollout_with_gradient(control)
        np.testing.assert_allclose(
            baseline.position.numpy(), position[-1].detach().numpy(), atol=2e-6
        )
        found = baseline.log_stiffness.grad.numpy()
        np.testing.assert_allclose(found, expected.numpy(), atol=2e-5 * size)


def test_it_works_without_control_nodes(device):
    scene = cube_scene(damping=np.full(33, 2.0))
    free = replace(
        scene,
        springs=scene.springs[:28],
        rest=scene.rest[:28],
        stiffness=scene.stiffness[:28],
        damping=scene.damping[:28],
        control=scene.control[:, :0],
    )
    model, parameters = as_model(free)
    control = free.control.astype(np.float32)
    expected = Simulator(model, parameters, device=device).rollout(control).position[-1]
    baseline = PhysTwinLike(model, parameters, device)
    baseline.rollout(control)
    np.testing.assert_allclose(baseline.position.numpy(), expected, atol=2e-6)
    baseline.rollout_with_gradient(control)
    np.testing.assert_allclose(baseline.position.numpy(), expected, atol=2e-6)
    assert np.abs(baseline.log_stiffness.grad.numpy()).max() > 1e-5
