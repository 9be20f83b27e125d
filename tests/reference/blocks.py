"""Jittered blocks of nodes that hit the ground while their top is held, for the fast engines."""

from dataclasses import replace

import numpy as np
import torch
from reference.spring_mass import Scene

from physhandi.simulation import differentiable
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.topology import build_model

PARAMETERS = SimulationParameters(
    connection_radius=0.018,
    max_neighbors=18,
    stiffness=300.0,
    virtual_stiffness=200.0,
    virtual_connection_radius=0.015,
    damping=3.0,
    substeps_per_frame=150,
)


def thrown_block(side, frames=4, clearance=0.0):
    """Throw a block of jittered nodes at the ground while its top is held.

    Two thirds of the nodes touch it at a clearance and at twice that, the lowest one at 0.
    """
    rng = np.random.default_rng(side)
    axis = 0.01 * np.arange(side)
    node = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    node = node + rng.normal(0, 5e-4, node.shape) + np.array([0, 0, 0.002])
    control = node[node[:, 2] > axis[-1]][::7] + np.array([0, 0, 0.004])
    model = build_model(node.astype(np.float32), control.astype(np.float32), PARAMETERS)
    velocity = rng.normal(0, 0.05, node.shape) + np.array([0.1, 0, -0.3])
    path = control + np.linspace(0, 1, frames)[:, None, None] * np.array([0.01, -0.004, 0.003])
    model = replace(
        model,
        initial_velocity=velocity.astype(np.float32),
        clearance=np.float32(clearance * (node[:, 2].argsort().argsort() % 3)),
    )
    return model, path.astype(np.float32)


def recorded(model, device, parameters=PARAMETERS):
    """Make a simulator that does without a fast engine."""
    simulator = Simulator(model, parameters, device=device)
    simulator.engine = None
    return simulator


def as_scene(model, control, parameters=PARAMETERS):
    """Describe a model for the oracle."""
    return Scene(
        node=model.object_node.astype(float),
        velocity=model.initial_velocity.astype(float),
        springs=model.spring_nodes,
        rest=model.rest_length.astype(float),
        stiffness=model.stiffness.astype(float),
        damping=model.damping.astype(float),
        control=control.astype(float),
        drag=parameters.drag,
        restitution=parameters.restitution,
        friction=parameters.friction,
        ground=parameters.ground_height,
        clearance=model.clearance.astype(float),
        gravity=parameters.gravity,
        frame_rate=parameters.frame_rate,
        substeps=parameters.substeps_per_frame,
        moves=parameters.use_control_velocity,
    )


def block_gradients(model, control, parameters, device, memory=None):
    """Differentiate a random sum of the last positions and velocities by every input."""
    aim = torch.from_numpy(np.random.default_rng(5).normal(0, 1, model.object_node.shape)).float()
    inputs = {
        "control": torch.from_numpy(control),
        "log_stiffness": torch.log(torch.from_numpy(model.stiffness)),
        "damping": torch.from_numpy(model.damping),
        "drag": torch.tensor(3.0),
        "restitution": torch.tensor(0.5),
        "friction": torch.tensor(0.3),
        "initial_position": torch.from_numpy(model.object_node),
        "initial_velocity": torch.from_numpy(model.initial_velocity),
    }
    inputs = {name: value.clone().requires_grad_() for name, value in inputs.items()}
    options = {"device": device, "memory": memory}
    position, velocity = differentiable.rollout(model, parameters, **options, **inputs)
    ((position[-1] * aim).sum() + 0.01 * (velocity[-1] * aim).sum()).backward()
    return {name: value.grad.numpy() for name, value in inputs.items()}
