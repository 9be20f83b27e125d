"""Baseline predictions: static object, rigid motion with the hands, last residual."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.spatial import KDTree

from physhandi.metrics.alignment import CARRIERS, carried_points, rigid_transform


def static_baseline(
    object_node: Float[ndarray, "node 3"], frame_count: int
) -> Float[ndarray, "frame node 3"]:
    """Keep the object in its state of frame 0 [m]."""
    return np.broadcast_to(object_node, (frame_count, *object_node.shape))


def rigid_follow_baseline(
    object_node: Float[ndarray, "node 3"], control: Float[ndarray, "frame control 3"]
) -> Float[ndarray, "frame node 3"]:
    """Move the object of frame 0 rigidly with the control nodes [m]."""
    start = control[0].astype(np.float64)
    moved = np.empty((len(control), *object_node.shape))
    for frame, nodes in enumerate(control.astype(np.float64)):
        rotation, translation = rigid_transform(start, nodes)
        moved[frame] = object_node @ rotation.T + translation
    return moved


def last_residual_baseline(
    rollout: Float[ndarray, "frame node 3"],
    point: Float[ndarray, "frame track 3"],
    is_visible: Bool[ndarray, "frame track"],
    first_future: int,
    node_of_track: Int[ndarray, " track"] | None = None,
    *,
    continued_from: Float[ndarray, "node 3"] | None = None,
) -> Float[ndarray, "frame node 3"]:
    """Shift the predicted frames of a rollout by its residual in the last observed frame [m].

    Args:
        rollout: Simulated nodes [m].
        point: Observed tracks [m].
        is_visible: Whether a track is visible.
        first_future: First frame that was held out; only frames before it are read.
        node_of_track: Node that each track observes; None lets the nodes around it carry it.
        continued_from: State of the last observed frame from which the predicted ones were
            simulated, if it is not the rollout's own: their residual is this state's [m].

    Returns:
        The rollout as it is up to `first_future`; from there on every node is shifted by the
        `last_residual`.

    Raises:
        ValueError: If there is no frame before `first_future`, or the last one shows no track
            whose place on the object is known.
    """
    if not 0 < first_future <= len(rollout):
        raise ValueError(f"first_future is {first_future} of {len(rollout)} frames")
    last = first_future - 1
    now = rollout[last] if continued_from is None else continued_from
    corrected = rollout.astype(np.float64)
    corrected[first_future:] += last_residual(
        rollout[0], now, point, is_visible, last, node_of_track
    )
    return corrected


def last_residual(  # noqa: PLR0917  (the object at two times, then what was seen of it)
    start: Float[ndarray, "node 3"],
    now: Float[ndarray, "node 3"],
    point: Float[ndarray, "frame track 3"],
    is_visible: Bool[ndarray, "frame track"],
    frame: int,
    node_of_track: Int[ndarray, " track"] | None = None,
) -> Float[ndarray, "node 3"]:
    """Interpolate over the nodes what a frame's tracks are away from where the nodes put them [m].

    Args:
        start: Nodes in frame 0 [m].
        now: Nodes in the frame [m].
        point: Observed tracks [m].
        is_visible: Whether a track is visible.
        frame: The frame.
        node_of_track: Node that each track observes; None lets the nodes around it carry it.

    Returns:
        For each node the mean residual of the eight tracks nearest to it in frame 0, weighted by
        inverse distance.

    Raises:
        ValueError: If the frame shows no track whose place on the object is known.
    """
    anchor, residual = track_residuals(start, now, point, is_visible, frame, node_of_track)
    return Spread(start, anchor).over_nodes(residual)


class Spread:
    """Interpolates over nodes what is known at places; made once for the same of both."""

    def __init__(self, node: Float[ndarray, "node 3"], place: Float[ndarray, "place 3"]) -> None:
        """Find the eight places nearest to each node, weighted by inverse distance."""
        tree: Any = KDTree(place)
        count = min(CARRIERS, len(place))
        distance, near = tree.query(node.astype(np.float64), k=count)
        self._near = np.reshape(near, (-1, count))
        self._weight = 1.0 / (np.reshape(distance, (-1, count)) + 1e-6)
        self._weight /= self._weight.sum(axis=1, keepdims=True)

    def over_nodes(self, value: Float[ndarray, "place 3"]) -> Float[ndarray, "node 3"]:
        """Interpolate a value of each place."""
        return np.einsum("nc,nci->ni", self._weight, value[self._near])


def track_residuals(  # noqa: PLR0917  (the object at two times, then what was seen of it)
    start: Float[ndarray, "node 3"],
    now: Float[ndarray, "node 3"],
    point: Float[ndarray, "frame track 3"],
    is_visible: Bool[ndarray, "frame track"],
    frame: int,
    node_of_track: Int[ndarray, " track"] | None = None,
) -> tuple[Float[ndarray, "seen 3"], Float[ndarray, "seen 3"]]:
    """Tell what a frame's tracks are away from where the nodes put them.

    Args:
        start: Nodes in frame 0 [m].
        now: Nodes in the frame [m].
        point: Observed tracks [m].
        is_visible: Whether a track is visible.
        frame: The frame.
        node_of_track: Node that each track observes; None lets the nodes around it carry it.

    Returns:
        Of the tracks that are seen and whose place is known: their places in frame 0 and their
        residuals [m].

    Raises:
        ValueError: If the frame shows no track whose place on the object is known.
    """
    start, now = start.astype(np.float64), now.astype(np.float64)
    is_placed, place = placed_tracks(start, point, is_visible, node_of_track)
    is_usable = is_placed[frame]
    if not is_usable.any():
        raise ValueError(f"frame {frame} shows no track that frame 0 places on the object")
    anchor = place[is_usable]
    node_of_usable = None if node_of_track is None else node_of_track[is_usable]
    return anchor, point[frame, is_usable] - predicted_places(start, now, anchor, node_of_usable)


def predicted_places(
    start: Float[ndarray, "node 3"],
    now: Float[ndarray, "node 3"],
    place: Float[ndarray, "place 3"],
    node_of_place: Int[ndarray, " place"] | None = None,
) -> Float[ndarray, "place 3"]:
    """Tell where nodes that moved put places of frame 0 [m].

    Args:
        start: Nodes in frame 0 [m].
        now: Nodes later [m].
        place: Places in frame 0 [m].
        node_of_place: Node that each of them is; None lets the nodes around it carry it.
    """
    if node_of_place is not None:
        return now[node_of_place]
    return carried_points(place, np.stack([start, now]))[1]


def placed_tracks(
    start: Float[ndarray, "node 3"],
    point: Float[ndarray, "frame track 3"],
    is_visible: Bool[ndarray, "frame track"],
    node_of_track: Int[ndarray, " track"] | None = None,
) -> tuple[Bool[ndarray, "frame track"], Float[ndarray, "track 3"]]:
    """Tell in which frames tracks show a known place of the object, and where that is in frame 0.

    Args:
        start: Nodes in frame 0 [m].
        point: Observed tracks [m].
        is_visible: Whether a track is visible.
        node_of_track: Node that each track observes; None if its place is where it was seen in
            frame 0, and not known if it was not.

    Returns:
        Whether a track is seen in a frame and its place is known, and the places [m].
    """
    if node_of_track is not None:
        return is_visible, start[node_of_track]
    return is_visible & is_visible[0], point[0].astype(np.float64)
