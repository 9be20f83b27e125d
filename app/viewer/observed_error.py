"""How far an object's nodes are from what was observed in the same frame."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.spatial import KDTree  # pyright: ignore[reportMissingTypeStubs]  # it has none

from app.viewer.content import Content
from app.viewer.difference import surface_difference
from app.viewer.take import Take
from physhandi.metrics.alignment import carried_points

_SHARERS = 4
"""Tracks that tell the error of a node."""
_REACH = 3.0
"""They are not farther from it than this many typical distances between nodes."""
_MOST_POINTS = 3_000


class ObservedError:
    """Errors of nodes and of observed points, of any rollout of one content's object.

    With tracks, the error of a track is the distance to the place that the nodes around it carry
    along, as the metric ``track_error`` has it, and a node has the mean of the tracks around it.
    Without, the error of a node is the distance to the nearest observed point, and that of an
    observed point the distance to the object's surface.
    """

    def __init__(self, content: Content) -> None:
        self._content = content
        tracks, fitted = content.tracks, content.fitted
        self._tracks = tracks
        self._known: Int[ndarray, " known"] = np.zeros(0, np.int64)
        if tracks is None or fitted is None:
            return
        self._known = np.flatnonzero(tracks.is_visible[0])
        start = np.asarray(fitted.position[0], dtype=np.float64)
        place = np.asarray(tracks.point[0, self._known], dtype=np.float64)
        if len(place) == 0:
            self._tracks = None
            return
        count = min(_SHARERS, len(place))
        tree: Any = KDTree(place)
        distance, near = tree.query(start, k=count)
        self._near = np.reshape(near, (-1, count))
        self._is_near = np.reshape(distance, (-1, count)) <= _REACH * _pitch(start)

    @property
    def is_known(self) -> bool:
        """Whether there is anything to compare with."""
        return self._tracks is not None or self._content.observed is not None

    @property
    def source(self) -> str:
        """What it is a distance from."""
        if self._tracks is None:
            return "the nearest observed point"
        return self._tracks.name

    def nodes(self, take: Take, frame: int) -> Float[ndarray, " node"]:
        """Measure the error of each node [m]; NaN where nothing was observed."""
        if self._tracks is None:
            return self._from_points(take, frame)
        error, is_seen = self.tracks(take, frame)
        if len(self._near) != take.model.node_count:
            return np.full(take.model.node_count, np.nan)
        counts = self._is_near & is_seen[self._near]
        total = np.where(counts, error[self._near], 0.0).sum(axis=1)
        number = counts.sum(axis=1)
        return np.where(number > 0, total / np.maximum(number, 1), np.nan)

    def tracks(
        self, take: Take, frame: int
    ) -> tuple[Float[ndarray, " known"], Bool[ndarray, " known"]]:
        """Measure the error of each track that frame 0 shows [m], and tell whether it is seen."""
        tracks, known = self._tracks, self._known
        if tracks is None or frame >= len(tracks.point):
            return np.full(len(known), np.nan), np.zeros(len(known), dtype=bool)
        point = np.asarray(tracks.point[frame, known], dtype=np.float64)
        is_seen = np.asarray(tracks.is_visible[frame, known]) & np.isfinite(point).all(axis=1)
        if tracks.node is not None:
            predicted = np.asarray(take.position[frame], dtype=np.float64)[tracks.node[known]]
        else:
            both = np.stack([take.position[0], take.position[frame]]).astype(np.float64)
            start = np.asarray(tracks.point[0, known], dtype=np.float64)
            predicted = carried_points(start, both)[1]
        return np.linalg.norm(point - predicted, axis=1), is_seen

    def points(
        self, point: Float[ndarray, "point 3"], take: Take, frame: int
    ) -> Float[ndarray, " point"]:
        """Measure how far observed points are from the object's surface [m]."""
        node = np.asarray(take.position[frame], dtype=np.float64)
        if len(point) == 0:
            return np.zeros(0)
        return surface_difference(np.asarray(point, dtype=np.float64), node)

    def _from_points(self, take: Take, frame: int) -> Float[ndarray, " node"]:
        observed = self._content.observed
        point = observed.points(frame) if observed is not None else np.zeros((0, 3))
        if len(point) == 0:
            return np.full(take.model.node_count, np.nan)
        tree: Any = KDTree(point[:: max(1, len(point) // _MOST_POINTS)])
        distance, _ = tree.query(np.asarray(take.position[frame], dtype=np.float64))
        return np.asarray(distance, dtype=np.float64)


def _pitch(node: Float[ndarray, "node 3"]) -> float:
    """Measure how far a node typically is from the nearest other one [m]."""
    if len(node) < 2:
        return np.inf
    tree: Any = KDTree(node)
    return float(np.median(tree.query(node, k=2)[0][:, 1]))
