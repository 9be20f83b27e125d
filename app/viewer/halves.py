"""How large something is as a camera sees it, to set two of it side by side."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from app.viewer.figure_camera import Eye

GAP = 1.08
"""Distance of the middles of two halves, as a multiple of a half's width."""
_SAMPLED_FRAMES = 10
_SAMPLED_POINTS = 300


class Extents:
    """Sampled points of all that moves in a half, without its few farthest ones."""

    def __init__(self, tracks: Iterable[Float[ndarray, "frame point 3"]], frame_count: int) -> None:
        """Sample the points.

        Args:
            tracks: What has to fit; at least one with a frame and a point.
            frame_count: How many frames of the tracks count.
        """
        frames = np.unique(np.linspace(0, frame_count - 1, _SAMPLED_FRAMES).astype(int))
        parts = [np.asarray(track[f]) for track in tracks for f in frames]
        parts = [part[:: max(1, len(part) // _SAMPLED_POINTS)] for part in parts]
        point = np.concatenate(parts).astype(np.float64)
        low, high = np.quantile(point, [0.002, 0.998], axis=0)
        self._point = np.clip(point, low, high)

    def seen(self, eye: Eye) -> tuple[Float[ndarray, " 3"], float, float]:
        """Measure it as it is seen: its middle, width and height."""
        middle, extents = np.zeros(3), list[float]()
        for axis in (eye.right, eye.up, eye.ahead):
            along = self._point @ axis
            middle += 0.5 * (along.min() + along.max()) * axis
            extents.append(float(np.ptp(along)))
        return middle, extents[0], extents[1]
