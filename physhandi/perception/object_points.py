"""Keeps of a frame's cloud what is the object, and names what got through its mask.

Masks are a pixel or two too wide, so that their rims show what is behind and beside the object, and
depth sensors invent points at edges. What goes, in this order:

1. *Background*: points that another view rules out, because it sees past them and nothing nearer
   stands in between, unless they are within half a cell of what all views allow.
2. *Loose* pieces. Points that are nearer to each other than two cells hang together. The largest
   piece is the object. Another one is real if it has at least `LEAST_PIECE` of the largest one's
   points and is at most `WIDEST_GAP` away from a real one; so much a hand may hide. Along a hand it
   may be more, up to `WIDEST_HIDDEN_GAP`, if no view sees past the object anywhere on the way.
3. *Stray* points: far from their own nearest neighbors, as measured by the median over the cloud.
"""

import math
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.spatial import KDTree

from physhandi.data.view import View
from physhandi.perception.lifting import OBJECT_LABEL
from physhandi.perception.shape_class import HiddenTest, pieces

LEAST_PIECE = 0.03
"""Points of a real piece, as a share of those of the largest one."""
WIDEST_GAP = 0.15
"""Widest gap between two real pieces [m]: a hand with its thumb spread."""
WIDEST_HIDDEN_GAP = 0.25
"""The same where no view sees past the object on the straight way across [m]: a hand along which
it lies, and the wrist."""
CALIBRATION_MARGIN = 4
"""Pixels by which masks and cameras may be wrong."""
_NEARER = 0.02
"""What stands in front of a point is nearer by more than this [m]."""
_NEIGHBORS = 6
_STRAY = 4.0
"""Mean distance of a stray point to its neighbors, in medians of that distance."""

Reason = Literal["background", "loose", "stray", "ground"]
_WORDS: dict[Reason, str] = {
    "background": "behind or beside it according to another view",
    "loose": "in loose pieces",
    "stray": "far from all others",
    "ground": "on the ground beside it",
}


@dataclass(frozen=True, kw_only=True)
class Removal:
    """Points that are not the object."""

    reason: Reason
    """Reason for which they are not."""
    count: int
    """How many they are."""
    distance: float
    """How far the farthest of them is from the object [m]."""

    def __str__(self) -> str:
        """Tell it as part of a sentence."""
        return f"{self.count} {_WORDS[self.reason]} (up to {1e3 * self.distance:.0f} mm away)"


def object_points(
    cloud: Float[ndarray, "point 3"],
    cell: float,
    *,
    is_possible: HiddenTest | None = None,
) -> tuple[Bool[ndarray, " point"], tuple[Removal, ...]]:
    """Tell which points of a cloud are the object.

    Args:
        cloud: Points of one frame in the world frame [m].
        cell: Length at which the object's cloud has no holes between its points [m].
        is_possible: Where the object may be according to all views.

    Returns:
        Whether each point is the object's, and what is not. No more than the largest piece is left
        of a cloud of which no view allows anything.
    """
    is_kept = np.ones(len(cloud), dtype=bool)
    steps: list[tuple[Reason, Bool[ndarray, " point"]]] = []
    if is_possible is not None:
        is_allowed = is_possible(cloud)
        if is_allowed.any():
            # What is so near to the object is its own rim, as masks and cameras err.
            is_kept = KDTree(cloud[is_allowed]).query(cloud)[0] <= 0.5 * cell
            steps.append(("background", ~is_kept))
    before = is_kept.copy()
    is_kept[before] = _is_in_real_piece(cloud[before], cell, is_possible)
    steps.append(("loose", before & ~is_kept))
    before = is_kept.copy()
    is_kept[before] = ~_is_stray(cloud[before], cell)
    steps.append(("stray", before & ~is_kept))
    return is_kept, tuple(
        removal(reason, cloud, is_gone, is_kept) for reason, is_gone in steps if is_gone.any()
    )


def removal(
    reason: Reason,
    cloud: Float[ndarray, "point 3"],
    is_gone: Bool[ndarray, " point"],
    is_kept: Bool[ndarray, " point"],
) -> Removal:
    """Describe points that go."""
    distance = KDTree(cloud[is_kept]).query(cloud[is_gone])[0]
    return Removal(reason=reason, count=int(is_gone.sum()), distance=float(distance.max()))


def silhouette_test(
    views: list[View], frame: int, point: Float[ndarray, "point 3"], *, margin: int = 1
) -> Bool[ndarray, " point"]:
    """Mark the points that the object may occupy according to the masks of all views.

    A point is ruled out if a view sees background around its pixel, which the object would cover.
    What a view's depth shows to be hidden by something nearer is not ruled out, and neither is what
    is outside of its image.

    Args:
        views: Views with masks.
        frame: Number of the frame.
        point: Points in the world frame [m].
        margin: Distance from a mask up to which a pixel counts as covered [px].
    """
    possible = np.ones(len(point), dtype=bool)
    window = np.ones((2 * margin + 1,) * 2, dtype=np.uint8)
    for view in views:
        covered = (view.mask(frame) >= OBJECT_LABEL).astype(np.uint8)
        covered = cv2.dilate(covered, window) > 0
        pixel = np.nan_to_num(view.camera.project(point), nan=-1e6).round().astype(np.int64)
        inside = (pixel >= 0).all(axis=1)
        inside &= (pixel[:, 0] < view.camera.width) & (pixel[:, 1] < view.camera.height)
        column, row = pixel[inside].T
        allowed = covered[row, column]
        if view.has_depth:
            nearest = view.depth(frame)[row, column]
            limit = view.camera.camera_depth(point[inside]) - _NEARER
            allowed |= (nearest > 0) & (nearest < limit)
        possible[inside] &= allowed
    return possible


def _is_in_real_piece(
    cloud: Float[ndarray, "point 3"], cell: float, is_possible: HiddenTest | None
) -> Bool[ndarray, " point"]:
    def is_near(piece: Float[ndarray, "point 3"], tree: KDTree) -> bool:
        distance, nearest = tree.query(piece)
        first = int(distance.argmin())
        if distance[first] <= WIDEST_GAP:
            return True
        if is_possible is None or distance[first] > WIDEST_HIDDEN_GAP:
            return False
        count = math.ceil(distance[first] / (0.5 * cell))
        return bool(is_possible(np.linspace(piece[first], tree.data[nearest[first]], count)).all())

    label = pieces(cloud, 2.0 * cell)
    count = np.bincount(label)
    # Of pieces of one size, the one whose first point comes first in space is the largest.
    first = np.lexsort(cloud.T[::-1])
    order = np.unique(label[first], return_index=True)[1]
    largest = int(np.lexsort((order, -count))[0])
    waiting = set(np.flatnonzero(count >= LEAST_PIECE * count.max()).tolist()) - {largest}
    is_kept = label == largest
    while waiting:
        tree = KDTree(cloud[is_kept])
        near = {n for n in waiting if is_near(cloud[label == n], tree)}
        if not near:
            break
        is_kept |= np.isin(label, list(near))
        waiting -= near
    return is_kept


def _is_stray(cloud: Float[ndarray, "point 3"], cell: float) -> Bool[ndarray, " point"]:
    count = min(_NEIGHBORS + 1, len(cloud))
    if count < 2:
        return np.zeros(len(cloud), dtype=bool)
    mean = KDTree(cloud).query(cloud, k=count)[0][:, 1:].mean(axis=1)
    return mean > max(_STRAY * float(np.median(mean)), cell)
