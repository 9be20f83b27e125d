"""Rigid motions between point sets: baselines, carried points and aligned errors."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.spatial import KDTree

from physhandi.rotations import best_rotations

CARRIERS = 8
"""Nodes whose common rigid motion carries a point."""
LEAST_CARRIERS = 3
"""Carriers that determine a rotation; with fewer the carried point is unknown."""
REACH = 0.03
"""Largest distance in frame 0 at which an observed point carries another [m]."""


def rigid_transform(
    source: Float[ndarray, "point 3"], target: Float[ndarray, "point 3"]
) -> tuple[Float[ndarray, "3 3"], Float[ndarray, " 3"]]:
    """Find the rotation and translation that move `source` best onto `target` (Kabsch).

    Where the points leave a rotation open because they lie on a line, the smallest one is taken.

    Returns:
        Rotation R and translation t [m] such that ``source @ R.T + t`` is nearest to `target`.
    """
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    rotation = best_rotations((target - target_mean).T @ (source - source_mean))
    return rotation, target_mean - rotation @ source_mean


def similarity_aligned(
    source: Float[ndarray, "frame point 3"], target: Float[ndarray, "frame point 3"]
) -> Float[ndarray, "frame point 3"]:
    """Turn, shift and scale the points of each frame onto the target's (Procrustes) [m]."""
    source_mean, target_mean = (x.mean(axis=1, keepdims=True) for x in (source, target))
    moved, aim = source - source_mean, target - target_mean
    rotation = best_rotations(np.einsum("fpi,fpj->fij", aim, moved))
    turned = moved @ rotation.transpose(0, 2, 1)
    size = (moved**2).sum(axis=(1, 2))
    scale = (turned * aim).sum(axis=(1, 2)) / np.maximum(size, 1e-300)
    return scale[:, None, None] * turned + target_mean


def carried_points(
    point: Float[ndarray, "point 3"],
    carrier: Float[ndarray, "frame carrier 3"],
    is_visible: Bool[ndarray, "frame carrier"] | None = None,
    *,
    reach: float = np.inf,
) -> Float[ndarray, "frame point 3"]:
    """Move points of frame 0 with the carriers around them.

    Each point follows the rigid motion, since frame 0, of the `CARRIERS` carriers that are nearest
    to it in frame 0, among those that frame 0 and the frame in question show. With carriers that
    move rigidly it is exact.

    Args:
        point: Points in frame 0 [m].
        carrier: Carriers in every frame [m].
        is_visible: Which of them are known; all of them if left out.
        reach: Carriers farther away than this in frame 0 are ignored [m].

    Returns:
        The points in every frame [m]; NaN where fewer than `LEAST_CARRIERS` carriers are near.
        If there are fewer carriers in all, those there are suffice.
    """
    frame_count, carrier_count = carrier.shape[:2]
    if is_visible is None:
        is_visible = np.ones((frame_count, carrier_count), dtype=bool)
    moved = np.full((frame_count, len(point), 3), np.nan)
    least = min(LEAST_CARRIERS, carrier_count)
    held: _Held | None = None
    for frame in range(frame_count):
        usable = np.flatnonzero(is_visible[0] & is_visible[frame])
        if not len(point) or len(usable) < max(least, 1):
            continue
        # Nodes are known in all frames: what carries a point is looked up once.
        if held is None or not np.array_equal(held.usable, usable):
            held = _Held(point, carrier[0], usable, least, reach)
        moved[frame] = held.moved(carrier[frame])
    return moved


class _Held:
    """Points with what carries them, as long as the same carriers are known."""

    def __init__(
        self, point: ndarray, start: ndarray, usable: ndarray, least: int, reach: float
    ) -> None:
        self.usable = usable
        start = start[usable]
        tree: Any = KDTree(start)
        count = min(CARRIERS, len(start))
        distance, near = tree.query(point, k=count)
        distance, self._near = (np.reshape(x, (-1, count)) for x in (distance, near))
        weight = (distance <= reach).astype(np.float64)
        self._is_known = weight.sum(axis=1) >= least
        self._weight = weight / np.maximum(weight.sum(axis=1, keepdims=True), 1.0)
        mean, self._source = self._about_mean(start)
        self._offset = point - mean

    def _about_mean(self, carrier: ndarray) -> tuple[ndarray, ndarray]:
        """Mean of each point's carriers, and where they are from there."""
        near = carrier[self._near]
        mean = np.einsum("pc,pci->pi", self._weight, near)
        return mean, near - mean[:, None]

    def moved(self, carrier: ndarray) -> Float[ndarray, "point 3"]:
        """Where carriers of another frame take the points."""
        mean, target = self._about_mean(carrier[self.usable])
        turn = best_rotations(np.einsum("pc,pci,pcj->pij", self._weight, target, self._source))
        point = np.einsum("pij,pj->pi", turn, self._offset) + mean
        return np.where(self._is_known[:, None], point, np.nan)
