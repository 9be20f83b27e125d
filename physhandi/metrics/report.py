"""How well a run did: one table per sequence, with the baselines beside it.

Each figure is a mean over frames of a mean over points. Frame 0 is given and is not scored.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from physhandi.data.atomic import read_array
from physhandi.data.sequence import Sequence
from physhandi.errors import RunError
from physhandi.metrics.geometry import (
    chamfer_one_way,
    chamfer_symmetric,
    dynamic_tracks,
    marker_error,
    nearest_node,
    reprojection_error,
    rigid_follow_baseline,
    static_baseline,
    track_error,
)

AGGREGATION = "mean over frames of the mean over points; frame 0 is not scored"
METRICS = (
    "chamfer_l1",
    "chamfer_l2",
    "chamfer_symmetric",
    "chamfer_dynamic_l1",
    "chamfer_dynamic_l2",
    "track_error",
    "marker_error",
)


@dataclass(frozen=True, eq=False, kw_only=True)
class Reference:
    """What a rollout is compared with; any part may be absent."""

    object_node: Float[ndarray, "node 3"]
    """Object nodes in frame 0 [m]."""
    point: Float[ndarray, "frame track 3"] | None = None
    """Observed tracks [m]; NaN where not visible."""
    is_visible: Bool[ndarray, "frame track"] | None = None
    """Whether a track is visible."""
    node_of_track: Int[ndarray, " track"] | None = None
    """Node that each track observes; None takes the one nearest in frame 0."""
    cloud: tuple[Float[ndarray, "_ 3"], ...] = ()
    """Observed points per frame [m]; none takes the visible tracks."""
    marker: Float[ndarray, "frame marker 3"] | None = None
    """Identified points [m]; NaN where not seen."""
    marker_node: Int[ndarray, " marker"] | None = None
    """Node that each marker observes."""
    controlled_markers: tuple[int, ...] = ()
    """Markers that are not scored because they move with the controls."""


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
        of ``rollout static rigid_follow`` the `METRICS` [m]; None where nothing can be measured.
        Also ``aggregation``, ``unit`` and ``substituted_frames``, the number of static stand-ins.
    """
    frame_count = max(reconstruction_frames.stop, future_frames.stop)
    static = np.asarray(static_baseline(reference.object_node.astype(np.float64), frame_count))
    complete, substituted = _complete(rollout, static)
    candidates = {"rollout": complete, "static": static}
    if control is not None and len(control) >= frame_count and control.shape[1] > 0:
        candidates["rigid_follow"] = rigid_follow_baseline(static[0], control[:frame_count])
    splits = {"reconstruction": reconstruction_frames, "future": future_frames}
    report: dict[str, Any] = {
        "aggregation": AGGREGATION,
        "unit": "m",
        "substituted_frames": substituted,
    }
    curves = {name: _curves(nodes, reference) for name, nodes in candidates.items()}
    for split, frames in splits.items():
        scored = [frame for frame in frames if frame > 0]
        if not scored:
            continue
        report[split] = {"frames": [scored[0], scored[-1] + 1]}
        for name, curve in curves.items():
            report[split][name] = {
                metric: _mean(curve[metric][scored]) if metric in curve else None
                for metric in METRICS
            }
    return report


def score_run(out: Path, sequence: Sequence) -> dict[str, Any]:
    """Measure what a run found for one sequence.

    Args:
        out: Output folder of the run.
        sequence: The sequence; gives the split, markers and cameras.

    Returns:
        The table of `score_rollout` if the sequence has an object, and ``hands`` with each hand's
        reprojection error [px] if keypoints were detected.

    Raises:
        RunError: If a file of the run is damaged.
    """
    folder = out / "sequences" / sequence.name
    report: dict[str, Any] = {}
    rollout = _read(folder / "rollout.npy")
    reference = _reference(folder, sequence, rollout)
    if reference is not None:
        report |= score_rollout(
            rollout,
            reference,
            control=_read(folder / "control.npy"),
            reconstruction_frames=sequence.reconstruction_frames,
            future_frames=sequence.future_frames,
        )
    hands = _score_hands(folder, sequence)
    if hands:
        report["hands"] = hands
    return report


def _complete(rollout: ndarray | None, static: ndarray) -> tuple[ndarray, int]:
    """Fill what a rollout lacks with the static object; return the number of filled frames."""
    complete = static.copy()
    if rollout is None or rollout.shape[1:] != static.shape[1:]:
        return complete, len(static)
    count = min(len(rollout), len(static))
    is_usable = np.isfinite(rollout[:count]).all(axis=(1, 2))
    complete[:count][is_usable] = rollout[:count][is_usable]
    return complete, len(static) - int(is_usable.sum())


def _curves(nodes: ndarray, reference: Reference) -> dict[str, Float[ndarray, " frame"]]:
    """Measure every frame by every metric that the reference allows."""
    curves: dict[str, ndarray] = {}
    point, is_visible = reference.point, reference.is_visible
    frames = range(len(nodes))
    if point is not None and is_visible is not None and point.shape[1]:
        point, is_visible = point[: len(nodes)].astype(np.float64), is_visible[: len(nodes)]
        node_of_track = reference.node_of_track
        if node_of_track is None:
            first = np.take_along_axis(point, is_visible.argmax(axis=0)[None, :, None], axis=0)
            node_of_track = nearest_node(np.nan_to_num(first[0]), nodes[0])
        curves["track_error"] = track_error(point, is_visible, nodes, node_of_track)
        is_dynamic = dynamic_tracks(point, is_visible)
        moving = [point[f, is_visible[f] & is_dynamic] for f in frames]
        curves["chamfer_dynamic_l1"] = _each(moving, nodes, "l1")
        curves["chamfer_dynamic_l2"] = _each(moving, nodes, "l2")
    observed = _observed(reference, len(nodes))
    if observed:
        curves["chamfer_l1"] = _each(observed, nodes, "l1")
        curves["chamfer_l2"] = _each(observed, nodes, "l2")
        pairs = zip(observed, nodes, strict=True)
        curves["chamfer_symmetric"] = np.array(
            [chamfer_symmetric(o, n) if len(o) else np.nan for o, n in pairs]
        )
    if reference.marker is not None and reference.marker_node is not None:
        marker = reference.marker[: len(nodes)].astype(np.float64)
        free = [m for m in range(marker.shape[1]) if m not in reference.controlled_markers]
        curves["marker_error"] = marker_error(marker, nodes, reference.marker_node, np.array(free))
    return curves


def _observed(reference: Reference, frame_count: int) -> list[ndarray]:
    if len(reference.cloud) >= frame_count:
        return [cloud.astype(np.float64) for cloud in reference.cloud[:frame_count]]
    if reference.point is None or reference.is_visible is None:
        return []
    return [
        reference.point[f, reference.is_visible[f]].astype(np.float64) for f in range(frame_count)
    ]


def _each(observed: list[ndarray], nodes: ndarray, norm: Any) -> Float[ndarray, " frame"]:
    return np.array([chamfer_one_way(o, nodes[frame], norm) for frame, o in enumerate(observed)])


def _mean(value: ndarray) -> float | None:
    known = value[np.isfinite(value)]
    return float(known.mean()) if len(known) else None


def _reference(folder: Path, sequence: Sequence, rollout: ndarray | None) -> Reference | None:
    """Collect what a run and its sequence know; None if there is no object to score."""
    point = _read(folder / "observation" / "point.npy")
    is_visible = _read(folder / "observation" / "is_visible.npy")
    node_of_track = _read(folder / "observation" / "node_of_track.npy")
    node = _read(folder / "object_node.npy")
    if node is None:
        node = sequence.object_node if rollout is None else rollout[0]
    if node is None or (point is None and sequence.marker is None):
        return None
    if sequence.marker is not None and point is not None and is_visible is not None:
        free = [m for m in range(point.shape[1]) if m not in sequence.controlled_markers]
        point, is_visible = point[:, free], is_visible[:, free]
        node_of_track = None if node_of_track is None else node_of_track[free]
    cloud, cloud_end = (
        _read(folder / "observation" / name) for name in ("cloud.npy", "cloud_end.npy")
    )
    return Reference(
        object_node=node,
        point=point,
        is_visible=is_visible,
        node_of_track=node_of_track,
        cloud=() if cloud is None or cloud_end is None else tuple(np.split(cloud, cloud_end[:-1])),
        marker=sequence.marker,
        marker_node=sequence.marker_node,
        controlled_markers=sequence.controlled_markers,
    )


def _score_hands(folder: Path, sequence: Sequence) -> dict[str, Any]:
    """Compare the joints of each hand with the detected keypoints of all views."""
    detected = _read(folder / "keypoint.npy")
    scores: dict[str, Any] = {}
    for hand, side in enumerate(sequence.hands):
        joint = _read(folder / f"hand_{side}_keypoint.npy")
        if joint is None or detected is None:
            continue
        error = np.stack(
            [
                reprojection_error(view.camera.project(joint.astype(np.float64)), keypoint[:, hand])
                for view, keypoint in zip(sequence.views, detected, strict=True)
            ]
        )
        known = error[np.isfinite(error)]
        scores[side] = {
            "reprojection_median": float(np.median(known)) if len(known) else None,
            "reprojection_mean": float(known.mean()) if len(known) else None,
            "unit": "px",
            "scored_views_and_frames": len(known),
        }
    return scores


def _read(path: Path) -> Any:
    if not path.is_file():
        return None
    try:
        return read_array(path)
    except (ValueError, OSError) as error:
        raise RunError(f"{path} is not a readable array: {error}.") from error
