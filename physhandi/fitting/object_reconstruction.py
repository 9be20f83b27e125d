"""Stage 2: find the spring-mass object whose simulated motion explains what was seen."""

import math
from collections.abc import Sequence as Many
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from physhandi.errors import SimulationDivergedError
from physhandi.fitting.object_problem import ObjectProblem
from physhandi.fitting.search import SearchConfig, SearchResult, search_parameters
from physhandi.progress import Progress
from physhandi.simulation.model import SimulationParameters, SpringMassModel
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.stability import stable_substeps
from physhandi.simulation.topology import build_model

SAFETY = 1.25
"""Margin of the substeps over the stability limit."""


@dataclass(frozen=True, kw_only=True)
class FirstOrderConfig:
    """How per-spring stiffness and damping are optimised (Adam)."""

    iterations: int = 60
    """Passes over all sequences; 0 skips the stage."""
    learning_rate: float = 0.02
    """Step of Adam in log space."""
    beta_2: float = 0.99
    """Adam's second moment decay."""
    window: int | None = None
    """Frames that a gradient reaches back, with one update a window; none is the whole sequence."""
    is_annealed: bool = True
    """Fit the first frames first and lengthen the horizon over the first half of the iterations."""
    learns_damping: bool = True
    """Whether each spring gets its own damping (paper) or all keep the searched one (PhysTwin)."""
    prior_weight: float = 1e-8
    """Pull of every logarithm towards its searched value [m²]."""


@dataclass(frozen=True, kw_only=True)
class ObjectFitConfig:
    """What stage 2 does."""

    search: SearchConfig = field(default_factory=SearchConfig)
    """Zeroth-order part: global parameters."""
    first_order: FirstOrderConfig = field(default_factory=FirstOrderConfig)
    """First-order part: one stiffness and one damping for each spring."""
    track_weight: float = 1.0
    """Weight of the track term beside the Chamfer term; PhysTwin's is 1/6."""
    freezes_counts: bool = False
    """Divide every frame's loss by the counts of frame 1, as PhysTwin does."""
    automatic_substeps: bool = False
    """Give each candidate the substeps that its own stability limit asks for."""
    most_substeps: int = 2000
    """A candidate that needs more substeps a frame than this is not tried."""
    cloud_points: int = 300
    """Most observed points of a frame that enter the Chamfer term."""


def problem_parameters(
    parameters: SimulationParameters, problem: ObjectProblem
) -> SimulationParameters:
    """Set the frame rate, ground and gravity of one sequence."""
    return replace(
        parameters,
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
) -> Tensor:
    """Roll the model out over the frames to fit; "frame node 3" [m]."""
    simulator = Simulator(model, problem_parameters(parameters, problem), device=device)
    position = simulator.rollout(problem.control[: problem.frame_count]).position
    return torch.from_numpy(np.ascontiguousarray(position))


def mean_loss(
    problems: Many[ObjectProblem],
    models: dict[str, SpringMassModel],
    parameters: SimulationParameters,
    config: ObjectFitConfig,
    device: str,
) -> float:
    """Simulate every sequence and average its frame losses; infinite if one diverges [m²]."""
    losses = []
    for problem in problems:
        try:
            node = simulate_problem(problem, models[problem.name], parameters, device)
        except SimulationDivergedError:
            return math.inf
        frame_losses = problem.frame_losses(
            node[1:], track_weight=config.track_weight, freeze_counts=config.freezes_counts
        )
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


def search_object(
    problems: Many[ObjectProblem],
    start: SimulationParameters,
    config: ObjectFitConfig,
    progress: Progress,
    *,
    device: str = "cpu",
) -> SearchResult:
    """Find the global parameters, topology included, that explain all sequences best.

    Args:
        problems: One for each sequence; all must have the same object nodes at rest.
        start: Parameters to start from.
        config: What stage 2 does.
        progress: Told once a generation.
        device: Warp device.

    Returns:
        The best global parameters.

    Raises:
        FitError: If every candidate diverges.
    """

    def evaluate(parameters: SimulationParameters) -> float:
        models = {p.name: build_problem_model(p, parameters) for p in problems}
        has_springs = all(len(model.spring_nodes) > 0 for model in models.values())
        if not has_springs or parameters.substeps_per_frame > config.most_substeps:
            return math.inf
        return mean_loss(problems, models, parameters, config, device)

    def settle(parameters: SimulationParameters) -> SimulationParameters:
        parameters = problem_parameters(parameters, problems[0])
        models = [build_problem_model(p, parameters) for p in problems]
        return settle_substeps(models, parameters, config)

    return search_parameters(evaluate, start, config.search, progress, settle)
