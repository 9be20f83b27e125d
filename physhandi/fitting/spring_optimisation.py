"""Stage 2, first order: a stiffness and a damping for every spring, by gradient descent."""

import math
from collections.abc import Sequence as Many
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from physhandi.errors import FitError, SimulationDivergedError
from physhandi.fitting.object_problem import ObjectProblem
from physhandi.fitting.object_reconstruction import (
    SAFETY,
    FirstOrderConfig,
    ObjectFitConfig,
    build_problem_model,
    mean_loss,
    problem_parameters,
    settle_substeps,
)
from physhandi.progress import Progress
from physhandi.simulation import differentiable
from physhandi.simulation.model import SimulationParameters, SpringMassModel

STAGE = "first_order"
STEEPEST = 100.0
"""Largest sane gradient, in losses per unit of the logarithm of a stiffness."""


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
                    f"Sequence '{name}' connects the object's nodes differently from the first "
                    "one: sequences fitted together must share one object and its rest nodes."
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
    descent = _Descent(logs, parameters, config, device)
    for iteration in range(settings.iterations):
        progress.check_cancelled()
        try:
            walked = [
                descent.walk(p, models[p.name], _horizon(iteration, settings, p.frame_count))
                for p in problems
            ]
        except SimulationDivergedError as error:
            progress.report(STAGE, iteration, settings.iterations, best_loss, f"stopped: {error}")
            break
        now = {name: logs.model(name, model) for name, model in models.items()}
        loss = mean_loss(problems, now, parameters, config, device)
        if loss < best_loss:
            best, best_loss = now, loss
        curve.append([float(iteration + 1), loss])
        progress.report(STAGE, iteration + 1, settings.iterations, loss, _tell(problems, walked))
    return FirstOrderResult(
        models=best,
        parameters=parameters,
        loss_before=loss_before,
        loss_after=best_loss,
        curve=curve,
    )


def _tell(problems: Many[ObjectProblem], walked: list[bool]) -> str:
    """Say which sequences gave no usable gradient; there must be one that did."""
    skipped = [p.name for p, was_walked in zip(problems, walked, strict=True) if not was_walked]
    if len(skipped) == len(problems):
        raise FitError(
            "No sequence has a usable gradient, not even over one frame. Raise substeps_per_frame, "
            "or lower the upper ends of the stiffness and damping intervals."
        )
    return f"too chaotic to learn from: {', '.join(skipped)}" if skipped else ""


class _Descent:
    """Adam on the springs' logarithms, with sane gradients only."""

    def __init__(
        self,
        logs: _SpringLogs,
        parameters: SimulationParameters,
        config: ObjectFitConfig,
        device: str,
    ) -> None:
        self.logs = logs
        self.parameters = parameters
        self.config = config
        self.device = device
        settings = config.first_order
        self.optimizer = torch.optim.Adam(
            logs.tensors(), lr=settings.learning_rate, betas=(0.9, settings.beta_2)
        )
        self.reach: dict[str, int] = {}

    def walk(self, problem: ObjectProblem, model: SpringMassModel, horizon: int) -> bool:
        """Walk once through a sequence and update after every window of frames.

        Returns:
            Whether the gradient was usable; if not, the rest of the sequence is left out.
        """
        window = self.config.first_order.window or horizon - 1
        state = torch.from_numpy(model.object_node), torch.from_numpy(model.initial_velocity)
        for begin in range(0, horizon - 1, window):
            end = min(begin + window, horizon - 1)
            found = self._find_gradient(problem, model, (begin, end), state)
            if found is None:
                return False
            state = found
            self.optimizer.step()
        return True

    def _find_gradient(
        self,
        problem: ObjectProblem,
        model: SpringMassModel,
        frames: tuple[int, int],
        state: tuple[Tensor, Tensor],
    ) -> tuple[Tensor, Tensor] | None:
        """Leave the gradient of one window in the parameters; return the state at its end.

        Motion that is chaotic over the window has gradients that grow without bound and point
        nowhere. The gradient then reaches back over half as many frames, and again half as many
        until it is sane; how far it came is tried first the next time.
        """
        begin, end = frames
        reach = min(self.reach.get(problem.name, end - begin), end - begin)
        while reach >= 1:
            self.optimizer.zero_grad()
            log_stiffness, damping = self.logs.of(problem.name)
            node, velocity = differentiable.rollout(
                model,
                problem_parameters(self.parameters, problem),
                torch.from_numpy(problem.control[begin : end + 1]),
                log_stiffness=log_stiffness,
                damping=damping,
                initial_position=state[0],
                initial_velocity=state[1],
                device=self.device,
                window=reach,
            )
            loss = self._loss(problem, node[1:], begin + 1)
            loss.backward()
            gradients = [t.grad for t in self.logs.tensors() if t.grad is not None]
            steepest = max(float(gradient.double().norm()) for gradient in gradients)
            if steepest <= STEEPEST * float(loss.detach()):
                if reach < end - begin:
                    self.reach[problem.name] = reach
                return node[-1].detach(), velocity[-1].detach()
            reach //= 2
        return None

    def _loss(self, problem: ObjectProblem, node: Tensor, first_frame: int) -> Tensor:
        frame_losses = problem.frame_losses(
            node,
            first_frame=first_frame,
            track_weight=self.config.track_weight,
            freeze_counts=self.config.freezes_counts,
        )
        prior = self.config.first_order.prior_weight * self.logs.distance_from_start()
        return frame_losses.mean() + prior
