"""Whether depth and calibration fit together: the table's plane, and surfaces that views share."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from physhandi.data.camera import PinholeCamera

_POINTS = 20_000
_ROUNDS = 400
_THICKNESS = 0.008
_RELATIVE = 0.01
_TOLERANCE = 0.012
_LEAST_SHARED = 150
_EDGE = 0.02


@dataclass(frozen=True, eq=False)
class TablePlane:
    """The largest plane of a cloud."""

    T_table_world: Float[ndarray, "4 4"]
    """Maps to coordinates whose z = 0 is the plane, with z towards the cameras [m]."""
    share: float
    """Part of the points that lie on it."""


def cloud(
    camera: PinholeCamera, depth: Float[ndarray, "row column"], most: int = _POINTS
) -> Float[ndarray, "point 3"]:
    """Lift depth [m] to world points, evenly thinned to at most so many; none at depth edges."""
    is_known = depth > 0
    smooth = is_known.copy()
    for axis in (0, 1):
        step = np.abs(np.diff(depth, axis=axis)) > _EDGE * np.maximum(
            np.delete(depth, -1, axis), 0.2
        )
        before = [slice(None), slice(None)]
        after = [slice(None), slice(None)]
        before[axis], after[axis] = slice(None, -1), slice(1, None)
        smooth[tuple(before)] &= ~step
        smooth[tuple(after)] &= ~step
    row, column = np.nonzero(smooth)
    chosen = np.linspace(0, len(row) - 1, min(most, len(row))).astype(np.int64)
    row, column = row[chosen], column[chosen]
    pixel = np.stack([column, row], axis=1).astype(np.float64)
    return camera.unproject(pixel, depth[row, column].astype(np.float64))


def find_table(
    point: Float[ndarray, "point 3"],
    eye: Float[ndarray, "camera 3"],
    right: Float[ndarray, " 3"],
) -> TablePlane | None:
    """Find the largest plane by RANSAC; None if there are too few points.

    Args:
        point: Points of the first frames, in any coordinates [m].
        eye: Where the cameras are; the plane's z axis points to their side [m].
        right: Direction that its x axis shall have, as far as it lies in the plane.
    """
    if len(point) < 100:
        return None
    random = np.random.default_rng(0)
    thickness = np.maximum(_THICKNESS, _RELATIVE * np.linalg.norm(point - eye.mean(0), axis=1))
    best: Bool[ndarray, " point"] = np.zeros(len(point), bool)
    most = 0
    drawn = [random.choice(len(point), 3, replace=False) for _ in range(_ROUNDS)]
    a, b, c = np.swapaxes(point[np.array(drawn)], 0, 1)
    for corner, across in zip(a, np.cross(b - a, c - a), strict=True):
        length = math.sqrt(across @ across)
        if length < 1e-6:
            continue
        normal = across / length
        is_on = np.abs(point @ normal - corner @ normal) < thickness
        count = np.count_nonzero(is_on)
        if count > most:
            best, most = is_on, count
    if most < 100:
        return None
    center, normal = _plane(point[best])
    for _ in range(2):
        best = np.abs((point - center) @ normal) < thickness
        center, normal = _plane(point[best])
    if ((eye - center) @ normal).mean() < 0:
        normal = -normal
    x: Float[ndarray, " 3"] = right - normal * (right @ normal)
    x = x / np.linalg.norm(x)
    T_table_world = np.eye(4)
    T_table_world[:3, :3] = np.stack([x, np.cross(normal, x), normal])
    T_table_world[:3, 3] = -T_table_world[:3, :3] @ center
    return TablePlane(T_table_world, float(best.mean()))


def _plane(point: ndarray) -> tuple[Float[ndarray, " 3"], Float[ndarray, " 3"]]:
    """Fit a plane by least squares: its middle and its normal."""
    center = point.mean(axis=0)
    return center, np.linalg.svd(point - center, full_matrices=False)[2][2]


def table_distance_ratio(
    camera: PinholeCamera, depth: Float[ndarray, "row column"]
) -> tuple[float, float]:
    """Compare the measured depth of the table with that of the plane z = 0.

    Returns:
        The most frequent ratio, and the part of all known pixels within 3 % of it.
    """
    row, column = np.nonzero(depth > 0)
    chosen = np.linspace(0, len(row) - 1, min(_POINTS, len(row))).astype(np.int64)
    row, column = row[chosen], column[chosen]
    pixel = np.stack([column, row], axis=1).astype(np.float64)
    far = camera.unproject(pixel, np.ones(len(pixel)))
    eye = camera.T_world_camera[:3, 3]
    drop = eye[2] - far[:, 2]
    is_down = drop > 0.05
    if is_down.sum() < 100:
        return 1.0, 0.0
    expected = eye[2] / drop[is_down]
    ratio = np.log(depth[row, column][is_down] / expected)
    counts, edges = np.histogram(ratio, bins=np.arange(-9.0, 9.0, 0.01))
    smooth = np.convolve(counts, np.ones(3), mode="same")
    peak = int(smooth.argmax())
    middle = (edges[peak] + edges[peak + 1]) / 2
    near = ratio[np.abs(ratio - middle) < 0.03]
    return float(np.exp(np.median(near))), float(len(near) / len(row))


def shared_surface(
    first: PinholeCamera,
    first_depth: Float[ndarray, "row column"],
    second: PinholeCamera,
    second_depth: Float[ndarray, "row column"],
    above: float | None = None,
) -> float | None:
    """Tell how well what one view measures agrees with what another one sees.

    A point of the first view that would stand in front of what the second one measured cannot be:
    the second would have seen it. Points behind are hidden and say nothing.

    Args:
        first: Camera of the first view.
        first_depth: Its depth [m].
        second: Camera of the second view.
        second_depth: Its depth [m].
        above: Only points higher than this count [m]; None: all.

    Returns:
        Part of the points seen by both that lie on the second view's surface; None if there are
        too few.
    """
    point = cloud(first, first_depth)
    if above is not None:
        point = point[point[:, 2] > above]
    pixel = second.project(point)
    is_seen = np.isfinite(pixel).all(axis=1)
    place = np.zeros((len(point), 2), np.int64)
    place[is_seen] = np.round(pixel[is_seen]).astype(np.int64)
    is_seen &= (place >= 0).all(axis=1)
    is_seen &= (place[:, 0] < second.width) & (place[:, 1] < second.height)
    point, place = point[is_seen], place[is_seen]
    measured = second_depth[place[:, 1], place[:, 0]]
    difference = second.camera_depth(point) - measured
    tolerance = np.maximum(_TOLERANCE, 0.015 * measured)
    agrees = (measured > 0) & (np.abs(difference) < tolerance)
    is_impossible = (measured > 0) & (difference < -tolerance)
    shared = int(agrees.sum() + is_impossible.sum())
    return float(agrees.sum() / shared) if shared >= _LEAST_SHARED else None
