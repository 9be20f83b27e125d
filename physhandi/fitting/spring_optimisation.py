"""Stage 2, first order: a stiffness and a damping for every spring, by gradient descent."""

import logging
import math
from collections.abc import Sequence as Many
from dataclasses import dataclass, replace

import numpy as np

from physhandi.errors import FitError, SimulationDivergedError
from physhandi.fitting.descent import Descent
from physhandi.fitting.material import Material
from physhandi.fitting.object_config import FirstOrderConfig, ObjectFitConfig
from physhandi.fitting.object_problem import ObjectProblem
from physhandi.fitting.object_simulation import (
    SAFETY,
    build_problem_model,
    mean_loss,
    settle_substeps,
)
from physhandi.fitting.preview import RolloutPreview
from physhandi.progress import Progress
from physhandi.simulation.model import SimulationParameters, SpringMassModel

STAGE = "first_order"
logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class FirstOrderResult:
    """Models with a fitted stiffness and damping for every spring."""

    models: dict[str, SpringMassModel]
    """The fitted model of each sequence; object springs are the same in all."""
    parameters: SimulationParameters
    """The global parameters, with the substeps that the fitted springs need and, where contact is
    learned, its coefficients."""
    loss_before: float
    """Mean loss of the start [m²]."""
    loss_after: float
    """Mean loss of the returned models [m²]."""
    curve: list[list[float]]
    """Iteration and mean loss, as iterations are ranked by."""
    stopped: str = ""
    """Why it went no further than it did; empty if all iterations were made."""


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
        The best models, as `FirstOrderConfig` ranks them.

    Raises:
        FitError: If the start already diverges or has no usable gradient, or what was ranked best
            diverges. What goes wrong later ends the descent, and the best so far is returned.
    """
    settings = config.first_order
    if settings.truncates_damping:
        parameters = _truncated(parameters)
    models = {p.name: build_problem_model(p, parameters) for p in problems}
    # Springs may stiffen while they are fitted, so the limit is kept farther away.
    parameters = settle_substeps(list(models.values()), parameters, config, safety=SAFETY * SAFETY)
    material = Material(models, parameters, settings)
    loss_before = _finite(
        mean_loss(problems, models, parameters, config, device),
        "The searched parameters diverge; raise substeps_per_frame in the profile.",
    )
    best, best_parameters = dict(models), parameters
    best_loss = math.inf if settings.judges_online else loss_before
    curve = [[0.0, loss_before]]
    descent = Descent(material, parameters, config, device)
    preview = RolloutPreview(STAGE, progress)
    stopped = ""
    for iteration in range(settings.iterations):
        progress.check_cancelled()
        try:
            met = [
                descent.walk(p, models[p.name], _horizon(iteration, settings, p.frame_count))
                for p in problems
            ]
            note = _tell(problems, met)
        except (SimulationDivergedError, FitError) as error:
            if isinstance(error, FitError) and iteration == 0:
                raise
            stopped = f"Stopped after {iteration} of {settings.iterations} iterations. {error}"
            logger.warning("%s: %s", STAGE, stopped)
            progress.report(STAGE, iteration, settings.iterations, best_loss, stopped)
            break
        now = {name: material.model(name, model) for name, model in models.items()}
        now_parameters = material.parameters(parameters)
        if settings.judges_online:
            loss = float(np.mean([value for value in met if value is not None]))
        else:
            loss = mean_loss(problems, now, now_parameters, config, device, seen=preview.see)
            preview.show(loss)
        if _is_judged(iteration, settings) and loss < best_loss:
            best, best_parameters, best_loss = now, now_parameters, loss
        curve.append([float(iteration + 1), loss])
        progress.report(STAGE, iteration + 1, settings.iterations, loss, note)
    if settings.judges_online:
        best_loss = _finite(
            mean_loss(problems, best, best_parameters, config, device),
            "The springs that did best while they were fitted diverge when simulated from start "
            "to end; raise substeps_per_frame or switch judges_online off in the profile.",
        )
    return FirstOrderResult(
        models=best,
        parameters=best_parameters,
        loss_before=loss_before,
        loss_after=best_loss,
        curve=curve,
        stopped=stopped,
    )


def _finite(loss: float, otherwise: str) -> float:
    if not math.isfinite(loss):
        raise FitError(otherwise)
    return loss


def _truncated(parameters: SimulationParameters) -> SimulationParameters:
    damping, drag = math.trunc(parameters.damping), math.trunc(parameters.drag)
    return replace(parameters, damping=float(damping), drag=float(drag))


def _is_judged(iteration: int, config: FirstOrderConfig) -> bool:
    return iteration % config.judged_every == 0 or iteration == config.iterations - 1


def _tell(problems: Many[ObjectProblem], met: list[float | None]) -> str:
    """Say which sequences gave no usable gradient; there must be one that did."""
    skipped = [p.name for p, loss in zip(problems, met, strict=True) if loss is None]
    if len(skipped) == len(problems):
        raise FitError(
            "No sequence has a usable gradient, not even over one frame. Raise substeps_per_frame, "
            "or lower the upper ends of the stiffness and damping intervals."
        )
    return f"too chaotic to learn from: {', '.join(skipped)}" if skipped else ""
