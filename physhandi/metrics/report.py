"""How well a run did: one table per sequence, with the baselines beside it.

Definitions, units and the paper's columns are in docs/metrics.md.
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from physhandi.data.sequence import Sequence
from physhandi.metrics.baselines import rigid_follow_baseline, static_baseline
from physhandi.metrics.contact import (
    THRESHOLDS,
    ContactLabels,
    ContactReference,
    contact_scores,
    predicted_contacts,
)
from physhandi.metrics.report_curves import CURVES, Curves, error_curves
from physhandi.metrics.report_hands import StoredPoints, score_hands
from physhandi.metrics.report_inputs import Reference, read, read_reference, read_topology

AGGREGATION = (
    "mean over frames of the mean over points; frame 0 is not scored; "
    "contact F1 over all nodes and frames"
)
_BY_PROXIMITY = "proximity_"
CONTACT_METRICS = tuple(
    f"contact_{kind}_{labels}{threshold}"
    for labels in ("", _BY_PROXIMITY)
    for threshold in THRESHOLDS
    for kind in ("accuracy", "f1")
)
METRICS = (*CURVES, *CONTACT_METRICS)
"""What every method is scored by: distances [m], then shares from 0 to 1."""
_DIGITS = 7

Motions = dict[str, Float[ndarray, "frame node 3"]]


def score_rollout(
    rollout: Float[ndarray, "frame node 3"] | None,
    reference: Reference,
    *,
    control: Float[ndarray, "frame control 3"] | None = None,
    reconstruction_frames: range,
    future_frames: range = range(0),
) -> dict[str, Any]:
    """Compare a rollout and the baselines with what was observed.

    Args:
        rollout: Simulated nodes [m]. Where it is missing or not finite, the object counts as
            static; nothing is dropped.
        reference: What was observed.
        control: Control nodes, for the rigid-follow baseline [m].
        reconstruction_frames: Frames that were fitted.
        future_frames: Frames that were held out.

    Returns:
        For ``reconstruction`` and (if there are such frames) ``future``: the frames, and for each
        of ``rollout static rigid_follow`` the `METRICS`; None where nothing can be measured.
        ``contact`` has the details of contact for the rollout, if contact can be judged. Also
        ``aggregation``, ``unit`` and ``substituted_frames``, the number of static stand-ins.
    """
    frame_count = max(reconstruction_frames.stop, future_frames.stop)
    motions, substituted = _motions(rollout, reference, control, frame_count)
    curves = {name: error_curves(nodes, reference) for name, nodes in motions.items()}
    splits = {"reconstruction": reconstruction_frames, "future": future_frames}
    return _tabulated(motions, curves, substituted, reference, splits)


def measure_run(
    out: Path,
    sequence: Sequence,
    *,
    hand_points: StoredPoints | None = None,
    with_baselines: bool = True,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Give what `score_run` and `frame_errors` give, measured once.

    Args:
        out: Output folder of the run.
        sequence: The sequence.
        hand_points: As for `score_run`.
        with_baselines: Whether to measure the static and the rigid baseline too, which takes twice
            as long as the rollout alone.

    Raises:
        RunError: If a file of the run is damaged.
    """
    folder = out / "sequences" / sequence.name
    rollout = read(folder / "rollout.npy")
    reference = read_reference(folder, sequence, rollout)
    report: dict[str, Any] = {}
    frames: dict[str, Any] = {"unit": "m", "frames": list(range(sequence.frame_count))}
    if reference is not None:
        splits = {
            "reconstruction": sequence.reconstruction_frames,
            "future": sequence.future_frames,
        }
        motions, substituted = _motions(
            rollout, reference, read(folder / "control.npy"), sequence.frame_count
        )
        if not with_baselines:
            motions = {"rollout": motions["rollout"]}
        curves = {name: error_curves(nodes, reference) for name, nodes in motions.items()}
        report |= _tabulated(motions, curves, substituted, reference, splits)
        frames |= {name: _plain(of_method) for name, of_method in curves.items()}
        topology = read_topology(out, reference.object_node)
        if topology is not None:
            report["topology"] = topology
    hands, hand_curves = score_hands(folder, sequence, hand_points)
    if hands:
        report["hands"] = hands
    if hand_curves:
        frames["hands"] = {side: _plain(of_hand) for side, of_hand in hand_curves.items()}
    return report, frames


def score_run(
    out: Path, sequence: Sequence, *, hand_points: StoredPoints | None = None
) -> dict[str, Any]:
    """Measure what a run found for one sequence.

    Args:
        out: Output folder of the run.
        sequence: The sequence; gives the split, markers, cameras and the truth.
        hand_points: What the views measured on the hands, for a run that does not hold it.

    Returns:
        The table of `score_rollout` if the sequence has an object, with ``topology`` if one was
        fitted; and ``hands`` with each hand's figures if there is anything to compare it with.

    Raises:
        RunError: If a file of the run is damaged.
    """
    return measure_run(out, sequence, hand_points=hand_points)[0]


def frame_errors(out: Path, sequence: Sequence) -> dict[str, Any]:
    """Give the error of every frame of a run, for charts.

    Args:
        out: Output folder of the run.
        sequence: The sequence.

    Returns:
        ``unit`` (m), ``frames`` (all of them, frame 0 included), for each of ``rollout static
        rigid_follow`` a list a metric, and the same for each hand in ``hands``; None where a frame
        cannot be measured. Metrics that cannot be measured in any frame are left out.

    Raises:
        RunError: If a file of the run is damaged.
    """
    return measure_run(out, sequence)[1]


def _motions(
    rollout: ndarray | None, reference: Reference, control: ndarray | None, frame_count: int
) -> tuple[Motions, int]:
    """Put the rollout, completed, beside the baselines; return also the number of stand-ins."""
    static = np.asarray(static_baseline(reference.object_node.astype(np.float64), frame_count))
    complete, substituted = _complete(rollout, static)
    motions = {"rollout": complete, "static": static}
    if control is not None and len(control) >= frame_count and control.shape[1] > 0:
        motions["rigid_follow"] = rigid_follow_baseline(static[0], control[:frame_count])
    return motions, substituted


def _tabulated(
    motions: Motions,
    curves: dict[str, Curves],
    substituted: int,
    reference: Reference,
    splits: dict[str, range],
) -> dict[str, Any]:
    report: dict[str, Any] = {
        "aggregation": AGGREGATION,
        "unit": "m",
        "substituted_frames": substituted,
    }
    contact = reference.contact
    contacts = {name: _predicted(contact, nodes) for name, nodes in motions.items()}
    detail: dict[str, Any] = {}
    if contact is not None:
        detail = {"labels": contact.kind, "frame_0": _judged(contact, contacts["rollout"], [0])}
    for split, frames in splits.items():
        scored = [frame for frame in frames if frame > 0]
        if not scored:
            continue
        report[split] = {"frames": [scored[0], scored[-1] + 1]}
        for name, of_method in curves.items():
            judged = _judged(contact, contacts[name], scored)
            if name == "rollout" and judged:
                detail[split] = judged
            report[split][name] = {
                metric: _mean(of_method[metric][scored]) if metric in of_method else None
                for metric in CURVES
            } | {metric: judged.get(metric.removeprefix("contact_")) for metric in CONTACT_METRICS}
    if detail:
        report["contact"] = detail
    return report


def _predicted(
    contact: ContactReference | None, nodes: Float[ndarray, "frame node 3"]
) -> dict[str, Bool[ndarray, "frame node"]]:
    if contact is None:
        return {}
    return {name: predicted_contacts(contact, nodes, value) for name, value in THRESHOLDS.items()}


def _judged(
    contact: ContactReference | None, predicted: dict[str, ndarray], frames: list[int]
) -> dict[str, float | None]:
    """Score contacts in some frames, by every threshold and all labels that there are."""
    scores: dict[str, float | None] = {}
    if contact is None:
        return scores
    for prefix, all_labels in (("", contact.labels), (_BY_PROXIMITY, contact.true_proximity)):
        for name, labels in all_labels.items():
            chosen = ContactLabels(
                is_contact=labels.is_contact[frames], is_known=labels.is_known[frames]
            )
            scores |= contact_scores(predicted[name][frames], chosen, prefix + name)
    return scores


def _complete(rollout: ndarray | None, static: ndarray) -> tuple[ndarray, int]:
    """Fill what a rollout lacks with the static object; return the number of filled frames."""
    complete = static.copy()
    if rollout is None or rollout.shape[1:] != static.shape[1:]:
        return complete, len(static)
    count = min(len(rollout), len(static))
    is_usable = np.isfinite(rollout[:count]).all(axis=(1, 2))
    complete[:count][is_usable] = rollout[:count][is_usable]
    return complete, len(static) - int(is_usable.sum())


def _mean(value: ndarray) -> float | None:
    known = value[np.isfinite(value)]
    return float(known.mean()) if len(known) else None


def _plain(curves: Curves) -> dict[str, list[float | None]]:
    return {
        name: [round(float(v), _DIGITS) if np.isfinite(v) else None for v in curve]
        for name, curve in curves.items()
        if np.isfinite(curve).any()
    }
