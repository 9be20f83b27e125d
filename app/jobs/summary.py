"""The few figures of a run that a list shows and sorts by."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from physhandi.data.atomic import named_fields
from physhandi.data.run import Run
from physhandi.errors import PhysHandiError

_METRICS = "metrics.json"


@dataclass(frozen=True)
class RunSummary:
    """What a run took and how well it did."""

    duration_s: float | None = None
    """Time that its finished stages took [s]."""
    track_error_fitted: float | None = None
    """Track error of the rollout in the frames that were fitted [m]."""
    track_error_predicted: float | None = None
    """Track error of the rollout in the frames that were not fitted [m]."""
    reprojection: float | None = None
    """Median distance of the hands' joints from their keypoints in the images [px]."""


def summarize(run: Run) -> RunSummary:
    """Read the figures of a run; what is missing or damaged is None, as a list must not fail.

    Of several sequences the mean over the frames of all of them is given. A simulation of a
    sequence that its source was not fitted to is a prediction from its first frame on.
    """
    try:
        fitted, predicted = _track_errors(run)
        reprojection = _reprojection(run)
    except (PhysHandiError, OSError):
        fitted = predicted = reprojection = None
    return RunSummary(_duration(run), fitted, predicted, reprojection)


def _duration(run: Run) -> float | None:
    try:
        seconds = [stage.get("seconds") for stage in run.stages()]
    except (PhysHandiError, OSError):
        return None
    known = [float(value) for value in seconds if isinstance(value, int | float)]
    return sum(known) if known and len(known) == len(seconds) else None


def _track_errors(run: Run) -> tuple[float | None, float | None]:
    if not run.has(_METRICS):
        return None, None
    metrics = named_fields(run.json(_METRICS)) or {}
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
    metrics = (named_fields(run.json(_METRICS)) if run.has(_METRICS) else None) or {}
    found: list[tuple[float, float]] = []
    for scores in metrics.values():
        hands = named_fields((named_fields(scores) or {}).get("hands")) or {}
        for score in hands.values():
            fields = named_fields(score) or {}
            error, count = fields.get("reprojection_median"), fields.get("scored_keypoints")
            if isinstance(error, int | float) and isinstance(count, int | float) and count > 0:
                found.append((float(error), float(count)))
    return _mean(found)


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
