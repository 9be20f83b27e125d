"""Stage 2, first order: fits a stiffness and a damping of every spring by gradient descent.

`optimise_springs` owns the loop, `Material` the learned values, `SpringDescent` the gradients;
`fit_steady_springs` begins again from another candidate of the search where motion is unsteady.
"""

import logging
import math
from collections.abc import Callable, Mapping
from collections.abc import Sequence as Many
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
import warp as wp
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from physhandi.adam import Adam
from physhandi.data.checkpoint import Checkpointer, resumed_note
from physhandi.errors import FitError, SimulationDivergedError
from physhandi.fitting.config import FirstOrderConfig, ObjectFitConfig
from physhandi.fitting.object_problem import (
    SUBSTEP_SAFETY,
    ObjectProblem,
    build_problem_model,
    mean_loss,
    problem_parameters,
    settle_substeps,
)
from physhandi.fitting.preview import RolloutPreview
from physhandi.fitting.rest_state import hold_still
from physhandi.one_thread import one_thread
from physhandi.progress import Progress, RelayedProgress
from physhandi.simulation import differentiable
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.surface import typical_distance

CONTACT = {
    "restitution": (0.0, 1.0),
    "friction": (0.0, 2.0),
    "self_restitution": (0.0, 1.0),
    "self_friction": (0.0, 2.0),
}
"""Interval to which the simulator clamps each contact coefficient (physics.md §3.2)."""
SMALLEST_VALUE = 1e-6
"""Lower bound of stiffness [N] and damping [N·s/m] before the logarithm is taken."""
State = tuple[Float[Tensor, "node 3"], Float[Tensor, "node 3"]]
"""Positions [m] and velocities [m/s] of the object nodes."""
SPRING_STAGE = "first_order"
STEADY = 0.05
"""Distance by which `NUDGE` may move a steady motion on average, in typical distances of nodes."""
NUDGE = 0.01
"""Part of the stiffness by which motion is tried; an unsteady one is moved as far by rounding."""
_WHOLE = -1
"""Stored reach of gradients that were never too steep."""
logger = logging.getLogger(__name__)

_NOT_HELD = (
    "Rest lengths that hold the object still at first make it diverge, so it begins with those "
    "that the search judged."
)


@dataclass(frozen=True, kw_only=True)
class FirstOrderResult:
    """Models with a fitted stiffness and damping for every spring."""

    models: dict[str, SpringMassModel]
    """The fitted model of each sequence; object springs are the same in all."""
    parameters: SimulationParameters
    """The global parameters, with the substeps that the fitted springs need and, if contact is
    learned, its coefficients."""
    loss_before: float
    """Mean loss of the start [m²]."""
    loss_after: float
    """Mean loss of the returned models [m²]."""
    curve: list[list[float]]
    """Iteration and the mean loss that ranks it [m²]."""
    stopped: str = ""
    """Why the descent ended early; empty if all iterations were made."""
    sway: float = 0.0
    """Largest mean distance by which `NUDGE` more or less stiffness moves the fitted frames, in
    typical distances of nodes; infinite where they diverge. Zero if it was not asked."""
    start: int = 0
    """Number of the candidate of the search that the springs began as; 0 is the best."""

    @property
    def note(self) -> str:
        """What a stage tells of it besides its losses; empty if that is nothing."""
        began = (
            f"Began from candidate {self.start + 1} of the search: what became of those before was "
            "unsteady, or failed."
        )
        return " ".join(filter(None, (began if self.start else "", self.stopped)))

    @property
    def is_steady(self) -> bool:
        """Whether the fitted motion hardly depends on a little more or less stiffness."""
        return self.sway <= STEADY


def fit_steady_springs(
    problems: Many[ObjectProblem],
    starts: Many[SimulationParameters],
    config: ObjectFitConfig,
    progress: Progress,
    *,
    device: str = "cpu",
    checkpointer: Checkpointer | None = None,
) -> FirstOrderResult:
    """Fit springs from one candidate of a search after the other until their motion is steady.

    A body about to buckle goes one way or another by rounding alone: its loss is luck, and so is
    its prediction. Other springs between the same nodes explain it as well and do not.

    Args:
        problems: One for each sequence; all show the same object.
        starts: Global parameters that the search found, the best first.
        config: Settings of stage 2.
        progress: Receives a report each iteration.
        device: Warp device.
        checkpointer: Keeps the state after an iteration; None keeps nothing.

    Returns:
        The first steady result; if there is none, that with the least loss of those that do not
        diverge with a little more or less stiffness, or of all.

    Raises:
        FitError: As `optimise_springs` does with the first start, if it does with all.
    """
    results: list[FirstOrderResult] = []
    failures: list[FitError] = []
    why = ""
    for number, start in enumerate(starts[: config.first_order.most_starts]):
        listener = _LaterStart(progress, number, why) if number else progress
        try:
            result = optimise_springs(
                problems,
                start,
                config,
                listener,
                device=device,
                checkpointer=checkpointer,
                loop=f"{SPRING_STAGE}_{number}" if number else SPRING_STAGE,
            )
        except FitError as error:
            logger.warning("%s: start %d fails. %s", SPRING_STAGE, number + 1, error)
            failures.append(error)
            why = f"{error}"
            continue
        sway = motion_sway(problems, result, device)
        results.append(replace(result, sway=sway, start=number))
        if results[-1].is_steady:
            return results[-1]
        why = unsteadiness(NUDGE, sway, STEADY)
    if not results:
        raise failures[0]
    return min(results, key=lambda each: (math.isinf(each.sway), each.loss_after))


def motion_sway(problems: Many[ObjectProblem], result: FirstOrderResult, device: str) -> float:
    """Measure how far a little more or less stiffness moves the fitted frames.

    Args:
        problems: One for each sequence.
        result: Their models.
        device: Warp device.

    Returns:
        `FirstOrderResult.sway`.
    """
    sways: list[float] = []
    for problem in problems:
        model = result.models[problem.name]
        parameters = problem_parameters(result.parameters, problem)
        simulator = Simulator(model, parameters, device=device)
        motions: list[ndarray] = []
        for factor in (1.0, 1.0 - NUDGE, 1.0 + NUDGE):
            simulator.set_material(stiffness=factor * model.stiffness)
            try:
                motion = simulator.rollout(problem.control[: problem.frame_count])
            except SimulationDivergedError:
                return math.inf
            motions.append(motion.position.astype(np.float64))
        shifts = [np.linalg.norm(motion - motions[0], axis=-1).mean() for motion in motions[1:]]
        sways.append(max(shifts) / typical_distance(problem.rest_node))
    return float(max(sways))


def unsteadiness(nudge: float, sway: float, limit: float) -> str:
    """Say how far a motion goes elsewhere with a little more or less stiffness.

    Args:
        nudge: Part of the stiffness by which that was tried.
        sway: `FirstOrderResult.sway`.
        limit: The most that would be steady.

    Returns:
        A sentence.
    """
    shift = f"moves nodes by {sway:.0%} of their distance ({limit:.0%} would be steady)"
    if math.isinf(sway):
        shift = "lets it diverge"
    return f"The fitted motion is unsteady: {nudge:.0%} more or less stiffness {shift}."


class _LaterStart(RelayedProgress):
    """Hears of a descent that begins after others, whose iterations count before its own."""

    def __init__(self, progress: Progress, number: int, why: str) -> None:
        super().__init__(progress)
        self._number = number
        self._note = f"{why} Springs are fitted from another candidate of the search."

    def report(
        self,
        stage: str,
        iteration: int,
        total: int,
        loss: float | None = None,
        message: str = "",
    ) -> None:
        message, self._note = " ".join(filter(None, (self._note, message))), ""
        before = self._number * total
        super().report(stage, before + iteration, before + total, loss, message)


@one_thread()
def optimise_springs(
    problems: Many[ObjectProblem],
    parameters: SimulationParameters,
    config: ObjectFitConfig,
    progress: Progress,
    *,
    device: str = "cpu",
    checkpointer: Checkpointer | None = None,
    loop: str = SPRING_STAGE,
) -> FirstOrderResult:
    """Fit each spring's own stiffness and damping by gradient descent through the simulator.

    The gradient reaches back over `FirstOrderConfig.window` frames, or the whole sequence.

    Args:
        problems: One for each sequence; all show the same object.
        parameters: Global parameters that the search found.
        config: Settings of stage 2.
        progress: Receives a report each iteration.
        device: Warp device.
        checkpointer: Keeps the state after an iteration; None keeps nothing.
        loop: Name under which it does.

    Returns:
        The best models, as `FirstOrderConfig` ranks them.

    Raises:
        FitError: If the start diverges, or if the best-ranked springs diverge. Where no gradient is
            usable, or springs diverge while they are fitted, the descent ends and the best so far
            is returned, be it the start.
    """
    settings = config.first_order
    if settings.truncates_damping:
        parameters = _truncated(parameters)
    problems = [problem.on(device) for problem in problems]
    models, parameters, loss_before = _first_models(problems, parameters, config, device, progress)
    material = Material(models, parameters, settings)
    course = _Course(models, parameters, loss_before, is_candidate=not settings.judges_online)
    descent = SpringDescent(material, parameters, config, device)
    checkpointer = checkpointer or Checkpointer()
    first = course.resume(problems, descent, checkpointer, loop)
    if first:
        last = course.curve[-1][1]
        progress.report(SPRING_STAGE, first, settings.iterations, last, resumed_note(first))
    preview, stopped = RolloutPreview(SPRING_STAGE, progress), ""
    for iteration in range(first, settings.iterations):
        progress.check_cancelled()
        try:
            losses = [
                descent.fit_pass(p, models[p.name], _horizon(iteration, settings, p.frame_count))
                for p in problems
            ]
            message = _skipped_message(problems, losses)
        except (SimulationDivergedError, FitError) as error:
            stopped = f"Stopped after {iteration} of {settings.iterations} iterations. {error}"
            logger.warning("%s: %s", SPRING_STAGE, stopped)
            progress.report(SPRING_STAGE, iteration, settings.iterations, course.loss, stopped)
            break
        now = {name: material.model(name, model) for name, model in models.items()}
        now_parameters = material.parameters(parameters)
        if settings.judges_online:
            loss = float(np.mean([value for value in losses if value is not None]))
        else:
            loss = descent.loss_ahead(problems, models, iteration + 1, preview.update)
            if loss is None:
                loss = mean_loss(
                    problems, now, now_parameters, config, device, on_rollout=preview.update
                )
            preview.show(loss)
        if _is_judged(iteration, settings) and loss < course.loss:
            course.models, course.parameters, course.loss = now, now_parameters, loss
        course.curve.append([float(iteration + 1), loss])
        checkpointer.offer(loop, iteration + 1, lambda: course.state(problems, descent))
        progress.report(SPRING_STAGE, iteration + 1, settings.iterations, loss, message)
    return _settled(problems, course.result(loss_before, stopped), config, device)


class _Course:
    """The best springs so far, and how the loss went."""

    def __init__(
        self,
        models: Mapping[str, SpringMassModel],
        parameters: SimulationParameters,
        loss: float,
        *,
        is_candidate: bool,
    ) -> None:
        self.models, self.parameters = dict(models), parameters
        self.loss = loss if is_candidate else math.inf
        self.curve = [[0.0, loss]]

    def result(self, loss_before: float, stopped: str) -> FirstOrderResult:
        """Give what the descent has found."""
        return FirstOrderResult(
            models=self.models,
            parameters=self.parameters,
            loss_before=loss_before,
            loss_after=self.loss,
            curve=self.curve,
            stopped=stopped,
        )

    def state(self, problems: Many[ObjectProblem], descent: "SpringDescent") -> dict[str, ndarray]:
        """Give everything that the next iterations depend on."""
        contact = [getattr(self.parameters, name) for name in CONTACT]
        state = descent.state(problems) | {
            "best.loss": np.array([self.loss]),
            "best.contact": np.array(contact, np.float64),
            "curve": np.array(self.curve, np.float64),
        }
        for number, problem in enumerate(problems):
            state[f"best.{number}.stiffness"] = self.models[problem.name].stiffness
            state[f"best.{number}.damping"] = self.models[problem.name].damping
        return state

    def resume(
        self,
        problems: Many[ObjectProblem],
        descent: "SpringDescent",
        checkpointer: Checkpointer,
        loop: str,
    ) -> int:
        """Go on from the latest checkpoint, if there is one; return its iteration, else 0."""
        like = self.state(problems, descent)
        resumed = checkpointer.load(loop, like, growing=("curve",))
        if resumed is None:
            return 0
        state = resumed.tensors
        descent.restore(problems, state)
        self.loss, self.curve = float(state["best.loss"][0]), state["curve"].tolist()
        contact = zip(CONTACT, state["best.contact"].tolist(), strict=True)
        self.parameters = self.parameters.replace(**dict(contact))
        for number, problem in enumerate(problems):
            self.models[problem.name] = replace(
                self.models[problem.name],
                stiffness=state[f"best.{number}.stiffness"],
                damping=state[f"best.{number}.damping"],
            )
        return resumed.iteration


def _settled(
    problems: Many[ObjectProblem], result: FirstOrderResult, config: ObjectFitConfig, device: str
) -> FirstOrderResult:
    """Give the chosen springs the substeps that they need, and judge them if they are not yet.

    Springs that stiffened beyond the margin may hold for the fitted frames and no longer.
    """
    needed = settle_substeps(list(result.models.values()), result.parameters, config)
    needs_more = needed.substeps_per_frame > result.parameters.substeps_per_frame
    if not needs_more and not config.first_order.judges_online:
        return result
    parameters = needed if needs_more else result.parameters
    loss = _finite(
        mean_loss(problems, result.models, parameters, config, device),
        "The springs that did best while they were fitted diverge when simulated from start to "
        "end; raise substeps_per_frame or switch judges_online off in the profile.",
    )
    return replace(result, parameters=parameters, loss_after=loss)


def _first_models(
    problems: Many[ObjectProblem],
    searched: SimulationParameters,
    config: ObjectFitConfig,
    device: str,
    progress: Progress,
) -> tuple[dict[str, SpringMassModel], SimulationParameters, float]:
    """Give the models to begin with, their parameters with enough substeps, and their loss.

    The search judges springs as long as they were seen. With rest lengths that hold the object
    still a part of it may fall farther before a hand catches it, which can tear it apart.
    """
    for holds_still in (True, False) if config.holds_still else (False,):
        models = _starting_models(problems, searched, holds_still=holds_still)
        parameters = _with_margin(list(models.values()), searched, config, device)
        loss = mean_loss(problems, models, parameters, config, device)
        if math.isfinite(loss):
            return models, parameters, loss
        if holds_still:
            logger.warning("%s: %s", SPRING_STAGE, _NOT_HELD)
            progress.report(SPRING_STAGE, 0, config.first_order.iterations, None, _NOT_HELD)
    raise FitError("The searched parameters diverge; raise substeps_per_frame in the profile.")


def _starting_models(
    problems: Many[ObjectProblem], parameters: SimulationParameters, *, holds_still: bool
) -> dict[str, SpringMassModel]:
    """Build every sequence's springs; the object's own have the same rest lengths in all."""
    models: dict[str, SpringMassModel] = {}
    for problem in problems:
        model = build_problem_model(problem, parameters)
        if holds_still:
            if models:
                first = next(iter(models.values()))
                own = first.rest_length[: first.object_spring_count]
                virtual = model.rest_length[model.object_spring_count :]
                model = replace(model, rest_length=np.concatenate([own, virtual]))
            model = hold_still(
                model,
                problem.control[0],
                problem_parameters(parameters, problem),
                keeps_object=bool(models),
            )
        models[problem.name] = model
    return models


def _with_margin(
    models: Many[SpringMassModel],
    parameters: SimulationParameters,
    config: ObjectFitConfig,
    device: str,
) -> SimulationParameters:
    """Choose substeps with which springs may stiffen while they are fitted.

    A search on a GPU takes more of them than its best candidate needs; they go on being taken.
    """
    settled = settle_substeps(models, parameters, config, safety=SUBSTEP_SAFETY * SUBSTEP_SAFETY)
    is_finer = parameters.substeps_per_frame > settled.substeps_per_frame
    return parameters if is_finer and wp.get_device(device).is_cuda else settled


def _truncated(parameters: SimulationParameters) -> SimulationParameters:
    damping, drag = math.trunc(parameters.damping), math.trunc(parameters.drag)
    return parameters.replace(damping=float(damping), drag=float(drag))


def _horizon(iteration: int, config: FirstOrderConfig, frame_count: int) -> int:
    if not config.is_annealed or config.window is not None:
        return frame_count
    done = min(1.0, (iteration + 1) / max(1.0, config.iterations / 2))
    return max(2, round(frame_count * (0.25 + 0.75 * done)))


def _is_judged(iteration: int, config: FirstOrderConfig) -> bool:
    return iteration % config.judged_every == 0 or iteration == config.iterations - 1


def _skipped_message(problems: Many[ObjectProblem], losses: list[float | None]) -> str:
    """Name the sequences without a usable gradient; at least one must have had one."""
    skipped = [p.name for p, loss in zip(problems, losses, strict=True) if loss is None]
    if len(skipped) == len(problems):
        raise FitError(
            "No sequence has a usable gradient, not even over one frame. Raise substeps_per_frame, "
            "or lower the upper ends of the stiffness and damping intervals."
        )
    return f"too chaotic to learn from: {', '.join(skipped)}" if skipped else ""


def _finite(loss: float, otherwise: str) -> float:
    if not math.isfinite(loss):
        raise FitError(otherwise)
    return loss


class Material:
    """Learned logarithms of stiffness and damping: object springs shared, virtual ones a sequence.

    A spring that starts without stiffness stays off, dashpot included: where PhysTwin's linear
    search reaches 0 N, the logarithm is -∞ and has no gradient.
    """

    def __init__(
        self,
        models: Mapping[str, SpringMassModel],
        parameters: SimulationParameters,
        config: FirstOrderConfig,
    ) -> None:
        """Start from the springs of every sequence's model.

        Args:
            models: Model of each sequence; they must share their object springs.
            parameters: Initial contact coefficients.
            config: Says whether damping and contact are learned.

        Raises:
            FitError: If two sequences connect the object's nodes differently.
        """
        first = next(iter(models.values()))
        self._object_count = first.object_spring_count
        for name, model in models.items():
            same = np.array_equal(
                model.spring_nodes[: self._object_count], first.spring_nodes[: self._object_count]
            )
            if model.object_spring_count != self._object_count or not same:
                raise FitError(
                    f"Sequence '{name}' connects the object's nodes differently from the first "
                    "one: sequences fitted together must share one object and its rest nodes."
                )
        self._config = config
        self._shared = _logarithms(first, slice(None, self._object_count))
        self._own = {n: _logarithms(m, slice(self._object_count, None)) for n, m in models.items()}
        self._is_off = {n: torch.from_numpy(m.stiffness <= 0.0) for n, m in models.items()}
        self._start = [tensor.detach().clone() for tensor in self.logarithms()]
        self._contact: dict[str, Tensor] = {}
        if config.learns_contact:
            self._contact = {
                name: torch.tensor(float(getattr(parameters, name)), requires_grad=True)
                for name in CONTACT
            }

    def logarithms(self) -> list[Tensor]:
        """The learned logarithms: stiffness (row 0) and damping (row 1) of a group of springs."""
        return [self._shared, *self._own.values()]

    def tensors(self) -> list[Tensor]:
        """All learned tensors, for the optimizer."""
        return [*self.logarithms(), *self._contact.values()]

    def of(self, name: str) -> tuple[Float[Tensor, " spring"], Float[Tensor, " spring"]]:
        """Log stiffness [log N] and damping [N·s/m] of all springs of one sequence's model."""
        both = torch.cat([self._shared, self._own[name]], dim=1)
        log_stiffness, is_off = both[0], self._is_off[name]
        if self._config.most_stiffness is not None:
            # The gradient of a clamp is zero where it acts.
            log_stiffness = log_stiffness.clamp(max=math.log(self._config.most_stiffness))
        damping = (both[1] if self._config.learns_damping else both[1].detach()).exp()
        off = torch.full_like(log_stiffness, -math.inf)
        return torch.where(is_off, off, log_stiffness), damping * ~is_off

    def contact(self) -> dict[str, Tensor]:
        """The learned contact coefficients by name; empty if none are learned."""
        return dict(self._contact)

    def gradient(self, name: str) -> Float[Tensor, " spring"]:
        """Gradient of the latest backward pass with respect to one sequence's log stiffness."""
        parts = (self._shared, self._own[name])
        rows = [torch.zeros_like(part[0]) if part.grad is None else part.grad[0] for part in parts]
        return torch.cat(rows)

    def distance_from_start(self) -> Float[Tensor, ""]:
        """Sum of the squared changes of all logarithms."""
        pairs = zip(self.logarithms(), self._start, strict=True)
        return torch.stack([((now - then) ** 2).sum() for now, then in pairs]).sum()

    def model(self, name: str, model: SpringMassModel) -> SpringMassModel:
        """Replace the springs of one sequence's model by the learned ones."""
        log_stiffness, damping = self.of(name)
        return replace(
            model,
            stiffness=log_stiffness.detach().exp().numpy().astype(np.float32),
            damping=damping.detach().numpy().astype(np.float32),
        )

    def parameters(self, parameters: SimulationParameters) -> SimulationParameters:
        """Replace the contact coefficients by the learned ones, clamped as the simulator does."""
        learned = {
            name: min(max(float(value.detach()), CONTACT[name][0]), CONTACT[name][1])
            for name, value in self._contact.items()
        }
        return parameters.replace(**learned)


def _logarithms(model: SpringMassModel, part: slice) -> Tensor:
    both = np.stack([model.stiffness[part], model.damping[part]])
    return torch.log(torch.from_numpy(both).clamp(min=SMALLEST_VALUE)).requires_grad_()


def _start(model: SpringMassModel) -> State:
    return torch.from_numpy(model.object_node), torch.from_numpy(model.initial_velocity)


@dataclass(frozen=True, kw_only=True, eq=False)
class FitWindow:
    """A window of simulated frames, whose gradient can be or has been computed."""

    frame_losses: Float[Tensor, " frame"]
    """Loss of each frame before the update [m²]."""
    node: Float[Tensor, "frame_1 node 3"]
    """The nodes in all its frames, the first included [m]."""
    velocity: Float[Tensor, "frame_1 node 3"]
    """Their velocities [m/s]."""

    @property
    def state(self) -> State:
        """State of the nodes in the last frame."""
        return self.node[-1], self.velocity[-1]


class SpringDescent:
    """Adam on the material, window by window, by gradients of bounded norm only."""

    def __init__(
        self,
        material: Material,
        parameters: SimulationParameters,
        config: ObjectFitConfig,
        device: str = "cpu",
    ) -> None:
        self.material = material
        self._parameters = parameters
        self._config = config
        self._device = device
        settings = config.first_order
        self._optimizer = Adam(
            [(tensor, settings.learning_rate) for tensor in material.tensors()],
            betas=(0.9, settings.beta_2),
        )
        self._reach: dict[str, int] = {}
        self._ahead: FitWindow | None = None

    def state(self, problems: Many[ObjectProblem]) -> dict[str, ndarray]:
        """Copy everything that the next passes over some sequences depend on.

        What `loss_ahead` has simulated of the next pass is simulated once more then.
        """
        reach = [self._reach.get(problem.name, _WHOLE) for problem in problems]
        return self._optimizer.state() | {"reach": np.array(reach)}

    def restore(self, problems: Many[ObjectProblem], state: Mapping[str, ndarray]) -> None:
        """Return to what `state` gave."""
        self._optimizer.restore(state)
        reach = zip(problems, state["reach"].tolist(), strict=True)
        self._reach = {problem.name: frames for problem, frames in reach if frames != _WHOLE}

    def loss_ahead(
        self,
        problems: Many[ObjectProblem],
        models: Mapping[str, SpringMassModel],
        next_iteration: int,
        on_rollout: Callable[[ObjectProblem, Float[Tensor, "frame node 3"]], None],
    ) -> float | None:
        """Simulate what the next pass would, which then need not simulate it once more.

        A GPU simulates the frames beyond the next pass's horizon too, without a gradient.

        Args:
            problems: All sequences.
            models: Their springs before any update.
            next_iteration: Number of the iteration that follows, if one does.
            on_rollout: Receives the motion [m].

        Returns:
            Mean loss of the present springs [m²], infinite if they diverge; None if the next pass
            does not simulate all of them from start to end, or if there is none.
        """
        problem, settings = problems[0], self._config.first_order
        if len(problems) > 1 or settings.window is not None:
            return None
        last = problem.frame_count - 1
        length = _horizon(next_iteration, settings, problem.frame_count) - 1
        if next_iteration >= settings.iterations:
            length = 0
        if length < last and not problem.cloud.is_cuda:
            return None
        model = models[problem.name]
        state = _start(model)
        parts: list[FitWindow] = []
        try:
            if length > 0:
                reach = self._reach_over(problem, length)
                self._ahead = self._simulate(problem, model, (0, length), state, reach)
                parts, state = [self._ahead], self._ahead.state
            if length < last:
                with torch.no_grad():
                    parts.append(self._simulate(problem, model, (length, last), state, last))
        except SimulationDivergedError:
            return math.inf
        node = [part.node.detach()[min(number, 1) :] for number, part in enumerate(parts)]
        on_rollout(problem, torch.cat(node))
        return float(torch.cat([part.frame_losses.detach() for part in parts]).mean())

    def fit_pass(
        self, problem: ObjectProblem, model: SpringMassModel, horizon: int
    ) -> float | None:
        """Simulate a sequence once and update the material after every window of frames.

        Each window starts in the state in which the last one ended, with the updated material
        (physics.md §4.3).

        Args:
            problem: The sequence.
            model: Its springs before any update.
            horizon: Frames of the pass, frame 0 included.

        Returns:
            Mean loss over all windows [m²]; None if a window had no usable gradient, where the
            pass ends.

        Raises:
            SimulationDivergedError: If the motion runs away.
        """
        length = self._config.first_order.window or horizon - 1
        state = _start(model)
        losses = []
        for begin in range(0, horizon - 1, length):
            window = self.fit_window(
                problem, model, (begin, min(begin + length, horizon - 1)), state
            )
            if window is None:
                return None
            self._optimizer.step()
            losses.append(window.frame_losses)
            state = window.state
        return float(torch.cat(losses).double().mean())

    def fit_window(
        self,
        problem: ObjectProblem,
        model: SpringMassModel,
        frames: tuple[int, int],
        state: State,
    ) -> FitWindow | None:
        """Simulate one window and compute the gradient of its mean loss.

        Where motion is chaotic, gradients grow without bound and have no useful direction. The
        number of frames that the gradient reaches back over is then halved until its norm is
        within `FirstOrderConfig.steepest`; that reach is where the next window begins.

        Args:
            problem: The sequence.
            model: Its springs.
            frames: First and last frame of the window.
            state: The nodes in the first frame.

        Returns:
            The simulated window; None if even over one frame the gradient is too steep.
        """
        begin, end = frames
        steepest = self._config.first_order.steepest
        reach = self._reach_over(problem, end - begin)
        while reach >= 1:
            self._optimizer.zero_grad()
            window, self._ahead = self._ahead, None
            if window is None:
                window = self._simulate(problem, model, frames, state, reach)
            prior = self._config.first_order.prior_weight * self.material.distance_from_start()
            loss = window.frame_losses.mean() + prior
            loss.backward()
            if steepest is None or self._steepness() <= steepest * float(loss.detach()):
                if reach < end - begin:
                    self._reach[problem.name] = reach
                return FitWindow(
                    frame_losses=window.frame_losses.detach(),
                    node=window.node.detach(),
                    velocity=window.velocity.detach(),
                )
            reach //= 2
        return None

    def _simulate(
        self,
        problem: ObjectProblem,
        model: SpringMassModel,
        frames: tuple[int, int],
        state: State,
        reach: int,
    ) -> FitWindow:
        """Simulate a window so that gradients reach back over so many frames."""
        begin, end = frames
        log_stiffness, damping = self.material.of(problem.name)
        contact: dict[str, Any] = self.material.contact()
        node, velocity = differentiable.rollout(
            model,
            problem_parameters(self._parameters, problem),
            torch.from_numpy(problem.control[begin : end + 1]).to(problem.cloud.device),
            log_stiffness=log_stiffness,
            damping=damping,
            initial_position=state[0],
            initial_velocity=state[1],
            device=self._device,
            first_frame=begin,
            window=reach,
            **contact,
        )
        frame_losses = problem.frame_losses(
            node[1:],
            first_frame=begin + 1,
            track_weight=self._config.track_weight,
            freeze_counts=self._config.freezes_counts,
        )
        return FitWindow(frame_losses=frame_losses, node=node, velocity=velocity)

    def _reach_over(self, problem: ObjectProblem, length: int) -> int:
        """Number of frames that gradients reach back in a window of so many."""
        return min(self._reach.get(problem.name, length), length)

    def _steepness(self) -> float:
        """Largest norm of the gradients of the logarithms."""
        gradients = [t.grad for t in self.material.logarithms() if t.grad is not None]
        return max(float(gradient.double().norm()) for gradient in gradients)
