"""Observed points of a frame, from markers or from depth images."""

from collections.abc import Sequence as Listing
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from physhandi.data.view import View

_POINTS = 5_000
_GREEN = np.array([46, 160, 67], dtype=np.uint8)


class Observed(Protocol):
    """Finds what was seen in a frame."""

    def points(self, frame: int) -> Float[ndarray, "point 3"]:
        """Find the points seen in a frame [m]."""
        ...

    def colors(self) -> UInt8[ndarray, "point 3"] | UInt8[ndarray, " 3"]:
        """Tell the color of the points of the frame asked for last."""
        ...


@dataclass(frozen=True, eq=False, kw_only=True)
class Tracks:
    """Points that keep their identity over the frames, so that errors can be told for each."""

    point: Float[ndarray, "frame track 3"]
    """Observed places [m]."""
    is_visible: Bool[ndarray, "frame track"]
    """Whether a track is seen."""
    node: Int[ndarray, " track"] | None = None
    """Node that each track observes; None if the nodes around it carry it."""

    @property
    def name(self) -> str:
        """What they are called: whoever knows their nodes has markers."""
        return "the tracks" if self.node is None else "the markers"


class PointSet:
    """Tracked points, of which each frame shows those that are visible."""

    def __init__(
        self, point: Float[ndarray, "frame point 3"], is_visible: Bool[ndarray, "frame point"]
    ) -> None:
        self._point = point
        self._is_visible = is_visible

    def points(self, frame: int) -> Float[ndarray, "point 3"]:
        """Find the visible points of a frame [m]."""
        if frame >= len(self._point):
            return np.zeros((0, 3), np.float32)
        point = np.asarray(self._point[frame], dtype=np.float32)
        is_seen = np.asarray(self._is_visible[frame]) & np.isfinite(point).all(axis=-1)
        point = point[is_seen]
        return point[:: max(1, -(-len(point) // _POINTS))]

    def colors(self) -> UInt8[ndarray, " 3"]:
        """All points are green."""
        return _GREEN


class CloudSet:
    """Clouds of all frames, one after the other in one array."""

    def __init__(self, point: Float[ndarray, "point 3"], end: Int[ndarray, " frame"]) -> None:
        self._point = point
        self._end = end

    def points(self, frame: int) -> Float[ndarray, "point 3"]:
        """Find the cloud of a frame, thinned out [m]."""
        if frame >= len(self._end):
            return np.zeros((0, 3), np.float32)
        start = int(self._end[frame - 1]) if frame > 0 else 0
        point = np.asarray(self._point[start : int(self._end[frame])], dtype=np.float32)
        return point[:: max(1, -(-len(point) // _POINTS))]

    def colors(self) -> UInt8[ndarray, " 3"]:
        """All points are green."""
        return _GREEN


class DepthCloud:
    """The depth images of all views, put together in the world and thinned out."""

    def __init__(self, views: Listing[View]) -> None:
        self._views = [view for view in views if view.has_depth]
        self._colors: UInt8[ndarray, "point 3"] = np.zeros((0, 3), np.uint8)

    def points(self, frame: int) -> Float[ndarray, "point 3"]:
        """Unproject a frame's depth, of the masked parts where there are masks [m]."""
        clouds: list[ndarray] = []
        colors: list[ndarray] = []
        for view in self._views:
            depth = view.depth(frame)
            is_seen = depth > 0
            if view.has_mask:
                is_seen &= view.mask(frame) > 0
            row, column = np.nonzero(is_seen)
            every = max(1, -(-len(row) * len(self._views) // _POINTS))
            row, column = row[::every], column[::every]
            pixel = np.stack([column, row], axis=-1).astype(np.float64)
            clouds.append(view.camera.unproject(pixel, depth[row, column].astype(np.float64)))
            image = view.color(frame)[row, column] if view.has_color else None
            colors.append(np.tile(_GREEN, (len(row), 1)) if image is None else image)
        self._colors = np.concatenate(colors).astype(np.uint8)
        return np.concatenate(clouds).astype(np.float32)

    def colors(self) -> UInt8[ndarray, "point 3"]:
        """Tell the pixels' colors."""
        return self._colors
