"""Observations: points and clouds of a frame, identified tracks and markers, hand keypoints."""

from collections.abc import Sequence as Listing
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from app.previews.links import MOST_MARKERS, marker_links
from physhandi.data.camera import triangulate
from physhandi.data.sequence import Sequence
from physhandi.data.view import View
from physhandi.errors import SequenceError
from physhandi.metrics.photometric import seen_colors

_POINTS = 5_000
_MOST_FRAMES = 400
"""Frames of which the colors of points are kept."""
_GREEN = np.array([46, 160, 67], dtype=np.uint8)


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

    @property
    def is_colored(self) -> bool:
        """Whether points have the colors of what they were seen on."""
        return False


class CloudSet:
    """Clouds of all frames, one after the other in one array."""

    def __init__(
        self,
        point: Float[ndarray, "point 3"],
        end: Int[ndarray, " frame"],
        views: Listing[View] = (),
    ) -> None:
        """Keep the clouds.

        Args:
            point: Points of all frames.
            end: Where each frame's points end.
            views: Views that lend the points their colors.
        """
        self._point = point
        self._end = end
        self._views = [view for view in views if view.has_color and view.has_mask]
        self._frame = 0
        self._colors: dict[int, UInt8[ndarray, "*point 3"]] = {}

    def points(self, frame: int) -> Float[ndarray, "point 3"]:
        """Find the cloud of a frame, thinned out [m]."""
        if frame >= len(self._end):
            return np.zeros((0, 3), np.float32)
        start = int(self._end[frame - 1]) if frame > 0 else 0
        point = np.asarray(self._point[start : int(self._end[frame])], dtype=np.float32)
        self._frame = frame
        return point[:: max(1, -(-len(point) // _POINTS))]

    def colors(self) -> UInt8[ndarray, "*point 3"]:
        """Give the colors that the views show where the points are; all green without views."""
        frame = self._frame
        if not self._views or frame >= self._views[0].frame_count:
            return _GREEN
        if frame not in self._colors:
            if len(self._colors) >= _MOST_FRAMES:
                self._colors.clear()
            self._colors[frame] = self._seen(frame)
        return self._colors[frame]

    @property
    def is_colored(self) -> bool:
        """Whether points have the colors of what they were seen on."""
        return bool(self._views)

    def _seen(self, frame: int) -> UInt8[ndarray, "*point 3"]:
        """Ask the views; a frame that is damaged is green."""
        try:
            color = seen_colors(self._views, self.points(frame).astype(np.float64), frame=frame)
        except SequenceError:
            return _GREEN
        return _GREEN if color is None else color


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
        """Give the pixels' colors."""
        return self._colors

    @property
    def is_colored(self) -> bool:
        """Whether points have the colors of what they were seen on."""
        return True


Observed = PointSet | CloudSet | DepthCloud
"""Finds the points that were seen in a frame, and the colors of those it found last."""


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
        """Their name: points with known nodes are markers."""
        return "the tracks" if self.node is None else "the markers"


@dataclass(frozen=True, eq=False, kw_only=True)
class Markers:
    """Markers that keep their number over the frames."""

    point: Float[ndarray, "frame marker 3"]
    """Positions [m]; NaN where they are not seen."""
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


BONES = np.array(
    [
        *([0, 1], [1, 2], [2, 3], [3, 4]),
        *([0, 5], [5, 6], [6, 7], [7, 8]),
        *([5, 9], [9, 10], [10, 11], [11, 12]),
        *([9, 13], [13, 14], [14, 15], [15, 16]),
        *([13, 17], [0, 17], [17, 18], [18, 19], [19, 20]),
    ]
)
"""Pairs of keypoints, in MediaPipe's order, that a bone joins."""

_MIN_CONFIDENCE = 0.3


def lift_keypoints(views: Listing[View]) -> tuple[Float[ndarray, "frame keypoint 3"], ...]:
    """Triangulate each hand's keypoints from all views that see them, for a first look.

    Args:
        views: Views; those without keypoints are left out.

    Returns:
        One array per hand [m], NaN where fewer than two views see a keypoint; empty if fewer than
        two views have keypoints.
    """
    seen = [(view.camera, view.keypoint) for view in views if view.keypoint is not None]
    if len(seen) < 2:
        return ()
    keypoint = np.stack([keypoint for _, keypoint in seen]).astype(np.float64)
    views_count, frames, hands, joints, _ = keypoint.shape
    flat = keypoint.reshape(views_count, -1, 3)
    trust = np.where(flat[..., 2] >= _MIN_CONFIDENCE, 1.0, 0.0)
    cameras = [camera for camera, _ in seen]
    point = triangulate(cameras, flat[..., :2], trust, tolerance=np.inf).astype(np.float32)
    point = point.reshape(frames, hands, joints, 3)
    return tuple(point[:, hand] for hand in range(hands))
