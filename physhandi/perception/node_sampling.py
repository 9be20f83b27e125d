"""Samples nodes over an object's cloud: along a flat sheet, along any surface, or through a solid.

* A *flat sheet* gets a grid in its own plane, lifted to its height.
* Any other *surface* (a sheet that hangs, bends or is folded, a shell, a rope) gets nodes evenly
  along itself. They lie among the points that were seen, because losses compare with those: nodes
  on the centre line of a rope would start half its thickness away.
* A *solid* gets a voxel grid, filled from its top down to the ground, or to its lowest seen point.
* With a *mesh* of the whole object, parts of its surface that nothing was seen of get nodes evenly
  along themselves, and a solid is filled where the mesh says that it is.

Gaps in a surface are closed where the hand may hide it: where no view sees past the object, or,
without masks, where they are no wider than `MAX_GAP`. Limits without a mesh: overhangs of a solid
are filled, and what no view sees beside its outline is not invented.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.ndimage import binary_closing, binary_fill_holes
from scipy.spatial import ConvexHull, Delaunay, KDTree, QhullError

from physhandi.perception.object_points import WIDEST_GAP, WIDEST_HIDDEN_GAP
from physhandi.perception.shape_class import (
    STANDING_HEIGHT,
    HiddenTest,
    pieces,
    poisson_disk_points,
    rim_points,
)
from physhandi.rotations import unit
from physhandi.triangles import SurfaceSamples
from physhandi.unique_rows import unique_rows

MAX_GAP = 0.04
"""Widest gap in a surface that is closed without knowing whether a hand hides it [m]."""
_LEAST_FILL = 0.25
"""Points of an occupied cell, as a share of the median over cells."""
_SMOOTHED = 13
"""Points over which a sheet's height is smoothed."""
_FLAT_THICKNESS = 1.5
"""Largest relief of a flat sheet, in distances between nodes."""
_PACKING = 0.8
"""Least distance of nodes on a surface, in distances between nodes: then each is about one such
distance away from those around it."""
_LARGEST_LEAN = 0.6
"""Sine of the largest angle between a surface and the way across a gap in it."""
_LEAST_APART = 0.6
"""Distance below which a drawn filling is dropped beside another node, in the same."""
_AROUND = 7
"""Nodes about which a filling is drawn smooth, itself included."""
_DRAWN = 20
"""Times that it is."""
_UPRIGHT = 0.95
"""Sine of the steepest slope of a tube that has an upper half."""
_TOUCHING = 1.6
"""Distance up to which nodes on a surface are beside each other, in distances between nodes."""


def is_flat(cloud: Float[ndarray, "point 3"], spacing: float) -> bool:
    """Whether a cloud is wide and lies in a plane, its outermost points left out."""
    local = cloud - cloud.mean(axis=0)
    axes = np.linalg.svd(local, full_matrices=False)[2]
    if len(axes) < 3:
        return False
    low, high = np.percentile(local @ axes.T, [2, 98], axis=0)
    _, width, thickness = high - low
    return bool(thickness < _FLAT_THICKNESS * spacing and thickness < max(0.02, width))


def flat_sheet_nodes(
    cloud: Float[ndarray, "point 3"], spacing: float, is_hidden: HiddenTest | None
) -> Float[ndarray, "node 3"]:
    """Sample a grid in the plane of a sheet and lift it to the sheet's height.

    Args:
        cloud: Points on the sheet [m].
        spacing: Edge of the grid's cells [m].
        is_hidden: Where the sheet may continue unseen. Without it only gaps up to `MAX_GAP` and
            holes enclosed on all sides are filled.
    """
    center = cloud.mean(axis=0)
    normal = np.linalg.svd(cloud - center, full_matrices=False)[2][2]
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
    long = unit(sides[int(np.argmax(np.linalg.norm(sides, axis=1)))].astype(np.float64))
    long = long if long[np.argmax(np.abs(long))] > 0 else -long
    length = long[0] * first + long[1] * second
    return np.stack([length, np.cross(normal, length), normal])


def _heights(local: Float[ndarray, "point 3"], grid: Float[ndarray, "cell 2"]) -> ndarray:
    """Interpolate the sheet's height over its plane, and continue it level beyond the cloud.

    Each point first takes the median height of those around it: beside a hand, masks let some of
    the hand's points through.
    """
    from scipy.interpolate import griddata

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


def surface_nodes(
    cloud: Float[ndarray, "point 3"], spacing: float, is_hidden: HiddenTest | None
) -> Float[ndarray, "node 3"]:
    """Sample nodes evenly along a sheet or shell of any shape, and close the gaps in it.

    Args:
        cloud: Points on the surface [m].
        spacing: Distance between neighbouring nodes [m].
        is_hidden: Where the surface may continue unseen.
    """
    node = poisson_disk_points(cloud, _PACKING * spacing)
    is_rim, normal = rim_points(node, _TOUCHING * spacing)
    edge = np.flatnonzero(is_rim)
    if len(edge) < 2:
        return node
    tree = KDTree(node)
    widest = MAX_GAP if is_hidden is None else WIDEST_GAP
    pair, across, length = _gaps(node, edge, spacing, widest)
    # What lies off the surface at either end is another layer of it.
    run = across / length[:, None]
    lean = np.abs((normal[pair] * run[:, None]).sum(axis=2)).max(axis=1)
    # Most ways end right beside another node already, which saves laying the whole bridge.
    step = np.minimum(spacing, 0.5 * length)[:, None] * run
    is_open = lean < _LARGEST_LEAN
    for start in (node[pair[:, 0]] + step, node[pair[:, 1]] - step):
        is_open[is_open] = tree.query(start[is_open])[0] >= _PACKING * spacing
    pair, across, length = (part[is_open] for part in (pair, across, length))
    bridges, owner = _bridges(node, pair, across, length, spacing)
    is_open = np.ones(len(pair), dtype=bool)
    beside = tree.query(bridges)[0] < _PACKING * spacing
    np.logical_and.at(is_open, owner, ~beside)
    if is_hidden is not None and len(bridges):
        np.logical_and.at(is_open, owner, is_hidden(bridges))
    order = np.lexsort((owner, length[owner]))
    order = order[is_open[owner[order]]]
    if len(order) == 0:
        return node
    ends = normal[pair[owner[order]]]
    along = unit(ends[:, 0] + ends[:, 1] * np.sign((ends[:, :1] * ends[:, 1:]).sum(axis=2)))
    return np.concatenate([node, _filling(node, bridges[order], along, spacing)])


def _filling(
    node: Float[ndarray, "node 3"],
    bridge: Float[ndarray, "bridge 3"],
    normal: Float[ndarray, "bridge 3"],
    spacing: float,
) -> Float[ndarray, "filling 3"]:
    """Choose one layer of the points that lie on bridges, and draw it smooth.

    Bridges in different directions across a hole in a curved surface pass each other at a distance.

    Args:
        node: Nodes around the gaps [m].
        bridge: Points on the bridges, the surest first [m].
        normal: Direction of the surface's normal at each; zero if it is not known.
        spacing: Distance between neighbouring nodes [m].
    """
    chosen: list[int] = []
    for index, (point, axis) in enumerate(zip(bridge, normal, strict=True)):
        offset = bridge[chosen] - point
        beside = offset - np.outer(offset @ axis, axis)
        is_near = (beside**2).sum(axis=1) < (_PACKING * spacing) ** 2
        if not (is_near & ((offset**2).sum(axis=1) < MAX_GAP**2)).any():
            chosen.append(index)
    filling, axis = bridge[chosen].copy(), normal[chosen]
    count = min(_AROUND, len(node) + len(filling))
    for _ in range(_DRAWN):
        every = np.concatenate([node, filling])
        near = KDTree(every).query(filling, k=count)[1]
        pull = every[np.reshape(near, (len(filling), count))].mean(axis=1) - filling
        filling += (pull * axis).sum(axis=1, keepdims=True) * axis
    least = _LEAST_APART * spacing
    filling = filling[KDTree(node).query(filling)[0] >= least]
    is_kept = np.ones(len(filling), dtype=bool)
    for first, second in sorted(KDTree(filling).query_pairs(least)):
        is_kept[second] &= not is_kept[first]
    return filling[is_kept]


def rope_nodes(
    cloud: Float[ndarray, "point 3"],
    spacing: float,
    thickness: float,
    is_hidden: HiddenTest | None,
) -> Float[ndarray, "node 3"]:
    """Sample nodes evenly along the seen side of a rope, and join its pieces straight.

    What joins them has the rope's thickness, as the rest has: springs along a line do not resist
    bending, and it is where hands hold a rope that it is hidden.

    Args:
        cloud: Points on the rope [m].
        spacing: Distance between neighbouring nodes [m].
        thickness: Diameter of the rope [m].
        is_hidden: Where the rope may continue unseen.
    """
    node = poisson_disk_points(cloud, _PACKING * spacing)
    piece = pieces(node, _TOUCHING * spacing)
    widest = WIDEST_GAP if is_hidden is None else WIDEST_HIDDEN_GAP
    pair, across, length = _gaps(node, np.arange(len(node)), spacing, widest)
    is_between = piece[pair[:, 0]] != piece[pair[:, 1]]
    pair, across, length = (part[is_between] for part in (pair, across, length))
    bridges, owner = _bridges(node, pair, across, length, spacing)
    is_open = np.ones(len(pair), dtype=bool)
    if is_hidden is not None and len(bridges):
        np.logical_and.at(is_open, owner, is_hidden(bridges))
    lines = int(0.5 * np.pi * thickness / (_PACKING * spacing)) + 1
    added = [node]
    for index in np.flatnonzero(is_open)[np.argsort(length[is_open], kind="stable")]:
        first, second = piece[pair[index]]
        if first != second:
            piece[piece == second] = first
            bridge = bridges[owner == index]
            if lines > 2 and length[index] > thickness:
                bridge = _half_tube(node, node[pair[index]], len(bridge), thickness, lines)
            added.append(bridge)
    return np.concatenate(added)


def _half_tube(
    node: Float[ndarray, "node 3"],
    end: Float[ndarray, "2 3"],
    count: int,
    thickness: float,
    lines: int,
) -> Float[ndarray, "filling 3"]:
    """Lay the upper half of a straight tube from one end of a gap in a rope to the other.

    Args:
        node: Nodes on the rope [m].
        end: Those at both ends of the gap [m].
        count: Number of nodes along the tube.
        thickness: Its diameter [m].
        lines: Number of nodes around it.
    """
    axis = (end[1] - end[0]) / np.linalg.norm(end[1] - end[0])
    upward = np.eye(3)[0 if abs(axis[2]) > _UPRIGHT else 2]
    upward = upward - (upward @ axis) * axis
    upward /= np.linalg.norm(upward)
    sideways = np.cross(axis, upward)

    def top_near(place: Float[ndarray, " 3"]) -> Float[ndarray, " 3"]:
        around = node[np.linalg.norm(node - place, axis=1) < thickness] - place
        return place + (around @ sideways).mean() * sideways + (around @ upward).max() * upward

    first, last = (top_near(place) for place in end)
    share = np.linspace(0.0, 1.0, count + 2)[1:-1, None, None]
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, lines)[:, None]
    around = (np.cos(angle) - 1.0) * upward + np.sin(angle) * sideways
    return ((1.0 - share) * first + share * last + 0.5 * thickness * around).reshape(-1, 3)


def _gaps(
    node: Float[ndarray, "node 3"], edge: Int[ndarray, " edge"], spacing: float, widest: float
) -> tuple[Int[ndarray, "gap 2"], Float[ndarray, "gap 3"], Float[ndarray, " gap"]]:
    """Find the pairs of nodes with a gap between them: who they are, the way across, its length."""
    pair = edge[KDTree(node[edge]).query_pairs(widest, output_type="ndarray")]
    across = node[pair[:, 1]] - node[pair[:, 0]]
    length = np.linalg.norm(across, axis=1)
    is_gap = length > _TOUCHING * spacing
    return pair[is_gap], across[is_gap], length[is_gap]


def _bridges(
    node: Float[ndarray, "node 3"],
    pair: Int[ndarray, "gap 2"],
    across: Float[ndarray, "gap 3"],
    length: Float[ndarray, " gap"],
    spacing: float,
) -> tuple[Float[ndarray, "bridge 3"], Int[ndarray, " bridge"]]:
    """Lay evenly spaced points across gaps, and tell the gap of each."""
    count = np.ceil(length / spacing).astype(np.int64) - 1
    owner = np.repeat(np.arange(len(pair)), count)
    number = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count) + 1
    share = number / (count[owner] + 1.0)
    return node[pair[owner, 0]] + share[:, None] * across[owner], owner


def solid_nodes(
    cloud: Float[ndarray, "point 3"], spacing: float, ground_height: float | None
) -> Float[ndarray, "node 3"]:
    """Sample the surface on a voxel grid and fill every column below its top.

    Args:
        cloud: Points on the surface [m].
        spacing: Edge of a voxel [m].
        ground_height: Height below which there is nothing [m].
    """
    origin, key, surface = _surface_voxels(cloud, spacing, ground_height)
    column, _, of_column, _ = unique_rows(key[:, :2])
    top = np.zeros(len(column), dtype=np.int64)
    np.maximum.at(top, of_column, key[:, 2])
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


def _surface_voxels(
    cloud: Float[ndarray, "point 3"], spacing: float, ground_height: float | None
) -> tuple[Float[ndarray, " 3"], Int[ndarray, "voxel 3"], Float[ndarray, "voxel 3"]]:
    """Average the points in each voxel: corner of the grid, voxels, and the mean in each [m]."""
    low = cloud.min(axis=0)
    stands = ground_height is not None and low[2] - ground_height < STANDING_HEIGHT
    floor = ground_height if stands and ground_height is not None else low[2]
    origin = np.array([low[0], low[1], floor])
    voxel = np.floor((cloud - origin) / spacing).astype(np.int64)
    key, _, owner, count = unique_rows(voxel)
    total = [np.bincount(owner, weights=cloud[:, axis]) for axis in range(3)]
    return origin, key, np.stack(total, axis=1) / count[:, None]


def meshed_solid_nodes(
    cloud: Float[ndarray, "point 3"],
    spacing: float,
    ground_height: float | None,
    mesh: SurfaceSamples,
) -> Float[ndarray, "node 3"]:
    """Sample the seen surface on a voxel grid, and what a mesh says of the rest of a solid.

    Args:
        cloud: Points on the surface [m].
        spacing: Edge of a voxel [m].
        ground_height: Height below which there is nothing [m].
        mesh: Samples of the whole surface in the same place [m].
    """
    origin, _, seen = _surface_voxels(cloud, spacing, ground_height)
    surface = np.concatenate([seen, unseen_surface_nodes(seen, mesh, spacing)])
    low = np.floor((mesh.point.min(axis=0) - origin) / spacing).astype(np.int64)
    high = np.ceil((mesh.point.max(axis=0) - origin) / spacing).astype(np.int64)
    voxel = low + np.indices(tuple(high - low)).reshape(3, -1).T
    middle = origin + (voxel + 0.5) * spacing
    # Beside the surface a node is on it already, and winding numbers of samples are not sure.
    middle = middle[KDTree(surface).query(middle)[0] >= _LEAST_APART * spacing]
    return np.concatenate([surface, middle[np.abs(mesh.winding_number(middle)) > 0.5]])


def unseen_surface_nodes(
    node: Float[ndarray, "node 3"], mesh: SurfaceSamples, spacing: float
) -> Float[ndarray, "unseen 3"]:
    """Sample nodes evenly along those parts of a mesh that are farther than `spacing` from others.

    Args:
        node: Nodes that come from what was seen [m].
        mesh: Samples of the whole surface in the same place [m].
        spacing: Distance between neighbouring nodes [m].
    """
    unseen = mesh.point[KDTree(node).query(mesh.point)[0] > spacing]
    if len(unseen) == 0:
        return unseen
    unseen = poisson_disk_points(unseen, _PACKING * spacing)
    return unseen[KDTree(node).query(unseen)[0] >= _LEAST_APART * spacing]
