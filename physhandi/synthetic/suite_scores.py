"""The figures of a cell, told apart by what they are taken over."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.data.atomic import named_fields
from physhandi.data.sequence import Sequence
from physhandi.data.truth import read_truth
from physhandi.metrics.contact import THRESHOLDS, ContactLabels, contact_scores, true_labels
from physhandi.metrics.report import CONTACT_METRICS, METRICS
from physhandi.metrics.suite_tables import Score
from physhandi.synthetic.cells import Outcome

DENSE_ACTIONS = ("squeeze", "wipe")
"""Actions of made recordings in which the whole hand is on the body; others use fingertips."""
DENSE = 0.05
"""Of other recordings contact is dense if a hand touches more than this share of the object's
places on average, in the frames in which it touches any."""
_SPLITS = ("reconstruction", "future")
_HANDS = {"chamfer_symmetric": "hand_chamfer", "mpjpe": "mpjpe", "surface_error": "hand_surface"}
_SHADED = ("iou", "psnr")
_TOPOLOGY = ("rrd_object", "rrd_virtual")

Figures = dict[str, dict[str, float]]
"""Figures by split and metric."""


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


def figures_of(
    outcome: Outcome,
    recording: Sequence,
    protocol: str,
    name: str,
    unmoved: Float[ndarray, "node 3"] | None = None,
) -> Figures:
    """Collect the figures of a cell.

    Args:
        outcome: What came out of it.
        recording: What it was scored against.
        protocol: Protocol that asked for it.
        name: What the protocol calls it; the first part of every split but those of ``main``.
        unmoved: Object nodes of frame 0, if the method predicts contact [m].

    Returns:
        Every figure that is known. A method without output has those of the static object, which
        touches nothing; and none of hands, topology and time. Nor has an object in a sequence that
        it was not fitted in.
    """

    def named(split: str) -> str:
        return split if protocol == "main" else f"{name}/{split}"

    found: dict[str, Mapping[str, Any]] = {}
    for split in _SPLITS[:1] if protocol == "unseen" else _SPLITS:
        rollout = outcome.report.get(split, {}).get("rollout", {})
        figures = {metric: rollout.get(metric) for metric in (*METRICS, *_SHADED)}
        if outcome.error and rollout and unmoved is not None:
            figures |= no_contact_scores(recording, unmoved, _frames(recording, protocol, split))
        # All frames of an unseen interaction are in the first split.
        found["unseen" if protocol == "unseen" else named(split)] = figures
    if not outcome.error and protocol != "unseen":
        found[named("hands")] = _hand_figures(outcome.report.get("hands", {}))
        topology = outcome.report.get("topology", {})
        found[named("topology")] = {metric: topology.get(metric) for metric in _TOPOLOGY}
        if protocol == "main":
            found["runtime"] = _times(outcome.seconds, recording.frame_count)
    known = {
        split: {m: float(v) for m, v in figures.items() if isinstance(v, int | float)}
        for split, figures in found.items()
    }
    return {split: figures for split, figures in known.items() if figures}


def scores_of(cells: Iterable[Mapping[str, Any]]) -> Iterator[Score]:
    """List the figures of cells; those of the protocol ``main`` also by their kind of contact.

    Args:
        cells: Entries with ``method case protocol contact figures``.
    """
    for cell in cells:
        figures = dict(cell["figures"])
        if cell["protocol"] == "main" and cell["contact"]:
            kind = cell["contact"]
            figures |= {f"{s}/{kind}": figures[s] for s in _SPLITS if s in figures}
        for split, by_metric in figures.items():
            for metric, value in by_metric.items():
                yield Score(
                    method=cell["method"],
                    case=cell["case"],
                    split=split,
                    metric=metric,
                    value=float(value),
                )


def no_contact_scores(
    recording: Sequence, node: Float[ndarray, "node 3"], frames: Iterable[int]
) -> dict[str, float | None]:
    """Score a prediction that nothing is ever touched, where the true contact is known.

    Without it a method that fails where contact is hard would be averaged over what is easy.

    Args:
        recording: The recording; without true contact there is no figure.
        node: Object nodes of frame 0 [m].
        frames: Frames to score; frame 0 is left out.
    """
    labels = true_labels(read_truth(recording.folder), node)
    chosen = [frame for frame in frames if frame > 0]
    if labels is None or not chosen:
        return {}
    in_frames = ContactLabels(
        is_contact=labels.is_contact[chosen], is_known=labels.is_known[chosen]
    )
    nothing = np.zeros_like(in_frames.is_contact)
    scores: dict[str, float | None] = {}
    for threshold in THRESHOLDS:
        scores |= contact_scores(nothing, in_frames, threshold)
    return {metric: scores.get(metric.removeprefix("contact_")) for metric in CONTACT_METRICS}


def _frames(recording: Sequence, protocol: str, split: str) -> range:
    if protocol == "unseen":
        return range(recording.frame_count)
    is_fitted = split == "reconstruction"
    return recording.reconstruction_frames if is_fitted else recording.future_frames


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
