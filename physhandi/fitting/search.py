"""Stage 2, zeroth order: CMA-ES over the global parameters that have no gradient."""

import math
import warnings
from collections.abc import Callable
from collections.abc import Sequence as Many
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.errors import FitError
from physhandi.fitting.config import SearchConfig
from physhandi.progress import Progress
from physhandi.simulation.parameters import SimulationParameters

SEARCH_STAGE = "zeroth_order"
"""Name of the stage in progress reports."""
Evaluate = Callable[[list[SimulationParameters]], Many[tuple[SimulationParameters, float]]]
"""Fills in what follows from each candidate's values, such as its substeps, and computes its loss
[m²], infinite where its simulation diverges."""


@dataclass(frozen=True, kw_only=True)
class SearchResult:
    """The best global parameters of a search."""

    parameters: SimulationParameters
    """Best parameters; those of the start if nothing was better."""
    loss_before: float
    """Loss of the start values [m²]."""
    loss_after: float
    """Loss of the best values [m²]."""
    curve: list[list[float]]
    """Evaluations so far and best loss, once a generation."""


def search_parameters(
    evaluate: Evaluate, start: SimulationParameters, config: SearchConfig, progress: Progress
) -> SearchResult:
    """Search global parameters with CMA-ES (paper, zeroth-order stage; PhysTwin §4.2).

    Args:
        evaluate: Called once with the start and once with each generation.
        start: Initial parameters; those that are not searched keep their values.
        config: Intervals and effort.
        progress: Receives a report each generation.

    Raises:
        FitError: If every candidate diverges.
    """
    with warnings.catch_warnings():
        # cma warns that it cannot import matplotlib, which only its unused plots need.
        warnings.filterwarnings("ignore", message="Could not import matplotlib")
        import cma

    names = list(config.variables)
    ((start, loss_before),) = evaluate([start])
    best, best_loss = start, loss_before
    curve = [[1.0, loss_before]]
    if not names or config.generations == 0:
        return SearchResult(
            parameters=start, loss_before=loss_before, loss_after=loss_before, curve=curve
        )

    def candidate(unit: Float[ndarray, " variable"]) -> SimulationParameters:
        values = {
            n: config.variables[n].from_unit(float(u)) for n, u in zip(names, unit, strict=True)
        }
        values |= {name: values[other] for name, other in config.tied.items() if other in values}
        return start.replace(**values)

    if not config.keeps_start:
        best_loss = math.inf
    # pycma 4.5 fails when it bounds the step of a single variable.
    longest = config.longest_step if len(names) > 1 else None
    options = {
        "bounds": [0, 1],
        "maxstd": np.inf if longest is None else longest,
        "seed": config.seed,
        "verbose": -9,
        "verb_log": 0,
    }
    if config.population is not None:
        options["popsize"] = config.population
    first = np.array(
        [config.variables[name].to_unit(float(getattr(start, name))) for name in names]
    )
    # CMA's transform has zero slope exactly on a bound, so a start there could never leave it.
    strategy = cma.CMAEvolutionStrategy(np.clip(first, 0.01, 0.99), config.sigma, options)
    evaluations = 1
    for generation in range(config.generations):
        progress.check_cancelled()
        units = strategy.ask()
        evaluated = evaluate([candidate(unit) for unit in units])
        losses = [loss for _, loss in evaluated]
        evaluations += len(losses)
        winner = int(np.argmin(losses))
        if losses[winner] < best_loss:
            best, best_loss = evaluated[winner]
        # CMA uses ranks only, so any value above all finite ones stands for "diverged".
        finite = [loss for loss in losses if math.isfinite(loss)]
        worst = max(finite, default=1.0)
        strategy.tell(units, [loss if math.isfinite(loss) else 10.0 * worst for loss in losses])
        curve.append([float(evaluations), best_loss])
        progress.report(SEARCH_STAGE, generation + 1, config.generations, best_loss)
    if not math.isfinite(best_loss):
        raise FitError(
            f"All {evaluations} candidates diverged. Lower the upper end of the stiffness interval "
            "or raise substeps_per_frame in the profile."
        )
    return SearchResult(parameters=best, loss_before=loss_before, loss_after=best_loss, curve=curve)
