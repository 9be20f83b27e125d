"""Evaluates methods on sequences: computes the cells of an order and writes its tables.

`evaluate_suite` owns the loop, `list_tasks` says which cells the protocols consist of.
"""

import logging
import time
from collections.abc import Callable, Iterator, Mapping
from collections.abc import Sequence as Many
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from physhandi.data.environment import describe_environment
from physhandi.data.files import named_fields
from physhandi.data.layout import SequenceFiles
from physhandi.data.run_folder import now
from physhandi.data.sequence import Sequence
from physhandi.devices import describe_device
from physhandi.errors import MissingInputError, SequenceError, UsageError
from physhandi.progress import NullProgress, Progress
from physhandi.synthetic.code_version import (
    PREDICTIONS,
    SCORES,
    code_version,
    outdated,
    recorded_version,
)
from physhandi.synthetic.suite.cells import FAILURES, UNSEEN, Bench, Outcome
from physhandi.synthetic.suite.folder import SuiteFolder, contact_kind, figures_of
from physhandi.synthetic.suite.methods import (
    METHODS,
    Method,
    method_settings,
    parse_method,
    searched_from,
)
from physhandi.synthetic.suite.suite import RESERVED_SEED, Protocol

SENSITIVITY = ((0.001, 3), (0.002, 3), (0.02, 3), (0.04, 3), (0.002, 1), (0.002, 10), (0.002, 50))
"""Start values of virtual δ [m] and d_max: the rows of the paper's sensitivity table."""
ROBUSTNESS = ("noisy_depth", "noisy_tracks", "noisy_hand")
"""The paper's three disturbances."""
_LOG = logging.getLogger(__name__)
WRITE_EVERY = 600.0
"""Tables are written after every protocol, and after this time [s]."""
_SCORES = "synthetic/suite/folder.py"


@dataclass(frozen=True, kw_only=True)
class Order:
    """Order of an evaluation: sequences, methods and protocols."""

    title: str
    """Title of the report."""
    recordings: tuple[Sequence, ...]
    """Sequences that methods are scored on."""
    methods: tuple[str, ...]
    """Names of methods."""
    protocols: tuple[Protocol, ...] = ("main",)
    """Protocols to run."""
    settings: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """Settings that all methods share."""
    search_seeds: tuple[int, ...] = ()
    """Seeds of the search with which every fit is repeated; none takes the profiles' own."""
    device: str = "cpu"
    """Warp device."""
    command: str = ""
    """Command line of the evaluation, for the report."""
    at_once: int = 1
    """Cells that are computed in parallel and share the machine."""
    environment: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """Machines that compute the cells, as `describe_environment` does; empty for this one."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """One cell of a protocol: a method on a sequence."""

    protocol: Protocol
    """Protocol that the cell belongs to."""
    split: str
    """Name of the cell's split in the protocol."""
    method: Method
    """Method that is evaluated."""
    recording: Sequence
    """Sequence that the result is scored against."""
    variant: str = "recording"
    """Variant of the sequence that is the method's input."""
    fitted: Sequence | None = None
    """Sequence on which the object is fitted, if it is another one."""


Fill = Callable[[Many[Task]], Iterator[tuple[int, str]]]
"""Computes cells elsewhere and yields their indices as they finish, each once; with a reason if the
cell was lost with the process that computed it, else with nothing."""


def evaluate_suite(
    order: Order, out: Path, progress: Progress | None = None, *, fill: Fill | None = None
) -> dict[str, Any]:
    """Compute the missing cells of an order, and write its tables.

    Tables are also written during the evaluation, and when it is cancelled or fails. Results of an
    earlier order on the same sequences with the same code remain in them.

    Args:
        order: Sequences, methods and protocols.
        out: Folder of the suite; finished cells in it are not computed again.
        progress: Receives reports of every cell and of every iteration in it.
        fill: Computes the cells in other processes, by `filler`; None computes them here, one after
            the other.

    Returns:
        ``out``, ``table`` and ``report`` (paths), ``cells`` and ``failed`` (numbers of cells),
        ``skipped`` (why some cells are not possible) and ``notes`` (on the data).

    Raises:
        UsageError: If a method is unknown, there is nothing to evaluate, or the folder holds the
            table of other sequences.
        MissingInputError: If no recording can be observed at all.
        CancelledError: If the user asked to stop; finished cells remain.
    """
    progress = progress or NullProgress()
    order, methods, tasks = _read(order)
    folder = SuiteFolder(out, _about(order, methods))
    for note in folder.about["notes"]:
        _LOG.warning("%s", note)
    work = _Work(order, out, progress)
    finished, paths, written = 0, dict[str, Any](), time.monotonic()
    before = ""

    def write() -> dict[str, Any]:
        missing = len(tasks) - finished
        recordings = () if missing else order.recordings
        environment = _environment(order)
        return folder.write(environment, work.skipped, missing, recordings, order.device)

    try:
        here = ((number, "") for number in range(len(tasks)))
        for number, lost in here if fill is None else fill(tasks):
            task = tasks[number]
            is_other, before = task.protocol != before, task.protocol
            if folder.done and (is_other or time.monotonic() - written > WRITE_EVERY):
                paths, written = write(), time.monotonic()
            progress.check_cancelled()
            message = f"{task.method.name}, {task.recording.name}"
            progress.report("suite", finished, len(tasks), message=message)
            cell = work.lost_cell(task, lost) if lost else work.cell(task)
            finished += 1
            if cell is not None:
                folder.done.append(cell)
        progress.report("suite", len(tasks), len(tasks))
    finally:
        if folder.done:
            paths = write()
    work.raise_if_blind()
    return (paths or write()) | {
        "cells": len(folder.done),
        "failed": sum(bool(cell["error"]) for cell in folder.done),
        "skipped": work.skipped,
        "notes": [*folder.about["notes"], *folder.notes],
    }


def filler(order: Order, out: Path, progress: Progress) -> Callable[[int], None]:
    """Return a function that computes the cell of an index, for one of several processes.

    Args:
        order: The order, the same in all processes.
        out: Folder of the suite.
        progress: Receives a report of every iteration.
    """
    order, _, tasks = _read(order)
    work = _Work(order, out, progress)

    def fill(number: int) -> None:
        work.outcome(tasks[number])

    return fill


class _Work:
    """Computes cells, and collects the reasons why some are skipped."""

    def __init__(self, order: Order, out: Path, progress: Progress) -> None:
        self.bench = Bench(
            out,
            common=order.settings,
            device=order.device,
            progress=progress,
            device_name=order.environment.get("device_name"),
        )
        self.recordings = order.recordings
        self.skipped: list[str] = []
        self._blind: dict[str, str] = {}

    def cell(self, task: Task) -> dict[str, Any] | None:
        """Compute a cell and describe it; None if it is skipped."""
        outcome = self.outcome(task)
        return None if outcome is None else self._described(task, outcome)

    def lost_cell(self, task: Task, why: str) -> dict[str, Any] | None:
        """Describe a cell that was lost as one without output; None if it cannot be scored."""
        where = f"{task.method.name}, {task.recording.name}, {task.split}"
        _LOG.warning("%s: %s", where, why)
        variant = task.variant if task.fitted is None else UNSEEN
        outcome = self.bench.without_output(task.method, task.recording, variant, why)
        if outcome is None:
            self._skip(f"{where}: {why}")
            return None
        return self._described(task, outcome)

    def outcome(self, task: Task) -> Outcome | None:
        """Compute a cell; None if it is skipped."""
        for recording in filter(None, (task.recording, task.fitted)):
            reason = self._why_blind(recording)
            if reason:
                self._skip(f"{recording.name}: {reason}")
                return None
        if task.protocol == "unseen" and task.fitted is None:
            self._skip(
                f"{task.recording.name}, unseen: no other sequence shows the same body in another "
                "action."
            )
            return None
        for recording in filter(None, (task.recording, task.fitted)):
            reason = self.bench.lacks(task.method, recording, task.variant)
            if reason:
                self._skip(f"{task.method.name}, {task.recording.name}, {task.split}: {reason}")
                return None
        if task.fitted is not None:
            return self.bench.unseen(task.method, task.fitted, task.recording)
        return self.bench.outcome(task.method, task.recording, task.variant)

    def raise_if_blind(self) -> None:
        """Check that at least one recording can be scored.

        Raises:
            MissingInputError: If no recording can be observed.
        """
        if self._blind and all(self._blind.get(r.name) for r in self.recordings):
            raise MissingInputError(f"No sequence can be evaluated. {' '.join(self.skipped)}")

    def _why_blind(self, recording: Sequence) -> str:
        """Explain why no method can be scored on a recording; empty if it can."""
        if recording.name not in self._blind:
            reason = ""
            try:
                self.bench.outcome(METHODS["static"], recording)
            except (*FAILURES, SequenceError) as error:
                reason = str(error)
            self._blind[recording.name] = reason
        return self._blind[recording.name]

    def _skip(self, reason: str) -> None:
        if reason not in self.skipped:
            self.skipped.append(reason)

    def _described(self, task: Task, outcome: Outcome) -> dict[str, Any]:
        unmoved = None
        if outcome.error and task.method.rule is None:
            static = self.bench.reference(task.recording)
            unmoved = static.array(SequenceFiles(task.recording.name).rollout)[0]
        figures = figures_of(outcome, task.recording, task.protocol, task.split, unmoved)
        return {
            "protocol": task.protocol,
            "split": task.split,
            "method": outcome.method,
            "case": outcome.case,
            "variant": outcome.variant,
            "run": outcome.run,
            "error": outcome.error,
            "contact": contact_kind(task.recording),
            "seconds": dict(outcome.seconds),
            "figures": figures,
            "curves": dict(outcome.curves),
        }


def _read(order: Order) -> tuple[Order, tuple[Method, ...], list[Task]]:
    """Check an order, remove duplicates, and return it with its methods and tasks."""
    named = [parse_method(name) for name in dict.fromkeys(order.methods)]
    methods = tuple(one for method in named for one in searched_from(method, order.search_seeds))
    order = replace(order, protocols=tuple(dict.fromkeys(order.protocols)))
    _check(order, methods)
    return order, methods, list(list_tasks(order, methods))


def _check(order: Order, methods: Many[Method]) -> None:
    names = [recording.name for recording in order.recordings]
    if not names or not methods:
        raise UsageError("There is nothing to evaluate: name at least one sequence and one method.")
    doubled = [name for name in names if names.count(name) > 1]
    if doubled:
        raise UsageError(f"Two sequences are named '{doubled[0]}'. Rename one of them.")
    for method in methods:
        method_settings(method, order.settings)


def _about(order: Order, methods: Many[Method]) -> dict[str, Any]:
    environment = _environment(order)
    settings = [named_fields(r.provenance.get("synthesize")) or {} for r in order.recordings]
    seeds = sorted({one["seed"] for one in settings if isinstance(one.get("seed"), int)})
    versions = [recorded_version(recording) for recording in order.recordings]
    return {
        "title": order.title,
        "command": order.command,
        "methods": {method.name: method.about for method in methods},
        "oracles": _oracles(methods),
        "seed_of": {method.name: method.seed_of for method in methods if method.seed_of},
        "cases": [recording.name for recording in order.recordings],
        "protocols": list(order.protocols),
        "settings": dict(order.settings),
        "at_once": order.at_once,
        "seeds": seeds,
        "is_verification": any(seed >= RESERVED_SEED for seed in seeds),
        "presets": sorted({str(one["preset"]) for one in settings if "preset" in one}),
        "generators": sorted({version for version in versions if version}),
        "notes": [note for recording in order.recordings if (note := outdated(recording))],
        "made_from": {
            "code": code_version((*PREDICTIONS, *SCORES, _SCORES)),
            "settings": dict(order.settings),
            "device": [environment["device"], environment["device_name"]],
            "packages": environment["packages"],
            "sequences": {r.name: r.fingerprint() for r in order.recordings},
        },
    }


def _oracles(methods: Many[Method]) -> list[str]:
    """Name the methods that are given what no real one can have, and the means over their seeds."""
    oracles = [method for method in methods if method.gets != "recording"]
    seeded = [method.seed_of for method in oracles if method.seed_of]
    return list(dict.fromkeys([*(method.name for method in oracles), *seeded]))


def _environment(order: Order) -> dict[str, Any]:
    if order.environment:
        return {**order.environment, "started": now()}
    return describe_environment(order.device, describe_device(order.device))


def list_tasks(order: Order, methods: Many[Method]) -> Iterator[Task]:
    """List the cells of an order, protocol by protocol and sequence by sequence.

    Args:
        order: Sequences and protocols.
        methods: The order's methods.

    Yields:
        Cells; an unseen interaction without `fitted` lacks another recording of the same body.
    """
    for protocol in order.protocols:
        for recording in order.recordings:
            for method in methods:
                yield from _asked(protocol, order, method, recording)


def _asked(protocol: Protocol, order: Order, method: Method, recording: Sequence) -> Iterator[Task]:
    task = Task(protocol=protocol, split=protocol, method=method, recording=recording)
    is_plain = method.gets == "recording"
    if protocol == "main":
        yield task
    elif protocol == "single_view" and is_plain:
        yield replace(task, variant="one_view")
    elif protocol == "robustness" and is_plain:
        for variant in ROBUSTNESS:
            yield replace(task, variant=variant, split=variant)
    elif protocol == "unseen" and method.correction is None:
        yield replace(task, fitted=_other_of_same_object(recording, order.recordings))
    elif protocol == "sensitivity" and is_plain and recording is order.recordings[0]:
        starts = () if method.rule else SENSITIVITY
        yield from (_started(task, *start) for start in starts)


def _started(task: Task, radius: float, most: int) -> Task:
    """Change the start of a method's search; the name stays, the split states the start."""
    start = {
        "simulation.virtual_connection_radius": radius,
        "simulation.virtual_max_neighbors": most,
    }
    method = replace(task.method, overrides={**task.method.overrides, **start})
    return replace(task, method=method, split=f"start δ={1000 * radius:g} mm d_max={most}")


def _other_of_same_object(recording: Sequence, others: Many[Sequence]) -> Sequence | None:
    """Find the next recording of the same body in another action, cyclically."""
    own, action = _body(recording)
    order = list(others)
    place = order.index(recording)
    if own is None or action is None:
        return None
    for other in order[place + 1 :] + order[:place]:
        body, done = _body(other)
        if body == own and done is not None and done != action:
            return other
    return None


def _body(recording: Sequence) -> tuple[tuple[Any, ...] | None, Any]:
    """Identify the body and the action of a synthetic recording.

    Object and seed determine a body's size and material within one version of the generator.
    """
    settings = named_fields(recording.provenance.get("synthesize"))
    if settings is None:
        return None, None
    body = tuple(settings.get(name) for name in ("object", "seed", "resolution"))
    return (*body, recorded_version(recording)), settings.get("action")
