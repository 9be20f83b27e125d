"""How far fitted hands are from measured points, and from the true hand where it is known."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.metrics.alignment import similarity_aligned
from physhandi.metrics.geometry import chamfer_one_way, chamfer_symmetric

Curve = Float[ndarray, " frame"]
WRIST = 0
"""Number of the wrist among the keypoints."""


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
    for frame, (mesh, seen) in enumerate(zip(vertex, points, strict=True)):
        if not len(seen):
            continue
        mesh64, seen64 = mesh.astype(np.float64), seen.astype(np.float64)
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
    """Let a hand stand still where its fit is not finite, as the static baseline does.

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
