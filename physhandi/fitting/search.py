"""Stage 2, zeroth order: CMA-ES over the global parameters that have no gradient."""

import math
import warnings
from collections.abc import Callable, Mapping
from collections.abc import Sequence as Many
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.errors import FitError
from physhandi.fitting.config import SearchConfig, SearchVariable
from physhandi.fitting.search_bounds import bounds_met, interval_text, widened
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
    intervals: dict[str, SearchVariable] = field(default_factory=dict[str, SearchVariable])
    """Interval in which each searched parameter was looked for at last."""
    widened: tuple[str, ...] = ()
    """Parameters whose interval was lengthened during the search."""
    runners_up: tuple[SimulationParameters, ...] = ()
    """The next best parameters, which connect nodes over other distances, the best first."""

    @property
    def note(self) -> str:
        """Departures of the search from its settings, in a sentence; empty if there are none."""
        if not self.widened:
            return ""
        texts = (f"{name} to {interval_text(name, self.intervals[name])}" for name in self.widened)
        return f"Ended at a bound and went on with wider intervals: {', '.join(texts)}."


def search_parameters(
    evaluate: Evaluate, start: SimulationParameters, config: SearchConfig, progress: Progress
) -> SearchResult:
    """Search global parameters with CMA-ES (paper, zeroth-order stage; PhysTwin §4.2).

    Where a parameter ends at a bound of its interval, the search goes on once with wider intervals,
    for `SearchConfig.widening_generations`.

    Args:
        evaluate: Called once with the start and once with each generation.
        start: Initial parameters; those that are not searched keep their values.
        config: Intervals and effort.
        progress: Receives a report each generation.

    Raises:
        FitError: If every candidate diverges.
    """
    ((start, loss_before),) = evaluate([start])
    if not config.variables or config.generations == 0:
        return SearchResult(
            parameters=start,
            loss_before=loss_before,
            loss_after=loss_before,
            curve=[[1.0, loss_before]],
        )
    with warnings.catch_warnings():
        # cma warns that it cannot import matplotlib, which only its unused plots need.
        warnings.filterwarnings("ignore", message="Could not import matplotlib")
        import cma
    search = _Search(cma, evaluate, start, loss_before, config, progress)
    search.evolve(config.variables, start, config.generations)
    if not math.isfinite(search.best_loss):
        raise FitError(
            f"All {search.evaluations} candidates diverged. Lower the upper end of the stiffness "
            "interval or raise substeps_per_frame in the profile."
        )
    intervals, ends = dict(config.variables), {}
    if config.widening_generations:
        ends = bounds_met(search.best, intervals)
    if ends:
        intervals = widened(intervals, ends)
        search.evolve(intervals, search.best, config.widening_generations)
    return SearchResult(
        parameters=search.best,
        loss_before=loss_before,
        loss_after=search.best_loss,
        curve=search.curve,
        intervals=intervals,
        widened=tuple(ends),
    )


class _Search:
    """The best candidate of all generations so far."""

    def __init__(  # noqa: PLR0917  (what `search_parameters` is given)
        self,
        cma: Any,
        evaluate: Evaluate,
        start: SimulationParameters,
        loss_before: float,
        config: SearchConfig,
        progress: Progress,
    ) -> None:
        self._cma, self._evaluate, self._config, self._progress = cma, evaluate, config, progress
        self._start = start
        self._generation, self._planned = 0, 0
        self.best = start
        self.best_loss = loss_before if config.keeps_start else math.inf
        self.curve = [[1.0, loss_before]]
        self.evaluations = 1

    def evolve(
        self,
        variables: Mapping[str, SearchVariable],
        mean: SimulationParameters,
        generations: int,
    ) -> None:
        """Evolve so many generations, beginning around some parameters.

        Args:
            variables: Interval of each searched parameter.
            mean: Parameters to begin with.
            generations: How many.
        """
        config = self._config
        # pycma 4.5 fails when it bounds the step of a single variable.
        longest = config.longest_step if len(variables) > 1 else None
        options = {
            "bounds": [0, 1],
            "maxstd": np.inf if longest is None else longest,
            "seed": config.seed,
            "verbose": -9,
            "verb_log": 0,
        }
        if config.population is not None:
            options["popsize"] = config.population
        first = [v.to_unit(float(getattr(mean, name))) for name, v in variables.items()]
        # CMA's transform has zero slope exactly on a bound, so a start there could never leave it.
        begin = np.clip(np.array(first), 0.01, 0.99)
        strategy = self._cma.CMAEvolutionStrategy(begin, config.sigma, options)
        self._planned += generations
        for _ in range(generations):
            self._progress.check_cancelled()
            units = strategy.ask()
            evaluated = self._evaluate([self._candidate(variables, unit) for unit in units])
            losses = [loss for _, loss in evaluated]
            self.evaluations += len(losses)
            winner = int(np.argmin(losses))
            if losses[winner] < self.best_loss:
                self.best, self.best_loss = evaluated[winner]
            # CMA uses ranks only, so any value above all finite ones stands for "diverged".
            finite = [loss for loss in losses if math.isfinite(loss)]
            worst = max(finite, default=1.0)
            strategy.tell(units, [loss if math.isfinite(loss) else 10.0 * worst for loss in losses])
            self.curve.append([float(self.evaluations), self.best_loss])
            self._generation += 1
            self._progress.report(SEARCH_STAGE, self._generation, self._planned, self.best_loss)

    def _candidate(
        self, variables: Mapping[str, SearchVariable], unit: Float[ndarray, " variable"]
    ) -> SimulationParameters:
        values = {
            name: variable.from_unit(float(u))
            for (name, variable), u in zip(variables.items(), unit, strict=True)
        }
        tied = self._config.tied.items()
        return self._start.replace(
            **values, **{name: values[other] for name, other in tied if other in values}
        )
