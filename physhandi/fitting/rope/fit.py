"""Steps of Levenberg and Marquardt on rollouts of a rope that bends.

First over windows that start in observed states, where chance decides nothing yet, then over whole
rollouts.
"""

import math
from collections.abc import Iterator
from collections.abc import Sequence as Many
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from scipy.interpolate import make_interp_spline

from physhandi.data.checkpoint import Checkpointer, resumed_note
from physhandi.errors import FitError, SimulationDivergedError
from physhandi.fitting.config import ObjectFitConfig
from physhandi.fitting.object_problem import (
    ObjectProblem,
    mean_loss_of,
    problem_parameters,
    rollout_in,
    settle_substeps,
)
from physhandi.fitting.preview import RolloutPreview
from physhandi.fitting.rope.bending import (
    LOGARITHMS,
    Bending,
    bent,
    rope_model,
    rope_parameters,
)
from physhandi.fitting.rope.moments import balance_moments, seen_nodes
from physhandi.fitting.search import SEARCH_STAGE, SearchResult
from physhandi.fitting.spring_optimisation import SPRING_STAGE, FirstOrderResult
from physhandi.one_thread import one_thread
from physhandi.progress import Progress
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.simulator import Simulator

WINDOW = 1.0
"""Time over which the rope is simulated from an observed state at first [s]."""
STIFFENING = 1.5
"""How much stiffer, and how much more damped, a rope may become with the same substeps."""
DIFFERENCE = 0.02
"""Step of a difference quotient: of a logarithm, and of a curvature [1/m]."""
LARGEST_CHANGE = (0.7, 3.0)
"""Most by which one step changes a logarithm, and a curvature [1/m]."""
FIRST_LEVENBERG, LEAST_LEVENBERG, MOST_TRIALS = 1e-2, 1e-4, 8
"""Levenberg's term, as a part of the diagonal, and how often a step is tried with four times it."""
LEAST_GAIN = 2e-3
"""Part of the loss that a step takes away if another one is to follow."""
SMALL_ERROR = 0.03
"""Errors above this count less than with their square, because chance decides them [m]."""


def start_rope(
    problems: Many[ObjectProblem],
    start: SimulationParameters,
    config: ObjectFitConfig,
    progress: Progress,
) -> SearchResult:
    """Find a rope's parameters without simulating candidates; the equivalent of `search_object`.

    Args:
        problems: One for each sequence; all must have the same object nodes at rest.
        start: Initial parameters.
        config: Settings of stage 2.
        progress: Receives a report.

    Raises:
        FitError: If nothing holds the rope.
    """
    fit = RopeFit(problems, start, config, progress)
    before = fit.loss(fit.straight)
    bending, after = fit.likely()
    if not math.isfinite(after):
        raise FitError(
            "The rope diverges, whether it is straight at rest or bent. Check that its nodes are "
            "in their order along it, and that control.npy holds both of its ends."
        )
    progress.report(SEARCH_STAGE, 1, 1, after)
    return SearchResult(
        parameters=fit.parameters.replace(drag=bending.drag),
        loss_before=before,
        loss_after=after,
        curve=[[1.0, before], [2.0, after]] if math.isfinite(before) else [[2.0, after]],
    )


@one_thread()
def fit_rope(
    problems: Many[ObjectProblem],
    start: SimulationParameters,
    config: ObjectFitConfig,
    progress: Progress,
    *,
    checkpointer: Checkpointer | None = None,
) -> FirstOrderResult:
    """Fit how a rope bends to whole rollouts; the equivalent of `optimise_springs`.

    Rollouts are simulated on the CPU: a rope of a dozen nodes leaves a GPU idle.

    Args:
        problems: One for each sequence; all show the same rope.
        start: Parameters that `start_rope` found.
        config: Settings of stage 2.
        progress: Receives a report each iteration.
        checkpointer: Keeps the state after a step; None keeps nothing.

    Raises:
        FitError: If nothing holds the rope.
    """
    fit = RopeFit(problems, start, config, progress)
    best, loss = fit.likely()
    loss_before, bending, curve = loss, best, [[0.0, loss]]
    count = config.rope_steps
    step = RopeStep(vector=best.to_vector(), levenberg=FIRST_LEVENBERG)
    number = 0  # Which of the two windows steps look at.

    def state() -> dict[str, ndarray]:
        return {
            "vector": step.vector,
            "levenberg": np.array([step.levenberg]),
            "place": np.array([number, step.made, step.is_last], np.int64),
            "best": best.to_array(),
            "loss": np.array([loss]),
            "curve": np.array(curve, np.float64),
        }

    checkpointer = checkpointer or Checkpointer()
    resumed = checkpointer.load(SPRING_STAGE, state(), growing=("curve",))
    first, stored_step = 0, None
    if resumed is not None:
        tensors = resumed.tensors
        first, made, is_last = tensors["place"].tolist()
        stored_step = RopeStep(
            vector=tensors["vector"],
            levenberg=float(tensors["levenberg"][0]),
            made=made,
            is_last=bool(is_last),
        )
        bending, best = Bending.from_vector(stored_step.vector), Bending.from_array(tensors["best"])
        loss, curve = float(tensors["loss"][0]), tensors["curve"].tolist()
        done = resumed.iteration
        progress.report(SPRING_STAGE, done, 2 * count, curve[-1][1], resumed_note(done))
    for number in range(first, 2):
        for step in fit.steps(bending, (WINDOW, None)[number], count, stored_step):
            bending = Bending.from_vector(step.vector)
            now = fit.loss(bending)
            curve.append([float(len(curve)), now])
            if now < loss:
                best, loss = bending, now
            checkpointer.offer(SPRING_STAGE, len(curve) - 1, state)
            progress.report(SPRING_STAGE, len(curve) - 1, 2 * count, now)
        stored_step = None
    return FirstOrderResult(
        models=fit.models(best),
        parameters=fit.parameters.replace(drag=best.drag),
        loss_before=loss_before,
        loss_after=loss,
        curve=curve,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class RopeStep:
    """Where a step of Levenberg and Marquardt led."""

    vector: Float[ndarray, " number"]
    """The numbers after it, see `Bending.to_vector`."""
    levenberg: float
    """Levenberg's term for the next one."""
    made: int = 0
    """Steps until here, this one included."""
    is_last: bool = False
    """Whether it gained so little that no other one follows."""


class RopeFit:
    """Rollouts of one rope in all sequences, and what they tell of its numbers."""

    def __init__(
        self,
        problems: Many[ObjectProblem],
        start: SimulationParameters,
        config: ObjectFitConfig,
        progress: Progress,
    ) -> None:
        """Balance moments and choose the substeps.

        Args:
            problems: One for each sequence; all show the same rope.
            start: Parameters of whatever is not about springs.
            config: Settings of stage 2.
            progress: Can cancel between two rollouts; shows the latest one.

        Raises:
            FitError: If nothing holds the rope.
        """
        self._problems, self._config, self._progress = problems, config, progress
        self.straight = Bending.straight(len(problems[0].object_node))
        """A rope of which nothing is known."""
        self.parameters = rope_parameters(problems[0], start)
        """Of the springs, with the substeps of all rollouts; a rollout has its own drag."""
        balanced = balance_moments(problems, self.parameters)
        likely = self.straight if balanced is None else balanced
        stiffer = replace(
            likely,
            stiffness=STIFFENING * max(likely.stiffness, self.straight.stiffness),
            damping=STIFFENING * max(likely.damping, self.straight.damping),
        )
        self.parameters = settle_substeps(
            list(self.models(stiffer).values()), self.parameters, config
        )
        self._preview = RolloutPreview(SPRING_STAGE, progress)
        self._simulators: dict[str, Simulator] = {}
        self._seen = {problem.name: seen_nodes(problem) for problem in problems}
        self.balanced = balanced
        """Rope that the balance of moments yields; None if it has no solution."""

    def likely(self) -> tuple[Bending, float]:
        """Give the rope that the balance of moments found, or the straight one, and its loss."""
        candidates = [each for each in (self.balanced, self.straight) if each is not None]
        losses = [self.loss(each) for each in candidates]
        index = int(np.argmin(losses))
        return candidates[index], losses[index]

    def models(self, bending: Bending) -> dict[str, SpringMassModel]:
        """Build the model of each sequence."""
        return {p.name: rope_model(p, self.parameters, bending) for p in self._problems}

    def loss(self, bending: Bending) -> float:
        """Give the mean loss of rollouts from frame 0, infinite if one diverges [m²]."""

        def simulate(problem: ObjectProblem) -> tuple[torch.Tensor, torch.Tensor]:
            return rollout_in(self._simulator(problem, bending), problem)

        show = self._preview.update
        loss = mean_loss_of(self._problems, simulate, self._config, on_rollout=show)
        self._preview.show(loss)
        return loss

    def steps(
        self, start: Bending, window: float | None, most: int, stored_step: RopeStep | None = None
    ) -> Iterator[RopeStep]:
        """Make Levenberg-Marquardt steps that lower the cost of `_errors`.

        Args:
            start: Where to begin.
            window: Time over which rollouts follow from an observed state; None for whole ones [s].
            most: Number of steps.
            stored_step: Step after which to go on; None for the first one.

        Yields:
            Each step; it ends where steps gain next to nothing.
        """
        step = stored_step or RopeStep(vector=start.to_vector(), levenberg=FIRST_LEVENBERG)
        if step.is_last:
            return
        vector, levenberg = step.vector, step.levenberg
        errors = self._errors(vector, window)
        if errors is None:
            return
        longest = np.full(len(vector), LARGEST_CHANGE[1])
        longest[: len(LOGARITHMS)] = LARGEST_CHANGE[0]
        cost = _cost(errors)
        for made in range(step.made, most):
            matrix, slope = self._normal_equations(vector, errors, window)
            before = cost
            for _ in range(MOST_TRIALS):
                damped = matrix + levenberg * np.diag(np.diag(matrix))
                change = np.clip(-np.linalg.solve(damped, slope), -longest, longest)
                tried = self._errors(vector + change, window)
                if tried is not None and _cost(tried) < cost:
                    vector, errors, cost = vector + change, tried, _cost(tried)
                    break
                levenberg *= 4.0
            else:
                return
            levenberg = max(levenberg / 4.0, LEAST_LEVENBERG)
            is_last = cost > (1.0 - LEAST_GAIN) * before
            yield RopeStep(vector=vector, levenberg=levenberg, made=made + 1, is_last=is_last)
            if is_last:
                return

    def _normal_equations(
        self, vector: Float[ndarray, " number"], errors: dict[str, ndarray], window: float | None
    ) -> tuple[Float[ndarray, "number number"], Float[ndarray, " number"]]:
        """Sum the normal equations of all sequences, by difference quotients."""
        matrix = np.zeros((len(vector), len(vector)))
        slope = np.zeros(len(vector))
        for problem in self._problems:
            own = errors[problem.name]
            weight = np.sqrt(_weight(own))[..., None]
            changes = np.zeros((len(vector), own.size))
            for number in range(len(vector)):
                other = vector.copy()
                other[number] += DIFFERENCE
                moved = self._errors_of(problem, Bending.from_vector(other), window)
                if moved is not None:
                    changes[number] = (weight * (moved - own) / DIFFERENCE).ravel()
            matrix += changes @ changes.T / len(own)
            slope += changes @ (weight * own).ravel() / len(own)
        return matrix, slope

    def _errors(
        self, vector: Float[ndarray, " number"], window: float | None
    ) -> dict[str, ndarray] | None:
        bending = Bending.from_vector(vector)
        errors = {}
        for problem in self._problems:
            own = self._errors_of(problem, bending, window)
            if own is None:
                return None
            errors[problem.name] = own
        return errors

    def _errors_of(
        self, problem: ObjectProblem, bending: Bending, window: float | None
    ) -> Float[ndarray, "seen 3"] | None:
        """Give how far the markers are from where they were seen [m]; None if the rope diverges."""
        self._progress.check_cancelled()
        simulator = self._simulator(problem, bending)
        control = problem.control[: problem.frame_count]
        node = np.empty((problem.frame_count, *problem.object_node.shape), np.float32)
        seen = self._seen[problem.name]
        try:
            for first, last, state in _windows(problem, seen, window):
                simulator.reset(*state)
                for frame in range(first + 1, last + 1):
                    simulator.step_frame(frame, control[frame - 1], control[frame])
                    node[frame] = simulator.position.numpy()
        except SimulationDivergedError:
            return None
        track = problem.predict_tracks(torch.from_numpy(node[1:]))
        error = (track - problem.track[1:])[problem.is_valid[1:]]
        return error.numpy().astype(np.float64)

    def _simulator(self, problem: ObjectProblem, bending: Bending) -> Simulator:
        """Give the one simulator of a sequence other numbers.

        To record the launches of a frame anew takes as long as a rollout.
        """
        simulator = self._simulators.get(problem.name)
        if simulator is None:
            model = rope_model(problem, self.parameters, bending)
            simulator = Simulator(model, problem_parameters(self.parameters, problem))
            self._simulators[problem.name] = simulator
        simulator.set_rod(bent(simulator.model, bending))
        simulator.set_parameters(simulator.parameters.replace(drag=bending.drag))
        return simulator


def _windows(
    problem: ObjectProblem, seen: Float[ndarray, "frame node 3"] | None, window: float | None
) -> Iterator[tuple[int, int, tuple[ndarray, ndarray]]]:
    """Give the first and last frame of each rollout, and positions and velocities it begins in."""
    last = problem.frame_count - 1
    state = problem.object_node, problem.initial_velocity
    if window is None or seen is None:
        yield 0, last, state
        return
    time = np.arange(len(seen)) / problem.frame_rate
    velocity = make_interp_spline(time, seen, k=5)(time, 1)
    length = max(1, round(window * problem.frame_rate))
    for first in range(0, last, length):
        yield first, min(first + length, last), (seen[first], velocity[first]) if first else state


def _weight(error: Float[ndarray, "seen 3"]) -> Float[ndarray, " seen"]:
    """Weigh each error as the pseudo-Huber loss does."""
    return 1.0 / np.sqrt(1.0 + (error**2).sum(axis=1) / SMALL_ERROR**2)


def _cost(errors: dict[str, Float[ndarray, "seen 3"]]) -> float:
    """Average the pseudo-Huber loss, over what was seen of a sequence and over sequences [m²]."""
    return float(
        np.mean([2.0 * SMALL_ERROR**2 * (1.0 / _weight(e) - 1.0).mean() for e in errors.values()])
    )
