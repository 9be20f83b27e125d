"""Follows points of the object through the images of each view, by pyramidal Lucas-Kanade.

What is thin, as a rope is, fills little of any window, and what lies around it would hold its
points where they are along it. So of thin things only their own pixels are matched, over a long
piece, and points are laid onto the image in which they began, so that steps do not add up to a
slide.

A track goes on while it comes back to where it was when followed backwards (Kalal et al. 2010), is
still found in the image in which it began, moves as its neighbors do, stays as near to them as a
surface can, and its pixel is the object's, with a depth that does not jump. One that does not (it
hangs on a shadow, say), or that a hand covers, ends; new ones begin where the object shows room for
them. A track model, where the user has one, follows the points in the place of that.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray
from scipy.spatial import KDTree

from physhandi.data.sequence import Sequence
from physhandi.data.view import View
from physhandi.perception.lifting import OBJECT_LABEL, mask_thickness, pixel_values
from physhandi.perception.track_model import TrackModel
from physhandi.progress import NullProgress, Progress

PixelTracks = dict[str, tuple[Float[ndarray, "frame _ 2"], Bool[ndarray, "frame _"]]]
"""By view, positions [px], NaN where a track is not seen, and where it is seen."""

_cv2: Any = cv2  # Its type stubs refuse absent starts.
TRACKING_STAGE = "point_tracking"
MOST_TRACKS = 400
"""Tracks of a view in a frame in which some begin, if there is room: where much is lost from frame
to frame, more than half of them end before they are old enough to be kept."""
LEAST_TRACKS = 220
"""Living tracks below which new ones begin, if there is room."""

_WINDOW = (9, 21)
"""Least and largest side of what of an image is matched [px]."""
THIN, _LONG_WINDOW = 8.0, 41
"""Thickness up to which an object is thin, and the side of what is matched of nothing but its own
pixels then [px]."""
_RETURN, _THIN_RETURN = 0.3, 0.15
"""Distance from its start at which a track may come back when followed backwards, of thin things
where the long window gives smaller ones [px]."""
_SMEAR = 3.0
"""Radius (standard deviation) from which pixels beside a thin thing take its own values [px]."""
_FADE = 0.02
"""Share of its pixels around below which they fade to its mean: no edge is there to be matched."""
_RETURNED = 3.0
"""Farthest way by which a track is moved to where the image in which it began matches [px]."""
_FIRST_RETURN = 1.5
"""Distance from where it began at which a track of a thick thing may come back when followed from
there and backwards: the surface has turned and bent since [px]."""
_DEPTH_JUMP = 0.04
"""Change of depth in one frame that no track survives [m]."""
_COMPANY = 8
"""Neighbors whose motion a track is compared with."""
_DISAGREEMENT = 1.0
"""Difference from the median motion of the neighbors that is always allowed [px]."""
_TIED = 0.07
"""Tracks that begin within this distance of each other are held together by the surface [m]."""
_STRETCH = 1.15
"""Factor by which a surface may stretch between them."""
_STRETCH_ERROR = 0.008
"""Error of measured distances [m]."""
_TORN = 0.25
"""Share of the tracks around it that a sliding one leaves behind."""
_CLOSEST = 1.4
"""Least distance between tracks when they begin [px]."""
SHORTEST_TRACK = 3
"""Frames that a track must live to be kept."""
_MODEL_ROUNDS = 4
"""Most frames of a view in which a model is told points to follow."""


def track_points(
    sequence: Sequence,
    masks: Mapping[str, UInt8[ndarray, "frame row column"]],
    progress: Progress | None = None,
    model: TrackModel | None = None,
) -> PixelTracks:
    """Follow points of the object's surface.

    Args:
        sequence: Recording; its own masks and tracks are not read.
        masks: Labels of views with color, as `segment` gives them; a view needs depth too, without
            which a track says nothing about space.
        progress: Told after every frame; may cancel.
        model: Follows points in the place of what is built in.

    Returns:
        By view, positions [px], NaN where a track is not seen, and where it is seen. Views without
        depth, or in which the object is never seen, are left out.

    Raises:
        CancelledError: If the user asked to stop.
    """
    progress = progress or NullProgress()
    views = [v for v in sequence.views if v.name in masks and v.has_color and v.has_depth]
    total = len(views) * sequence.frame_count
    result: PixelTracks = {}
    for number, view in enumerate(views):
        if model is not None:
            paths = _followed_by_model(model, view, masks[view.name], progress)
            view.close()
            if paths[0].shape[1]:
                result[view.name] = paths
            done = (number + 1) * sequence.frame_count
            progress.report(TRACKING_STAGE, done, total, None, f"View {view.name}")
            continue
        tracker = _Tracker(view, masks[view.name])
        for frame in range(view.frame_count):
            progress.check_cancelled()
            tracker.step(frame)
            done = number * view.frame_count + frame + 1
            progress.report(TRACKING_STAGE, done, total, None, f"View {view.name}")
        view.close()
        paths = tracker.paths()
        if paths[0].shape[1]:
            result[view.name] = paths
    return result


@dataclass
class _Path:
    begin: int
    pixel: list[ndarray] = field(default_factory=list)


class _Tracker:
    """The tracks of one view while it is followed from frame to frame."""

    def __init__(self, view: View, mask: UInt8[ndarray, "frame row column"]) -> None:
        self._view, self._mask = view, mask
        self._paths: list[_Path] = []
        self._alive: list[int] = []
        # Of the frame before and of those in which living tracks began: gray images, and the own
        # pixels of what is thin there.
        self._gray: dict[int, ndarray] = {}
        self._own: dict[int, ndarray] = {}
        self._depth = np.zeros(0)
        self._pair = np.zeros((0, 2), dtype=np.int64)
        self._rest = np.zeros(0)

    def step(self, frame: int) -> None:
        """Go on to a frame, the first or the next one."""
        gray = cv2.cvtColor(self._view.color(frame), cv2.COLOR_RGB2GRAY)
        is_object = self._mask[frame] == OBJECT_LABEL
        depth = solid_depth(self._view.depth(frame), is_object)
        if 0 < mask_thickness(is_object) <= THIN:
            self._own[frame] = _own_pixels(gray, is_object)
        self._gray[frame] = gray
        if self._alive:
            self._advance(frame, is_object, depth)
        count, first_new = len(self._alive), len(self._paths)
        if count < (MOST_TRACKS if not self._paths else LEAST_TRACKS):
            start = np.array([self._paths[track].pixel[-1] for track in self._alive])
            for pixel in _new_points(gray, is_object & (depth > 0), start.reshape(-1, 2)):
                self._alive.append(len(self._paths))
                self._paths.append(_Path(frame, [pixel]))
        used = {frame, *(self._paths[track].begin for track in self._alive)}
        for images in (self._gray, self._own):
            for image in images.keys() - used:
                del images[image]
        pixel = np.array([self._paths[track].pixel[-1] for track in self._alive])
        self._depth = pixel_values(depth, pixel.reshape(-1, 2))
        self._tie(pixel.reshape(-1, 2), np.array(self._alive, dtype=np.int64) >= first_new)

    def _advance(
        self,
        frame: int,
        is_object: Bool[ndarray, "row column"],
        depth: Float[ndarray, "row column"],
    ) -> None:
        start = np.array([self._paths[track].pixel[-1] for track in self._alive])
        is_young = np.array([self._paths[track].begin == frame - 1 for track in self._alive])
        if frame in self._own and frame - 1 in self._own:
            end, is_found = _follow(
                self._own[frame - 1], self._own[frame], start, _LONG_WINDOW, returns=_THIN_RETURN
            )
            is_same = self._laid_onto_beginning(self._own, frame, end, _LONG_WINDOW, _THIN_RETURN)
            # What the first image finds again goes on, also where the one before did not.
            is_found |= is_same
        else:
            size = _window_size(is_object)
            end, is_found = _follow(self._gray[frame - 1], self._gray[frame], start, size)
            is_same = self._laid_onto_beginning(self._gray, frame, end, size, _FIRST_RETURN)
            is_found &= is_same | is_young
        here = pixel_values(depth, end)
        is_good = is_found & (pixel_values(is_object, end) > 0)
        is_good &= (here == 0) | (self._depth == 0) | (np.abs(here - self._depth) < _DEPTH_JUMP)
        is_good &= _moves_with_neighbors(start, end, is_good)
        is_good &= ~self._is_torn(end, here, is_good)
        alive: list[int] = []
        for track, pixel, good in zip(self._alive, end, is_good, strict=True):
            if good:
                self._paths[track].pixel.append(pixel)
                alive.append(track)
        self._alive = alive

    def _laid_onto_beginning(
        self,
        images: dict[int, ndarray],
        frame: int,
        end: Float[ndarray, "track 2"],
        size: int,
        returns: float,
    ) -> Bool[ndarray, " track"]:
        """Move tracks to where the images in which they began are found; tells which are."""
        begin = np.array([self._paths[track].begin for track in self._alive])
        first = np.array([self._paths[track].pixel[0] for track in self._alive])
        is_same = np.zeros(len(end), dtype=bool)
        for image in sorted(set(begin[begin < frame - 1].tolist()) & images.keys()):
            mine = np.flatnonzero(begin == image)
            place, is_found = _follow(
                images[image], images[frame], first[mine], size, end[mine], returns=returns
            )
            is_found &= np.linalg.norm(place - end[mine], axis=1) < _RETURNED
            end[mine[is_found]] = place[is_found]
            is_same[mine] = is_found
        return is_same

    def _points(
        self, pixel: Float[ndarray, "track 2"], depth: Float[ndarray, " track"]
    ) -> Float[ndarray, "track 3"]:
        """Lift tracks [m]; NaN where no depth was measured."""
        point = self._view.camera.unproject(pixel.astype(np.float64), depth.astype(np.float64))
        return np.where(depth[:, None] > 0, point, np.nan)

    def _tie(self, pixel: Float[ndarray, "track 2"], is_new: Bool[ndarray, " track"]) -> None:
        """Remember how far new tracks are from those around them."""
        point = self._points(pixel, self._depth)
        there = np.flatnonzero(np.isfinite(point).all(axis=1))
        if not is_new.any() or len(there) < 2:
            return
        alive = np.array(self._alive, dtype=np.int64)
        pair = KDTree(point[there]).query_pairs(_TIED, output_type="ndarray")
        pair = there[pair[is_new[there[pair]].any(axis=1)]]
        rest = np.linalg.norm(point[pair[:, 0]] - point[pair[:, 1]], axis=1)
        self._pair = np.concatenate([self._pair, alive[pair]])
        self._rest = np.concatenate([self._rest, rest])

    def _is_torn(
        self,
        pixel: Float[ndarray, "track 2"],
        depth: Float[ndarray, " track"],
        is_good: Bool[ndarray, " track"],
    ) -> Bool[ndarray, " track"]:
        """Tell which tracks have left most of those that they began beside, as no surface does."""
        point = self._points(pixel, depth)
        number = np.full(len(self._paths), -1, dtype=np.int64)
        number[np.array(self._alive)[is_good]] = np.flatnonzero(is_good)
        lives = (number[self._pair] >= 0).all(axis=1)
        self._pair, self._rest = self._pair[lives], self._rest[lives]
        pair = number[self._pair]
        length = np.linalg.norm(point[pair[:, 0]] - point[pair[:, 1]], axis=1)
        is_long = length > _STRETCH * self._rest + _STRETCH_ERROR
        count = np.bincount(pair[np.isfinite(length)].ravel(), minlength=len(pixel))
        long = np.bincount(pair[is_long].ravel(), minlength=len(pixel))
        return (count >= 4) & (long > _TORN * count)

    def paths(self) -> tuple[Float[ndarray, "frame track 2"], Bool[ndarray, "frame track"]]:
        """Lay the tracks that lived long enough side by side."""
        least = min(SHORTEST_TRACK, self._view.frame_count)
        long_enough = [path for path in self._paths if len(path.pixel) >= least]
        pixel = np.full((self._view.frame_count, len(long_enough), 2), np.nan, dtype=np.float32)
        for track, path in enumerate(long_enough):
            pixel[path.begin : path.begin + len(path.pixel), track] = path.pixel
        return pixel, np.asarray(np.isfinite(pixel).all(axis=-1))


def visible_on_object(
    mask: UInt8[ndarray, "frame row column"],
    pixel: Float[ndarray, "frame track 2"],
    is_visible: Bool[ndarray, "frame track"],
) -> Bool[ndarray, "frame track"]:
    """Tell which of the visible points are on the object, as its masks say."""
    on = [
        pixel_values(label == OBJECT_LABEL, place) > 0
        for label, place in zip(mask, pixel, strict=True)
    ]
    return is_visible & np.stack(on)


def _followed_by_model(
    model: TrackModel,
    view: View,
    mask: UInt8[ndarray, "frame row column"],
    progress: Progress,
) -> tuple[Float[ndarray, "frame track 2"], Bool[ndarray, "frame track"]]:
    """Let a model follow points of the first frame with the object, and of those with few tracks.

    Where a point is not on the object, it is not seen, whatever the model says.
    """
    is_object = mask == OBJECT_LABEL
    pixel = np.zeros((view.frame_count, 0, 2), dtype=np.float32)
    seen = np.zeros((view.frame_count, 0), dtype=bool)
    shown = np.flatnonzero(is_object.any(axis=(1, 2)))
    asked: set[int] = set()
    while len(asked) < min(_MODEL_ROUNDS, len(shown)):
        progress.check_cancelled()
        alive = seen.sum(axis=1)
        rest = [int(frame) for frame in shown if frame not in asked]
        frame = min(rest, key=lambda at: int(alive[at])) if asked else rest[0]
        if asked and alive[frame] >= LEAST_TRACKS:
            break
        asked.add(frame)
        gray = cv2.cvtColor(view.color(frame), cv2.COLOR_RGB2GRAY)
        free = solid_depth(view.depth(frame), is_object[frame]) > 0
        start = _new_points(gray, free, pixel[frame, seen[frame]])
        if not len(start):
            continue
        place, is_visible = model.follow(view, frame, start, progress)
        is_visible = visible_on_object(mask, place, is_visible)
        pixel = np.concatenate([pixel, place.astype(np.float32)], axis=1)
        seen = np.concatenate([seen, is_visible], axis=1)
    is_long = seen.sum(axis=0) >= min(SHORTEST_TRACK, view.frame_count)
    pixel, seen = pixel[:, is_long], seen[:, is_long]
    return np.where(seen[..., None], pixel, np.float32(np.nan)), seen


def solid_depth(
    depth: Float[ndarray, "row column"], is_object: Bool[ndarray, "row column"]
) -> Float[ndarray, "row column"]:
    """Leave only the object's depth, without single wrong values; 0 elsewhere."""
    own = np.where(is_object, depth, 0).astype(np.float32)
    # The largest of the values around is the farthest; holes (0) must not win, so it is a mean.
    count = cv2.blur((own > 0).astype(np.float32), (3, 3))
    mean = cv2.blur(own, (3, 3)) / np.maximum(count, 1e-6)
    return np.where((count > 0.3) & is_object, mean, 0.0)


def _window_size(is_object: Bool[ndarray, "row column"]) -> int:
    """Choose what is matched as wide as the object is thick, so that little else gets into it."""
    return int(np.clip(round(mask_thickness(is_object)), *_WINDOW)) | 1


def _own_pixels(
    gray: UInt8[ndarray, "row column"], is_object: Bool[ndarray, "row column"]
) -> UInt8[ndarray, "row column"]:
    """Give what is beside the object the values of its pixels around, and farther off their mean.

    A normalized convolution (Knutsson and Westin 1993): nothing that is not the object's is left to
    be matched, and no outline either, which tells nothing of the motion along a thin thing.
    """
    share = is_object.astype(np.float32)
    own = gray * share
    total, count = (cv2.GaussianBlur(image, (0, 0), _SMEAR) for image in (own, share))
    mean = float(own.sum() / share.sum())
    smeared = (total + _FADE * mean) / (count + _FADE)
    return np.where(is_object, gray, smeared).astype(np.uint8)


def _follow(
    before: UInt8[ndarray, "row column"],
    now: UInt8[ndarray, "row column"],
    start: Float[ndarray, "track 2"],
    size: int,
    guess: Float[ndarray, "track 2"] | None = None,
    *,
    returns: float = _RETURN,
) -> tuple[Float[ndarray, "track 2"], Bool[ndarray, " track"]]:
    """Find points of an image in another, near a guess or where they were, and whether they return.

    With a guess only the full resolution is searched, which a good one does not leave.
    """
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01)
    options: dict[str, Any] = {"winSize": (size, size), "maxLevel": 3, "criteria": stop}
    first = start.astype(np.float32).reshape(-1, 1, 2)
    there = None
    if guess is not None:
        options |= {"maxLevel": 0, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
        there = guess.astype(np.float32).reshape(-1, 1, 2)
    end, reached, _ = _cv2.calcOpticalFlowPyrLK(before, now, first, there, **options)
    # The way back begins as far from its end as the way there did.
    back_there = None if guess is None else first + end - guess.reshape(-1, 1, 2).astype(np.float32)
    back, came_back, _ = _cv2.calcOpticalFlowPyrLK(now, before, end, back_there, **options)
    far = np.linalg.norm((back - first).reshape(-1, 2), axis=1)
    is_found = (reached.reshape(-1) > 0) & (came_back.reshape(-1) > 0) & (far < returns)
    return end.reshape(-1, 2), is_found


def _moves_with_neighbors(
    start: Float[ndarray, "track 2"],
    end: Float[ndarray, "track 2"],
    is_good: Bool[ndarray, " track"],
) -> Bool[ndarray, " track"]:
    """Tell which tracks move about as the median of their nearest neighbors does."""
    result = np.ones(len(start), dtype=bool)
    tracks = np.flatnonzero(is_good)
    if len(tracks) <= _COMPANY:
        return result
    motion = end[tracks] - start[tracks]
    near = np.asarray(KDTree(start[tracks]).query(start[tracks], k=_COMPANY + 1)[1])[:, 1:]
    typical: ndarray = np.asarray(np.median(motion[near], axis=1))
    allowed = np.maximum(_DISAGREEMENT, 0.5 * np.linalg.norm(typical, axis=1))
    result[tracks] = np.linalg.norm(motion - typical, axis=1) < allowed
    return result


def _new_points(
    gray: UInt8[ndarray, "row column"],
    is_free: Bool[ndarray, "row column"],
    taken: Float[ndarray, "track 2"],
) -> Float[ndarray, "track 2"]:
    """Choose where new tracks begin: at corners first, then wherever there is room."""
    area = int(is_free.sum())
    wanted = MOST_TRACKS - len(taken)
    if area == 0 or wanted <= 0:
        return np.zeros((0, 2))
    inner = cv2.erode(is_free.astype(np.uint8), np.ones((3, 3), np.uint8))
    room = inner if inner.sum() > 0.4 * area else is_free.astype(np.uint8)
    distance = max(_CLOSEST, 0.7 * float(np.sqrt(area / MOST_TRACKS)))
    for x, y in taken.round().astype(int):
        cv2.circle(room, (int(x), int(y)), round(distance), 0, -1)
    corner = _cv2.goodFeaturesToTrack(gray, wanted, 0.001, distance, mask=room, blockSize=3)
    corners = np.zeros((0, 2)) if corner is None else corner.reshape(-1, 2).astype(np.float64)
    for x, y in corners.round().astype(int):
        cv2.circle(room, (int(x), int(y)), round(distance), 0, -1)
    more: list[tuple[float, float]] = []
    for row, column in np.argwhere(room > 0):
        if len(corners) + len(more) >= wanted:
            break
        if room[row, column]:
            more.append((float(column), float(row)))
            cv2.circle(room, (int(column), int(row)), round(distance), 0, -1)
    return np.concatenate([corners, np.array(more).reshape(-1, 2)])
