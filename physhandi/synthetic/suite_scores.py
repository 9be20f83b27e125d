"""The figures of a cell, told apart by what they are taken over."""

from collections.abc import Iterator, Mapping
from typing import Any, Literal

from physhandi.data.atomic import named_fields
from physhandi.data.sequence import Sequence
from physhandi.data.truth import read_truth
from physhandi.metrics.report import METRICS
from physhandi.metrics.suite_tables import Score
from physhandi.synthetic.cells import Outcome

DENSE_ACTIONS = ("squeeze", "wipe")
"""Actions of made recordings in which the whole hand is on the body; others use fingertips."""
DENSE = 0.05
"""Of other recordings contact is dense if a hand touches more than this share of the object's
places on average, in the frames in which it touches any."""
BREAKDOWN = ("/dense", "/point")
"""Ends of the splits that repeat the figures of others for one kind of contact."""
_HANDS = {"chamfer_symmetric": "hand_chamfer", "mpjpe": "mpjpe", "surface_error": "hand_surface"}
_SHADED = ("iou", "psnr")
_TOPOLOGY = ("rrd_object", "rrd_virtual")


def contact_kind(recording: Sequence) -> Literal["dense", "point"] | None:
    """Tell by its action, else by its true contact, how much is held; None if unknown."""
    made = named_fields(recording.provenance.get("synthesize")) or {}
    if made.get("action") is not None:
        return "dense" if made["action"] in DENSE_ACTIONS else "point"
    contact = read_truth(recording.folder).contact
    if contact is None or not contact.any():
        return None
    share = contact.mean(axis=1)
    return "dense" if share[share > 0].mean() > DENSE else "point"


def scores_of(outcome: Outcome, recording: Sequence, protocol: str, name: str) -> Iterator[Score]:
    """Collect the figures of a cell.

    Args:
        outcome: What came out of it.
        recording: What it was scored against.
        protocol: Protocol that asked for it.
        name: What the protocol calls it; the first part of every split but those of ``main``.

    Yields:
        Every figure that is known. A method without output has those of the static object, and none
        of hands, topology and time; nor has an object in a sequence that it was not fitted in.
    """

    def named(split: str) -> str:
        return split if protocol == "main" else f"{name}/{split}"

    is_fitted = not outcome.error and protocol != "unseen"

    found = dict(_object_figures(outcome.report, recording, protocol, named))
    if is_fitted:
        found[named("hands")] = _hand_figures(outcome.report.get("hands", {}))
        topology = outcome.report.get("topology", {})
        found[named("topology")] = {metric: topology.get(metric) for metric in _TOPOLOGY}
    if is_fitted and protocol == "main":
        found["runtime"] = _times(outcome.seconds, recording.frame_count)
    for split, figures in found.items():
        for metric, value in figures.items():
            if isinstance(value, int | float):
                yield Score(
                    method=outcome.method,
                    case=outcome.case,
                    split=split,
                    metric=metric,
                    value=float(value),
                )


def _object_figures(
    report: Mapping[str, Any], recording: Sequence, protocol: str, named: Any
) -> Iterator[tuple[str, dict[str, Any]]]:
    kind = contact_kind(recording) if protocol == "main" else None
    for split in ("reconstruction", "future"):
        found = report.get(split, {}).get("rollout", {})
        figures = {metric: found.get(metric) for metric in (*METRICS, *_SHADED)}
        yield ("unseen" if protocol == "unseen" else named(split)), figures
        if protocol == "unseen":
            return  # All its frames are in the first split.
        if kind is not None:
            yield f"{split}/{kind}", figures


def _hand_figures(hands: Mapping[str, Any]) -> dict[str, Any]:
    """Average over the hands that have a figure."""
    found: dict[str, Any] = {}
    for key, name in _HANDS.items():
        known = [hand[key] for hand in hands.values() if isinstance(hand.get(key), float)]
        if known:
            found[name] = sum(known) / len(known)
    return found


def _times(seconds: Mapping[str, float], frame_count: int) -> dict[str, Any]:
    """Give the time that a video frame took in each stage, and in all of them."""
    times = {f"seconds_per_frame_{stage}": s / frame_count for stage, s in seconds.items()}
    return times | ({"seconds_per_frame": sum(times.values())} if times else {})
