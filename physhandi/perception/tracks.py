"""Pixel tracks lifted to 3-D paths, and which of their motions can be trusted."""

import numpy as np
from jaxtyping import Bool, Float, Shaped
from numpy import ndarray
from scipy.spatial import KDTree

from physhandi.data.camera import PinholeCamera

EDGE_STEP = 0.015
"""Depth step between neighbouring pixels above which they see two different surfaces [m]."""
NEIGHBOR_RADIUS = 0.01
"""Least distance within which tracks are expected to move alike [m]."""
NEIGHBOR_COUNT = 5
"""Tracks, the judged one included, that must be near before a motion can be judged."""
AGREEMENT = 0.005
"""Two motions that differ by less agree [m]."""


def lift_pixels(
    camera: PinholeCamera,
    depth: Float[ndarray, "row column"],
    is_object: Bool[ndarray, "row column"],
    pixel: Float[ndarray, "track 2"],
) -> Float[ndarray, "track 3"]:
    """Find the surface points that sub-pixel image positions see.

    Depth is interpolated bilinearly, but only where all four surrounding pixels carry depth, belong
    to the object and lie on one surface (their depths differ by less than `EDGE_STEP`).

    Args:
        camera: Calibration of the view.
        depth: Depth image, 0 where nothing was measured [m].
        is_object: Pixels that show the object.
        pixel: Image positions x, y [px]; NaN if unknown.

    Returns:
        Points in the world frame [m]; NaN where the position cannot be lifted.
    """
    row_count, column_count = depth.shape
    is_finite = np.asarray(np.isfinite(pixel).all(axis=1))
    corner = np.floor(np.where(is_finite[:, None], pixel, 0.0)).astype(np.int64)
    inside = is_finite & (corner >= 0).all(axis=1)
    inside &= (corner[:, 0] < column_count - 1) & (corner[:, 1] < row_count - 1)
    corner[~inside] = 0
    rows = corner[:, 1, None] + np.array([0, 0, 1, 1])
    columns = corner[:, 0, None] + np.array([0, 1, 0, 1])
    around = depth[rows, columns].astype(np.float64)
    inside &= (around > 0).all(axis=1) & is_object[rows, columns].all(axis=1)
    inside &= np.ptp(around, axis=1) < EDGE_STEP
    x, y = (np.where(is_finite[:, None], pixel, 0.0) - corner).T
    weight = np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], axis=1)
    point = np.full((len(pixel), 3), np.nan)
    if inside.any():
        sampled = (weight * around).sum(axis=1)
        point[inside] = camera.unproject(pixel[inside].astype(np.float64), sampled[inside])
    return point


def motion_validity(
    point: Float[ndarray, "frame track 3"], is_visible: Bool[ndarray, "frame track"]
) -> Bool[ndarray, "frame track"]:
    """Decide which motions from one frame to the next agree with their surroundings.

    A motion is trusted if the track is seen in both frames, at least `NEIGHBOR_COUNT` tracks seen
    in both frames (itself included) start within the neighbour radius, and at least half of them
    move within `AGREEMENT` of it. The radius is `NEIGHBOR_RADIUS`, or more if tracks lie sparser.
    All tracks are judged from the same candidates, so the answer does not depend on their order.

    Args:
        point: Track positions in the world frame [m].
        is_visible: Whether a track was seen.

    Returns:
        Flag of the motion that *ends* in each frame; all False in frame 0.
    """
    valid = np.zeros(is_visible.shape, dtype=bool)
    for frame in range(1, len(point)):
        tracks = np.flatnonzero(is_visible[frame - 1] & is_visible[frame])
        if len(tracks) < NEIGHBOR_COUNT:
            continue
        start = point[frame - 1, tracks]
        motion = point[frame, tracks] - start
        tree = KDTree(start)
        spacing = np.median(tree.query(start, k=NEIGHBOR_COUNT)[0][:, -1])
        radius = max(NEIGHBOR_RADIUS, 2.0 * float(spacing))
        valid[frame, tracks] = _agrees(tree.query_pairs(radius, output_type="ndarray"), motion)
    return valid


def _agrees(
    pair: Shaped[ndarray, "pair 2"], motion: Float[ndarray, "track 3"]
) -> Bool[ndarray, " track"]:
    """Count for each track the neighbours that move like it."""
    count = len(motion)
    alike = np.linalg.norm(motion[pair[:, 0]] - motion[pair[:, 1]], axis=1) < AGREEMENT
    neighbors = 1 + np.bincount(pair.ravel(), minlength=count)
    agreeing = 1 + np.bincount(pair[alike].ravel(), minlength=count)
    return (neighbors >= NEIGHBOR_COUNT) & (2 * agreeing >= neighbors)
