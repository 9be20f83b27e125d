"""Tells sheets, solids, shells and ropes apart by the cloud of an object's first frame.

What decides is local, so that a sheet may hang, bend or fold, and a rope may wind:

* A *rope* is long along itself: cut into slices by the distance along its surface, its median slice
  is narrow, and either two nodes wide or about as thick as wide.
* A *solid* stands on the ground: seen from above most of it is thick, beside thick parts it falls
  off towards its outline, which is near the ground, and no view looks through what would be filled.
  A sheet that is held up ends level instead, where it is open.
* A *shell* is a surface that faces itself across a distance and whose rim is shorter than that of
  any flat piece of its area.
* Everything else is a *sheet*: one layer, or several that lie on each other.

Limits: a sheet that covers a space from all sides, as a tent does, is taken for a solid, and a body
in the air that is seen from one side only for a sheet; ``shape`` in ``sequence.yaml`` corrects it.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.ndimage import binary_closing, binary_erosion, binary_fill_holes, distance_transform_edt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import KDTree

from physhandi.data.sequence_meta import ShapeClass
from physhandi.rotations import unit
from physhandi.unique_rows import unique_rows

HiddenTest = Callable[[Float[ndarray, "point 3"]], Bool[ndarray, " point"]]
"""Whether the object may occupy world points at which no cloud point lies."""

STANDING_HEIGHT = 0.03
"""An object whose lowest point is nearer to the ground than this stands on it [m]."""
LEAST_LAYERS = 1.5
"""Thickness from which a body is thick, in distances between nodes: room for a second layer."""
_LEAST_SHARE_OF_WIDTH = 0.1
"""Thickness from which a body is thick, as a share of its second longest side."""
_LEAST_DEPTH = 1.5
"""Least distance of a solid's innermost column from its outline seen from above, in cells."""
_INNER_DEPTH = 2.01
"""Distance from the outline at which a column is inside, in cells."""
_LEVEL = 0.12
"""Where a surface ends as high as it is inside, it is less than this share of that height lower."""
_LEVEL_SHARE = 0.27
"""Largest part of a solid's outline at which its surface ends level; hands may hide its sides."""
_STANDING_SHARE = 0.5
"""Least part of a solid's outline that is near the ground."""
_ROUND_SIDE = 0.6
"""Height up to which that is so, as a share of the height inside: round sides are seen from above
down to about their middle."""
_POSSIBLE_SHARE = 0.8
"""Part of the filled volume that views must allow."""
_LONG = 6.0
"""Length of a rope, in widths of its median slice."""
_NARROW = 2.0
"""Width below which a long thing is a rope whatever its thickness, in distances between nodes."""
_ROUND = 0.35
"""Thickness of wider ropes, in widths."""
_SHORT_RIM = 0.7
"""Rim of a shell, in circumferences of a disc of the same area."""
_ASKED_AT_ONCE = 32
"""Points whose surroundings are looked for together when a cloud is thinned."""
_LEAST_NEIGHBORS = 3
"""Neighbors from which a point has a tangent plane."""
_FREE_ANGLE = 2 * np.pi / 3
"""Directions that the neighbors of a point on the rim leave free [rad]."""
_FACING_SHARE = 0.5
"""Part of a shell's points that face another layer."""


@dataclass(frozen=True, kw_only=True)
class FoundClass:
    """Kind and thickness of the object that a cloud shows."""

    kind: ShapeClass
    """Kind of object."""
    thickness: float
    """Median local thickness [m]: height above the ground of a solid, distance between facing
    layers of a shell, width of a rope, spread of the cloud about the surface of a sheet."""
    reason: str
    """Reason for the kind, in one line."""


def find_class(
    cloud: Float[ndarray, "point 3"],
    spacing: float,
    *,
    ground_height: float | None = None,
    is_possible: HiddenTest | None = None,
) -> FoundClass:
    """Tell what kind of object a cloud shows.

    Args:
        cloud: Points on the seen surface in the world frame, z up, without strays [m].
        spacing: Distance between neighbouring nodes [m].
        ground_height: Height of the ground [m]; without ground nothing stands.
        is_possible: Where the object may be according to all views.

    Returns:
        The same for the same points in any order.
    """
    cell = cell_size(cloud, 0.5 * spacing)
    patch = poisson_disk_points(cloud, cell)
    extent = np.sort(_extent(patch))[::-1]
    thick = max(LEAST_LAYERS * spacing, _LEAST_SHARE_OF_WIDTH * float(extent[1]))
    rope = _rope_of(cloud, patch, cell, spacing)
    if rope is not None:
        return rope
    if ground_height is not None and cloud[:, 2].min() - ground_height < STANDING_HEIGHT:
        solid = _solid_of(cloud, cell, thick, ground_height, is_possible)
        if solid is not None:
            return solid
    return _surface_of(cloud, patch, cell, thick)


def cell_size(cloud: Float[ndarray, "point 3"], spacing: float) -> float:
    """Choose the length at which a cloud has no holes between its points [m]."""
    if len(cloud) < 2:
        return spacing
    return max(spacing, 3.0 * float(np.median(KDTree(cloud).query(cloud, k=2)[0][:, 1])))


def poisson_disk_points(
    cloud: Float[ndarray, "point 3"], distance: float, *, rounds: int = 2
) -> Float[ndarray, "kept 3"]:
    """Thin a cloud evenly along its surface.

    No two of the points picked first are nearer to each other than `distance`, and every point of
    the cloud is nearer than that to one of them (Poisson disks). They are then moved to the middle
    of the points of which they are the nearest (Lloyd), which also averages noise.

    Args:
        cloud: Points [m].
        distance: Least distance at first [m].
        rounds: Times that they are moved.

    Returns:
        Points ordered by x, then y, then z; the same for the same cloud in any order.
    """
    cloud = cloud[np.lexsort(cloud.T[::-1])]
    is_left = np.ones(len(cloud), dtype=bool)
    chosen: list[int] = []
    tree, left = KDTree(cloud), np.arange(len(cloud))
    while len(left):
        # Some at once, which takes less time; most of the others are dropped without being asked.
        asked = left[:_ASKED_AT_ONCE]
        for index, around in zip(asked, tree.query_ball_point(cloud[asked], distance), strict=True):
            if is_left[index]:
                chosen.append(index)
                is_left[around] = False
        left = left[len(asked) :]
        left = left[is_left[left]]
    point = cloud[chosen]
    for _ in range(rounds):
        owner = KDTree(point).query(cloud)[1]
        count = np.bincount(owner, minlength=len(point))
        total = [np.bincount(owner, cloud[:, axis], len(point)) for axis in range(3)]
        mean = np.stack(total, axis=1) / np.maximum(count, 1)[:, None]
        point = np.where(count[:, None] > 0, mean, point)
    return point


def rim_points(
    point: Float[ndarray, "point 3"], reach: float
) -> tuple[Bool[ndarray, " point"], Float[ndarray, "point 3"]]:
    """Find the points at the rim of a surface.

    A point is on the rim if its neighbors leave a third of the directions in its tangent plane
    free, or if there are too few to tell.

    Args:
        point: Points spread evenly over the surface [m].
        reach: Distance of neighbors [m].

    Returns:
        Whether each point is on the rim, and the normal of each, of either sign; zero where
        too few points are near.
    """
    pair = KDTree(point).query_pairs(reach, output_type="ndarray")
    pair = np.concatenate([pair, pair[:, ::-1]])
    pair = pair[np.linalg.norm(point[pair[:, 1]] - point[pair[:, 0]], axis=1) > 1e-9]
    own, away = pair[:, 0], point[pair[:, 1]] - point[pair[:, 0]]
    count = np.bincount(own, minlength=len(point))
    scatter = np.empty((len(point), 3, 3))
    total = np.stack([np.bincount(own, away[:, axis], len(point)) for axis in range(3)], axis=1)
    for row, column in np.ndindex(3, 3):
        product = away[:, row] * away[:, column]
        scatter[:, row, column] = np.bincount(own, product, len(point))
    # The point itself belongs to its neighborhood, at no distance.
    scatter -= total[:, :, None] * total[:, None, :] / (count + 1.0)[:, None, None]
    axes = np.linalg.eigh(scatter)[1]
    angle = np.arctan2((away * axes[own, :, 1]).sum(axis=1), (away * axes[own, :, 2]).sum(axis=1))
    order = np.lexsort((angle, own))
    own, angle = own[order], angle[order]
    gap = np.diff(angle, append=0.0)
    is_last = np.append(own[1:] != own[:-1], True) if len(own) else np.zeros(0, dtype=bool)
    first = np.cumsum(count) - count
    gap[is_last] = angle[first[own[is_last]]] + 2 * np.pi - angle[is_last]
    widest = np.zeros(len(point))
    np.maximum.at(widest, own, gap)
    is_sure = count >= _LEAST_NEIGHBORS
    normal = np.where(is_sure[:, None], axes[:, :, 0], 0.0)
    return ~is_sure | (widest > _FREE_ANGLE), normal


def links(point: Float[ndarray, "point 3"], reach: float) -> coo_array:
    """Join the points that are nearer to each other than `reach`, weighted by distance [m]."""
    pair = KDTree(point).query_pairs(reach, output_type="ndarray")
    length = np.linalg.norm(point[pair[:, 0]] - point[pair[:, 1]], axis=1)
    return coo_array((length, (pair[:, 0], pair[:, 1])), shape=(len(point), len(point)))


def pieces(point: Float[ndarray, "point 3"], reach: float) -> Int[ndarray, " point"]:
    """Number the pieces into which points fall that are farther apart than `reach`."""
    pair = KDTree(point).query_pairs(reach, output_type="ndarray")
    ends = (pair[:, 0], pair[:, 1])
    graph = coo_array((np.ones(len(pair)), ends), shape=(len(point), len(point)))
    # No pair comes twice, and their order does not matter here: to sort them takes longest.
    graph.has_canonical_format = True
    return connected_components(graph, directed=False)[1]


def _extent(point: Float[ndarray, "point 3"]) -> Float[ndarray, " axis"]:
    """Measure a cloud along its principal axes, its outermost points left out [m]."""
    local = point - point.mean(axis=0)
    axes = np.linalg.svd(local, full_matrices=False)[2]
    size = np.zeros(3)
    size[: len(axes)] = np.ptp(np.percentile(local @ axes.T, [2, 98], axis=0), axis=0)
    return size


def _rope_of(
    cloud: Float[ndarray, "point 3"],
    patch: Float[ndarray, "point 3"],
    cell: float,
    spacing: float,
) -> FoundClass | None:
    """Cut every connected piece into slices by the distance along it, and measure them."""
    graph = links(patch, 2.0 * cell)
    label = connected_components(graph, directed=False)[1]
    owner = np.asarray(KDTree(patch).query(cloud)[1])
    slices: list[tuple[float, float]] = []
    length = 0.0
    for piece in np.unique(label):
        start = int(np.argmax(label == piece))
        away = dijkstra(graph, directed=False, indices=start)
        end = int(np.where(label == piece, away, -1.0).argmax())
        along = dijkstra(graph, directed=False, indices=end)
        is_own = label[owner] == piece
        length += float(along[label == piece].max())
        slices += _slices(cloud[is_own], along[owner[is_own]], 2.0 * cell)
    width, thickness = (float(np.median(sizes)) for sizes in zip(*slices, strict=True))
    is_narrow = width <= _NARROW * spacing
    if length < _LONG * max(width, cell) or not (is_narrow or thickness >= _ROUND * width):
        return None
    return FoundClass(
        kind="rope",
        thickness=width,
        reason=f"{1e3 * length:.0f} mm long along itself and {1e3 * width:.0f} mm wide",
    )


def _slices(
    point: Float[ndarray, "point 3"], along: Float[ndarray, " point"], step: float
) -> list[tuple[float, float]]:
    """Measure the two sides of every slice across the direction in which a piece runs [m]."""
    number = np.floor(along / step).astype(np.int64)
    middle = {n: point[number == n].mean(axis=0) for n in np.unique(number)}
    sizes: list[tuple[float, float]] = []
    for n, center in middle.items():
        run = unit(middle.get(n + 1, center) - middle.get(n - 1, center))
        around = point[number == n] - center
        across = around - np.outer(around @ run, run)
        sides = np.sort(np.linalg.svd(across, full_matrices=False)[1])[::-1]
        # Points on a circle deviate by its diameter over √8.
        size = np.sqrt(8.0 / max(len(across), 1)) * np.append(sides, [0.0, 0.0])[:2]
        sizes += [(float(size[0]), float(size[1]))] * len(across)
    return sizes


def _solid_of(
    cloud: Float[ndarray, "point 3"],
    cell: float,
    thick: float,
    ground_height: float,
    is_possible: HiddenTest | None,
) -> FoundClass | None:
    """Look at a cloud from above: how thick it is, and whether its outline closes downwards."""
    place, top, low, shape = columns(cloud, cell, ground_height)
    is_there = np.zeros(shape, dtype=bool)
    is_there[place[:, 0], place[:, 1]] = True
    height = float(np.median(top))
    if height < thick:
        return None
    outline = np.asarray(binary_closing(is_there, np.ones((3, 3), dtype=bool)), dtype=bool)
    outline = np.asarray(binary_fill_holes(outline), dtype=bool)
    depth = np.asarray(distance_transform_edt(outline))
    if depth.max() < _LEAST_DEPTH:
        return None
    rim = np.argwhere(outline & ~np.asarray(binary_erosion(outline), dtype=bool))
    is_inner = depth[place[:, 0], place[:, 1]] >= min(_INNER_DEPTH, float(depth.max()))
    inside = top[is_inner][KDTree(place[is_inner]).query(rim)[1]]
    outside = low[KDTree(place).query(rim)[1]]
    around = KDTree(place).query_ball_point(rim, 1.5)
    lowest = np.array([low[cells].min() if cells else np.inf for cells in around])
    counts = inside >= thick
    if not counts.any():
        return None
    level = float(((inside - outside) < _LEVEL * inside)[counts].mean())
    is_near_ground = lowest <= np.maximum(STANDING_HEIGHT, _ROUND_SIDE * inside)
    near_ground = float(is_near_ground[counts].mean())
    if level > _LEVEL_SHARE or near_ground < _STANDING_SHARE:
        return None
    reason = f"{1e3 * height:.0f} mm high, and {100 * (1 - level):.0f} % of its outline falls off"
    if is_possible is not None:
        filled = [
            np.column_stack([np.repeat(one[None], len(levels), axis=0), levels])
            for one, level in zip(place, top, strict=True)
            if len(levels := np.arange(0.5 * cell, level - 0.5 * cell, cell))
        ]
        if filled:
            inside_point = np.concatenate(filled).astype(np.float64)
            corner = cloud[:, :2].min(axis=0) - 2 * cell
            inside_point[:, :2] = corner + (inside_point[:, :2] + 0.5) * cell
            inside_point[:, 2] += ground_height
            possible = float(is_possible(inside_point).mean())
            if possible < _POSSIBLE_SHARE:
                return None
            reason += f"; views allow {100 * possible:.0f} % of what is below it"
    return FoundClass(kind="solid", thickness=height, reason=reason)


def columns(
    cloud: Float[ndarray, "point 3"], cell: float, ground_height: float
) -> tuple[
    Int[ndarray, "column 2"],
    Float[ndarray, " column"],
    Float[ndarray, " column"],
    tuple[int, int],
]:
    """Sort a cloud into vertical columns.

    Returns:
        Place of each column in a grid with two empty cells around it, height of its highest and its
        lowest point above the ground [m], and the size of the grid.
    """
    start = cloud[:, :2].min(axis=0) - 2 * cell
    index = np.floor((cloud[:, :2] - start) / cell).astype(np.int64)
    place, _, owner, _ = unique_rows(index)
    top, low = np.full(len(place), -np.inf), np.full(len(place), np.inf)
    np.maximum.at(top, owner, cloud[:, 2] - ground_height)
    np.minimum.at(low, owner, cloud[:, 2] - ground_height)
    rows, wide = index.max(axis=0) + 3
    return place, top, low, (int(rows), int(wide))


def _surface_of(
    cloud: Float[ndarray, "point 3"], patch: Float[ndarray, "point 3"], cell: float, thick: float
) -> FoundClass:
    """Tell a shell from a sheet by what a surface faces and by the length of its rim."""
    is_rim, normal = rim_points(patch, 2.0 * cell)
    gap = [
        float(facing.min())
        for point, direction in zip(patch, normal, strict=True)
        if len(facing := _beside(patch - point, direction, cell, thick))
    ]
    near = KDTree(cloud).query_ball_point(patch, cell)
    spread = [
        _spread((cloud[around] - point) @ direction)
        for point, direction, around in zip(patch, normal, near, strict=True)
    ]
    # A patch covers a hexagon about as wide as its points are apart.
    area = np.sqrt(3) / 2 * cell**2 * len(patch)
    rim = float(is_rim.sum()) * cell / (2.0 * np.sqrt(np.pi * area))
    share = len(gap) / max(len(patch), 1)
    layers = f"{100 * share:.0f} % of its points face another layer" if share else "in one layer"
    reason = f"{layers}, its rim is {rim:.1f} times as long as that of a disc"
    if share >= _FACING_SHARE and rim < _SHORT_RIM:
        return FoundClass(kind="shell", thickness=float(np.median(gap)), reason=reason)
    return FoundClass(kind="sheet", thickness=float(np.median(spread)), reason=reason)


def _beside(
    offset: Float[ndarray, "point 3"], direction: Float[ndarray, " 3"], radius: float, least: float
) -> Float[ndarray, " beside"]:
    """Measure how far along a line the points within `radius` of it are, the near ones left out."""
    along = np.abs(offset @ direction)
    is_far = along > least
    along, offset = along[is_far], offset[is_far]
    return along[(offset**2).sum(axis=1) - along**2 < radius**2]


def _spread(value: Float[ndarray, " point"]) -> float:
    """Measure how far apart values are, without the lowest and highest twentieth."""
    ordered = np.sort(value)
    end = round(0.05 * (len(ordered) - 1))
    return float(ordered[len(ordered) - 1 - end] - ordered[end])
