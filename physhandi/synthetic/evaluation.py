"""Evaluating methods on sequences: which cells a protocol asks for, and what is written of them."""

from collections.abc import Iterator, Mapping
from collections.abc import Sequence as Many
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import warp as wp

from physhandi.data.atomic import named_fields, write_bytes, write_json
from physhandi.data.environment import describe_environment
from physhandi.data.sequence import Sequence
from physhandi.errors import PhysHandiError, UsageError
from physhandi.metrics.suite_report import write_report
from physhandi.metrics.suite_tables import (
    PAIRED_COLUMNS,
    Score,
    compare,
    summarise,
    to_csv,
)
from physhandi.progress import NullProgress, Progress
from physhandi.synthetic.baselines import Method, parse_method, settings_of
from physhandi.synthetic.cells import Bench, Outcome
from physhandi.synthetic.suite import Protocol
from physhandi.synthetic.suite_scores import BREAKDOWN, contact_kind, scores_of

SENSITIVITY = ((0.001, 3), (0.002, 3), (0.02, 3), (0.04, 3), (0.002, 1), (0.002, 10), (0.002, 50))
"""Start values of virtual δ [m] and d_max: the rows of the paper's sensitivity table."""
ROBUSTNESS = ("noisy_depth", "noisy_tracks", "noisy_hand")
"""The paper's three disturbances."""


@dataclass(frozen=True, kw_only=True)
class Order:
    """What is to be evaluated."""

    title: str
    """What the report is called."""
    recordings: tuple[Sequence, ...]
    """Sequences that methods are scored on."""
    methods: tuple[str, ...]
    """Names of methods."""
    protocols: tuple[Protocol, ...] = ("main",)
    """Which protocols are run."""
    settings: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """Settings that all methods share."""
    device: str = "cpu"
    """Warp device."""


@dataclass(frozen=True, kw_only=True)
class _Task:
    """One cell that a protocol asks for."""

    protocol: Protocol
    split: str
    method: Method
    recording: Sequence
    variant: str = "recording"
    fitted: Sequence | None = None


def evaluate(order: Order, out: Path, progress: Progress | None = None) -> dict[str, Any]:
    """Run what is missing of an order, and write its tables.

    Args:
        order: What is to be evaluated.
        out: Folder of the suite; finished cells in it are not computed again.
        progress: Told about every cell, and about every iteration in it.

    Returns:
        ``out``, ``table`` and ``report`` (paths), ``cells`` and ``failed`` (numbers of cells), and
        ``skipped`` (why some could not be asked for).

    Raises:
        UsageError: If a method is unknown, or there is nothing to evaluate.
        PhysHandiError: If a recording cannot be observed at all.
        CancelledError: If the user asked to stop; what is finished stays.
    """
    progress = progress or NullProgress()
    methods = tuple(parse_method(name) for name in dict.fromkeys(order.methods))
    _check(order, methods)
    bench = Bench(out, common=order.settings, device=order.device, progress=progress)
    tasks = list(_tasks(order, methods))
    scores: list[Score] = []
    cells: list[dict[str, Any]] = []
    skipped: list[str] = []
    for number, task in enumerate(tasks):
        progress.check_cancelled()
        told = f"{task.method.name}, {task.recording.name}"
        progress.report("suite", number, len(tasks), message=told)
        try:
            outcome = _outcome(bench, task)
        except _ImpossibleError as reason:
            skipped.append(f"{told}, {task.split}: {reason}")
            continue
        found = list(scores_of(outcome, task.recording, task.protocol, task.split))
        scores += found
        cells.append(_cell(task, outcome, found))
    progress.report("suite", len(tasks), len(tasks))
    environment = describe_environment(order.device, wp.get_device(order.device).name)
    about = {
        "title": order.title,
        "methods": {method.name: method.about for method in methods},
        "cases": [recording.name for recording in order.recordings],
        "protocols": list(order.protocols),
        "settings": dict(order.settings),
        "skipped": skipped,
        "environment": environment,
    }
    return _write(out, about, scores, cells) | {
        "cells": len(cells),
        "failed": sum(bool(cell["error"]) for cell in cells),
        "skipped": skipped,
    }


class _ImpossibleError(PhysHandiError):
    """A recording lacks what a protocol or an oracle needs; no method is to blame."""


def _check(order: Order, methods: Many[Method]) -> None:
    names = [recording.name for recording in order.recordings]
    if not names or not methods:
        raise UsageError("There is nothing to evaluate: name at least one sequence and one method.")
    doubled = [name for name in names if names.count(name) > 1]
    if doubled:
        raise UsageError(f"Two sequences are named '{doubled[0]}'. Rename one of them.")
    for method in methods:
        settings_of(method, order.settings)


def _tasks(order: Order, methods: Many[Method]) -> Iterator[_Task]:
    for protocol in order.protocols:
        for recording in order.recordings:
            for method in methods:
                yield from _asked(protocol, order, method, recording)


def _asked(
    protocol: Protocol, order: Order, method: Method, recording: Sequence
) -> Iterator[_Task]:
    task = _Task(protocol=protocol, split=protocol, method=method, recording=recording)
    is_plain = method.gets == "recording"
    if protocol == "main":
        yield task
    elif protocol == "single_view" and is_plain:
        yield replace(task, variant="one_view")
    elif protocol == "robustness" and is_plain:
        for variant in ROBUSTNESS:
            yield replace(task, variant=variant, split=variant)
    elif protocol == "unseen" and not method.is_corrected:
        fitted = _other_of_same_object(recording, order.recordings)
        if fitted is not None:
            yield replace(task, fitted=fitted)
    elif protocol == "sensitivity" and is_plain and recording is order.recordings[0]:
        starts = () if method.rule else SENSITIVITY
        yield from (_started(task, *start) for start in starts)


def _started(task: _Task, radius: float, most: int) -> _Task:
    """Start a method's search elsewhere; it keeps its name, and the split tells where."""
    start = {
        "simulation.virtual_connection_radius": radius,
        "simulation.virtual_max_neighbors": most,
    }
    method = replace(task.method, overrides={**task.method.overrides, **start})
    return replace(task, method=method, split=f"start δ={1000 * radius:g} mm d_max={most}")


def _other_of_same_object(recording: Sequence, others: Many[Sequence]) -> Sequence | None:
    """Find the next recording of the same body in another action; around the end of the list."""
    own = _body(recording)
    order = list(others)
    place = order.index(recording)
    rest = order[place + 1 :] + order[:place]
    return next((other for other in rest if own is not None and _body(other) == own), None)


def _body(recording: Sequence) -> tuple[Any, ...] | None:
    """Identify the made body of a recording: seed and object decide its size and material."""
    made = named_fields(recording.provenance.get("synthesize"))
    if made is None:
        return None
    return tuple(made.get(name) for name in ("object", "seed", "resolution"))


def _outcome(bench: Bench, task: _Task) -> Outcome:
    for recording in filter(None, (task.recording, task.fitted)):
        reason = bench.lacks(task.method, recording, task.variant)
        if reason:
            raise _ImpossibleError(reason)
    if task.fitted is not None:
        return bench.unseen(task.method, task.fitted, task.recording)
    return bench.outcome(task.method, task.recording, task.variant)


def _cell(task: _Task, outcome: Outcome, scores: Many[Score]) -> dict[str, Any]:
    figures: dict[str, dict[str, float]] = {}
    for score in scores:
        if not score.split.endswith(BREAKDOWN):
            figures.setdefault(score.split, {})[score.metric] = score.value
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


def _write(
    out: Path, about: Mapping[str, Any], scores: Many[Score], cells: Many[dict[str, Any]]
) -> dict[str, Any]:
    rows = summarise(scores)
    methods = list(about["methods"])
    against = "phystwin" if "phystwin" in methods else methods[0]
    differences = compare(scores, against)
    write_json(out / "cells.json", {"about": about, "cells": list(cells)})
    write_bytes(out / "table.csv", to_csv(rows).encode())
    write_bytes(out / "paired.csv", to_csv(differences, PAIRED_COLUMNS).encode())
    for file, content in write_report(about, rows, differences, cells).items():
        (out / file).parent.mkdir(exist_ok=True)
        write_bytes(out / file, content.encode())
    return {
        "out": str(out),
        "table": str(out / "table.csv"),
        "report": str(out / "report.md"),
    }
