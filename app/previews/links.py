"""Pairs of neighboring markers, which lines join."""

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

MOST_MARKERS = 200
"""More markers are a cloud, in which nobody looks for a single one."""
_NEIGHBOR = 1.35
"""A neighbor is at most this many times as far away as the nearest marker of either."""


def marker_links(marker: Float[ndarray, "marker 3"]) -> Int[ndarray, "link 2"]:
    """Join each marker with its nearest ones, so that a rope looks like one."""
    if len(marker) > MOST_MARKERS:
        return np.empty((0, 2), dtype=int)
    distance = np.linalg.norm(marker[:, None] - marker[None], axis=-1)
    np.fill_diagonal(distance, np.inf)
    distance[~np.isfinite(distance)] = np.inf
    nearest = distance.min(axis=1, initial=np.inf)
    close = distance <= _NEIGHBOR * np.maximum(nearest[:, None], nearest[None])
    # Not where a third marker is nearer to both: a line would pass it by.
    detour = np.minimum.reduce(np.maximum(distance[:, :, None], distance[None]), axis=1)
    return np.argwhere(np.triu(close & np.isfinite(distance) & (distance <= detour)))
