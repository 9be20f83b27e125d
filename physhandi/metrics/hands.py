"""Errors of fitted hands against detected keypoints, measured points and the truth."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from physhandi.data.camera import PinholeCamera
from physhandi.metrics.alignment import similarity_aligned
from physhandi.metrics.geometry import chamfer_one_way, chamfer_symmetric

Curve = Float[ndarray, " frame"]
"""One value a frame; NaN where it cannot be measured."""
WRIST = 0
"""Number of the wrist among the keypoints."""


@dataclass(frozen=True, kw_only=True)
class ReprojectionScore:
    """Distances between projected and seen keypoints, over all views, frames and joints."""

    median: float
    """Half of the keypoints are nearer [px]; NaN if none was scored."""
    mean: float
    """Mean distance [px]."""
    p95: float
    """95 of 100 keypoints are nearer [px]."""
    keypoint_count: int
    """Keypoints scored."""


@dataclass(frozen=True, kw_only=True)
class HandScore:
    """Score of one hand."""

    fitted: ReprojectionScore
    """Keypoints that the fit was given."""
    hidden: ReprojectionScore
    """Keypoints that were kept from the fit."""
    frame_count: int
    """Frames in which at least one view saw the hand; all of them are scored."""
    joint_median: tuple[float, ...]
    """Median distance of each of the 21 keypoints [px]."""

    def to_dict(self) -> dict[str, Any]:
        """Describe the score in plain numbers."""
        return asdict(self)


def evaluate_hands(
    cameras: Sequence[PinholeCamera],
    joint: Sequence[Float[ndarray, "frame 21 3"]],
    keypoint: Float[ndarray, "view frame hand 21 3"],
    hidden: Bool[ndarray, "view frame hand 21"] | None = None,
    *,
    least_views: int = 1,
) -> tuple[HandScore, ...]:
    """Project each hand's keypoints into all views and compare them with what was seen.

    Args:
        cameras: Camera of each view.
        joint: Keypoints of each hand in the world frame, as `HandMotion.keypoints` gives them.
        keypoint: Pixel x, pixel y and confidence of the seen keypoints; NaN where not seen [px].
        hidden: Which of them were kept from the fit; None means none.
        least_views: Score only frames in which so many views saw the hand.

    Returns:
        One score for each hand, in their order. A frame whose fit is missing or behind a camera
        has an infinite distance; it is not dropped.
    """
    scores: list[HandScore] = []
    for hand, points in enumerate(joint):
        detected = np.asarray(keypoint[:, :, hand], dtype=np.float64)
        is_seen = np.isfinite(detected).all(-1)
        is_scored = is_seen.any(-1).sum(0) >= least_views
        is_seen &= is_scored[:, None]
        distance = np.stack(
            [
                np.linalg.norm(camera.project(points.astype(np.float64)) - view[..., :2], axis=-1)
                for camera, view in zip(cameras, detected, strict=True)
            ]
        )
        distance = np.where(np.isfinite(distance), distance, np.inf)
        is_hidden = np.zeros_like(is_seen) if hidden is None else hidden[:, :, hand]
        scores.append(
            HandScore(
                fitted=_score(distance[is_seen & ~is_hidden]),
                hidden=_score(distance[is_seen & is_hidden]),
                frame_count=int(is_scored.sum()),
                joint_median=tuple(
                    _score(distance[..., k][is_seen[..., k]]).median for k in range(21)
                ),
            )
        )
    return tuple(scores)


def _score(distance: Float[ndarray, " keypoint"]) -> ReprojectionScore:
    if not len(distance):
        return ReprojectionScore(median=np.nan, mean=np.nan, p95=np.nan, keypoint_count=0)
    return ReprojectionScore(
        median=float(np.median(distance)),
        mean=float(np.mean(distance)),
        p95=float(np.percentile(distance, 95, method="higher")),
        keypoint_count=len(distance),
    )


def hand_chamfer(
    vertex: Float[ndarray, "frame vertex 3"], points: tuple[Float[ndarray, "_ 3"], ...]
) -> dict[str, Curve]:
    """Compare the vertices of a hand with the points that the views measured on it (Hand CD).

    Args:
        vertex: Fitted surface [m].
        points: Measured points of each frame [m].

    Returns:
        For each frame ``chamfer_symmetric``, and its two directions ``chamfer_points_to_mesh`` and
        ``chamfer_mesh_to_points`` [m]. NaN where nothing was measured.
    """
    curves = {
        name: np.full(len(vertex), np.nan)
        for name in ("chamfer_symmetric", "chamfer_points_to_mesh", "chamfer_mesh_to_points")
    }
    for frame, (mesh, measured) in enumerate(zip(vertex, points, strict=True)):
        if not len(measured):
            continue
        mesh64, seen64 = mesh.astype(np.float64), measured.astype(np.float64)
        curves["chamfer_points_to_mesh"][frame] = chamfer_one_way(seen64, mesh64)
        curves["chamfer_mesh_to_points"][frame] = chamfer_one_way(mesh64, seen64)
    both = curves["chamfer_points_to_mesh"] + curves["chamfer_mesh_to_points"]
    curves["chamfer_symmetric"] = 0.5 * both
    return curves


def joint_errors(
    joint: Float[ndarray, "frame 21 3"], true_joint: Float[ndarray, "frame 21 3"]
) -> dict[str, Curve]:
    """Measure the mean per-joint position error of each frame (MPJPE) [m].

    Returns:
        ``mpjpe`` in the world, ``mpjpe_wrist`` with both wrists laid on each other, and
        ``mpjpe_procrustes`` after the best rotation, translation and scale.
    """
    fitted, true = joint.astype(np.float64), true_joint.astype(np.float64)
    return {
        "mpjpe": _mean_distance(fitted, true),
        "mpjpe_wrist": _mean_distance(_from_wrist(fitted, fitted), _from_wrist(true, true)),
        "mpjpe_procrustes": _mean_distance(similarity_aligned(fitted, true), true),
    }


def vertex_errors(
    vertex: Float[ndarray, "frame vertex 3"],
    true_vertex: Float[ndarray, "frame true_vertex 3"],
    joint: Float[ndarray, "frame 21 3"] | None = None,
    true_joint: Float[ndarray, "frame 21 3"] | None = None,
) -> dict[str, Curve]:
    """Measure the mean per-vertex position error of each frame (MPVPE) [m].

    Args:
        vertex: Fitted surface [m].
        true_vertex: True surface [m]; of another mesh if its number of vertices differs.
        joint: Fitted keypoints [m]; needed to lay the wrists on each other.
        true_joint: True keypoints [m].

    Returns:
        Always ``surface_error``, the symmetric Chamfer distance of both surfaces' vertices. Only if
        they correspond, ``mpvpe`` in the world, ``mpvpe_wrist`` and ``mpvpe_procrustes`` as for
        joints.
    """
    fitted, true = vertex.astype(np.float64), true_vertex.astype(np.float64)
    pairs = zip(fitted, true, strict=True)
    errors = {"surface_error": np.array([chamfer_symmetric(a, b) for a, b in pairs])}
    if fitted.shape != true.shape:
        return errors
    errors["mpvpe"] = _mean_distance(fitted, true)
    if joint is not None and true_joint is not None:
        errors["mpvpe_wrist"] = _mean_distance(
            _from_wrist(fitted, joint.astype(np.float64)),
            _from_wrist(true, true_joint.astype(np.float64)),
        )
    errors["mpvpe_procrustes"] = _mean_distance(similarity_aligned(fitted, true), true)
    return errors


def held_where_missing(
    motion: Float[ndarray, "frame point 3"],
) -> tuple[Float[ndarray, "frame point 3"] | None, int]:
    """Hold the last finite pose of a hand where its fit is not finite.

    Returns:
        The motion, each missing frame filled with the last finite one before it (at the start, with
        the first one), and the number of missing frames; None if no frame is finite.
    """
    is_known = np.isfinite(motion).all(axis=(1, 2))
    missing = int((~is_known).sum())
    if not is_known.any():
        return None, missing
    last = np.maximum.accumulate(np.where(is_known, np.arange(len(motion)), -1))
    last[last < 0] = int(is_known.argmax())
    return motion[last], missing


def _from_wrist(
    point: Float[ndarray, "frame point 3"], joint: Float[ndarray, "frame 21 3"]
) -> Float[ndarray, "frame point 3"]:
    return point - joint[:, WRIST : WRIST + 1]


def _mean_distance(
    first: Float[ndarray, "frame point 3"], second: Float[ndarray, "frame point 3"]
) -> Curve:
    return np.linalg.norm(first - second, axis=2).mean(axis=1)
