"""Stage 2, zeroth order: searches the global parameters of the spring-mass object.

`search_object` runs CMA-ES on the losses that `CandidateEvaluator` computes; `check_problem` and
`check_springs` refuse objects that no parameters, or not these, can hold together.
"""

import hashlib
import json
import logging
import math
from collections import Counter
from collections.abc import Container
from collections.abc import Sequence as Many
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import torch
import warp as wp
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import KDTree

from physhandi.data.checkpoint import Checkpointer, SavedState, resumed_note
from physhandi.errors import FitError, SimulationDivergedError, UsageError
from physhandi.fitting.config import ObjectFitConfig, SearchConfig
from physhandi.fitting.object_problem import (
    SUBSTEP_SAFETY,
    ObjectProblem,
    build_problem_model,
    mean_loss,
    problem_parameters,
    settle_substeps,
    simulate_problem,
    with_substeps,
)
from physhandi.fitting.preview import RolloutPreview
from physhandi.fitting.search import SEARCH_STAGE, SearchResult, search_parameters
from physhandi.fitting.search_bounds import fit_intervals, measure_object
from physhandi.progress import Progress, RelayedProgress
from physhandi.simulation.contact_intervals import ContactIntervals
from physhandi.simulation.engines.batch import (
    BatchSimulator,
    MotionTarget,
    losses_at_once,
    shared_out,
)
from physhandi.simulation.engines.batch_substeps import bound_substeps
from physhandi.simulation.engines.cpu import processor_count
from physhandi.simulation.master_topology import MasterTopology
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.topology import MINIMUM_LENGTH

logger = logging.getLogger(__name__)
_DIGEST = 16
"""Bytes by which a candidate is told from others."""
_DIVERGED, _TOO_FINE, _LOOSE = "diverged", "too fine", "loose"
"""Why a candidate cannot be simulated."""
_OTHER_RADIUS, _LITTLE_WORSE = 1.1, 1.25
"""Ratio of connection radii from which candidates have other springs, and of the losses of a
runner-up and the best candidate at most."""
CATCHING_SPEED = 1000.0
"""Speed from which nodes count as diverged where all candidates exceed the usual one [m/s]. Springs
of millimetres that take hold of a node centimetres away move it at 200 m/s, and are stable."""


def search_object(
    problems: Many[ObjectProblem],
    start: SimulationParameters,
    config: ObjectFitConfig,
    progress: Progress,
    *,
    device: str = "cpu",
    more_devices: Many[str] = (),
    checkpointer: Checkpointer | None = None,
) -> SearchResult:
    """Search the global parameters, topology included, that explain all sequences best.

    A search that was stopped runs again from its seed with the losses that were computed before:
    the strategy's own steps take milliseconds, and so all of its state comes out as it was.

    Args:
        problems: One for each sequence; all must have the same object nodes at rest.
        start: Initial parameters.
        config: Settings of stage 2.
        progress: Receives a report each generation.
        device: Warp device.
        more_devices: Further GPUs that share the candidates of a generation with it.
        checkpointer: Keeps the losses of all candidates; None keeps nothing.

    Raises:
        FitError: If no spring can form, or no candidate can be simulated; says why.
    """
    search = config.search
    if search.generations:
        search, start = fit_intervals(search, start, measure_object(problems))
    for problem in problems:
        check_problem(problem, start, search)
    if config.automatic_substeps:
        models = [build_problem_model(problem, start) for problem in problems]
        needed = settle_substeps(models, start, config).substeps_per_frame
        config = config.replace(most_substeps=max(config.most_substeps, 2 * needed))
    known_losses = _KnownLosses(checkpointer or Checkpointer())
    evaluate = CandidateEvaluator(
        problems,
        config,
        progress,
        device=device,
        more_devices=more_devices,
        known_losses=known_losses,
    )
    progress = _ResumedSearch(progress, known_losses)
    try:
        result = search_parameters(evaluate, start, search, progress)
    except FitError:
        if evaluate.failures and not evaluate.failures[_DIVERGED]:
            raise FitError(evaluate.explain_failures()) from None
        if start.speed_limit >= CATCHING_SPEED:
            raise
        start = start.replace(speed_limit=CATCHING_SPEED)
        result = search_parameters(evaluate, start, search, progress)
    if wp.get_device(device).is_cuda:
        result = evaluate.best_that_holds(result)
    most = config.first_order.most_starts - 1
    return replace(result, runners_up=evaluate.runners_up(result, most))


class _KnownLosses:
    """Losses of all candidates so far, in the order in which the search asked for them."""

    def __init__(self, checkpointer: Checkpointer) -> None:
        self._checkpointer = checkpointer
        self._digest = np.zeros((0, _DIGEST), np.uint8)
        self._loss, self._substeps = np.zeros(0), np.zeros(0, np.int64)
        state = checkpointer.load(SEARCH_STAGE, self._state(), growing=self._state())
        if state is not None:
            self._digest, self._loss = state.tensors["digest"], state.tensors["loss"]
            self._substeps = state.tensors["substeps"]
        self._next = 0
        self.resumed: SavedState | None = state
        """From where a search goes on, until it does."""

    @property
    def is_recalling(self) -> bool:
        """Whether the next candidates have known losses."""
        return self._next < len(self._loss)

    def recall(self, candidates: Many[SimulationParameters]) -> list[tuple[int, float]] | None:
        """Give substeps and loss of the next candidates; None if they are not known."""
        if not self.is_recalling:
            return None
        part = slice(self._next, self._next + len(candidates))
        if not np.array_equal(self._digest[part], _digests(candidates)):
            logger.warning("The search asks for other candidates than before; it begins anew.")
            self._digest, self._loss = self._digest[: self._next], self._loss[: self._next]
            self._substeps, self.resumed = self._substeps[: self._next], None
            return None
        self._next = part.stop
        return list(zip(self._substeps[part].tolist(), self._loss[part].tolist(), strict=True))

    def add(
        self,
        candidates: Many[SimulationParameters],
        settled: Many[SimulationParameters],
        losses: list[float],
    ) -> None:
        """Remember what was computed for candidates."""
        substeps = [parameters.substeps_per_frame for parameters in settled]
        self._digest = np.concatenate([self._digest, _digests(candidates)])
        self._loss = np.append(self._loss, losses)
        self._substeps = np.append(self._substeps, np.array(substeps, np.int64))
        self._next = len(self._loss)
        self._checkpointer.offer(SEARCH_STAGE, self._next, self._state)

    def _state(self) -> dict[str, ndarray]:
        return {"digest": self._digest, "loss": self._loss, "substeps": self._substeps}


def _digests(candidates: Many[SimulationParameters]) -> ndarray:
    """Hash all values of each candidate."""
    texts = [json.dumps(parameters.to_dict(), sort_keys=True) for parameters in candidates]
    digests = [hashlib.sha256(text.encode()).digest()[:_DIGEST] for text in texts]
    return np.frombuffer(b"".join(digests), np.uint8).reshape(-1, _DIGEST)


class _ResumedSearch(RelayedProgress):
    """Hears of the generations after those whose losses were known, and where these ended."""

    def __init__(self, progress: Progress, known_losses: _KnownLosses) -> None:
        super().__init__(progress)
        self._known_losses = known_losses

    def report(
        self,
        stage: str,
        iteration: int,
        total: int,
        loss: float | None = None,
        message: str = "",
    ) -> None:
        if self._known_losses.is_recalling:
            return
        if self._known_losses.resumed is not None:
            self._known_losses.resumed = None
            message = resumed_note(iteration)
        super().report(stage, iteration, total, loss, message)


def check_problem(
    problem: ObjectProblem, start: SimulationParameters, config: SearchConfig
) -> None:
    """Refuse an object for which no candidate of the search can form springs.

    Raises:
        FitError: If control nodes are too far from the object, or its nodes from each other, or
            all in one place; names the distance and the widest radius of the search.
    """

    def widest(field: str) -> float:
        variable = config.variables.get(field)
        return max(getattr(start, field), 0.0 if variable is None else variable.high)

    radius = widest("virtual_connection_radius")
    gap = _control_gap(problem.control[0], problem.object_node)
    if problem.contacts is not None:
        # An object that nothing has touched yet lies there; hands of another world never come.
        fitted = problem.control[: problem.frame_count]
        gap = min(_control_gap(control, problem.object_node) for control in fitted)
    when = "at frame 0" if problem.contacts is None else "in every fitted frame"
    if gap >= radius and problem.control.shape[1] > 0:
        raise FitError(
            f"Sequence '{problem.name}': {when} the control nodes are {gap:.3g} m or more away "
            f"from the object, but virtual springs reach {radius:.3g} m at most "
            "(virtual_connection_radius): nothing would hold it. Check that hands or control.npy "
            "lie in the object's world and unit, and that they touch it at frame 0."
        )
    radius = widest("connection_radius")
    gap = _node_gap(problem.rest_node)
    if gap >= radius and len(problem.rest_node) > 1:
        what = "in one place" if np.isinf(gap) else f"{gap:.3g} m or more apart"
        raise FitError(
            f"Sequence '{problem.name}': the {len(problem.rest_node)} object nodes are {what}, but "
            f"springs join nodes that are more than {MINIMUM_LENGTH:g} m and less than "
            f"{radius:.3g} m apart (connection_radius): it would fall to pieces. Give more nodes, "
            "or a profile that searches a wider radius."
        )


def check_springs(  # noqa: PLR0917  (what is checked, then what it was made from)
    name: str,
    model: SpringMassModel,
    parameters: SimulationParameters,
    control_0: Float[ndarray, "control 3"],
    rest_node: Float[ndarray, "node 3"],
    contacts: ContactIntervals | None = None,
) -> None:
    """Refuse parameters that form no object spring or no virtual spring in sequence `name`.

    Args:
        name: Name of the sequence, for the message.
        model: Model that `parameters` build.
        parameters: Radii and neighbor limits.
        control_0: Control nodes at frame 0 [m].
        rest_node: The object's rest shape [m].
        contacts: What the hands hold, and when, if springs are attached over time.

    Raises:
        UsageError: If one kind of spring is missing; names the value to change.
    """
    if model.object_spring_count == 0 and model.node_count > 1:
        raise UsageError(
            f"No object spring forms in sequence '{name}': {_cause(parameters, '')} and the "
            f"nearest nodes are {_node_gap(rest_node):.3g} m apart. Raise connection_radius above "
            "that, and max_neighbors to at least 1."
        )
    nothing_held = contacts is not None and len(contacts.node) == 0
    if model.virtual_spring_count == 0 and len(control_0) and not nothing_held:
        gap = _control_gap(control_0, model.object_node)
        if contacts is not None:
            gap = float(contacts.distance.min())
        raise UsageError(
            f"No virtual spring forms in sequence '{name}': {_cause(parameters, 'virtual_')} and "
            f"the nearest control node is {gap:.3g} m from the object. Raise "
            "virtual_connection_radius above that, and virtual_max_neighbors to at least 1."
        )


def _cause(parameters: SimulationParameters, prefix: str) -> str:
    radius = getattr(parameters, f"{prefix}connection_radius")
    most = getattr(parameters, f"{prefix}max_neighbors")
    return f"{prefix}connection_radius is {radius:.3g} m, {prefix}max_neighbors is {most},"


def _control_gap(control: ndarray, node: ndarray) -> float:
    """Compute the distance between the object and the nearest control node [m]."""
    return float(KDTree(node).query(control)[0].min(initial=np.inf))


def _node_gap(node: ndarray) -> float:
    """Compute the least distance of two nodes that a spring may join; infinite if none [m]."""
    count = min(len(node), 64)
    distance = np.reshape(KDTree(node).query(node, k=count)[0], -1)
    return float(distance[distance > MINIMUM_LENGTH].min(initial=np.inf))


class CandidateEvaluator:
    """Computes the loss of candidate parameters over all sequences.

    On CUDA each sequence simulates a generation as one batch, or as one on each of several GPUs; on
    a CPU as many candidates at once as there are processors, each in a thread of its own. With
    self-collision they take turns.
    """

    def __init__(
        self,
        problems: Many[ObjectProblem],
        config: ObjectFitConfig,
        progress: Progress,
        *,
        device: str = "cpu",
        more_devices: Many[str] = (),
        threads: int | None = None,
        known_losses: _KnownLosses | None = None,
    ) -> None:
        """Prepare the observations of all sequences.

        Args:
            problems: One for each sequence.
            config: Weights of the loss and bounds of the substeps.
            progress: Can cancel between two simulations; shows the best candidate.
            device: Warp device.
            more_devices: Further GPUs that share each batch with it. Losses are rounded otherwise,
                but in the same way every time.
            threads: Candidates at once on a CPU; None for as many as processors. The bits are the
                same.
            known_losses: Losses that need not be computed again; None for none.
        """
        self._threads = threads or processor_count()
        self._problems, self._config, self._progress = problems, config, progress
        self._device, self._gpus = device, (device, *more_devices)
        self._targets = [motion_target(problem, config) for problem in problems]
        self._preview = RolloutPreview(SEARCH_STAGE, progress)
        self._best_loss = np.inf
        self._best: SimulationParameters | None = None
        self._judged: list[tuple[float, SimulationParameters]] = []
        self.failures = Counter[str]()
        """Candidates that could not be simulated, by the reason."""
        self._has_kernels = False
        self._known_losses = known_losses or _KnownLosses(Checkpointer())

    def __call__(
        self, candidates: Many[SimulationParameters]
    ) -> list[tuple[SimulationParameters, float]]:
        """Return each candidate with the substeps that it was simulated with, and its loss [m²].

        The loss is infinite if a candidate diverges, has no springs or needs more substeps than
        the configuration allows.
        """
        candidates = [problem_parameters(p, self._problems[0]) for p in candidates]
        recalled = self._known_losses.recall(candidates)
        if recalled is None:
            settled, mean = self._evaluate(candidates)
            self._known_losses.add(candidates, settled, mean)
        else:
            settled = [
                parameters.replace(substeps_per_frame=substeps)
                for parameters, (substeps, _) in zip(candidates, recalled, strict=True)
            ]
            mean = [loss for _, loss in recalled]
            self._note_failures(settled, mean)
        self._judged += [
            (loss, parameters)
            for parameters, loss in zip(settled, mean, strict=True)
            if math.isfinite(loss)
        ]
        winner = int(np.argmin(mean))
        if mean[winner] < self._best_loss:
            self._best_loss, self._best = mean[winner], settled[winner]
        if not self._known_losses.is_recalling:
            self._show_best()
        return list(zip(settled, mean, strict=True))

    def _evaluate(
        self, candidates: Many[SimulationParameters]
    ) -> tuple[list[SimulationParameters], list[float]]:
        """Settle the substeps of candidates and compute their losses [m²]."""
        masters = [
            MasterTopology.of(
                problem.object_node,
                problem.control[0],
                candidates,
                rest_node=problem.rest_node,
                initial_velocity=problem.initial_velocity,
                clearance=problem.clearance,
                contacts=problem.contacts,
            )
            for problem in self._problems
        ]
        is_batched = wp.get_device(self._device).is_cuda
        settled = (self._settle_batch if is_batched else self._settle)(masters, candidates)
        possible = [
            index
            for index, parameters in enumerate(settled)
            if parameters.substeps_per_frame <= self._config.most_substeps
            and all(master.has(parameters).any() for master in masters)
        ]
        if is_batched:
            # A batch takes the substeps of the candidate that needs most. The best one keeps them:
            # with longer ones it would move otherwise than it was judged, and may diverge.
            most = max((settled[index].substeps_per_frame for index in possible), default=1)
            for index in possible:
                settled[index] = settled[index].replace(substeps_per_frame=most)
        losses = np.full((len(masters), len(candidates)), np.inf)
        for row, master in enumerate(masters):
            self._simulate(row, master, settled, possible, losses[row])
        mean = [float(value) for value in losses.mean(axis=0)]
        self._note_failures(settled, mean, set(possible))
        return settled, mean

    def _note_failures(
        self,
        settled: Many[SimulationParameters],
        losses: list[float],
        possible: Container[int] | None = None,
    ) -> None:
        """Count why candidates have no loss.

        Args:
            settled: The candidates.
            losses: Of each, infinite where there is none.
            possible: Those that were simulated; those with few enough substeps if not known.
        """
        for index, (parameters, loss) in enumerate(zip(settled, losses, strict=True)):
            if math.isfinite(loss):
                continue
            is_fine = parameters.substeps_per_frame > self._config.most_substeps
            is_loose = possible is not None and index not in possible
            self.failures[_TOO_FINE if is_fine else _LOOSE if is_loose else _DIVERGED] += 1

    def explain_failures(self) -> str:
        """Say why no candidate could be simulated, and what to do."""
        too_fine, loose = self.failures[_TOO_FINE], self.failures[_LOOSE]
        reasons = [
            f"{too_fine} need more than {self._config.most_substeps} substeps a frame (lower the "
            "upper end of the stiffness interval, or raise most_substeps)"
        ] * bool(too_fine)
        reasons += [
            f"{loose} form no springs (raise connection_radius and virtual_connection_radius, or "
            "the lower ends of their intervals)"
        ] * bool(loose)
        return f"No candidate of the search can be simulated: {'; '.join(reasons)}."

    def best_that_holds(self, result: SearchResult) -> SearchResult:
        """Return a search's result, with the best candidate that does not diverge on its own.

        In a batch on CUDA sums are rounded otherwise, and what nearly diverges may do so alone.

        Raises:
            FitError: If all diverge alone.
        """
        if not math.isfinite(result.loss_after):
            return result
        best = result.loss_after, result.parameters
        worse = [each for each in self._judged if each[0] >= best[0] and each[1] != best[1]]
        for loss, parameters in (best, *sorted(worse, key=lambda each: each[0])):
            if self._holds_alone(parameters):
                return replace(result, parameters=parameters, loss_after=loss)
        raise FitError(
            f"All {1 + len(worse)} candidates that do not diverge in a batch do so alone. Lower "
            "the upper end of the stiffness interval or raise substeps_per_frame in the profile."
        )

    def runners_up(self, result: SearchResult, most: int) -> tuple[SimulationParameters, ...]:
        """Return the next best candidates, each of which connects nodes over another distance.

        Args:
            result: The best candidate.
            most: How many at most; fewer if others are much worse.
        """
        chosen = [result.parameters]
        for loss, parameters in sorted(self._judged, key=lambda each: each[0]):
            if len(chosen) > most or loss > _LITTLE_WORSE * result.loss_after:
                break
            radii = np.array([each.connection_radius for each in chosen])
            ratio = np.maximum(radii, parameters.connection_radius) / np.minimum(
                radii, parameters.connection_radius
            )
            if loss >= result.loss_after and np.all(ratio > _OTHER_RADIUS):
                chosen.append(parameters)
        return tuple(chosen[1:])

    def _settle(
        self, masters: Many[MasterTopology], candidates: Many[SimulationParameters]
    ) -> list[SimulationParameters]:
        """Give each candidate the substeps that it needs."""
        return [
            settle_substeps([master.model(each) for master in masters], each, self._config)
            for each in candidates
        ]

    def _settle_batch(
        self, masters: Many[MasterTopology], candidates: Many[SimulationParameters]
    ) -> list[SimulationParameters]:
        """Give each candidate substeps that are enough, without building its model."""
        if not self._config.automatic_substeps:
            return list(candidates)
        needed = [
            bound_substeps(master, candidates, self._device, safety=SUBSTEP_SAFETY)
            for master in masters
        ]
        return [
            with_substeps(parameters, max(of_masters))
            for parameters, *of_masters in zip(candidates, *needed, strict=True)
        ]

    def _holds_alone(self, parameters: SimulationParameters) -> bool:
        try:
            for problem in self._problems:
                model = build_problem_model(problem, parameters)
                simulate_problem(problem, model, parameters, self._device)
        except SimulationDivergedError:
            return False
        return True

    def _show_best(self) -> None:
        """Show the best candidate in a preview, at most once for each."""
        if self._best is None or not self._progress.wants_preview():
            return
        parameters, self._best = self._best, None
        problem = self._problems[0]
        model = build_problem_model(problem, parameters)
        self._preview.show_simulated(
            problem,
            self._best_loss,
            lambda: simulate_problem(problem, model, parameters, self._device)[0],
        )

    def _simulate(
        self,
        row: int,
        master: MasterTopology,
        candidates: Many[SimulationParameters],
        possible: list[int],
        losses: np.ndarray,
    ) -> None:
        """Write one sequence's losses of the possible candidates into `losses`."""
        problem = self._problems[row]
        for index in possible:
            if candidates[index].has_contacts:
                self._progress.check_cancelled()
                model = replace(master.model(candidates[index]), hand_face=problem.hand_face)
                losses[index] = mean_loss(
                    [problem],
                    {problem.name: model},
                    candidates[index],
                    self._config,
                    self._device,
                    acceleration_weight=self._config.acceleration_weight,
                )
        batch = [index for index in possible if not candidates[index].has_contacts]
        if batch:
            self._simulate_batch(row, master, candidates, batch, losses)

    def _simulate_batch(
        self,
        row: int,
        master: MasterTopology,
        candidates: Many[SimulationParameters],
        batch: list[int],
        losses: np.ndarray,
    ) -> None:
        problem, target = self._problems[row], self._targets[row]
        control = problem.control[: problem.frame_count]

        def simulator_of(
            part: list[int], device: str, threads: int | None = None
        ) -> BatchSimulator:
            self._progress.check_cancelled()
            parameters = [problem_parameters(candidates[index], problem) for index in part]
            return BatchSimulator(master, parameters, device, threads=threads)

        def simulate(index: int, threads: int | None = None) -> None:
            simulator = simulator_of([index], self._device, threads)
            losses[index] = simulator.losses(control, target).loss[0]

        if wp.get_device(self._device).is_cuda:
            parts = shared_out(batch, len(self._gpus))
            simulators = [simulator_of(*shared) for shared in zip(parts, self._gpus, strict=False)]
            losses[batch] = losses_at_once(simulators, control, target).loss
            return
        if len(batch) == 1 or self._threads == 1:
            for index in batch:
                simulate(index)
            self._has_kernels = True
            return
        if not self._has_kernels:
            # Warp 1.19 crashes where two threads load the same kernels at once.
            simulate(batch[0], 1)
            batch = batch[1:]
            self._has_kernels = True
        with ThreadPoolExecutor(self._threads, thread_name_prefix="physhandi-candidate") as pool:
            jobs = [pool.submit(simulate, index, 1) for index in batch]
            try:
                for job in jobs:
                    job.result()
            finally:
                for job in jobs:
                    job.cancel()


def motion_target(problem: ObjectProblem, config: ObjectFitConfig) -> MotionTarget:
    """Express the loss of `ObjectProblem.frame_losses` as weighted points and tracks."""

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
