"""Identified markers of a recording: which of them are held, and which are neighbors."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from app.previews.links import MOST_MARKERS, marker_links
from physhandi.data.sequence import Sequence


@dataclass(frozen=True, eq=False, kw_only=True)
class Markers:
    """Markers that keep their number over the frames."""

    point: Float[ndarray, "frame marker 3"]
    """Where they are [m]; NaN where they are not seen."""
    held: tuple[int, ...]
    """Those that sit on what moves the object, and are control points therefore."""
    links: Int[ndarray, "link 2"]
    """Pairs of neighbors."""

    @classmethod
    def of(cls, sequence: Sequence) -> "Markers | None":
        """Find the markers of a sequence; None if there are none, or too many to be told apart."""
        marker = sequence.marker
        if marker is None or marker.shape[1] > MOST_MARKERS:
            return None
        return cls(point=marker, held=sequence.controlled_markers, links=marker_links(marker[0]))

    def segments(self, frame: int) -> Float[ndarray, "link 2 3"]:
        """Give the lines between neighbors that are both seen in a frame."""
        line = np.asarray(self.point[frame], dtype=np.float32)[self.links]
        return line[np.isfinite(line).all(axis=(1, 2))]

    def neighbors(self, marker: int) -> list[int]:
        """Find the neighbors of a marker."""
        pairs = self.links[(self.links == marker).any(axis=1)]
        return sorted(int(other) for other in pairs[pairs != marker])
