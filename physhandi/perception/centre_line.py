"""Finds the lines along which thin things run in a cloud, as principal curves.

A principal curve passes through the middle of the points that are nearest to it (Hastie and
Stuetzle 1989). It begins here as the longest path of the cloud's minimum spanning tree, which
follows a thin thing from end to end wherever it does not touch itself, and is drawn anew a few
times: a local linear regression over the length along it, in which points far off count less.
Noise does not lengthen it, since it is smooth over a cell.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra, minimum_spanning_tree
from scipy.spatial import KDTree

from physhandi.perception.shape_class import links

_REACH = 3.0
"""Widest gap within a piece, in cells."""
_LEAST_POINTS = 12
"""Points of the smallest piece that gets a line."""
_SHORTEST = 2.0
"""Least length of a line, in cells."""
_LONG = 4.0
"""Least length of a line, in widths of its piece: else nothing tells in which way it runs."""
_ROUNDS = 6
_STEP = 0.5
"""Distance between corners of a line, in cells."""
_INSET = 1.0
"""Distance from an end up to which a line is straight, in cells: few points are there."""
_OUTER = 2
"""Points that may lie beyond an end at least, as noise moves some out."""
_BEYOND, _INNER = 0.5, 4.0
"""Length on which there are as many points as may lie beyond an end, and that on which they are
counted, in cells."""
_STRAY = 2.0
"""Distance from the line from which points count less, in medians of that distance."""
_OFF = 2.5
"""Distance from which they are not the line's, in medians."""
_MOST_OFF = 0.1
"""Share of such points from which a piece is no line."""
_NEAR = 1.5
"""Distance between two places of a line from which it touches itself, in cells; places that are not
four times as far from each other along it are neighbors."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CentreLine:
    """The middle of a piece of a thin thing, from one end of it to the other."""

    corner: Float[ndarray, "corner 3"]
    """Corners of the line [m]."""
    arc: Float[ndarray, " corner"]
    """Length along the line up to each corner [m], 0 at the first end of the piece; the line goes
    on a little beyond both ends."""
    length: float
    """Length at the other end [m]."""

    def at(self, arc: Float[ndarray, " place"]) -> Float[ndarray, "place 3"]:
        """Find the places at lengths along the line [m]; its first and last part go on straight."""
        part = np.clip(np.searchsorted(self.arc, arc, side="right") - 1, 0, len(self.arc) - 2)
        share = (arc - self.arc[part]) / (self.arc[part + 1] - self.arc[part])
        return self.corner[part] + share[:, None] * (self.corner[part + 1] - self.corner[part])

    def arc_of(self, point: Float[ndarray, "place 3"]) -> Float[ndarray, " place"]:
        """Find the lengths at which the line is nearest to points [m]."""
        return _nearest(self.corner, self.arc, point)[0]


def centre_lines(cloud: Float[ndarray, "point 3"], cell: float) -> tuple[CentreLine, ...]:
    """Find the centre lines of the pieces of a thin thing.

    Args:
        cloud: Points on its seen surface [m].
        cell: Length at which the cloud has no holes between its points [m].

    Returns:
        A line for each piece that is one, longest first. A piece that branches, crosses or touches
        itself, is knotted or closed, is short or has few points gets none: lengths along it are
        not known.
    """
    if len(cloud) < _LEAST_POINTS:
        return ()
    graph = links(cloud, _REACH * cell).tocsr()
    graph.data = np.maximum(graph.data, 1e-9)  # A stored zero joins nothing.
    label = connected_components(graph, directed=False)[1]
    lines: list[CentreLine] = []
    for piece in np.unique(label):
        own = np.flatnonzero(label == piece)
        if len(own) >= _LEAST_POINTS:
            line = _line(cloud[own], graph[own][:, own], cell)
            if line is not None:
                lines.append(line)
    return tuple(sorted(lines, key=lambda line: -line.length))


def _line(cloud: Float[ndarray, "point 3"], graph: csr_array, cell: float) -> CentreLine | None:
    """Draw the line of a connected piece, if it is one."""
    place, along = _longest_path(cloud, graph)
    weight = np.ones(len(place))
    off, corner, arc = np.zeros(0), np.zeros((0, 3)), np.zeros(0)
    for _ in range(_ROUNDS):
        start, end = _ends(along, weight, cell)
        if end - start < _SHORTEST * cell:
            return None
        inset = min(_INSET * cell, 0.25 * (end - start))
        count = max(5, round((end - start - 2 * inset) / (_STEP * cell)) + 1)
        at = np.linspace(start + inset, end - inset, count)
        corner = _prolonged(_regression(place, along, weight, at, cell), 1.5 * cell + inset)
        arc = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(corner, axis=0), axis=1)))
        place = cloud
        along, off = _nearest(corner, arc, place)
        weight = 1.0 / np.maximum(1.0, off / (_STRAY * float(np.median(off)))) ** 2
    start, end = _ends(along, weight, cell)
    is_off = off > max(_OFF * float(np.median(off)), cell)
    width = 2.0 * float(np.percentile(off, 90))
    if is_off.mean() > _MOST_OFF or end - start < max(_LONG * width, _SHORTEST * cell):
        return None
    if _touches_itself(corner, arc, cell):
        return None
    return CentreLine(corner=corner, arc=arc - start, length=end - start)


def _longest_path(
    cloud: Float[ndarray, "point 3"], graph: csr_array
) -> tuple[Float[ndarray, "place 3"], Float[ndarray, " place"]]:
    """Follow the minimum spanning tree between its farthest ends: places, lengths up to them."""
    tree = minimum_spanning_tree(graph)
    first = int(dijkstra(tree, directed=False, indices=0).argmax())
    away, before = dijkstra(tree, directed=False, indices=first, return_predecessors=True)
    path = [int(away.argmax())]
    while path[-1] != first:
        path.append(int(before[path[-1]]))
    return cloud[path[::-1]], away[path[::-1]]


def _ends(
    along: Float[ndarray, " point"], weight: Float[ndarray, " point"], cell: float
) -> tuple[float, float]:
    """Tell between which lengths the points of a line are.

    A mask that is a pixel too long adds a few points of the background at once, centimetres behind
    the end but beside it for the camera. So an end is not where the last points are but where these
    few would end if they lay as densely as those before them.
    """
    points = along[weight > 0.25]
    return _first(np.sort(points), cell), -_first(np.sort(-points), cell)


def _first(ordered: Float[ndarray, " point"], cell: float) -> float:
    """Find where sorted lengths begin."""
    outer = min(_OUTER, (len(ordered) - 1) // 2)
    inner = ordered[outer] + np.array([_BEYOND, _BEYOND + _INNER]) * cell
    low, high = np.searchsorted(ordered, inner)
    density = max(high - low, 1) / (_INNER * cell)
    beyond = int(np.clip(round(_BEYOND * cell * density), outer, max(outer, len(ordered) // 4)))
    return float(ordered[beyond] - beyond / density)


def _regression(
    place: Float[ndarray, "point 3"],
    along: Float[ndarray, " point"],
    weight: Float[ndarray, " point"],
    at: Float[ndarray, " corner"],
    radius: float,
) -> Float[ndarray, "corner 3"]:
    """Smooth places by local linear regression over a Gaussian of the length along the line."""
    away = along - at[:, None]
    share = np.exp(-0.5 * (away / radius) ** 2) * weight
    return local_regression(away, share, 1e-12 * radius**2) @ place


def local_regression(
    away: Float[ndarray, "place value"], share: Float[ndarray, "place value"], least_spread: float
) -> Float[ndarray, "place value"]:
    """Find how much values count for lines that are laid through them, at one place each.

    Args:
        away: How far values are from each place.
        share: How much they count there.
        least_spread: Variance of these distances up to which they tell no slope: then the line is
            level.
    """
    total, first, second = ((share * away**power).sum(axis=1) for power in range(3))
    spread = total * second - first**2
    is_slope = spread > least_spread * total**2
    slope = np.where(is_slope, first, 0.0)[:, None]
    height = np.where(is_slope, second, 1.0)[:, None]
    scale = np.where(is_slope, spread, total)[:, None]
    return (height - slope * away) * share / np.maximum(scale, 1e-300)


def _prolonged(corner: Float[ndarray, "corner 3"], length: float) -> Float[ndarray, "longer 3"]:
    """Let both ends go on straight, as they run over the last four parts."""
    first, last = corner[0] - corner[4], corner[-1] - corner[-5]
    before = corner[0] + length * first / np.linalg.norm(first)
    after = corner[-1] + length * last / np.linalg.norm(last)
    return np.concatenate([before[None], corner, after[None]])


def _nearest(
    corner: Float[ndarray, "corner 3"],
    arc: Float[ndarray, " corner"],
    point: Float[ndarray, "place 3"],
) -> tuple[Float[ndarray, " place"], Float[ndarray, " place"]]:
    """Find where a line is nearest to points: the length along it, and how far they are [m]."""
    start, run = corner[:-1], np.diff(corner, axis=0)
    # Corners lie so close that the nearest place is beside the nearest one.
    beside = KDTree(corner).query(point)[1][:, None] - np.array([1, 0])
    beside = np.clip(beside, 0, len(run) - 1)
    away = point[:, None] - start[beside]
    share = (away * run[beside]).sum(axis=2) / (run[beside] ** 2).sum(axis=2)
    share = np.clip(share, 0.0, 1.0)
    off = np.linalg.norm(away - share[..., None] * run[beside], axis=2)
    row, best = np.arange(len(point)), off.argmin(axis=1)
    part = beside[row, best]
    return arc[part] + share[row, best] * np.diff(arc)[part], off[row, best]


def _touches_itself(
    corner: Float[ndarray, "corner 3"], arc: Float[ndarray, " corner"], cell: float
) -> bool:
    pair = KDTree(corner).query_pairs(_NEAR * cell, output_type="ndarray")
    return bool((np.abs(arc[pair[:, 0]] - arc[pair[:, 1]]) > 4.0 * _NEAR * cell).any())
