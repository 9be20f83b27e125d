"""What the API and the pages say about sequences and runs, as plain data."""

from typing import Any

from app.jobs.catalog import RunItem, SequenceItem
from app.jobs.scheduler import Scheduler


def describe_sequence(item: SequenceItem) -> dict[str, Any]:
    """Describe one sequence of a listing."""
    described: dict[str, Any] = {
        "id": item.id,
        "is_bundled": item.is_bundled,
        "error": item.error,
    }
    sequence = item.sequence
    if sequence is None:
        return described
    parts = ("color", "depth", "mask", "keypoint", "track", "control", "marker", "object_node")
    missing = sequence.missing(*parts)
    return described | {
        "name": sequence.name,
        "description": sequence.description,
        "label": sequence.label,
        "frame_count": sequence.frame_count,
        "frame_rate": sequence.frame_rate,
        "duration_s": sequence.frame_count / sequence.frame_rate,
        "view_count": len(sequence.views),
        "hands": list(sequence.hands),
        "parts": [part for part in parts if part not in missing],
        "metric": sequence.metric,
        "length_unit": sequence.length_unit,
        "reconstruction_frames": len(sequence.reconstruction_frames),
    }


def describe_run(item: RunItem, scheduler: Scheduler) -> dict[str, Any]:
    """Describe one run of a listing, with how far it is."""
    view = scheduler.view(item)
    described: dict[str, Any] = {
        "id": item.id,
        "is_bundled": item.is_bundled,
        "state": view.state,
        "place": view.place,
        "reason": view.reason,
        "progress": dict(view.progress),
        "error": item.error,
        "name": item.id,
        "sequences": [],
    }
    run = item.run
    if run is None:
        return described
    profile = run.config.get("profile", {})
    return described | {
        "name": run.name,
        "kind": run.kind,
        "created": run.created,
        "sequences": run.sequence_names,
        "profile": profile.get("profile", "") if isinstance(profile, dict) else "",
        "is_published": run.is_published,
        "error": run.error,
    }


def describe_results(item: RunItem) -> dict[str, Any]:
    """Collect what a run found: losses, metrics and parameters, as far as it has them."""
    run = item.run
    if run is None or not run.is_published and run.state == "queued":
        return {}
    results: dict[str, Any] = {}
    for name, rel in (("losses", "losses.json"), ("metrics", "metrics.json")):
        if run.has(rel):
            results[name] = run.json(rel)
    if run.has("object/parameters.yaml"):
        results["parameters"] = run.yaml("object/parameters.yaml")
    return results
