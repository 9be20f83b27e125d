"""The hands' part of a report."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from physhandi.data.sequence import Sequence
from physhandi.data.truth import read_truth
from physhandi.metrics.hand_shape import (
    hand_chamfer,
    held_where_missing,
    joint_errors,
    vertex_errors,
)
from physhandi.metrics.hands import evaluate_hands
from physhandi.metrics.report_inputs import read, read_split

HAND_AGGREGATION = (
    "reprojection [px] over all seen keypoints of all views and frames; "
    "distances as mean over frames, frame 0 included"
)

Curves = dict[str, Float[ndarray, " frame"]]
StoredPoints = tuple[Float[ndarray, "point 3"], Int[ndarray, "hand frame"]]
"""Points of all hands and frames one after the other [m], and where those of each frame end."""


def score_hands(
    folder: Path, sequence: Sequence, given: StoredPoints | None = None
) -> tuple[dict[str, Any], dict[str, Curves]]:
    """Compare each hand with detected keypoints, measured points and the truth.

    Args:
        folder: The run's folder of this sequence.
        sequence: Gives cameras and, if it has it, the truth.
        given: What the views measured on the hands; None reads it from the run.

    Returns:
        For each hand its figures, and the same distances [m] frame by frame. A hand that has a
        truth but no fit is listed with an unknown error.

    Raises:
        RunError: If a file of the run is damaged.
    """
    truth = read_truth(sequence.folder)
    detected = read(folder / "keypoint.npy")
    points = read_split(folder / "observation", "hand_point")
    if given is not None:
        points = np.split(given[0], given[1].reshape(-1)[:-1])
    scores: dict[str, Any] = {}
    curves: dict[str, Curves] = {}
    for hand, side in enumerate(sequence.hands):
        joint = read(folder / f"hand_{side}_keypoint.npy")
        vertex = read(folder / f"hand_{side}_vertex.npy")
        true_joint, true_vertex = truth.hand_keypoint.get(side), truth.hand_vertex.get(side)
        score: dict[str, Any] = {}
        if joint is not None and detected is not None:
            score |= _reprojection(sequence, joint, detected[:, :, hand : hand + 1])
        joint, missing = (
            (None, sequence.frame_count) if joint is None else held_where_missing(joint)
        )
        vertex = None if vertex is None else held_where_missing(vertex)[0]
        errors = _truth_errors(joint, vertex, true_joint, true_vertex)
        if vertex is not None and points is not None:
            of_hand = points[hand * sequence.frame_count : (hand + 1) * sequence.frame_count]
            errors = hand_chamfer(vertex, tuple(of_hand)) | errors
        if true_joint is not None and joint is None:
            score["mpjpe"] = None
        if not score and not errors:
            continue
        score |= {name: _mean(curve) for name, curve in errors.items()}
        scores[side] = score | {
            "unit": "m",
            "aggregation": HAND_AGGREGATION,
            "substituted_frames": missing,
        }
        if errors:
            curves[side] = errors
    return scores, curves


def _reprojection(
    sequence: Sequence,
    joint: Float[ndarray, "frame 21 3"],
    detected: Float[ndarray, "view frame 1 21 3"],
) -> dict[str, Any]:
    cameras = [view.camera for view in sequence.views]
    (score,) = evaluate_hands(cameras, [joint], detected)
    return {
        "reprojection_median": score.fitted.median,
        "reprojection_mean": score.fitted.mean,
        "reprojection_p95": score.fitted.p95,
        "scored_keypoints": score.fitted.keypoint_count,
        "scored_frames": score.frame_count,
    }


def _truth_errors(
    joint: Float[ndarray, "frame 21 3"] | None,
    vertex: Float[ndarray, "frame vertex 3"] | None,
    true_joint: Float[ndarray, "frame 21 3"] | None,
    true_vertex: Float[ndarray, "frame true_vertex 3"] | None,
) -> Curves:
    errors: Curves = {}
    if joint is not None and true_joint is not None:
        errors |= joint_errors(joint, true_joint)
    if vertex is not None and true_vertex is not None:
        errors |= vertex_errors(vertex, true_vertex, joint, true_joint)
    return errors


def _mean(curve: Float[ndarray, " frame"]) -> float | None:
    known = curve[np.isfinite(curve)]
    return float(known.mean()) if len(known) else None
