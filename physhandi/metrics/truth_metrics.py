"""Distances between a simulated object and its true surface, and how nodes would truly move.

They are measured in the world of the truth and so include the errors of calibration and
synchronisation that observations and fit have in common.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial import KDTree

from physhandi.data.truth import Truth
from physhandi.errors import SequenceError
from physhandi.metrics.geometry import chamfer_one_way
from physhandi.triangles import triangle_areas, triangle_distance

SAMPLE_COUNT = 2000
"""Samples of the true surface."""
CANDIDATES = 12
"""Triangles with the nearest centres among which the point nearest to a node is searched."""
_SEED = 20260


@dataclass(frozen=True, eq=False, kw_only=True)
class TrueSurface:
    """The true surface of an object in every frame, with points that stick to it."""

    point: Float[ndarray, "frame point 3"]
    """Corners of its triangles [m]."""
    face: Int[ndarray, "face 3"]
    """Triangles."""
    sample_face: Int[ndarray, " sample"]
    """Triangle that each sample lies on."""
    sample_weight: Float[ndarray, "sample 3"]
    """Barycentric weights of the triangle's corners."""

    def samples(self, frame: int) -> Float[ndarray, "sample 3"]:
        """Find the samples in a frame [m]."""
        corner = self.point[frame][self.face[self.sample_face]].astype(np.float64)
        return np.einsum("sk,skd->sd", self.sample_weight, corner)

    def picked(self, chosen: Int[ndarray, " chosen"]) -> "TrueSurface":
        """Keep the samples with these numbers, in their order."""
        return TrueSurface(
            point=self.point,
            face=self.face,
            sample_face=self.sample_face[chosen],
            sample_weight=self.sample_weight[chosen],
        )


def true_surface(truth: Truth, count: int = SAMPLE_COUNT) -> TrueSurface | None:
    """Prepare the true surface; None if the recording has none or its area is zero.

    Samples are spread evenly over the area of frame 0 from a fixed seed, and are the same places of
    the object in all frames.

    Args:
        truth: The truth of a recording.
        count: Number of samples.

    Raises:
        SequenceError: If a triangle has a corner that does not exist.
    """
    point, face = truth.object_point, truth.object_face
    if point is None or face is None or not face.size:
        return None
    if face.min() < 0 or face.max() >= point.shape[1]:
        wrong = int(
            np.flatnonzero((face < 0).any(axis=1) | (face >= point.shape[1]).any(axis=1))[0]
        )
        raise SequenceError(
            f"truth/object_face.npy: triangle {wrong} joins the points {face[wrong].tolist()}, but "
            f"truth/object_point.npy has {point.shape[1]}. Repair one of them, or remove both."
        )
    until = np.cumsum(triangle_areas(point[0], face))
    if until[-1] <= 0.0:
        return None
    random = np.random.default_rng(_SEED)
    # One sample in each of as many strips of equal area: more even than independent draws.
    place = (np.arange(count) + random.random(count)) / count * until[-1]
    chosen = np.asarray(np.searchsorted(until, place, side="right"), dtype=np.int64)
    return TrueSurface(
        point=point,
        face=face,
        sample_face=np.minimum(chosen, len(face) - 1),
        sample_weight=random.dirichlet(np.ones(3), size=count),
    )


def truth_curves(
    nodes: Float[ndarray, "frame node 3"], surface: TrueSurface
) -> dict[str, Float[ndarray, " frame"]]:
    """Compare the nodes of an object's surface with the true surface of the same frames.

    Args:
        nodes: Simulated nodes that lie on the surface, finite [m].
        surface: The true surface, of at least as many frames.

    Returns:
        For each frame `chamfer_truth_to_nodes`, the mean distance of the samples to the nearest
        node; `chamfer_nodes_to_truth`, that of the nodes to the nearest point of the surface; and
        `chamfer_truth`, the mean of both [m].
    """
    there = np.array([chamfer_one_way(surface.samples(f), n) for f, n in enumerate(nodes)])
    back = np.array(
        [
            surface_distance(n, surface.point[f][surface.face].astype(np.float64)).mean()
            for f, n in enumerate(nodes)
        ]
    )
    return {
        "chamfer_truth": 0.5 * (there + back),
        "chamfer_truth_to_nodes": there,
        "chamfer_nodes_to_truth": back,
    }


def true_motion(
    node: Float[ndarray, "node 3"], surface: TrueSurface
) -> Float[ndarray, "frame node 3"]:
    """Carry nodes by the true motion [m]: what remains of their errors no fit can avoid.

    Each node is fixed to the triangle that is nearest to it in frame 0: its place along the plane
    stretches with two edges of the triangle, its distance from the plane turns with the normal. A
    rigid motion is followed exactly.

    Args:
        node: Nodes in frame 0, of whatever spacing [m].
        surface: The true surface, which has a triangle with an area.
    """
    mine, own = _held_by(node.astype(np.float64), surface, 0)
    return _carried(mine, own, surface)


def track_truth(
    point: Float[ndarray, "frame track 3"], surface: TrueSurface
) -> Float[ndarray, "frame track 3"]:
    """Find where the surface points that tracks began on truly are in every frame [m].

    A track begins in the first frame in which its place is known, on the point of the plane of the
    nearest triangle that is nearest to it, and has to stay there: what it is off later is an error.

    Args:
        point: Tracks in the world [m]; NaN where not known. One that is never known has no truth.
        surface: The true surface, of at least as many frames.
    """
    is_known = np.isfinite(point).all(axis=-1)
    first, begins = is_known.argmax(axis=0), is_known.any(axis=0)
    truth = np.full(point.shape, np.nan)
    for frame in np.unique(first[begins]):
        tracks = np.flatnonzero(begins & (first == frame))
        mine, own = _held_by(point[frame, tracks].astype(np.float64), surface, int(frame))
        own[:, 2] = 0.0  # On the surface, not as far from it as was measured.
        truth[:, tracks] = _carried(mine, own, surface)[: len(point)]
    return truth


def _held_by(
    place: Float[ndarray, "node 3"], surface: TrueSurface, frame: int
) -> tuple[Int[ndarray, "node 3"], Float[ndarray, "node 3 1"]]:
    """Find the triangle nearest to each place in a frame, and where the place is in its axes."""
    start = surface.point[frame].astype(np.float64)
    face = surface.face[triangle_areas(start, surface.face) > 0.0]
    corner = start[face]
    count = min(CANDIDATES, len(face))
    tree: Any = KDTree(corner.mean(axis=1))
    near = np.reshape(tree.query(place, k=count)[1], (len(place), count))
    nearest = triangle_distance(place[:, None], corner[near]).argmin(axis=1)
    mine = face[near[np.arange(len(place)), nearest]]
    origin, axes = _frames(start[mine])
    return mine, np.linalg.solve(axes, (place - origin)[..., None])


def _carried(
    mine: Int[ndarray, "node 3"], own: Float[ndarray, "node 3 1"], surface: TrueSurface
) -> Float[ndarray, "frame node 3"]:
    moved = np.empty((len(surface.point), len(mine), 3))
    for number, point in enumerate(surface.point):
        origin, axes = _frames(point[mine].astype(np.float64))
        moved[number] = origin + (axes @ own)[..., 0]
    return moved


def _frames(
    corner: Float[ndarray, "node 3 3"],
) -> tuple[Float[ndarray, "node 3"], Float[ndarray, "node 3 3"]]:
    """Return the first corner of each triangle, and as columns two edges and the unit normal."""
    origin = corner[:, 0]
    first, second = corner[:, 1] - origin, corner[:, 2] - origin
    normal = np.cross(first, second)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    return origin, np.stack([first, second, normal], axis=2)


def surface_distance(
    point: Float[ndarray, "point 3"], triangle: Float[ndarray, "face 3 3"]
) -> Float[ndarray, " point"]:
    """Measure how far each point is from a surface [m].

    Only the `CANDIDATES` triangles with the nearest centres are looked at: that is exact unless a
    surface has triangles of very different size or shape beside each other; then it is too large
    by less than a triangle.

    Args:
        point: Points [m].
        triangle: Corners of all triangles [m].
    """
    count = min(CANDIDATES, len(triangle))
    tree: Any = KDTree(triangle.mean(axis=1))
    near = np.reshape(tree.query(point, k=count)[1], (len(point), count))
    return triangle_distance(point[:, None], triangle[near]).min(axis=1)
