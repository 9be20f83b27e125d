"""Sequences and runs as plain data, for the API and the pages."""

import builtins
import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, cast
from weakref import WeakKeyDictionary

from app.jobs.catalog import RunItem, SequenceItem
from app.jobs.scheduler import AT_WORK, JobView, Scheduler
from physhandi import errors
from physhandi.data.environment import ENVIRONMENT
from physhandi.data.files import named_fields
from physhandi.data.layout import LOSSES_FILE, METRICS_FILE, PARAMETERS_FILE, SequenceFiles
from physhandi.data.run_folder import (
    EXIT,
    EnvironmentFile,
    PartsFile,
    checked,
    moment_of,
    read_events,
    read_mapping,
)
from physhandi.errors import PhysHandiError, describe
from physhandi.fitting.config import SIMULATION, planned_stages
from physhandi.run import Run

RECORDED_PARTS = ("color", "depth", "mask", "keypoint", "track", "control", "marker", "object_node")
_SHOWN: dict[str, tuple[str, Any]] = {
    "losses": (LOSSES_FILE, PartsFile),
    "metrics": (METRICS_FILE, PartsFile),
    "environment": (ENVIRONMENT, EnvironmentFile),
    "parameters": (PARAMETERS_FILE, dict[str, Any]),
}
"""Results that a run's page lists, with file and shape."""
CURVE_LIMIT = 2000
"""Most points of a curve that are sent to a browser."""
# Runs and the views of ended runs stay the same objects while nothing changes on disk, so a long
# list is described once; a run at work has a new view, and is described anew, each time.
_described: WeakKeyDictionary[Run, tuple[JobView, dict[str, Any]]] = WeakKeyDictionary()


def describe_sequence(item: SequenceItem) -> dict[str, Any]:
    """Describe one sequence of a listing."""
    described: dict[str, Any] = {
        "id": item.id,
        "name": item.id,
        "is_bundled": item.is_bundled,
        "error": item.error,
    }
    sequence = item.sequence
    if sequence is None:
        return described
    missing = sequence.missing(*RECORDED_PARTS)
    return described | {
        "name": sequence.name,
        "description": sequence.description,
        "label": sequence.label,
        "origin": _first_text(sequence.provenance, "origin"),
        "licence": _first_text(sequence.provenance, "licence", "license"),
        "frame_count": sequence.frame_count,
        "frame_rate": sequence.frame_rate,
        "duration_s": sequence.frame_count / sequence.frame_rate,
        "view_count": len(sequence.views),
        "hands": list(sequence.hands),
        "marker_count": 0 if sequence.marker is None else sequence.marker.shape[1],
        "parts": [part for part in RECORDED_PARTS if part not in missing],
        "metric": sequence.metric,
        "length_unit": sequence.length_unit,
        "reconstruction_frames": len(sequence.reconstruction_frames),
    }


def _first_text(provenance: Mapping[str, Any], *names: str) -> str:
    """Give the first of these fields that is text, which whoever made the sequence wrote."""
    values = (provenance.get(name) for name in names)
    return next((text for text in values if isinstance(text, str)), "")


def describe_run(item: RunItem, scheduler: Scheduler) -> dict[str, Any]:
    """Describe one run of a listing, with how far it is and how long it still takes."""
    view = scheduler.view(item)
    entry = _described.get(item.run) if item.run else None
    if entry is None or entry[0] is not view:
        entry = (view, _describe(item, view))
        if item.run is not None:
            _described[item.run] = entry
    return _with_time_left(entry[1], item.run, view, scheduler)


def _with_time_left(
    described: dict[str, Any], run: Run | None, view: JobView, scheduler: Scheduler
) -> dict[str, Any]:
    """Add ``estimate``: `Forecast.of_running` or `Forecast.of_waiting`, else none.

    Of a run at work, ``eta_s`` of its ``progress`` becomes the time that its stage still takes.
    """
    estimate = None
    if run is not None and view.state in {"starting", "running"}:
        estimate = scheduler.forecast.of_running(run)
    elif run is not None and view.state == "queued":
        line = scheduler.in_line()
        place = next((number for number, other in enumerate(line) if other.id == run.id), None)
        if place is not None:
            estimate = scheduler.forecast.of_waiting(
                run, line[:place], scheduler.at_work(), scheduler.slots
            )
    progress = dict(described["progress"])
    if progress and estimate and "stage_left_s" in estimate:
        progress["eta_s"] = estimate["stage_left_s"]
    return described | {"estimate": estimate, "progress": progress}


def _describe(item: RunItem, view: JobView) -> dict[str, Any]:
    described: dict[str, Any] = {
        "id": item.id,
        "name": item.id,
        "is_bundled": item.is_bundled,
        "state": view.state,
        "place": view.place,
        "priority": view.priority,
        "reason": view.reason,
        "progress": dict(view.progress),
        "is_published": view.is_published,
        "error": item.error,
        "kind": "",
        "created": "",
        "sequences": [],
        "profile": "",
        "tags": [],
        "note": "",
    }
    run = item.run
    if run is None:
        return described | asdict(RunSummary())
    profile = named_fields(run.config.get("profile")) or {}
    return (
        described
        | {
            "name": run.name,
            "kind": run.kind,
            "created": run.created,
            "sequences": run.sequence_names,
            "profile": str(profile.get("profile", "")),
            "tags": tags_of(run.label),
            "note": run.note,
            "error": view.reason if view.state in {"failed", "damaged"} else None,
        }
        | asdict(summarize_run(run) if view.is_published else RunSummary())
    )


def follow_run(item: RunItem, scheduler: Scheduler) -> dict[str, Any]:
    """Describe one run as its own page shows it.

    Returns:
        `describe_run`, with ``stages`` (see `StageView`), ``failure`` (``message advice`` of a
        failed run, else none) and ``revision``, which differs whenever anything but the progress
        within a stage does.
    """
    described = describe_run(item, scheduler)
    run, state = item.run, described["state"]
    results: list[tuple[str, int]] = []
    stages: list[dict[str, Any]] = []
    try:
        if run is not None:
            stages = stages_of(run, state)
            results = [
                (rel, (run.out / rel).stat().st_mtime_ns)
                for rel, _ in _SHOWN.values()
                if run.has(rel)
            ]
    except (PhysHandiError, OSError) as error:
        described |= {"reason": described["reason"] or describe(error)}
    failure = None
    if state in {"failed", "damaged"}:
        failure = asdict(explain(run, described["reason"], is_damaged=state == "damaged"))
    shown = [described | {"progress": None, "estimate": None}, results, failure]
    shown += [stage | {"seconds": None} for stage in stages]
    revision = hashlib.sha256(json.dumps(shown, default=str).encode()).hexdigest()[:16]
    return described | {"stages": stages, "failure": failure, "revision": revision}


def tags_of(label: str) -> list[str]:
    """Split a run's label into its tags."""
    return list(dict.fromkeys(tag.strip() for tag in label.split(",") if tag.strip()))


@dataclass(frozen=True)
class StageView:
    """One stage of a run, for people."""

    name: str
    """Name of the stage."""
    state: str
    """``done``, ``passed`` (nothing to do), ``at-work``, ``failed``, ``stopped`` or ``to-come``."""
    seconds: float | None = None
    """Time that it took, or has taken so far [s]."""
    before: float | None = None
    """Loss at its start."""
    after: float | None = None
    """Loss at its end."""
    note: str = ""
    """A remark on how it ended."""


def stages_of(run: Run, state: str) -> list[dict[str, Any]]:
    """Tell for each stage of a run how far it is.

    Args:
        run: The run.
        state: State of the run, as the queue knows it.
    """
    attempt = run.attempt  # Read once: a run that is deleted meanwhile has none.
    if attempt is None:
        return [asdict(StageView(name, "to-come")) for name in _names(run)]
    finished = run.stages()
    progress = run.progress
    latest = str(progress["stage"]) if progress.get("attempt") == attempt else None
    views = stage_views(_names(run), finished, state, latest)
    begun = _running_since(run, finished)
    now = datetime.now(UTC).timestamp()
    return [
        asdict(view)
        | ({"seconds": now - begun} if view.state == "at-work" and begun is not None else {})
        for view in views
    ]


def stage_views(
    names: Sequence[str],
    finished: Sequence[Mapping[str, Any]],
    state: str,
    latest: str | None,
) -> list[StageView]:
    """Tell for each stage whether it is done, at work, failed, stopped or still to come.

    A stage that was passed over because the sequences lack what it needs is left out.

    Args:
        names: Stages that such a run usually has, in their order.
        finished: Finished stages: ``name summary``, and ``seconds`` if they were measured.
        state: State of the run.
        latest: Stage of the latest report of this attempt.
    """
    done: dict[str, Mapping[str, Any]] = {str(stage["name"]): stage for stage in finished}
    mentioned: list[str] = [*names, *done, *([latest] if latest else [])]
    order = list(dict.fromkeys(mentioned))
    last_done = max((order.index(name) for name in done), default=-1)
    # A stage may fail before it reports anything: then it is the one after the last finished.
    current = latest if latest and latest not in done else next(iter(order[last_done + 1 :]), None)
    mark = (
        "at-work" if state in AT_WORK else {"failed": "failed", "cancelled": "stopped"}.get(state)
    )
    views: list[StageView] = []
    for position, name in enumerate(order):
        if name in done:
            summary = named_fields(done[name].get("summary")) or {}
            views.append(
                StageView(
                    name,
                    "done" if _has_worked(name, done[name]) else "passed",
                    done[name].get("seconds"),
                    summary.get("before"),
                    summary.get("after"),
                    str(summary.get("note", "")),
                )
            )
        elif state != "succeeded" and name == current and mark:
            views.append(StageView(name, mark))
        elif state != "succeeded" and position > last_done:
            views.append(StageView(name, "to-come"))
    return views


def _has_worked(name: str, finished: Mapping[str, Any]) -> bool:
    """Tell whether a stage had anything to do: those of hands write nothing of hands if not."""
    files = named_fields(finished.get("files"))
    if files is None or not name.startswith("hand_"):
        return True
    if not files:  # Stage 1 notes at least which sequences there are.
        return name != "hand_refinement"
    return any("/hand_" in file for file in files)


def _names(run: Run) -> Sequence[str]:
    is_fit = run.kind != "simulation"
    return planned_stages(run.config.get("profile")) if is_fit else [SIMULATION]


def _running_since(run: Run, finished: Sequence[Mapping[str, Any]]) -> float | None:
    """Start of the current stage: the end of the one before, or the start of this attempt."""
    environment = named_fields(run.json(ENVIRONMENT)) if run.has(ENVIRONMENT) else None
    times = [(environment or {}).get("started"), *(stage.get("time") for stage in finished[-1:])]
    return max((begin for time in times if (begin := moment_of(time)) is not None), default=None)


_ADVICE = {
    "MissingInputError": "Choose a recording that has this part, or import it again with it.",
    "SequenceError": (
        "Repair the named file of the sequence and resume, or import the recording again."
    ),
    "UsageError": "Launch a new fit with a value that the message allows.",
    "FitError": (
        "Look at the recording first: is the hand or object seen in most frames? "
        "Then launch a fit with another profile."
    ),
    "SimulationDivergedError": (
        "Launch a fit with a profile that searches softer springs or takes more substeps."
    ),
    "RunError": "Resume goes on where it was, a few seconds before it stopped.",
    "": "Resume goes on where it was, a few seconds before it stopped.",
}
_DEFECT = (
    "This is a mistake of the program, not of your recording. Resume tries the stage again; "
    "if it stays, report it together with the downloaded log."
)


_NO_DEVICE_MEMORY = re.compile(r"Failed to allocate \d+ bytes on device|CUDA out of memory")
"""Messages of Warp and PyTorch about a lack of memory."""


@dataclass(frozen=True)
class Failure:
    """Cause of a run's failure."""

    message: str
    """Description of the cause."""
    advice: str
    """Advice to the user."""


def explain(run: Run | None, reason: str, *, is_damaged: bool = False) -> Failure:
    """Tell why a run failed or is damaged, and what to do.

    Args:
        run: The run; None if it cannot be opened.
        reason: What the queue knows of it.
        is_damaged: Whether it can be opened, but not be told how it ended.
    """
    if run is None or is_damaged:
        mend = "Repair the named file" if run is None else "Resume computes again what is lost"
        return Failure(reason, f"{mend}, or move the run's folder aside.")
    kind = str(read_mapping(run.folder / EXIT).get("error_type", ""))
    if kind in _ADVICE:
        return Failure(reason, _ADVICE[kind])
    if hasattr(errors, kind):
        return Failure(reason, _ADVICE["RunError"])
    if kind == "MemoryError" or _NO_DEVICE_MEMORY.search(reason):
        return _explain_memory(kind, reason)
    builtin = getattr(builtins, kind, None)
    if isinstance(builtin, type) and issubclass(builtin, OSError):
        return Failure(reason, "Check the disk and the data folder, then resume.")
    return Failure(f"The program stopped at a mistake of its own ({kind}: {reason}).", _DEFECT)


def _explain_memory(kind: str, reason: str) -> Failure:
    if kind == "MemoryError":
        return Failure(
            "There was not enough memory.",
            "End other programs or use a profile with fewer nodes, then resume.",
        )
    return Failure(
        f"The memory of the device ran out: {reason}",
        "Let fewer fits and live scenes use it at a time, or use a profile with fewer nodes or a "
        "smaller population, then resume.",
    )


@dataclass(frozen=True)
class RunSummary:
    """Duration and main errors of a run."""

    duration_s: float | None = None
    """Time that its finished stages took [s]."""
    track_error_fitted: float | None = None
    """Track error of the rollout in the frames that were fitted [m]."""
    track_error_predicted: float | None = None
    """Track error of the rollout in the frames that were not fitted [m]."""
    reprojection: float | None = None
    """Median distance of the hands' joints from their keypoints in the images [px]."""
    has_object: bool = False
    """Whether there is an object that can be simulated."""


def summarize_run(run: Run) -> RunSummary:
    """Read the figures of a run; what is missing or damaged is None, as a list must not fail.

    Of several sequences the mean over the frames of all of them is given. A simulation of a
    sequence that its source was not fitted to is a prediction from its first frame on.
    """
    try:
        fitted, predicted = _track_errors(run)
        reprojection = _reprojection(run)
    except (PhysHandiError, OSError):
        fitted = predicted = reprojection = None
    return RunSummary(
        _duration(run), fitted, predicted, reprojection, has_object=run.has(PARAMETERS_FILE)
    )


def _duration(run: Run) -> float | None:
    try:
        seconds = [stage.get("seconds") for stage in run.stages()]
    except (PhysHandiError, OSError):
        return None
    measured = [float(value) for value in seconds if isinstance(value, int | float)]
    return sum(measured) if measured and len(measured) == len(seconds) else None


def _track_errors(run: Run) -> tuple[float | None, float | None]:
    if not run.has(METRICS_FILE):
        return None, None
    metrics = named_fields(run.json(METRICS_FILE)) or {}
    unseen = _unseen_sequences(run)
    fitted: list[tuple[float, float]] = []
    predicted: list[tuple[float, float]] = []
    for name, scores in metrics.items():
        of_sequence = named_fields(scores) or {}
        if of_sequence.get("unit", "m") != "m":
            continue
        fitted_frames = predicted if name in unseen else fitted
        fitted_frames += _error_and_weight(of_sequence.get("reconstruction"))
        predicted += _error_and_weight(of_sequence.get("future"))
    return _mean(fitted), _mean(predicted)


def _reprojection(run: Run) -> float | None:
    """Give the median reprojection error, weighted by the keypoints of each hand."""
    metrics = (named_fields(run.json(METRICS_FILE)) if run.has(METRICS_FILE) else None) or {}
    errors_of_hands: list[tuple[float, float]] = []
    for scores in metrics.values():
        hands = named_fields((named_fields(scores) or {}).get("hands")) or {}
        for score in hands.values():
            fields = named_fields(score) or {}
            error, count = fields.get("reprojection_median"), fields.get("scored_keypoints")
            if isinstance(error, int | float) and isinstance(count, int | float) and count > 0:
                errors_of_hands.append((float(error), float(count)))
    return _mean(errors_of_hands)


def _unseen_sequences(run: Run) -> set[str]:
    if run.kind != "simulation":
        return set()
    try:
        source = Run.open(Path(str(run.config.get("source", ""))))
    except (PhysHandiError, OSError):
        return set()  # The run that it began from was deleted since.
    return set(run.sequence_names) - set(source.sequence_names)


def _error_and_weight(part: Any) -> list[tuple[float, float]]:
    """Give the track error of a part of a sequence and its number of frames, if it is known."""
    fields = named_fields(part) or {}
    error = (named_fields(fields.get("rollout")) or {}).get("track_error")
    frames = fields.get("frames")
    if not isinstance(error, int | float) or isinstance(error, bool):
        return []
    match frames:
        case [int(first), int(end)] if end > first:
            return [(float(error), float(end - first))]
        case _:
            return [(float(error), 1.0)]


def _mean(weighted: list[tuple[float, float]]) -> float | None:
    total = sum(weight for _, weight in weighted)
    return sum(error * weight for error, weight in weighted) / total if total else None


def describe_results(run: Run, *names: str) -> dict[str, dict[str, Any]]:
    """Collect what a run has found so far.

    Args:
        run: The run.
        names: Some of losses, metrics, parameters and environment; by default all.
    """
    results: dict[str, dict[str, Any]] = {}
    problems: list[str] = []
    for name in names or _SHOWN:
        rel, kind = _SHOWN[name]
        try:
            if run.has(rel):
                content = run.yaml(rel) if rel.endswith(".yaml") else run.json(rel)
                results[name] = dict(checked(content, kind, rel))
        except (PhysHandiError, OSError) as error:
            problems.append(describe(error))
    if problems:
        results["problem"] = {"message": " ".join(problems)}
    return results


def read_frame_errors(run: Run) -> dict[str, dict[str, Any]]:
    """Give the errors of every frame, for each sequence that they were measured in.

    Returns:
        For each sequence what its ``frame_errors.json`` holds (``unit frames`` and by method
        ``track_error chamfer_l2``) and ``future_start``, the first frame that was not fitted.
    """
    metrics = describe_results(run, "metrics").get("metrics", {})
    errors_of: dict[str, dict[str, Any]] = {}
    for name in run.sequence_names:
        rel = SequenceFiles(name).frame_errors
        if not run.has(rel):
            continue
        content = named_fields(run.json(rel)) or {}
        scores = named_fields(metrics.get(name)) or {}
        future = (named_fields(scores.get("future")) or {}).get("frames")
        start = cast("list[Any]", future)[0] if isinstance(future, list) and future else None
        errors_of[name] = content | {"future_start": start}
    return errors_of


def loss_curves(run: Run) -> tuple[dict[str, dict[str, Any]], int]:
    """Give the loss of each stage over its iterations, of a running stage as far as it is.

    Returns:
        For each stage its ``before`` and ``after``, null while it runs, and the ``curve`` of
        ``[iteration, loss]``, thinned to `CURVE_LIMIT` points so that every peak stays; then the
        number of the last event that it holds, -1 if there is none.
    """
    curves: dict[str, list[list[float]]] = {}
    events, _ = read_events(run.folder)
    latest = -1
    for event in events:
        latest = event.get("seq", latest)
        loss, iteration = event.get("loss"), event.get("iteration")
        if loss is None or not isinstance(iteration, int):
            continue
        curve = curves.setdefault(str(event.get("stage")), [])
        while curve and iteration <= curve[-1][0]:
            curve.pop()  # It was started again, or goes on from an earlier checkpoint.
        curve.append([iteration, float(loss)])
    stages = describe_results(run, "losses").get("losses", {})
    result: dict[str, dict[str, Any]] = {}
    for stage in dict.fromkeys([*stages, *curves]):
        summary = named_fields(stages.get(stage)) or {}
        curve = _points(summary.get("curve")) or curves.get(stage, [])
        result[stage] = {
            "before": summary.get("before"),
            "after": summary.get("after"),
            "curve": thin(curve, CURVE_LIMIT),
        }
    return result, latest


def thin(curve: list[list[float]], limit: int) -> list[list[float]]:
    """Thin a curve to at most `limit` points, keeping the lowest and highest of each part."""
    if len(curve) <= limit:
        return curve
    parts = limit // 2
    thinned: list[list[float]] = []
    for part in range(parts):
        points = curve[part * len(curve) // parts : (part + 1) * len(curve) // parts]
        low = min(points, key=lambda point: point[1])
        high = max(points, key=lambda point: point[1])
        thinned.extend([low] if low == high else sorted([low, high], key=lambda point: point[0]))
    return thinned


def _points(curve: object) -> list[list[float]]:
    """Keep the points of a stored curve that have a finite loss."""
    points: list[list[float]] = []
    for point in cast("list[Any]", curve) if isinstance(curve, list) else []:
        values = cast("list[Any]", point)[:2] if isinstance(point, list) else []
        if len(values) == 2 and all(isinstance(value, int | float) for value in values):
            points.append(values)
    return points
