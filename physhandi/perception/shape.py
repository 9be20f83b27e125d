"""Object nodes sampled from what the first frame shows of the object.

Two kinds of object are told apart by the cloud's thickness. A *sheet* is sampled on a grid in its
own plane; cells that the hand hides are filled in between. Anything thicker is sampled on a voxel
grid and filled from its top down to the ground, or to its lowest seen point.

Limits: a sheet that is folded already in the first frame is taken for one layer; overhangs of a
thick object are filled, and what no view sees beside its silhouette is not invented.
"""

from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.interpolate import griddata
from scipy.ndimage import binary_closing, binary_fill_holes
from scipy.spatial import ConvexHull, Delaunay, KDTree, QhullError

from physhandi.data.observation import ObjectObservation
from physhandi.data.sequence import Sequence, View
from physhandi.errors import MissingInputError
from physhandi.perception.lifting import OBJECT_LABEL

HiddenTest = Callable[[Float[ndarray, "point 3"]], Bool[ndarray, " point"]]
"""Whether the object may occupy world points at which no cloud point lies."""

MAX_GAP = 0.04
"""Widest gap in a sheet that is closed without knowing whether a hand hides it [m]."""
_STANDING_HEIGHT = 0.03
"""An object whose lowest point is nearer to the ground than this stands on it [m]."""
_SHEET_THICKNESS = 1.5
"""Largest thickness of a sheet, in distances between nodes."""
_LEAST_FILL = 0.25
"""Points of an occupied cell, as a share of the median over cells."""
_SMOOTHED = 13
"""Points over which a sheet's height is smoothed."""


def object_nodes_from_observation(
    observation: ObjectObservation, spacing: float, sequence: Sequence | None = None
) -> Float[ndarray, "node 3"]:
    """Sample object nodes from the first frame of an observation.

    Args:
        observation: What was seen of the object; its fused cloud of frame 0 is used.
        spacing: Distance between neighbouring nodes [m].
        sequence: Recording that the observation came from. With it nodes stand on its ground, and
            a hidden part is filled exactly where no view sees past the object.

    Returns:
        Nodes in the world frame, in a fixed order [m].

    Raises:
        MissingInputError: If the first frame shows no object points.
    """
    if not observation.cloud or len(observation.cloud[0]) == 0:
        where = "" if sequence is None else f"Sequence '{sequence.name}': "
        raise MissingInputError(
            f"{where}The first frame shows no points of the object, so its shape is unknown. "
            "Add depth and masks of frame 0, or object_node.npy."
        )
    cloud = observation.cloud[0].astype(np.float64)
    if sequence is None:
        return object_nodes(cloud, spacing)
    views = [view for view in sequence.views if view.has_mask]
    return object_nodes(
        cloud,
        spacing,
        ground_height=sequence.ground_height,
        is_hidden=(lambda point: silhouette_test(views, 0, point)) if views else None,
    )


def object_nodes(
    cloud: Float[ndarray, "point 3"],
    spacing: float,
    *,
    ground_height: float | None = None,
    is_hidden: HiddenTest | None = None,
) -> Float[ndarray, "node 3"]:
    """Sample nodes evenly over an object that a cloud shows in part.

    Args:
        cloud: Points on the seen surface in the world frame, z up [m].
        spacing: Distance between neighbouring nodes [m].
        ground_height: Height below which there is nothing [m].
        is_hidden: Where the object may continue unseen. Without it only gaps up to `MAX_GAP` and
            holes enclosed on all sides are filled.

    Returns:
        Nodes in the world frame, ordered by grid cell [m]. The same cloud gives the same nodes.

    Raises:
        ValueError: If the cloud is empty or the spacing is not positive.
    """
    if len(cloud) == 0 or not spacing > 0:
        raise ValueError(f"need points and a positive spacing, not {len(cloud)} and {spacing}")
    cloud = cloud.astype(np.float64)
    center = cloud.mean(axis=0)
    axes = np.linalg.svd(cloud - center, full_matrices=False)[2]
    if len(axes) == 3 and _is_sheet((cloud - center) @ axes.T, spacing):
        node = _sheet_nodes(cloud, center, axes[2], spacing, is_hidden)
    else:
        node = _solid_nodes(cloud, spacing, ground_height)
    if ground_height is not None:
        node[:, 2] = np.maximum(node[:, 2], ground_height)
    return node.astype(np.float32)


def silhouette_test(
    views: list[View], frame: int, point: Float[ndarray, "point 3"]
) -> Bool[ndarray, " point"]:
    """Mark the points that the object may occupy according to the masks of all views.

    A point is ruled out if a view sees background all around its pixel, which the object would
    cover. Outside of an image nothing is ruled out.
    """
    possible = np.ones(len(point), dtype=bool)
    for view in views:
        covered = (view.mask(frame) >= OBJECT_LABEL).astype(np.uint8)
        covered = cv2.dilate(covered, np.ones((3, 3), dtype=np.uint8)) > 0
        pixel = np.nan_to_num(view.camera.project(point), nan=-1e6).round().astype(np.int64)
        inside = (pixel >= 0).all(axis=1)
        inside &= (pixel[:, 0] < view.camera.width) & (pixel[:, 1] < view.camera.height)
        possible[inside] &= covered[pixel[inside, 1], pixel[inside, 0]]
    return possible


def _is_sheet(local: Float[ndarray, "point 3"], spacing: float) -> bool:
    """Whether a cloud is wide and thin, its outermost points left out."""
    low, high = np.percentile(local, [2, 98], axis=0)
    _, width, thickness = high - low
    return bool(thickness < _SHEET_THICKNESS * spacing and thickness < max(0.02, width))


def _sheet_nodes(
    cloud: Float[ndarray, "point 3"],
    center: Float[ndarray, " 3"],
    normal: Float[ndarray, " 3"],
    spacing: float,
    is_hidden: HiddenTest | None,
) -> Float[ndarray, "node 3"]:
    """Sample a grid in the plane of a sheet and lift it to the sheet's height."""
    basis = _sheet_basis(cloud - center, normal)
    local = (cloud - center) @ basis.T
    low, high = np.percentile(local[:, :2], [0.5, 99.5], axis=0)
    shape = np.maximum(np.round((high - low) / spacing).astype(np.int64), 1)
    start = (low + high) / 2 - shape * spacing / 2
    cell = np.floor((local[:, :2] - start) / spacing).astype(np.int64)
    cell = np.clip(cell, 0, shape - 1)
    count = np.zeros(tuple(shape), dtype=np.int64)
    np.add.at(count, (cell[:, 0], cell[:, 1]), 1)
    is_seen = count >= max(1.0, _LEAST_FILL * float(np.median(count[count > 0])))
    grid = start + (np.indices(tuple(shape)).reshape(2, -1).T + 0.5) * spacing
    height = _heights(local, grid)
    position = center + np.concatenate([grid, height[:, None]], axis=1) @ basis
    filled = is_seen.ravel()
    if is_hidden is None:
        filled = filled | _close_gaps(is_seen, spacing).ravel()
    else:
        filled = filled | (_in_hull(grid, grid[filled], spacing) & is_hidden(position))
    return position[filled]


def _sheet_basis(
    local: Float[ndarray, "point 3"], normal: Float[ndarray, " 3"]
) -> Float[ndarray, "3 3"]:
    """Choose axes along the sheet's sides: rows are length, width and the upward normal."""
    normal = normal if normal[np.argmax(np.abs(normal))] > 0 else -normal
    helper = np.eye(3)[np.argmin(np.abs(normal))]
    first = np.cross(helper, normal)
    first /= np.linalg.norm(first)
    second = np.cross(normal, first)
    flat = np.stack([local @ first, local @ second], axis=1)
    corners = cv2.boxPoints(cv2.minAreaRect((flat * 1000).astype(np.float32)))
    sides = np.diff(corners[:3], axis=0)
    long = sides[int(np.argmax(np.linalg.norm(sides, axis=1)))].astype(np.float64)
    long /= max(float(np.linalg.norm(long)), 1e-12)
    long = long if long[np.argmax(np.abs(long))] > 0 else -long
    length = long[0] * first + long[1] * second
    return np.stack([length, np.cross(normal, length), normal])


def _heights(local: Float[ndarray, "point 3"], grid: Float[ndarray, "cell 2"]) -> ndarray:
    """Interpolate the sheet's height over its plane, and continue it level beyond the cloud.

    Each point first takes the median height of those around it: beside a hand, masks let some of
    the hand's points through.
    """
    around = KDTree(local[:, :2]).query(local[:, :2], k=min(_SMOOTHED, len(local)))[1]
    smooth = np.median(local[around.reshape(len(local), -1), 2], axis=1)
    nearest = griddata(local[:, :2], smooth, grid, method="nearest")
    try:
        height = griddata(local[:, :2], smooth, grid, method="linear")
    except QhullError:
        return nearest
    return np.where(np.isfinite(height), height, nearest)


def _close_gaps(seen: Bool[ndarray, "row column"], spacing: float) -> Bool[ndarray, "row column"]:
    """Fill enclosed holes, and gaps up to `MAX_GAP` along the grid's two directions."""
    reach = max(int(MAX_GAP / spacing), 1) + 1
    padded = np.pad(seen, reach)
    for structure in (np.ones((reach, 1)), np.ones((1, reach))):
        padded = padded | np.asarray(binary_closing(padded, structure.astype(bool)), dtype=bool)
    return np.asarray(binary_fill_holes(padded), dtype=bool)[reach:-reach, reach:-reach]


def _in_hull(
    grid: Float[ndarray, "cell 2"], seen: Float[ndarray, "point 2"], spacing: float
) -> Bool[ndarray, " cell"]:
    """Mark the cells in the convex hull of the seen ones."""
    corner = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]) * 0.5 * spacing
    outline = (seen[:, None] + corner).reshape(-1, 2)
    hull = outline[ConvexHull(outline).vertices]
    return Delaunay(hull).find_simplex(grid) >= 0


def _solid_nodes(
    cloud: Float[ndarray, "point 3"], spacing: float, ground_height: float | None
) -> Float[ndarray, "node 3"]:
    """Sample the surface on a voxel grid and fill every column below its top."""
    low = cloud.min(axis=0)
    stands = ground_height is not None and low[2] - ground_height < _STANDING_HEIGHT
    floor = ground_height if stands and ground_height is not None else low[2]
    origin = np.array([low[0], low[1], floor])
    voxel = np.floor((cloud - origin) / spacing).astype(np.int64)
    key, owner, count = np.unique(voxel, axis=0, return_inverse=True, return_counts=True)
    owner = owner.reshape(-1)
    total = [np.bincount(owner, weights=cloud[:, axis]) for axis in range(3)]
    surface = np.stack(total, axis=1) / count[:, None]
    column, of_column = np.unique(key[:, :2], axis=0, return_inverse=True)
    top = np.zeros(len(column), dtype=np.int64)
    np.maximum.at(top, of_column.reshape(-1), key[:, 2])
    inside = np.concatenate(
        [
            np.column_stack([np.repeat(place[None], level, axis=0), np.arange(level)])
            for place, level in zip(column, top, strict=True)
        ]
    )
    occupied = {tuple(place) for place in key.tolist()}
    empty = np.array([place for place in inside.tolist() if tuple(place) not in occupied])
    if len(empty) == 0:
        return surface
    return np.concatenate([surface, origin + (empty + 0.5) * spacing])
