"""What the API and the pages say about sequences and runs, as plain data."""

from typing import Any, cast

from app.jobs.catalog import RunItem, SequenceItem
from app.jobs.scheduler import Scheduler
from physhandi.data.atomic import named_fields
from physhandi.data.run import Run, read_events
from physhandi.errors import PhysHandiError

PARTS = ("color", "depth", "mask", "keypoint", "track", "control", "marker", "object_node")
CURVE_LIMIT = 2000
"""Most points of a curve that are sent to a browser."""


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
        "parts": [part for part in PARTS if part not in missing],
        "metric": sequence.metric,
        "length_unit": sequence.length_unit,
        "reconstruction_frames": len(sequence.reconstruction_frames),
    }


def describe_run(item: RunItem, scheduler: Scheduler) -> dict[str, Any]:
    """Describe one run of a listing, with how far it is."""
    view = scheduler.view(item)
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
    }
    run = item.run
    if run is None:
        return described
    profile = named_fields(run.config.get("profile")) or {}
    return described | {
        "name": run.name,
        "kind": run.kind,
        "created": run.created,
        "sequences": run.sequence_names,
        "profile": str(profile.get("profile", "")),
        "error": view.reason if view.state == "failed" else None,
    }


def describe_results(run: Run) -> dict[str, dict[str, Any]]:
    """Collect what a run has found so far: losses, metrics and parameters, each by name."""
    results: dict[str, dict[str, Any]] = {}
    try:
        for name in ("losses", "metrics"):
            if run.has(f"{name}.json"):
                results[name] = named_fields(run.json(f"{name}.json")) or {}
        if run.has("object/parameters.yaml"):
            results["parameters"] = named_fields(run.yaml("object/parameters.yaml")) or {}
    except PhysHandiError as error:
        results["problem"] = {"message": str(error)}
    return results


def loss_curves(run: Run) -> dict[str, dict[str, Any]]:
    """Give the loss of each stage over its iterations, of a running stage as far as it is.

    Returns:
        For each stage its ``before`` and ``after``, null while it runs, and the ``curve`` of
        ``[iteration, loss]``, thinned to `CURVE_LIMIT` points so that every peak stays.
    """
    curves: dict[str, list[list[float]]] = {}
    events, _ = read_events(run.folder)
    for event in events:
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
    return result


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
