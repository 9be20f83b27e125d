"""Judge the candidates of the search: give each its substeps, simulate it, compare."""

from collections.abc import Sequence as Many

import numpy as np
import torch
import warp as wp

from physhandi.fitting.object_config import ObjectFitConfig
from physhandi.fitting.object_problem import ObjectProblem
from physhandi.fitting.object_simulation import (
    mean_loss,
    problem_parameters,
    settle_substeps,
    simulate_problem,
)
from physhandi.fitting.preview import RolloutPreview
from physhandi.fitting.search import STAGE
from physhandi.progress import Progress
from physhandi.simulation.batch import BatchSimulator
from physhandi.simulation.batch_losses import MotionTarget
from physhandi.simulation.master import MasterTopology
from physhandi.simulation.model import SimulationParameters, SpringMassModel


class Judge:
    """Finds the loss of candidates over all sequences.

    On CUDA a generation is one batch for each sequence, and the host waits for each batch once;
    on a CPU, or with self-collision, candidates take turns.
    """

    def __init__(
        self,
        problems: Many[ObjectProblem],
        config: ObjectFitConfig,
        progress: Progress,
        *,
        device: str = "cpu",
    ) -> None:
        """Reduce the observations to what is compared.

        Args:
            problems: One for each sequence.
            config: Weights and substeps.
            progress: Asked between simulations whether to stop.
            device: Warp device.
        """
        self._problems, self._config, self._progress = problems, config, progress
        self._device = device
        self._targets = [motion_target(problem, config) for problem in problems]
        self._preview = RolloutPreview(STAGE, progress)
        self._best_loss = np.inf
        self._best: tuple[SimulationParameters, SpringMassModel] | None = None

    def __call__(
        self, candidates: Many[SimulationParameters]
    ) -> list[tuple[SimulationParameters, float]]:
        """Return each candidate with its substeps, and its loss [m²].

        The loss is infinite for a candidate that diverges, has no springs or needs more substeps
        than the configuration allows.
        """
        candidates = [problem_parameters(p, self._problems[0]) for p in candidates]
        masters = [
            MasterTopology.of(
                problem.object_node,
                problem.control[0],
                candidates,
                rest_node=problem.rest_node,
                initial_velocity=problem.initial_velocity,
            )
            for problem in self._problems
        ]
        settled, possible = [], []
        for index, parameters in enumerate(candidates):
            models = [master.model(parameters) for master in masters]
            settled.append(settle_substeps(models, parameters, self._config))
            if self._is_possible(models, settled[-1]):
                possible.append(index)
        losses = np.full((len(masters), len(candidates)), np.inf)
        for row, master in enumerate(masters):
            self._simulate(row, master, settled, possible, losses[row])
        mean = [float(value) for value in losses.mean(axis=0)]
        winner = int(np.argmin(mean))
        if mean[winner] < self._best_loss:
            self._best_loss = mean[winner]
            self._best = settled[winner], masters[0].model(settled[winner])
        self._show_best()
        return list(zip(settled, mean, strict=True))

    def _show_best(self) -> None:
        """Simulate the best candidate for whoever watches, at most once for each."""
        if self._best is None or not self._progress.wants_preview():
            return
        (parameters, model), self._best = self._best, None
        problem = self._problems[0]
        self._preview.show_made(
            problem,
            self._best_loss,
            lambda: simulate_problem(problem, model, parameters, self._device)[0],
        )

    def _is_possible(self, models: Many[SpringMassModel], parameters: SimulationParameters) -> bool:
        has_springs = all(len(model.spring_nodes) > 0 for model in models)
        return has_springs and parameters.substeps_per_frame <= self._config.most_substeps

    def _simulate(
        self,
        row: int,
        master: MasterTopology,
        candidates: Many[SimulationParameters],
        possible: list[int],
        losses: np.ndarray,
    ) -> None:
        """Fill in the losses of the candidates that can be simulated, in one sequence."""
        problem = self._problems[row]
        is_shared = wp.get_device(self._device).is_cuda
        batch = []
        for index in possible:
            if not candidates[index].self_collision:
                batch.append(index)
                continue
            self._progress.check_cancelled()
            models = {problem.name: master.model(candidates[index])}
            losses[index] = mean_loss(
                [problem],
                models,
                candidates[index],
                self._config,
                self._device,
                acceleration_weight=self._config.acceleration_weight,
            )
        for part in [batch] if is_shared and batch else [[index] for index in batch]:
            self._progress.check_cancelled()
            parameters = [problem_parameters(candidates[index], problem) for index in part]
            simulator = BatchSimulator(master, parameters, self._device)
            control = problem.control[: problem.frame_count]
            losses[part] = simulator.losses(control, self._targets[row]).loss


def motion_target(problem: ObjectProblem, config: ObjectFitConfig) -> MotionTarget:
    """Reduce what was observed of a sequence to points, tracks and their weights.

    The loss that it stands for is that of `ObjectProblem.frame_losses`.
    """

    def weights(counts: torch.Tensor, factor: float) -> np.ndarray:
        divisor = counts.sum(dim=1)
        if config.freezes_counts:
            divisor = divisor[1].expand(len(counts))
        return (factor * counts / divisor.clamp(min=1)[:, None]).numpy().astype(np.float32)

    return MotionTarget(
        cloud=torch.nan_to_num(problem.cloud).numpy(),
        cloud_weight=weights(problem.is_observed, 1.0),
        surface_count=problem.surface_count,
        track=torch.nan_to_num(problem.track).numpy(),
        track_weight=weights(problem.is_valid, config.track_weight),
        carrier=problem.carrier.numpy(),
        carrier_weight=problem.carrier_weight.numpy(),
        track_offset=problem.track_offset.numpy(),
        acceleration_weight=config.acceleration_weight,
    )
