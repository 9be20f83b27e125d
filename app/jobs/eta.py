"""Time left of fits, from medians of the time that stages of finished fits took for their work."""

import json
import math
import os
import statistics
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

from app.jobs.catalog import Catalog, RunItem
from physhandi.data import sequence as recordings
from physhandi.data.environment import ENVIRONMENT
from physhandi.data.files import named_fields
from physhandi.data.run_folder import CURRENT, EXIT, moment_of, read_mapping
from physhandi.devices import processor_name
from physhandi.errors import PhysHandiError, RunError, UsageError
from physhandi.fitting.checks.readiness import (
    colored_views,
    missing_for_hands,
    missing_for_object,
)
from physhandi.fitting.config import (
    APPEARANCE,
    EVALUATION,
    HANDS,
    OBSERVATION,
    REFINEMENT,
    SEARCH,
    SPRINGS,
    PipelineConfig,
    planned_stages,
)
from physhandi.run import Run

_MOST_FITS = 5
"""Most finished fits that a median is taken of, the newest ones."""
_REFRESH_S = 10.0
"""Time after which the run folders are looked at again [s]."""
_TRUST = {True: 0.1, False: 0.02}
"""Weight of "as fast as the finished fits" beside what a fit itself shows, as a share of its
expected time; the first if those had the same settings and machine."""
_DEPTH_COST = 15.0
"""Cost of an update of the hand with depth, in updates without (measured: 14 to 18)."""
_STEP_COST = 8.0
"""Cost of a step of Gauss and Newton, in updates of gradient descent without depth."""
_STEPS, _DEPTH_STEPS = 15, 20
"""Steps that a hand takes, and those with depth in steps without (measured: 13 to 26, 4 to 8)."""
_GRADIENT_COST = 3.0
"""Cost of a gradient, in simulations."""
_PICTURE_COST = 5.0
"""Cost of drawing and comparing a frame in all views, in frames that are evaluated without."""
_TYPICAL = {APPEARANCE: [8e-5]}
"""Time per unit of work, on two cores, of stages that a fit may be the first to have [s]."""
_NODE_COST = 6.0
"""Cost of a node in a substep, in springs."""
_LEAST_SUBSTEPS = 120.0
"""Substeps of a soft object: none is longer than 1/3600 s."""
_MACHINE = ("device", "device_name", "cpu_count")


@dataclass(frozen=True)
class Extent:
    """Size of the recordings, with which the work of a fit grows."""

    frames: int
    """Frames of all sequences together."""
    hand_frames: int
    """Those of the sequences that show hands."""
    sequences: int
    """Number of sequences."""
    has_object: bool
    """Whether every sequence shows an object to fit."""
    has_look: bool = False
    """Whether the first sequence shows what the object looks like."""

    @classmethod
    def of(cls, sequences: Sequence[recordings.Sequence]) -> "Extent":
        """Add up the frames of a fit's sequences."""
        return cls(
            sum(sequence.frame_count for sequence in sequences),
            sum(s.frame_count for s in sequences if not missing_for_hands(s)),
            len(sequences),
            not any(missing_for_object(sequence) for sequence in sequences),
            bool(colored_views(sequences[0])),
        )


def work_of(config: PipelineConfig, extent: Extent) -> dict[str, float]:
    """Count the work of every stage in units of its own, in the order of the stages.

    Units are frames times iterations, or simulated springs and nodes times substeps: only ratios
    between two fits mean anything. A stage that has nothing to do has no work.
    """
    hand, search = config.hand, config.object_.search
    # Without a number of candidates pycma takes so many.
    population = search.population or 4 + int(3 * math.log(max(1, len(search.variables))))
    updates = hand.iterations + _DEPTH_COST * hand.depth_iterations
    if hand.gauss_newton:
        steps = min(hand.iterations, _STEPS) + min(hand.depth_iterations, _DEPTH_STEPS)
        updates = _STEP_COST * steps
    hands = {HANDS: extent.hand_frames * updates}
    if not extent.has_object:
        return hands | {EVALUATION: float(extent.frames)}
    rollout = _frame_cost(config) * extent.frames
    refined = _frame_cost(config) * extent.hand_frames * config.refinement.iterations
    springs = config.object_.first_order.iterations
    work = hands | {
        OBSERVATION: float(extent.frames),
        SEARCH: rollout * (1 + search.generations * population),
        SPRINGS: rollout * (1 + springs * (1 + _GRADIENT_COST)),
        REFINEMENT: refined * (1 + _GRADIENT_COST),
    }
    if not config.appearance.enabled:
        return work | {EVALUATION: float(extent.frames)}
    look = config.appearance
    return work | {
        APPEARANCE: float(look.iterations * look.splat_count * extent.has_look),
        EVALUATION: extent.frames * (1 + _PICTURE_COST * extent.has_look),
    }


def _frame_cost(config: PipelineConfig) -> float:
    """Count the springs and nodes of a surface times the substeps of a frame."""
    parameters = config.simulation
    neighbors = max(1, parameters.max_neighbors)
    substeps = float(parameters.substeps_per_frame)
    if config.object_.automatic_substeps:
        length = 0.7 * max(parameters.connection_radius, 1e-4)
        stiffness = parameters.stiffness * parameters.stiffness_scale / length
        fastest = math.sqrt(2.0 * neighbors * stiffness)
        substeps = max(_LEAST_SUBSTEPS, 1.25 * fastest / 2.0 / parameters.frame_rate)
    return config.node_spacing**-2 * (0.5 * neighbors + _NODE_COST) * substeps


@dataclass(frozen=True, eq=False)
class FinishedFit:
    """Work and time of the stages of a finished fit."""

    settings: str
    """All of its settings but their name and description, as JSON."""
    profile: str
    """Name of its settings."""
    machine: tuple[Any, ...]
    """Device, name of the device and number of processors."""
    work: Mapping[str, float]
    """Work of its stages, see `work_of`."""
    seconds: Mapping[str, float]
    """Time that its stages took [s]."""
    end: float
    """Time of publication of its results [s since the epoch]."""


@dataclass(frozen=True)
class Expectation:
    """Expected time of a fit, stage by stage."""

    seconds: Mapping[str, float]
    """Time of each stage, in their order [s]."""
    fit_count: int
    """Fits with the same settings on the same machine that it is taken from; 0 if others."""

    @property
    def total_s(self) -> float:
        """Time of the whole fit [s]."""
        return sum(self.seconds.values())

    @property
    def basis(self) -> str:
        """Source of the estimate, in words."""
        if self.fit_count == 0:
            return "roughly, from fits with other settings or on another machine"
        if self.fit_count == 1:
            return "from an earlier fit with these settings"
        return f"from {self.fit_count} earlier fits with these settings"


def expect(
    fits: Sequence[FinishedFit],
    settings: Mapping[str, Any],
    machine: tuple[Any, ...],
    work: Mapping[str, float],
) -> Expectation | None:
    """Expect of each stage the median time per unit of work of the most similar finished fits.

    Args:
        fits: Finished fits, the newest first.
        settings: Settings of the fit, as a run stores them.
        machine: What it runs on, see `FinishedFit.machine`.
        work: Its work, see `work_of`.

    Returns:
        None if a stage that has work was never measured; of those that few fits have, a typical
        time stands in.
    """
    own, profile = _values_of(settings), settings.get("profile")
    same = [fit for fit in fits if fit.machine == machine and fit.settings == own]
    groups = (
        same,
        [fit for fit in fits if fit.machine == machine and fit.profile == profile],
        [fit for fit in fits if fit.machine == machine],
        [fit for fit in fits if fit.profile == profile],
        fits,
    )
    seconds: dict[str, float] = {}
    fit_count = len(same[:_MOST_FITS])
    for stage, amount in work.items():
        if amount <= 0:
            seconds[stage] = 0.0
            continue
        rates_of_groups = [_rates(group, stage) for group in groups]
        rates = next((rates for rates in rates_of_groups if rates), _TYPICAL.get(stage))
        if rates is None:
            return None
        seconds[stage] = amount * statistics.median(rates)
        fit_count = min(fit_count, len(rates_of_groups[0]))
    return Expectation(seconds, fit_count)


def _rates(fits: Sequence[FinishedFit], stage: str) -> list[float]:
    """Give the time per unit of work of the newest fits that had the stage."""
    measured = (fit for fit in fits if fit.work.get(stage, 0.0) > 0 and stage in fit.seconds)
    return [fit.seconds[stage] / fit.work[stage] for fit in islice(measured, _MOST_FITS)]


def _values_of(settings: Mapping[str, Any]) -> str:
    """Give settings as JSON; those that are newer than a run have the values that it was made with.

    Such are their defaults, as everywhere where a run says nothing of them.
    """
    config = _config_of(settings)
    whole = settings if config is None else config.to_dict()
    values = {key: v for key, v in whole.items() if key not in {"profile", "description"}}
    return json.dumps(values, sort_keys=True, default=str)


@dataclass(frozen=True)
class Position:
    """Progress of a fit at work."""

    finished: Mapping[str, float]
    """Time that its finished stages took [s]; 0 of those that an earlier attempt had finished."""
    stage: str
    """Stage at work; empty after the last one."""
    share: float | None
    """Finished share of the work of that stage at its latest report; None if it is not known."""
    reported_s: float
    """Time from the begin of that stage to its latest report [s]."""
    now_s: float
    """Time from the begin of that stage until now [s]."""


def time_left(expected: Expectation, position: Position) -> tuple[float, float]:
    """Estimate how long a fit still takes.

    What is to come is expected as fast as the finished stages were: their medians times a pace.
    Within the stage at work its own course counts the more, the further it is: at a share s that
    was reached after t, expected to take T in all, the rest is (1 - s) ((1 - s) T + t).

    Returns:
        Time until the results are published, and until the stage at work has ended [s].
    """
    stage, share = position.stage, position.share
    measured = {
        name: seconds
        for name, seconds in position.finished.items()
        if seconds > 0 and expected.seconds.get(name, 0.0) > 0
    }
    planned = sum(expected.seconds[name] for name in measured)
    spent = sum(measured.values())
    whole = expected.seconds.get(stage, 0.0)
    trust = _TRUST[expected.fit_count > 0] * expected.total_s
    pace = (spent + trust) / (planned + trust) if planned + trust > 0 else 1.0
    if share is None:
        stage_left = pace * whole - position.now_s
    else:
        rest = (1.0 - share) * ((1.0 - share) * pace * whole + position.reported_s)
        stage_left = rest - (position.now_s - position.reported_s)
    stage_left = max(0.0, stage_left)
    to_come = (
        seconds
        for name, seconds in expected.seconds.items()
        if name != stage and name not in position.finished
    )
    return stage_left + pace * sum(to_come), stage_left


class Forecast:
    """Estimates how long fits still take; safe to use from several threads.

    Run folders are its whole memory: every published fit tells what its stages took, on which
    device, with which settings and on how many frames.
    """

    def __init__(self, catalog: Catalog, device: str) -> None:
        """Prepare; nothing is read yet.

        Args:
            catalog: Finds runs and sequences.
            device: Warp device that fits use.
        """
        self._catalog = catalog
        self._device = device
        self._lock = threading.Lock()
        self._read_fits: dict[str, tuple[object, FinishedFit | None]] = {}
        self._fits: list[FinishedFit] = []
        self._refreshed = -_REFRESH_S
        self._expectations: dict[tuple[str, object], Expectation | None] = {}

    def of_running(self, run: Run, now: float | None = None) -> dict[str, Any] | None:
        """Estimate a run that is at work.

        Args:
            run: The run.
            now: Time now [s since the epoch]; None asks the clock.

        Returns:
            ``left_s``, ``stage_left_s``, ``share`` of the whole time that has passed and ``basis``;
            None if it is no fit, has not begun, or no finished fit is like it.
        """
        now = time.time() if now is None else now
        try:
            begun = _begin_of(run)
            expected = begun and self._expectation(run, begun[1])
            if begun is None or expected is None:
                return None
            left, stage_left = time_left(expected, _position_of(run, begun[0], now))
        except (PhysHandiError, OSError, KeyError):
            return None  # Its folder is being removed, or is damaged.
        elapsed = max(0.0, now - begun[0])
        # Digits that nobody reads are left out, so that what is shown changes once a second.
        return {
            "left_s": float(round(left)),
            "stage_left_s": float(round(stage_left)),
            "share": round(elapsed / (elapsed + left), 3) if elapsed + left > 0 else 1.0,
            "basis": expected.basis,
        }

    def of_waiting(
        self, run: Run, ahead: Sequence[Run], at_work: Sequence[Run], slots: int
    ) -> dict[str, Any] | None:
        """Estimate when a run in line begins and ends.

        Args:
            run: The run that waits.
            ahead: Those before it in line.
            at_work: Those that have a place.
            slots: How many have a place at a time.

        Returns:
            ``starts_in_s``, ``left_s`` until it has ended and ``basis``; None if nothing is known
            of one of them, or nobody knows yet how many have a place.
        """
        own = self._expectation(run)
        expected = [self._expectation(other) for other in ahead]
        busy = [self._left_of(other) for other in at_work]
        if own is None or None in expected or None in busy:
            return None
        free = [left for left in busy if left is not None] + [0.0] * (slots - len(busy))
        if not free:
            return None
        for other in expected:
            free.sort()
            free[0] += other.total_s if other else 0.0
        start = min(free)
        return {
            "starts_in_s": float(round(start)),
            "left_s": float(round(start + own.total_s)),
            "basis": own.basis,
        }

    def of_order(
        self, settings: Mapping[str, Any], sequences: Sequence[recordings.Sequence]
    ) -> dict[str, Any] | None:
        """Estimate a fit that is not launched: ``seconds`` and ``basis``; None if unknown."""
        config = _config_of(settings)
        if config is None or not sequences:
            return None
        with self._lock:
            fits = self._finished_fits()
            expected = expect(
                fits, settings, self._own_machine(), work_of(config, Extent.of(sequences))
            )
        if expected is None:
            return None
        return {"seconds": float(round(expected.total_s)), "basis": expected.basis}

    def _left_of(self, run: Run) -> float | None:
        """Estimate a run that has a place, also if it has not begun [s]."""
        running = self.of_running(run)
        if running is not None:
            return float(running["left_s"])
        expected = self._expectation(run)
        return None if expected is None else expected.total_s

    def _expectation(self, run: Run, machine: tuple[Any, ...] | None = None) -> Expectation | None:
        """Expect the stages of a run; the same until the run folders are looked at again."""
        with self._lock:
            fits = self._finished_fits()
            key = (str(run.folder), machine)
            if key not in self._expectations:
                settings, work = self._work_of_run(run)
                machine = machine or self._own_machine()
                self._expectations[key] = expect(fits, settings, machine, work) if work else None
            return self._expectations[key]

    def _own_machine(self) -> tuple[Any, ...]:
        """Describe this machine as its fits do.

        A GPU's name is that of the newest fit on it, since asking the driver takes seconds.
        """
        if self._device == "cpu":
            return self._device, processor_name(), os.cpu_count()
        machines = (fit.machine for fit in self._fits if fit.machine[0] == self._device)
        return next(machines, (self._device,))

    def _finished_fits(self) -> list[FinishedFit]:
        """List finished fits, the newest first."""
        if time.monotonic() - self._refreshed < _REFRESH_S:
            return self._fits
        self._refreshed = time.monotonic()
        self._expectations.clear()
        read_fits: dict[str, tuple[object, FinishedFit | None]] = {}
        for item in self._catalog.runs():
            stamp = _stamp_of(item)
            if stamp is None:
                continue
            entry = self._read_fits.get(str(item.folder))
            if entry is None or entry[0] != stamp:
                entry = (stamp, self._read(item))
            read_fits[str(item.folder)] = entry
        self._read_fits = read_fits
        fits = [fit for _, fit in read_fits.values() if fit is not None]
        self._fits = sorted(fits, key=lambda fit: -fit.end)
        return self._fits

    def _read(self, item: RunItem) -> FinishedFit | None:
        """Read what the stages of a finished fit took; None if it is no fit or is damaged."""
        run = item.run
        if run is None:
            return None
        settings, work = self._work_of_run(run)
        if not work:
            return None
        try:
            begun = _begin_of(run)
            seconds = {
                str(stage["name"]): float(stage["seconds"])
                for stage in run.stages()
                if isinstance(stage.get("seconds"), int | float)
            }
            end = moment_of(read_mapping(run.folder / EXIT).get("time"))
        except (PhysHandiError, OSError):
            return None
        if begun is None or end is None or not seconds:
            return None
        profile = str(settings.get("profile", ""))
        return FinishedFit(_values_of(settings), profile, begun[1], work, seconds, end)

    def _work_of_run(self, run: Run) -> tuple[dict[str, Any], dict[str, float]]:
        """Give the settings and the work of a run; no work if it is no fit or lacks a sequence."""
        settings = named_fields(run.config.get("profile")) or {}
        config = _config_of(settings) if run.kind == "reconstruction" else None
        sequences = self._sequences_of(run) if config else None
        return settings, work_of(config, Extent.of(sequences)) if config and sequences else {}

    def _sequences_of(self, run: Run) -> list[recordings.Sequence] | None:
        """Look a run's sequences up where it was made, else by name; None if one is gone."""
        listed: dict[str, recordings.Sequence] = {}
        for item in self._catalog.sequences():
            if item.sequence is not None:
                listed[str(item.folder)] = item.sequence
                listed.setdefault(item.sequence.name, item.sequence)
        pairs = zip(run.sequences, run.sequence_names, strict=True)
        sequences = [listed.get(folder, listed.get(name)) for folder, name in pairs]
        return [s for s in sequences if s is not None] if None not in sequences else None


def _config_of(settings: Mapping[str, Any]) -> PipelineConfig | None:
    """Read settings; None if they are those of another version of the program."""
    try:
        return PipelineConfig.from_dict(dict(settings))
    except UsageError:
        return None


def _begin_of(run: Run) -> tuple[float, tuple[Any, ...]] | None:
    """Tell when the latest attempt of a run began [s since the epoch] and on which machine."""
    try:
        about = named_fields(run.json(ENVIRONMENT)) or {} if run.has(ENVIRONMENT) else {}
    except (PhysHandiError, OSError):
        return None
    started, machine = moment_of(about.get("started")), [about.get(name) for name in _MACHINE]
    if started is None or any(isinstance(fact, list | dict) for fact in machine):
        return None
    return started, tuple(machine)


def _position_of(run: Run, begin: float, now: float) -> Position:
    """Tell how far the latest attempt of a run is."""
    finished: dict[str, float] = {}
    stage_begin = begin
    for stage in run.stages():
        if (ended := moment_of(stage.get("time"))) is None:
            raise RunError(f"Run '{run.id}' does not tell when {stage['name']} ended.")
        finished[str(stage["name"])] = float(stage.get("seconds", 0.0)) if ended > begin else 0.0
        stage_begin = max(stage_begin, ended)
    planned = planned_stages(run.config.get("profile"))
    current = next((name for name in planned if name not in finished), "")
    report = run.progress
    is_current = report.get("attempt") == run.attempt and report.get("stage") == current
    # Of several sequences most stages count anew for each one, so counting shows no share there.
    is_counted_once = len(run.sequences) == 1 or current in {SEARCH, SPRINGS, APPEARANCE}
    share = _share_of(run, report) if is_current and is_counted_once else None
    reported = float(report["time"]) if share is not None else stage_begin
    return Position(finished, current, share, max(0.0, reported - stage_begin), now - stage_begin)


def _share_of(run: Run, report: Mapping[str, Any]) -> float | None:
    """Give the finished share of the work of the stage that reports."""
    done, total = report.get("iteration"), report.get("total")
    if not isinstance(done, int | float) or not isinstance(total, int | float) or total <= 0:
        return None
    if report["stage"] == HANDS:
        # Its last iterations see depth, and take far longer than the others.
        settings = named_fields(run.config.get("profile")) or {}
        light = (named_fields(settings.get("hand")) or {}).get("iterations", total)
        done = done + (_DEPTH_COST - 1.0) * max(0, done - light)
        total = total + (_DEPTH_COST - 1.0) * max(0, total - light)
    return min(1.0, max(0.0, done / total))


def _stamp_of(item: RunItem) -> tuple[int, int] | None:
    """Give what changes with a new result of a run; None if it has no result."""
    try:
        result, end = (item.folder / CURRENT).stat(), (item.folder / EXIT).stat()
    except OSError:
        return None
    return result.st_mtime_ns, end.st_mtime_ns
