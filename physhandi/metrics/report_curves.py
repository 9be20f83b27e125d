"""How far a rollout is from what was observed, frame by frame, by every metric."""

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from physhandi.metrics.alignment import carried_points
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
from physhandi.metrics.report_inputs import Reference
from physhandi.metrics.truth_metrics import truth_curves

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


def error_curves(nodes: Float[ndarray, "frame node 3"], reference: Reference) -> Curves:
    """Measure every frame by every metric that the reference allows [m]; NaN where it cannot.

    Args:
        nodes: Simulated nodes, finite in every frame [m].
        reference: What was observed, and the true surface if it is known.
    """
    surface = nodes[:, : reference.surface_count]
    curves = _shape_curves(surface, reference) | _track_curves(nodes, reference)
    if reference.point is not None and reference.is_visible is not None:
        point = reference.point[: len(nodes)].astype(np.float64)
        if point.shape[1]:
            curves |= _dynamic_curves(surface, point, reference.is_visible[: len(nodes)])
    if reference.true_surface is not None:
        curves |= truth_curves(surface, reference.true_surface)
    if reference.marker is not None and reference.marker_node is not None:
        marker = reference.marker[: len(nodes)].astype(np.float64)
        free = [m for m in range(marker.shape[1]) if m not in reference.controlled_markers]
        curves["marker_error"] = marker_error(
            marker, nodes, reference.marker_node, np.array(free, dtype=np.int64)
        )
    return curves


def _shape_curves(surface: Float[ndarray, "frame node 3"], reference: Reference) -> Curves:
    """CD_full: PhysTwin's, over visible tracks, and ours, over the fused cloud."""
    curves: Curves = {}
    tracks = _visible_tracks(reference, len(surface))
    if tracks:
        curves["chamfer_phystwin"] = _each(tracks, surface, "l1")
    observed = tracks
    if len(reference.cloud) >= len(surface):
        observed = [cloud.astype(np.float64) for cloud in reference.cloud[: len(surface)]]
    if observed:
        curves["chamfer_l1"] = _each(observed, surface, "l1")
        curves["chamfer_l2"] = _each(observed, surface, "l2")
        pairs = zip(observed, surface, strict=True)
        curves["chamfer_symmetric"] = np.array([chamfer_symmetric(o, n) for o, n in pairs])
    return curves


def _dynamic_curves(
    surface: Float[ndarray, "frame node 3"],
    point: Float[ndarray, "frame track 3"],
    is_visible: Bool[ndarray, "frame track"],
) -> Curves:
    """CD_dyn: only tracks that move in any frame, and for the way back only nodes beside them."""
    is_dynamic = dynamic_tracks(point, is_visible)
    moving = [point[f, is_visible[f] & is_dynamic] for f in range(len(surface))]
    start = np.where(is_visible[0][:, None], point[0], np.nan)
    beside = surface[:, dynamic_nodes(surface[0], start, is_dynamic)]
    return {
        "chamfer_dynamic_l1": _each(moving, surface, "l1"),
        "chamfer_dynamic_l2": _each(moving, surface, "l2"),
        "chamfer_dynamic_symmetric": np.array(
            [chamfer_symmetric(o, n) for o, n in zip(moving, beside, strict=True)]
        ),
    }


def _track_curves(nodes: Float[ndarray, "frame node 3"], reference: Reference) -> Curves:
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
        known = np.flatnonzero(is_visible[0])
        carried = carried_points(point[0, known], nodes)
        curves["track_error"] = track_error(point[:, known], is_visible[:, known], carried)
    return curves


def _visible_tracks(reference: Reference, frame_count: int) -> list[Float[ndarray, "_ 3"]]:
    if reference.point is None or reference.is_visible is None or not reference.point.shape[1]:
        return []
    return [
        reference.point[f, reference.is_visible[f]].astype(np.float64) for f in range(frame_count)
    ]


def _each(
    observed: list[Float[ndarray, "_ 3"]], nodes: Float[ndarray, "frame node 3"], norm: Norm
) -> Float[ndarray, " frame"]:
    return np.array([chamfer_one_way(o, nodes[frame], norm) for frame, o in enumerate(observed)])
