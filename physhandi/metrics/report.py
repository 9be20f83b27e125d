"""Scores a run: one table per sequence, with the baselines beside it.

`measure_run` reads a run and its sequence; `score_rollout` and `score_hands` do the measuring.
Definitions, units and the paper's columns are in docs/metrics.md.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.spatial import KDTree

from physhandi.data.arrays import read_array, read_tensors
from physhandi.data.layout import PARAMETERS_FILE, REST_NODE_FILE, SequenceFiles
from physhandi.data.sequence import Sequence
from physhandi.data.truth import read_truth
from physhandi.errors import RunError
from physhandi.metrics.alignment import carried_points
from physhandi.metrics.baselines import (
    last_residual_baseline,
    rigid_follow_baseline,
    static_baseline,
)
from physhandi.metrics.contact import (
    THRESHOLDS,
    ContactLabels,
    ContactReference,
    contact_scores,
    hand_distance,
    joined_nodes,
    predicted_contacts,
    proximity_labels,
    true_labels,
    true_proximity_labels,
)
from physhandi.metrics.geometry import (
    Norm,
    chamfer_one_way,
    chamfer_symmetric,
    dynamic_nodes,
    dynamic_tracks,
    marker_error,
    track_error,
    track_error_phystwin,
)
from physhandi.metrics.hands import (
    evaluate_hands,
    hand_chamfer,
    held_where_missing,
    joint_errors,
    vertex_errors,
)
from physhandi.metrics.topology import radius_deviation, resolution
from physhandi.metrics.truth_metrics import TrueSurface, true_surface, truth_curves

CURVES = (
    "chamfer_phystwin",
    "chamfer_l1",
    "chamfer_l2",
    "chamfer_symmetric",
    "chamfer_dynamic_l1",
    "chamfer_dynamic_l2",
    "chamfer_dynamic_symmetric",
    "chamfer_truth",
    "chamfer_truth_to_nodes",
    "chamfer_nodes_to_truth",
    "track_error_phystwin",
    "track_error",
    "marker_error",
)
"""Metrics that have a value [m] for every frame."""
Curves = dict[str, Float[ndarray, " frame"]]
"""Values of every frame by metric; NaN where a frame cannot be measured."""
HAND_AGGREGATION = (
    "reprojection [px] over all seen keypoints of all views and frames; "
    "distances as mean over frames, frame 0 included"
)
StoredPoints = tuple[Float[ndarray, "point 3"], Int[ndarray, "hand frame"]]
"""Points of all hands and frames one after the other [m], and where those of each frame end."""
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
"""Metrics of every method: distances [m], then shares from 0 to 1."""
_DIGITS = 7
"""Decimal places of stored frame errors."""
Motions = dict[str, Float[ndarray, "frame node 3"]]
"""Nodes of the rollout and of each baseline by method [m]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ScoringReference:
    """Observations and truth that a rollout is compared with; any part may be absent."""

    object_node: Float[ndarray, "node 3"]
    """Object nodes in frame 0 [m]."""
    surface_count: int | None = None
    """Leading nodes that lie on the surface, which alone enter Chamfer distances; None: all."""
    point: Float[ndarray, "frame track 3"] | None = None
    """Observed tracks [m]; NaN where not visible."""
    is_visible: Bool[ndarray, "frame track"] | None = None
    """Whether a track is visible."""
    node_of_track: Int[ndarray, " track"] | None = None
    """Node that each track observes; None lets the nodes around it carry it."""
    validation: Float[ndarray, "frame validation 3"] | None = None
    """Annotated points that no fit saw [m]; NaN where not annotated. They replace the tracks where
    tracks are scored."""
    cloud: tuple[Float[ndarray, "_ 3"], ...] = ()
    """Observed points per frame [m]; if empty, the visible tracks take their place."""
    marker: Float[ndarray, "frame marker 3"] | None = None
    """Identified points [m]; NaN where not seen."""
    marker_node: Int[ndarray, " marker"] | None = None
    """Node that each marker observes."""
    controlled_markers: tuple[int, ...] = ()
    """Markers that are not scored because they move with the controls."""
    true_surface: TrueSurface | None = None
    """The object's true surface."""
    contact: ContactReference | None = None
    """Labels that contacts are scored against."""


def measure_run(
    out: Path,
    sequence: Sequence,
    *,
    hand_points: StoredPoints | None = None,
    with_baselines: bool = True,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Measure once and return the results of `score_run` and `frame_errors`.

    Args:
        out: Output folder of the run.
        sequence: The sequence.
        hand_points: As for `score_run`.
        with_baselines: Whether to measure the static and the rigid baseline too, which takes twice
            as long as the rollout alone.

    Raises:
        RunError: If a file of the run is damaged.
    """
    files = SequenceFiles(sequence.name)
    rollout = read_scoring_inputs(out / files.rollout)
    reference = read_reference(out, sequence, rollout)
    report: dict[str, Any] = {}
    unit = _unit_of(sequence)
    frames: dict[str, Any] = {"unit": unit, "frames": list(range(sequence.frame_count))}
    if reference is not None:
        splits = {
            "reconstruction": sequence.reconstruction_frames,
            "future": sequence.future_frames,
        }
        motions, substituted = _motions(
            rollout, reference, read_scoring_inputs(out / files.control), sequence.frame_count
        )
        if not with_baselines:
            motions = {"rollout": motions["rollout"]}
        curves = _curves_of(motions, reference)
        report |= _tabulated(motions, curves, substituted, reference, splits) | {"unit": unit}
        if with_baselines and "future" in report:
            report["future"] |= _last_residual(
                motions["rollout"],
                reference,
                sequence.future_frames,
                _restart_position(out / files.restart),
            )
        frames |= {name: _plain(of_method) for name, of_method in curves.items()}
        topology = read_topology(out, reference.object_node)
        if topology is not None:
            report["topology"] = topology
    hands, hand_curves = score_hands(out, sequence, hand_points)
    if hands:
        report["hands"] = hands
    if hand_curves:
        frames["hands"] = {side: _plain(of_hand) for side, of_hand in hand_curves.items()}
    return report, frames


def score_run(
    out: Path, sequence: Sequence, *, hand_points: StoredPoints | None = None
) -> dict[str, Any]:
    """Score a run's result for one sequence.

    Args:
        out: Output folder of the run.
        sequence: The sequence; gives the split, markers, cameras and the truth.
        hand_points: Measured points of the hands; None reads those stored in the run.

    Returns:
        The table of `score_rollout` if the sequence has an object, with ``topology`` if one was
        fitted and the track errors of ``last_residual`` in the ``future``; and ``hands`` with each
        hand's figures if there is anything to compare it with.

    Raises:
        RunError: If a file of the run is damaged.
    """
    return measure_run(out, sequence, hand_points=hand_points)[0]


def frame_errors(out: Path, sequence: Sequence) -> dict[str, Any]:
    """Compute the error of every frame of a run, for charts.

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


def score_rollout(
    rollout: Float[ndarray, "frame node 3"] | None,
    reference: ScoringReference,
    *,
    control: Float[ndarray, "frame control 3"] | None = None,
    reconstruction_frames: range,
    future_frames: range = range(0),
) -> dict[str, Any]:
    """Compare a rollout and the baselines with the observations.

    Args:
        rollout: Simulated nodes [m]. Where it is missing or not finite, the object counts as
            static; nothing is dropped.
        reference: Observations.
        control: Control nodes, for the rigid-follow baseline [m].
        reconstruction_frames: Frames that were fitted.
        future_frames: Frames that were held out.

    Returns:
        For ``reconstruction`` and (if there are such frames) ``future``: the frames, and for each
        of ``rollout static rigid_follow`` the `METRICS`; None where nothing can be measured.
        ``contact`` has the details of contact for the rollout, if contact can be scored. Also
        ``aggregation``, ``unit`` and ``substituted_frames``, the number of static stand-ins.
    """
    frame_count = max(reconstruction_frames.stop, future_frames.stop)
    motions, substituted = _motions(rollout, reference, control, frame_count)
    curves = _curves_of(motions, reference)
    splits = {"reconstruction": reconstruction_frames, "future": future_frames}
    return _tabulated(motions, curves, substituted, reference, splits)


def _motions(
    rollout: ndarray | None, reference: ScoringReference, control: ndarray | None, frame_count: int
) -> tuple[Motions, int]:
    """Collect the completed rollout and the baselines, and count the substituted frames."""
    static = np.asarray(static_baseline(reference.object_node.astype(np.float64), frame_count))
    complete, substituted = _complete(rollout, static)
    motions = {"rollout": complete, "static": static}
    if control is not None and len(control) >= frame_count and control.shape[1] > 0:
        motions["rigid_follow"] = rigid_follow_baseline(static[0], control[:frame_count])
    return motions, substituted


def _complete(rollout: ndarray | None, static: ndarray) -> tuple[ndarray, int]:
    """Replace missing and non-finite frames by the static object, and count them."""
    complete = static.copy()
    if rollout is None or rollout.shape[1:] != static.shape[1:]:
        return complete, len(static)
    count = min(len(rollout), len(static))
    is_usable = np.isfinite(rollout[:count]).all(axis=(1, 2))
    complete[:count][is_usable] = rollout[:count][is_usable]
    return complete, len(static) - int(is_usable.sum())


def _tabulated(
    motions: Motions,
    curves: dict[str, Curves],
    substituted: int,
    reference: ScoringReference,
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


def _last_residual(
    rollout: Float[ndarray, "frame node 3"],
    reference: ScoringReference,
    future_frames: range,
    continued_from: Float[ndarray, "node 3"] | None,
) -> dict[str, Any]:
    """Measure the tracks of a prediction that is shifted by the last fitted frame's residual.

    Args:
        rollout: Simulated nodes [m].
        reference: Observations.
        future_frames: Frames that were held out.
        continued_from: State of the last fitted frame from which they were simulated, if it is not
            the rollout's own [m].

    Returns:
        The measures under ``last_residual``; nothing where no track tells a residual.
    """
    if reference.point is None or reference.is_visible is None:
        return {}
    try:
        shifted = last_residual_baseline(
            rollout,
            reference.point.astype(np.float64),
            reference.is_visible,
            future_frames.start,
            reference.node_of_track,
            continued_from=continued_from,
        )
    except ValueError:
        return {}
    curves = _track_curves(shifted, reference)
    scored = list(future_frames)
    return {"last_residual": {name: _mean(curve[scored]) for name, curve in curves.items()}}


def _restart_position(path: Path) -> Float[ndarray, "node 3"] | None:
    """Read the state from which a prediction began; None if it began from the rollout's own."""
    if not path.is_file():
        return None
    try:
        return read_tensors(path)["position"]
    except Exception as error:  # safetensors has no common class of errors
        raise RunError(f"{path} is not a readable state: {error}.") from error


def _predicted(
    contact: ContactReference | None, nodes: Float[ndarray, "frame node 3"]
) -> dict[str, Bool[ndarray, "frame node"]]:
    if contact is None:
        return {}
    distance = hand_distance(nodes, contact.hand[: len(nodes)])
    return {name: predicted_contacts(contact, distance, t) for name, t in THRESHOLDS.items()}


def _judged(
    contact: ContactReference | None, predicted: dict[str, ndarray], frames: list[int]
) -> dict[str, float | None]:
    """Score contacts in the given frames, by every threshold and all available labels."""
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


def _curves_of(motions: Motions, reference: ScoringReference) -> dict[str, Curves]:
    """Measure motions beside each other: searches for nearest points use a processor each."""
    with ThreadPoolExecutor(len(motions), thread_name_prefix="physhandi-metrics") as pool:
        curves = pool.map(partial(error_curves, reference=reference), motions.values())
        return dict(zip(motions, curves, strict=True))


def error_curves(nodes: Float[ndarray, "frame node 3"], reference: ScoringReference) -> Curves:
    """Measure every frame by every metric that the reference allows [m]; NaN where it cannot.

    Args:
        nodes: Simulated nodes, finite in every frame [m].
        reference: Observations, and the true surface if it is known.
    """
    surface = nodes[:, : reference.surface_count]
    trees = [KDTree(frame) for frame in surface]
    curves = _shape_curves(surface, trees, reference) | _track_curves(nodes, reference)
    if reference.point is not None and reference.is_visible is not None:
        point = reference.point[: len(nodes)].astype(np.float64)
        if point.shape[1]:
            is_visible = reference.is_visible[: len(nodes)]
            curves |= _dynamic_curves(surface, trees, point, is_visible)
    if reference.true_surface is not None:
        curves |= truth_curves(surface, reference.true_surface)
    if reference.marker is not None and reference.marker_node is not None:
        marker = reference.marker[: len(nodes)].astype(np.float64)
        free = [m for m in range(marker.shape[1]) if m not in reference.controlled_markers]
        curves["marker_error"] = marker_error(
            marker, nodes, reference.marker_node, np.array(free, dtype=np.int64)
        )
    return curves


def _shape_curves(
    surface: Float[ndarray, "frame node 3"], trees: list[KDTree], reference: ScoringReference
) -> Curves:
    """CD_full: PhysTwin's, over visible tracks, and ours, over the fused cloud."""
    curves: Curves = {}
    tracks = _visible_tracks(reference, len(surface))
    if tracks:
        curves["chamfer_phystwin"] = _each(tracks, trees, "l1")
    observed = tracks
    if len(reference.cloud) >= len(surface):
        observed = [cloud.astype(np.float64) for cloud in reference.cloud[: len(surface)]]
    if observed:
        curves["chamfer_l1"] = _each(observed, trees, "l1")
        curves["chamfer_l2"] = _each(observed, trees, "l2")
        curves["chamfer_symmetric"] = 0.5 * (curves["chamfer_l2"] + _back(surface, observed))
    return curves


def _dynamic_curves(
    surface: Float[ndarray, "frame node 3"],
    trees: list[KDTree],
    point: Float[ndarray, "frame track 3"],
    is_visible: Bool[ndarray, "frame track"],
) -> Curves:
    """CD_dyn: only tracks that move in any frame, and for the way back only nodes beside them."""
    is_dynamic = dynamic_tracks(point, is_visible)
    moving = [point[f, is_visible[f] & is_dynamic] for f in range(len(surface))]
    start = np.where(is_visible[0][:, None], point[0], np.nan)
    beside = surface[:, dynamic_nodes(surface[0], start, is_dynamic)]
    return {
        "chamfer_dynamic_l1": _each(moving, trees, "l1"),
        "chamfer_dynamic_l2": _each(moving, trees, "l2"),
        "chamfer_dynamic_symmetric": np.array(
            [chamfer_symmetric(o, n) for o, n in zip(moving, beside, strict=True)]
        ),
    }


def _track_curves(nodes: Float[ndarray, "frame node 3"], reference: ScoringReference) -> Curves:
    """Track: of annotated points where there are any, else of the observed tracks."""
    point, is_visible, node_of_track = (
        reference.point,
        reference.is_visible,
        reference.node_of_track,
    )
    if reference.validation is not None:
        point, node_of_track = reference.validation, None
        is_visible = np.asarray(np.isfinite(point).all(axis=2))
    if point is None or is_visible is None or not point.shape[1]:
        return {}
    point, is_visible = point[: len(nodes)].astype(np.float64), is_visible[: len(nodes)]
    curves = {"track_error_phystwin": track_error_phystwin(point, is_visible, nodes)}
    if node_of_track is not None:
        curves["track_error"] = track_error(point, is_visible, nodes[:, node_of_track])
    else:  # A track that frame 0 does not show has no known place on the object.
        shown = np.flatnonzero(is_visible[0])
        carried = carried_points(point[0, shown], nodes)
        curves["track_error"] = track_error(point[:, shown], is_visible[:, shown], carried)
    return curves


def _visible_tracks(reference: ScoringReference, frame_count: int) -> list[Float[ndarray, "_ 3"]]:
    if reference.point is None or reference.is_visible is None or not reference.point.shape[1]:
        return []
    return [
        reference.point[f, reference.is_visible[f]].astype(np.float64) for f in range(frame_count)
    ]


def _each(
    observed: list[Float[ndarray, "_ 3"]], trees: list[KDTree], norm: Norm
) -> Float[ndarray, " frame"]:
    """From what was observed to the nodes of each frame; NaN where nothing was."""
    return np.array(
        [chamfer_one_way(o, tree, norm) for o, tree in zip(observed, trees, strict=True)]
    )


def _back(
    surface: Float[ndarray, "frame node 3"], observed: list[Float[ndarray, "_ 3"]]
) -> Float[ndarray, " frame"]:
    """From the nodes to what was observed of each frame; NaN where nothing was."""
    pairs = zip(surface, observed, strict=True)
    return np.array([chamfer_one_way(n, o) if len(o) else np.nan for n, o in pairs])


def _unit_of(sequence: Sequence) -> str:
    """Name the unit of all distances."""
    return "m" if sequence.metric else sequence.length_unit


def score_hands(
    out: Path, sequence: Sequence, hand_points: StoredPoints | None = None
) -> tuple[dict[str, Any], dict[str, Curves]]:
    """Compare each hand with detected keypoints, measured points and the truth.

    Args:
        out: Output folder of the run.
        sequence: The sequence, with its cameras and, if known, the truth.
        hand_points: Measured points of the hands; None reads those stored in the run.

    Returns:
        For each hand its figures, and the same distances [m] frame by frame. A hand that has a
        truth but no fit is listed with an unknown error.

    Raises:
        RunError: If a file of the run is damaged.
    """
    truth = read_truth(sequence.folder)
    files = SequenceFiles(sequence.name)
    detected = read_scoring_inputs(out / files.keypoint)
    stored = (out / files.observation(part) for part in ("hand_point", "hand_point_end"))
    points = read_split(*stored)
    if hand_points is not None:
        points = np.split(hand_points[0], hand_points[1].reshape(-1)[:-1])
    scores: dict[str, Any] = {}
    curves: dict[str, Curves] = {}
    for hand, side in enumerate(sequence.hands):
        joint = read_scoring_inputs(out / files.hand_keypoint(side))
        vertex = read_scoring_inputs(out / files.hand_vertex(side))
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
            "unit": _unit_of(sequence),
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


def read_reference(
    out: Path, sequence: Sequence, rollout: Float[ndarray, "frame node 3"] | None
) -> ScoringReference | None:
    """Collect observations and truth from a run and its sequence; None without an object to score.

    Args:
        out: Output folder of the run.
        sequence: The sequence.
        rollout: Simulated nodes of the run [m].

    Raises:
        RunError: If a file of the run is damaged.
        SequenceError: If the sequence's true surface is invalid.
    """
    files = SequenceFiles(sequence.name)
    point = read_scoring_inputs(out / files.observation("point"))
    is_visible = read_scoring_inputs(out / files.observation("is_visible"))
    node_of_track = read_scoring_inputs(out / files.observation("node_of_track"))
    node = read_scoring_inputs(out / files.object_node)
    if node is None:
        node = sequence.object_node if rollout is None else rollout[0]
    if node is None or (point is None and sequence.marker is None):
        return None
    if sequence.marker is not None and point is not None and is_visible is not None:
        free = [m for m in range(point.shape[1]) if m not in sequence.controlled_markers]
        point, is_visible = point[:, free], is_visible[:, free]
        node_of_track = None if node_of_track is None else node_of_track[free]
    clouds = read_split(*(out / files.observation(part) for part in ("cloud", "cloud_end")))
    return ScoringReference(
        object_node=node,
        surface_count=sequence.surface_node_count,
        point=point,
        is_visible=is_visible,
        node_of_track=node_of_track,
        validation=sequence.validation_track,
        cloud=tuple(clouds or ()),
        marker=sequence.marker,
        marker_node=sequence.marker_node,
        controlled_markers=sequence.controlled_markers,
        true_surface=true_surface(read_truth(sequence.folder)),
        contact=_contact(out, sequence, node, point, is_visible),
    )


def read_topology(out: Path, object_node: Float[ndarray, "node 3"]) -> dict[str, Any] | None:
    """Relate the fitted connection radii to the resolution; None if there is no fitted object.

    Args:
        out: Output folder of the run; the resolution is that of its rest shape.
        object_node: Nodes to use if the run stores no rest shape [m].

    Raises:
        RunError: If a file of the run is damaged.
    """
    path = out / PARAMETERS_FILE
    node = read_scoring_inputs(out / REST_NODE_FILE)
    node = object_node if node is None else node
    if not path.is_file() or len(node) < 2:
        return None
    try:
        parameters = yaml.safe_load(path.read_text(encoding="utf-8"))
        radius, virtual = (
            float(parameters[name]) for name in ("connection_radius", "virtual_connection_radius")
        )
    except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError) as error:
        raise RunError(f"{path} does not tell the connection radii: {error}.") from error
    spacing = resolution(node.astype(np.float64))
    return {
        "resolution": spacing,
        "connection_radius": radius,
        "virtual_connection_radius": virtual,
        "rrd_object": radius_deviation(radius, spacing),
        "rrd_virtual": radius_deviation(virtual, spacing),
    }


def read_scoring_inputs(path: Path) -> Any:
    """Read an array of a run; None if it is not there.

    Raises:
        RunError: If it is damaged.
    """
    if not path.is_file():
        return None
    try:
        return read_array(path)
    except (ValueError, OSError) as error:
        raise RunError(f"{path} is not a readable array: {error}.") from error


def read_split(point: Path, end: Path) -> list[ndarray] | None:
    """Read concatenated point sets and the array of their ends; None if one is missing."""
    points, ends = read_scoring_inputs(point), read_scoring_inputs(end)
    return None if points is None or ends is None else np.split(points, ends.reshape(-1)[:-1])


def _contact(
    out: Path,
    sequence: Sequence,
    node: Float[ndarray, "node 3"],
    point: ndarray | None,
    is_visible: ndarray | None,
) -> ContactReference | None:
    """Prepare the contact labels; None without hands or without virtual springs."""
    files = SequenceFiles(sequence.name)
    vertices = [read_scoring_inputs(out / files.hand_vertex(side)) for side in sequence.hands]
    whole = [held_where_missing(vertex)[0] for vertex in vertices if vertex is not None]
    hands = [vertex for vertex in whole if vertex is not None]
    path = out / files.model
    if not hands or not path.is_file():
        return None
    try:
        tensors = read_tensors(path)
        virtual = tensors["spring_nodes"][int(tensors["object_spring_count"][0]) :]
    except Exception as error:  # safetensors has no common class of errors
        raise RunError(f"{path} is not a readable model: {error}.") from error
    hand = np.concatenate(hands, axis=1).astype(np.float64)
    start = node.astype(np.float64)
    recorded = read_truth(sequence.folder)
    truth = true_labels(recorded, start)
    if truth is not None:
        labels = dict.fromkeys(THRESHOLDS, truth)
    else:
        tracks = None if point is None else point.astype(np.float64)
        labels = proximity_labels(start, hand, tracks, is_visible)
    return ContactReference(
        hand=hand,
        is_joined=joined_nodes(virtual, len(node), tensors.get("attached"), len(hand)),
        kind="proximity" if truth is None else "true",
        labels=labels,
        true_proximity=true_proximity_labels(recorded, start, sequence.hands),
    )


def _mean(value: Float[ndarray, " frame"]) -> float | None:
    """Average the finite values; None if there are none."""
    finite = value[np.isfinite(value)]
    return float(finite.mean()) if len(finite) else None


def _plain(curves: Curves) -> dict[str, list[float | None]]:
    return {
        name: [round(float(v), _DIGITS) if np.isfinite(v) else None for v in curve]
        for name, curve in curves.items()
        if np.isfinite(curve).any()
    }
