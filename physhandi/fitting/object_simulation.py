"""Simulate the object of a fit, and compare its motion with what was seen."""

import math
from collections.abc import Callable
from collections.abc import Sequence as Many
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from physhandi.errors import SimulationDivergedError
from physhandi.fitting.losses import acceleration_loss
from physhandi.fitting.object_config import ObjectFitConfig
from physhandi.fitting.object_problem import ObjectProblem
from physhandi.simulation.model import SimulationParameters, SpringMassModel
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.stability import stable_substeps
from physhandi.simulation.topology import build_model

SAFETY = 1.25
"""Margin of the substeps over the stability limit."""


def problem_parameters(
    parameters: SimulationParameters, problem: ObjectProblem
) -> SimulationParameters:
    """Set the frame rate, ground and gravity of one sequence, as far as the parameters let it."""
    return parameters.in_world(
        frame_rate=problem.frame_rate,
        ground_height=problem.ground_height,
        gravity=problem.gravity,
    )


def build_problem_model(
    problem: ObjectProblem, parameters: SimulationParameters
) -> SpringMassModel:
    """Connect the object's nodes and attach the control nodes of frame 0."""
    model = build_model(
        problem.object_node,
        problem.control[0],
        problem_parameters(parameters, problem),
        rest_node=problem.rest_node,
    )
    return replace(model, initial_velocity=problem.initial_velocity)


def simulate_problem(
    problem: ObjectProblem, model: SpringMassModel, parameters: SimulationParameters, device: str
) -> tuple[Float[Tensor, "frame node 3"], Float[Tensor, "frame node 3"]]:
    """Roll the model out over the frames to fit; positions [m] and velocities [m/s]."""
    simulator = Simulator(model, problem_parameters(parameters, problem), device=device)
    rollout = simulator.rollout(problem.control[: problem.frame_count])
    return torch.from_numpy(rollout.position), torch.from_numpy(rollout.velocity)


def mean_loss(
    problems: Many[ObjectProblem],
    models: dict[str, SpringMassModel],
    parameters: SimulationParameters,
    config: ObjectFitConfig,
    device: str,
    *,
    acceleration_weight: float = 0.0,
    seen: Callable[[ObjectProblem, Float[Tensor, "frame node 3"]], None] | None = None,
) -> float:
    """Simulate every sequence and average its frame losses; infinite if one diverges [m²].

    The mean is over the frames 1, 2, … to fit (physics.md §4.1); frame 0 is given. `seen` is
    handed each simulated motion [m].
    """
    losses = []
    for problem in problems:
        try:
            node, velocity = simulate_problem(problem, models[problem.name], parameters, device)
        except SimulationDivergedError:
            return math.inf
        if seen is not None:
            seen(problem, node)
        frame_losses = problem.frame_losses(
            node[1:], track_weight=config.track_weight, freeze_counts=config.freezes_counts
        )
        if acceleration_weight > 0.0:
            frame_losses = frame_losses + acceleration_weight * acceleration_loss(velocity)[1:]
        losses.append(float(frame_losses.mean()))
    return float(np.mean(losses))


def settle_substeps(
    models: Many[SpringMassModel],
    parameters: SimulationParameters,
    config: ObjectFitConfig,
    *,
    safety: float = SAFETY,
) -> SimulationParameters:
    """Choose the substeps that keep all models stable, if the configuration says so.

    A step near the limit may stay bounded and still be noise: a search without this finds
    parameters whose simulation no longer has useful gradients.
    """
    if not config.automatic_substeps:
        return parameters
    needed = max(stable_substeps(model, parameters, safety=safety) for model in models)
    return replace(parameters, substeps_per_frame=10 * math.ceil(needed / 10))
