"""Tells where tracks that come into view later were in frame 0, and which tracks slide.

The object is laid onto what was seen of it, frame by frame, before anything is simulated: its nodes
follow tracks and cloud and keep, piece by piece, their shape of frame 0 (as-rigid-as-possible:
Sorkine and Alexa 2007). A track that begins later is bound to where the nodes are then.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.sparse import coo_array, csc_array, diags_array
from scipy.sparse.linalg import splu
from scipy.spatial import KDTree

from physhandi.data.observation import ObjectObservation
from physhandi.fitting.object_problem import TRACK_CARRIERS, attach
from physhandi.fitting.placement import farthest_points
from physhandi.metrics.alignment import carried_points
from physhandi.perception.tracks import motion_validity
from physhandi.rotations import best_rotations

_MOST_NODES = 500
"""Nodes that are laid onto what was seen; of more these are chosen, far from each other."""
_REACH = 2.2
"""Nodes nearer than this keep their distance from each other [distances of nodes]."""
_STIFFNESS = 1.0
"""Weight of the shape beside that of one track, and of one node's part of the cloud."""
_DOUBT = 0.008
"""Distance of a track from where the object carries it from which on it counts less and less in
laying the object [m]."""
SLIDE = 0.016
"""The same distance from which on it slides, and is hidden [m]: no less, since the object follows a
sharp fold with delay."""
_FROM_NODES = 2.0
"""Farthest place beside the nodes at which a track begins [distances of nodes]."""
_FROM_CLOUD = 0.015
"""Farthest place beside the nodes at which a point of the cloud counts [m]."""
_ROUNDS = 6
"""How often rotations and places are found in turn, for each frame."""
_STAY = 1e-3
"""Weight with which nodes that nothing holds stay where they are."""


def with_late_tracks(
    observation: ObjectObservation, node: Float[ndarray, "node 3"], frame_count: int
) -> ObjectObservation:
    """Give tracks that begin later their place in frame 0, and hide tracks where they slide.

    Args:
        observation: What was seen; frames from `frame_count` on say nothing about earlier ones.
        node: Object nodes at frame 0 [m].
        frame_count: Frames onto which the object is laid; later ones are left as they are.

    Returns:
        The observation with late tracks beside the others, all of which are visible at frame 0 at
        their places there (NaN if a track begins beside the object, or later than all this).
        Positions after frame 0 are as observed [m].
    """
    if observation.late is None or observation.node_of_track is not None:
        return observation
    point = np.concatenate([observation.point, observation.late], axis=1).astype(np.float64)
    is_visible = np.asarray(np.isfinite(point).all(axis=2))
    valid = motion_validity(point, is_visible)
    body = _Body(node if len(node) <= _MOST_NODES else node[farthest_points(node, _MOST_NODES)])
    bound = _Tracks(point.shape[1])
    bound.bind(np.flatnonzero(is_visible[0]), point[0, is_visible[0]], body.start)
    for frame in range(1, min(frame_count, len(point))):
        now = np.flatnonzero(is_visible[frame] & bound.is_bound)
        followed = np.flatnonzero(is_visible[frame] & is_visible[frame - 1])
        body.drag(point[frame - 1, followed], point[frame, followed])
        cloud = observation.cloud[frame] if observation.cloud else np.zeros((0, 3))
        body.settle(point[frame, now], bound, now, cloud.astype(np.float64))
        off = np.linalg.norm(point[frame, now] - body.carried(bound, now), axis=1)
        is_visible[frame, now[off > SLIDE]] = False
        new = np.flatnonzero(is_visible[frame] & ~bound.is_bound)
        bound.bind(new, body.place(point[frame, new]), body.start)
    point[0] = bound.start
    is_visible[0] = bound.is_bound
    return replace(
        observation,
        point=np.where(is_visible[..., None], point, np.nan).astype(np.float32),
        is_visible=is_visible,
        is_motion_valid=valid & is_visible,
        late=None,
    )


class _Tracks:
    """Which nodes carry each track, and its place in frame 0."""

    def __init__(self, count: int) -> None:
        self.start = np.full((count, 3), np.nan)
        self.is_bound = np.zeros(count, dtype=bool)
        self.carrier = np.zeros((count, TRACK_CARRIERS), dtype=np.int64)
        self.weight = np.zeros((count, TRACK_CARRIERS))
        self.offset = np.zeros((count, 3))

    def bind(
        self,
        track: Int[ndarray, " new"],
        start: Float[ndarray, "new 3"],
        node: Float[ndarray, "node 3"],
    ) -> None:
        """Bind tracks to the nodes around their places in frame 0; NaN is no place."""
        is_placed = np.asarray(np.isfinite(start).all(axis=1))
        track, start = track[is_placed], start[is_placed]
        carrier, weight, offset = attach(start, node)
        used = slice(carrier.shape[1])
        self.carrier[track, used], self.weight[track, used] = carrier, weight
        self.offset[track] = offset
        self.start[track], self.is_bound[track] = start, True


class _Body:
    """The object's nodes, which follow what was seen and keep their shape piece by piece."""

    def __init__(self, start: Float[ndarray, "node 3"]) -> None:
        """Join the nodes.

        Args:
            start: Nodes at frame 0 [m].
        """
        self.start = start.astype(np.float64)
        self.node = self.start.copy()
        count = len(start)
        self._turn = np.broadcast_to(np.eye(3), (count, 3, 3))
        tree: Any = KDTree(self.start)
        nearest = tree.query(self.start, k=min(2, count))[0]
        self._spacing = float(np.median(np.reshape(nearest, (count, -1))[:, -1]))
        pair = tree.query_pairs(_REACH * self._spacing, output_type="ndarray")
        self._from, self._to = np.concatenate([pair, pair[:, ::-1]]).T
        self._edge = self.start[self._from] - self.start[self._to]
        degree = np.bincount(self._from, minlength=count)
        joined = coo_array(
            (np.full(len(self._from), -1.0), (self._from, self._to)), shape=(count, count)
        )
        self._shape = _STIFFNESS * (joined + diags_array(degree.astype(float)))

    def drag(self, before: Float[ndarray, "track 3"], after: Float[ndarray, "track 3"]) -> None:
        """Move the nodes as the tracks around them moved since the frame before."""
        if not len(before):
            return
        tree: Any = KDTree(before)
        count = min(8, len(before))
        distance, near = tree.query(self.node, k=count)
        weight = (np.reshape(distance, (-1, count)) + 1e-3) ** -2
        weight /= weight.sum(axis=1, keepdims=True)
        near = np.reshape(near, (-1, count))
        self.node = self.node + np.einsum("nk,nki->ni", weight, (after - before)[near])

    def settle(
        self,
        seen: Float[ndarray, "track 3"],
        bound: _Tracks,
        track: Int[ndarray, " track"],
        cloud: Float[ndarray, "point 3"],
    ) -> None:
        """Lay the nodes onto tracks and cloud.

        Args:
            seen: Where the tracks are [m].
            bound: What carries each track.
            track: The tracks, by their numbers.
            cloud: Points of the object [m].
        """
        count = len(self.node)
        row = np.repeat(np.arange(len(track)), bound.carrier.shape[1])
        place = (bound.weight[track].ravel(), (row, bound.carrier[track].ravel()))
        carry = coo_array(place, shape=(len(track), count)).tocsr()
        for _ in range(_ROUNDS):
            self._find_turns()
            offset = self._turned(bound, track)
            off = np.linalg.norm(seen - offset - carry @ self.node, axis=1)
            trusted = carry.multiply((1.0 + (off / _DOUBT) ** 2)[:, None] ** -2).tocsr()
            hold, mean = self._parts_of(cloud)
            hold = hold + _STAY
            turn = self._turn[self._from] + self._turn[self._to]
            pull = 0.5 * _STIFFNESS * np.einsum("eij,ej->ei", turn, self._edge)
            target = _summed(self._from, pull, count)
            target += trusted.T @ (seen - offset) + mean + _STAY * self.node
            matrix = self._shape + trusted.T @ carry + diags_array(hold)
            self.node = splu(csc_array(matrix)).solve(target)

    def carried(self, bound: _Tracks, track: Int[ndarray, " track"]) -> Float[ndarray, "track 3"]:
        """Tell where the nodes carry tracks [m]."""
        at = np.einsum("tc,tci->ti", bound.weight[track], self.node[bound.carrier[track]])
        return at + self._turned(bound, track)

    def place(self, point: Float[ndarray, "point 3"]) -> Float[ndarray, "point 3"]:
        """Tell where points of this frame were in frame 0; NaN for those beside the object [m]."""
        tree: Any = KDTree(self.node)
        is_near = tree.query(point)[0] <= _FROM_NODES * self._spacing
        start = carried_points(point, np.stack([self.node, self.start]))[1]
        return np.where(np.reshape(is_near, (-1, 1)), start, np.nan)

    def _turned(self, bound: _Tracks, track: Int[ndarray, " track"]) -> Float[ndarray, "track 3"]:
        """Turn the ways from carriers to tracks with the node that carries most."""
        turn = self._turn[bound.carrier[track, 0]]
        return np.einsum("tij,tj->ti", turn, bound.offset[track])

    def _find_turns(self) -> None:
        edge = self.node[self._from] - self.node[self._to]
        outer = (edge[:, :, None] * self._edge[:, None, :]).reshape(-1, 9)
        count = len(self.node)
        self._turn = best_rotations(_summed(self._from, outer, count).reshape(count, 3, 3))

    def _parts_of(
        self, cloud: Float[ndarray, "point 3"]
    ) -> tuple[Float[ndarray, " node"], Float[ndarray, "node 3"]]:
        """Give each node the mean of the cloud's points that are nearest to it.

        Returns 1 and the mean [m] for nodes that have points, 0 for others.
        """
        count = len(self.node)
        if not len(cloud):
            return np.zeros(count), np.zeros((count, 3))
        tree: Any = KDTree(self.node)
        distance, nearest = tree.query(cloud)
        is_near = distance < _FROM_CLOUD
        number = np.bincount(nearest[is_near], minlength=count)
        total = _summed(nearest[is_near], cloud[is_near], count)
        return (number > 0).astype(float), total / np.maximum(number, 1)[:, None]


def _summed(
    index: Int[ndarray, " item"], value: Float[ndarray, "item part"], count: int
) -> Float[ndarray, "count part"]:
    """Add up what belongs to each index."""
    parts = [np.bincount(index, weights=column, minlength=count) for column in value.T]
    return np.stack(parts, axis=1)
