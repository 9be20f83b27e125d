"""Scores of what an import found in a raw capture: masks, tracks and the places of cameras."""

from collections.abc import Iterable
from collections.abc import Sequence as Many
from itertools import combinations
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray

from physhandi.metrics.photometric import intersection_over_union
from physhandi.metrics.truth_metrics import TrueSurface, track_truth

_OBJECT = 1
"""Mask value of the object; those above are hands."""
FAR_OFF = 0.010
"""Error from which on a track is lost [m]."""


def mask_scores(
    estimated: Iterable[UInt8[ndarray, "row column"]], true: Iterable[UInt8[ndarray, "row column"]]
) -> dict[str, float]:
    """Compare masks: mean over images of the intersection over union of object and hands.

    Images in which neither mask shows it are left out; all hands count as one.

    Args:
        estimated: Masks of all frames and views.
        true: What they should be, in the same order.

    Returns:
        ``object`` and ``hand``; NaN if no image shows it.
    """
    each = [
        (
            intersection_over_union(one == _OBJECT, other == _OBJECT),
            intersection_over_union(one > _OBJECT, other > _OBJECT),
        )
        for one, other in zip(estimated, true, strict=True)
    ]
    value = np.array(each).reshape(-1, 2)
    means = [column[np.isfinite(column)] for column in value.T]
    return {
        name: float(column.mean()) if len(column) else float("nan")
        for name, column in zip(("object", "hand"), means, strict=True)
    }


def tracks_alive(visible: Many[Bool[ndarray, "frame _"]]) -> dict[str, Any]:
    """Count the visible tracks of each view in the frame that has fewest.

    Args:
        visible: Whether each track is visible, of each view.

    Returns:
        ``least_by_view``, and ``least`` of all views' sums.
    """
    counts = [one.sum(axis=1) for one in visible]
    return {
        "least_by_view": [int(count.min()) for count in counts],
        "least": int(np.sum(counts, axis=0).min()) if counts else 0,
    }


def track_scores(
    point: Float[ndarray, "frame track 3"], surface: TrueSurface
) -> dict[str, float | int]:
    """Compare lifted tracks with the true motion of the surface points that they began on.

    Every frame after a track's first one counts in which its place is known.

    Args:
        point: Tracks in the world [m]; NaN where not known.
        surface: The true surface, of at least as many frames.

    Returns:
        ``median`` and ``mean`` error [m], the ``lost`` part more than `FAR_OFF` off, and
        ``points``, how many were compared; errors are NaN if there are none.
    """
    is_known = np.isfinite(point).all(axis=-1)
    is_later = np.arange(len(point))[:, None] > is_known.argmax(axis=0)
    error = np.linalg.norm(point - track_truth(point, surface), axis=-1)[is_known & is_later]
    if not len(error):
        return {"median": np.nan, "mean": np.nan, "lost": np.nan, "points": 0}
    return {
        "median": float(np.median(error)),
        "mean": float(error.mean()),
        "lost": float((error > FAR_OFF).mean()),
        "points": len(error),
    }


def camera_scores(
    estimated: Many[Float[ndarray, "4 4"]], true: Many[Float[ndarray, "4 4"]]
) -> dict[str, float]:
    """Compare where cameras are from each other: that does not depend on the world's origin.

    Args:
        estimated: Poses of the cameras, which map their coordinates to the world [m].
        true: What they should be.

    Returns:
        ``shift`` [m] and ``turn`` [degrees], the worst of all pairs of cameras, as the one sees the
        other; and ``tilt`` [degrees], the worst angle between what cameras take for upwards and
        what is.
    """
    offs = [
        np.linalg.inv(np.linalg.inv(estimated[i]) @ estimated[j]) @ np.linalg.inv(true[i]) @ true[j]
        for i, j in combinations(range(len(estimated)), 2)
    ]
    tilts = [_angle(one[2, :3], other[2, :3]) for one, other in zip(estimated, true, strict=True)]
    return {
        "shift": max((float(np.linalg.norm(off[:3, 3])) for off in offs), default=0.0),
        "turn": max((_turn(off[:3, :3]) for off in offs), default=0.0),
        "tilt": max(tilts),
    }


def along_the_table(
    estimated: Many[Float[ndarray, "4 4"]], true: Many[Float[ndarray, "4 4"]], rise: float = 0.0
) -> Float[ndarray, "4 4"]:
    """Find the turn about z and the shift along the table that bring cameras best to their places.

    What falls and lies on a table does so alike wherever the origin on it is.

    Args:
        estimated: Poses of the cameras [m].
        true: Where they should be, of the same cameras [m].
        rise: How much higher the table is there [m].

    Returns:
        What maps the world of the first to that of the second.
    """
    pairs = list(zip(estimated, true, strict=True))
    moment = np.sum([t[:3, :3] @ f[:3, :3].T for f, t in pairs], axis=0)
    yaw = np.arctan2(moment[1, 0] - moment[0, 1], moment[0, 0] + moment[1, 1])
    place = np.eye(4)
    place[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    off = [t[:3, 3] - place[:3, :3] @ f[:3, 3] for f, t in pairs]
    place[:2, 3] = np.mean(off, axis=0)[:2]
    place[2, 3] = rise
    return place


def _turn(rotation: Float[ndarray, "3 3"]) -> float:
    """Angle of a rotation [degrees]; as exact for small ones as for others."""
    axis = np.array(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    return float(np.rad2deg(np.arctan2(np.linalg.norm(axis), np.trace(rotation) - 1.0)))


def _angle(one: Float[ndarray, " 3"], other: Float[ndarray, " 3"]) -> float:
    sine = np.linalg.norm(np.cross(one, other))
    return float(np.rad2deg(np.arctan2(sine, one @ other)))
