"""Stage 2: find the spring-mass object whose simulated motion explains what was seen."""

import math
from collections.abc import Sequence as Many
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from physhandi.errors import FitError, SimulationDivergedError
from physhandi.fitting.object_problem import ObjectProblem
from physhandi.fitting.search import SearchConfig, SearchResult, search_parameters
from physhandi.progress import Progress
from physhandi.simulation import differentiable
from physhandi.simulation.model import SimulationParameters, SpringMassModel
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.stability import stable_substeps
from physhandi.simulation.topology import build_model

STAGE = "first_order"
SAFETY = 1.25
"""Margin of the substeps over the stability limit."""
STEEPEST = 100.0
"""Largest sane gradient, in losses per unit of the logarithm of a stiffness."""


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
    """Frames that a gradient reaches back, with one update a window; none means the whole sequence."""
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
    """Give each candidate the substeps that its own stability limit asks for, not a fixed number."""
    most_substeps: int = 2000
    """A candidate that needs more substeps a frame than this is not tried."""
    cloud_points: int = 300
    """Most observed points of a frame that enter the Chamfer term."""


@dataclass(frozen=True, kw_only=True)
class FirstOrderResult:
    """Models with a fitted stiffness and damping for every spring."""

    models: dict[str, SpringMassModel]
    """The fitted model of each sequence; object springs are the same in all."""
    parameters: SimulationParameters
    """The global parameters, with the substeps that the fitted springs need."""
    loss_before: float
    """Mean loss of the start [m²]."""
    loss_after: float
    """Mean loss of the returned models [m²]."""
    curve: list[list[float]]
    """Iteration and mean loss."""


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


class _SpringLogs:
    """Logarithms of stiffness and damping: object springs shared, virtual springs per sequence."""

    def __init__(self, models: dict[str, SpringMassModel], *, learns_damping: bool) -> None:
        first = next(iter(models.values()))
        self.object_count = first.object_spring_count
        for name, model in models.items():
            same = np.array_equal(
                model.spring_nodes[: self.object_count], first.spring_nodes[: self.object_count]
            )
            if model.object_spring_count != self.object_count or not same:
                raise FitError(
                    f"Sequence '{name}' connects the object's nodes differently from the first one: "
                    "sequences fitted together must share one object with the same rest nodes."
                )
        self.learns_damping = learns_damping
        self.shared = self._parameter(first, slice(None, self.object_count))
        self.own = {
            n: self._parameter(m, slice(self.object_count, None)) for n, m in models.items()
        }
        self.start = [tensor.detach().clone() for tensor in self.tensors()]

    @staticmethod
    def _parameter(model: SpringMassModel, part: slice) -> Tensor:
        both = np.stack([model.stiffness[part], model.damping[part]])
        return torch.log(torch.from_numpy(both).clamp(min=1e-6)).requires_grad_()

    def tensors(self) -> list[Tensor]:
        return [self.shared, *self.own.values()]

    def of(self, name: str) -> tuple[Tensor, Tensor]:
        """Log stiffness and damping of all springs of one sequence's model."""
        both = torch.cat([self.shared, self.own[name]], dim=1)
        damping = both[1] if self.learns_damping else both[1].detach()
        return both[0], damping.exp()

    def distance_from_start(self) -> Tensor:
        pairs = zip(self.tensors(), self.start, strict=True)
        return torch.stack([((now - then) ** 2).sum() for now, then in pairs]).sum()

    def model(self, name: str, model: SpringMassModel) -> SpringMassModel:
        log_stiffness, damping = self.of(name)
        return replace(
            model,
            stiffness=log_stiffness.detach().exp().numpy().astype(np.float32),
            damping=damping.detach().numpy().astype(np.float32),
        )


def _horizon(iteration: int, config: FirstOrderConfig, frame_count: int) -> int:
    if not config.is_annealed or config.window is not None:
        return frame_count
    done = min(1.0, (iteration + 1) / max(1.0, config.iterations / 2))
    return max(2, round(frame_count * (0.25 + 0.75 * done)))


def optimise_springs(
    problems: Many[ObjectProblem],
    parameters: SimulationParameters,
    config: ObjectFitConfig,
    progress: Progress,
    *,
    device: str = "cpu",
) -> FirstOrderResult:
    """Give each spring its own stiffness and damping by gradient descent through the simulator.

    The gradient reaches back over `FirstOrderConfig.window` frames, or the whole sequence.

    Args:
        problems: One for each sequence, with one object between them.
        parameters: Global parameters found before.
        config: What stage 2 does.
        progress: Told once an iteration.
        device: Warp device.

    Returns:
        The best models that were simulated from start to end.

    Raises:
        FitError: If the start already diverges.
    """
    settings = config.first_order
    models = {p.name: build_problem_model(p, parameters) for p in problems}
    # Springs may stiffen while they are fitted, so the limit is kept farther away.
    parameters = settle_substeps(list(models.values()), parameters, config, safety=SAFETY * SAFETY)
    logs = _SpringLogs(models, learns_damping=settings.learns_damping)
    loss_before = mean_loss(problems, models, parameters, config, device)
    if not math.isfinite(loss_before):
        raise FitError("The searched parameters diverge; raise substeps_per_frame in the profile.")
    best, best_loss = dict(models), loss_before
    curve = [[0.0, loss_before]]
    optimizer = torch.optim.Adam(
        logs.tensors(), lr=settings.learning_rate, betas=(0.9, settings.beta_2)
    )
    for iteration in range(settings.iterations):
        progress.check_cancelled()
        try:
            for problem in problems:
                horizon = _horizon(iteration, settings, problem.frame_count)
                _descend(
                    problem,
                    models[problem.name],
                    logs,
                    optimizer,
                    parameters,
                    config,
                    horizon,
                    device,
                )
        except SimulationDivergedError as error:
            progress.report(STAGE, iteration, settings.iterations, best_loss, f"stopped: {error}")
            break
        now = {name: logs.model(name, model) for name, model in models.items()}
        loss = mean_loss(problems, now, parameters, config, device)
        if loss < best_loss:
            best, best_loss = now, loss
        curve.append([float(iteration + 1), loss])
        progress.report(STAGE, iteration + 1, settings.iterations, loss)
    return FirstOrderResult(
        models=best,
        parameters=parameters,
        loss_before=loss_before,
        loss_after=best_loss,
        curve=curve,
    )


def _descend(
    problem: ObjectProblem,
    model: SpringMassModel,
    logs: _SpringLogs,
    optimizer: torch.optim.Optimizer,
    parameters: SimulationParameters,
    config: ObjectFitConfig,
    horizon: int,
    device: str,
) -> None:
    """Walk once through a sequence and update after every window of frames."""
    window = config.first_order.window or horizon - 1
    parameters = problem_parameters(parameters, problem)
    position = torch.from_numpy(model.object_node)
    velocity = torch.from_numpy(model.initial_velocity)
    for begin in range(0, horizon - 1, window):
        end = min(begin + window, horizon - 1)
        node, node_velocity = _gradient(
            problem,
            model,
            logs,
            optimizer,
            parameters,
            config,
            (begin, end, position, velocity),
            device,
        )
        optimizer.step()
        position, velocity = node[-1].detach(), node_velocity[-1].detach()


def _gradient(
    problem: ObjectProblem,
    model: SpringMassModel,
    logs: _SpringLogs,
    optimizer: torch.optim.Optimizer,
    parameters: SimulationParameters,
    config: ObjectFitConfig,
    stretch: tuple[int, int, Tensor, Tensor],
    device: str,
) -> tuple[Tensor, Tensor]:
    """Leave the gradient of one window in the parameters; return the simulated motion.

    Motion that is chaotic over the window has gradients that grow without bound and point nowhere;
    the window is then cut in halves until they are sane.
    """
    begin, end, position, velocity = stretch
    cut: int | None = None
    while True:
        optimizer.zero_grad()
        log_stiffness, damping = logs.of(problem.name)
        node, node_velocity = differentiable.rollout(
            model,
            parameters,
            torch.from_numpy(problem.control[begin : end + 1]),
            log_stiffness=log_stiffness,
            damping=damping,
            initial_position=position,
            initial_velocity=velocity,
            device=device,
            window=cut,
        )
        frame_losses = problem.frame_losses(
            node[1:],
            first_frame=begin + 1,
            track_weight=config.track_weight,
            freeze_counts=config.freezes_counts,
        )
        loss = frame_losses.mean() + config.first_order.prior_weight * logs.distance_from_start()
        loss.backward()
        gradients = [tensor.grad for tensor in logs.tensors() if tensor.grad is not None]
        steepest = max(float(gradient.double().norm()) for gradient in gradients)
        if steepest <= STEEPEST * float(loss.detach()):
            return node, node_velocity
        cut = (end - begin if cut is None else cut) // 2
        if cut == 0:
            raise FitError(
                f"The gradient over one frame of sequence '{problem.name}' is out of bounds. Raise "
                "substeps_per_frame, or lower the upper ends of the stiffness and damping intervals."
            )
