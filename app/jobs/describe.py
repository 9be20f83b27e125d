"""What the API and the pages say about sequences and runs, as plain data."""

import hashlib
import json
from dataclasses import asdict
from typing import Any, cast
from weakref import WeakKeyDictionary

from app.jobs.catalog import RunItem, SequenceItem
from app.jobs.failures import explain
from app.jobs.listing import tags_of
from app.jobs.remaining import with_time
from app.jobs.scheduler import JobView, Scheduler
from app.jobs.stages import stages_of
from app.jobs.summary import RunSummary, summarize
from physhandi.data.atomic import named_fields
from physhandi.data.environment import ENVIRONMENT
from physhandi.data.run import Run, read_events
from physhandi.errors import PhysHandiError

PARTS = ("color", "depth", "mask", "keypoint", "track", "control", "marker", "object_node")
_RESULTS = ("losses.json", "metrics.json", "object/parameters.yaml", ENVIRONMENT)
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
    missing = sequence.missing(*PARTS)
    return described | {
        "name": sequence.name,
        "description": sequence.description,
        "label": sequence.label,
        "frame_count": sequence.frame_count,
        "frame_rate": sequence.frame_rate,
        "duration_s": sequence.frame_count / sequence.frame_rate,
        "view_count": len(sequence.views),
        "hands": list(sequence.hands),
        "marker_count": 0 if sequence.marker is None else sequence.marker.shape[1],
        "parts": [part for part in PARTS if part not in missing],
        "metric": sequence.metric,
        "length_unit": sequence.length_unit,
        "reconstruction_frames": len(sequence.reconstruction_frames),
    }


def describe_run(item: RunItem, scheduler: Scheduler) -> dict[str, Any]:
    """Describe one run of a listing, with how far it is and how long it still takes."""
    view = scheduler.view(item)
    known = _described.get(item.run) if item.run else None
    if known is None or known[0] is not view:
        known = (view, _describe(item, view))
        if item.run is not None:
            _described[item.run] = known
    return with_time(known[1], item.run, view, scheduler)


def _describe(item: RunItem, view: JobView) -> dict[str, Any]:
    described: dict[str, Any] = {
        "id": item.id,
        "name": item.id,
        "is_bundled": item.is_bundled,
        "state": view.state,
        "place": view.place,
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
            "error": view.reason if view.state == "failed" else None,
        }
        | asdict(summarize(run) if view.is_published else RunSummary())
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
                (rel, (run.out / rel).stat().st_mtime_ns) for rel in _RESULTS if run.has(rel)
            ]
    except (PhysHandiError, OSError) as error:
        described |= {"state": "failed", "reason": str(error)}
    failure = asdict(explain(run, described["reason"])) if state == "failed" else None
    shown = [described | {"progress": None, "estimate": None}, results, failure]
    shown += [stage | {"seconds": None} for stage in stages]
    revision = hashlib.sha256(json.dumps(shown, default=str).encode()).hexdigest()[:16]
    return described | {"stages": stages, "failure": failure, "revision": revision}


def describe_results(run: Run) -> dict[str, dict[str, Any]]:
    """Collect what a run has found so far: losses, metrics, parameters and environment."""
    results: dict[str, dict[str, Any]] = {}
    try:
        for name in ("losses", "metrics"):
            if run.has(f"{name}.json"):
                results[name] = named_fields(run.json(f"{name}.json")) or {}
        if run.has(ENVIRONMENT):
            results["environment"] = named_fields(run.json(ENVIRONMENT)) or {}
        if run.has("object/parameters.yaml"):
            results["parameters"] = named_fields(run.yaml("object/parameters.yaml")) or {}
    except PhysHandiError as error:
        results["problem"] = {"message": str(error)}
    return results


def frame_errors(run: Run) -> dict[str, dict[str, Any]]:
    """Give the errors of every frame, for each sequence that they were measured in.

    Returns:
        For each sequence what its ``frame_errors.json`` holds (``unit frames`` and by method
        ``track_error chamfer_l2``) and ``future_start``, the first frame that was not fitted.
    """
    metrics = describe_results(run).get("metrics", {})
    found: dict[str, dict[str, Any]] = {}
    for name in run.sequence_names:
        rel = f"sequences/{name}/frame_errors.json"
        if not run.has(rel):
            continue
        content = named_fields(run.json(rel)) or {}
        scores = named_fields(metrics.get(name)) or {}
        future = (named_fields(scores.get("future")) or {}).get("frames")
        found[name] = content | {"future_start": future[0] if isinstance(future, list) else None}
    return found


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
        latest = int(event.get("seq", latest))
        loss, iteration = event.get("loss"), event.get("iteration")
        if not isinstance(loss, int | float) or not isinstance(iteration, int):
            continue
        curve = curves.setdefault(str(event.get("stage")), [])
        if curve and iteration <= curve[-1][0]:
            curve.clear()  # The stage was started again.
        curve.append([iteration, float(loss)])
    stages = describe_results(run).get("losses", {})
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
    kept: list[list[float]] = []
    for part in range(parts):
        points = curve[part * len(curve) // parts : (part + 1) * len(curve) // parts]
        low = min(points, key=lambda point: point[1])
        high = max(points, key=lambda point: point[1])
        kept.extend([low] if low == high else sorted([low, high], key=lambda point: point[0]))
    return kept


def _points(curve: object) -> list[list[float]]:
    """Keep the points of a stored curve that have a finite loss."""
    points = cast("list[Any]", curve) if isinstance(curve, list) else []
    return [[p[0], p[1]] for p in points if isinstance(p, list) and None not in p]
