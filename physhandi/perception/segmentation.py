"""Finds object and hands in the color and depth images of a sequence, from clicks on the object.

Each pixel is judged for background, object and hands by its color, by its
height above what carries the object, by the label that dense optical flow (DIS, Kroeger et al.
2016) brings from the frame before, and by its distance, in space, from there. Pieces that hang on
nothing are dropped, and GrabCut (Rother et al. 2004) draws the outline of what is thick enough.
Labels travel forwards and backwards from the frame of a click. A view without a click begins in the
frame in which depth and calibration show it most of the object; hands begin, in every frame, at
their keypoints. Where several views agree about these, what is far from the bones in space is no
hand, though a finger behind it be drawn there. No network takes part, unless the user has one
(`MaskModel`): it is then told the same places, and does the rest.
"""

import dataclasses
import itertools
from collections.abc import Iterator, Mapping
from collections.abc import Sequence as Many
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray
from scipy.ndimage import gaussian_filter
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from physhandi.data.camera import triangulate
from physhandi.data.sequence import Sequence
from physhandi.data.view import View
from physhandi.errors import MissingInputError, UsageError
from physhandi.perception.keypoints import KeypointDetector, detect_view
from physhandi.perception.lifting import HAND_LABEL, OBJECT_LABEL
from physhandi.perception.mask_model import MaskModel, Prompt
from physhandi.perception.tracks import EDGE_STEP
from physhandi.progress import NullProgress, Progress

_cv2: Any = cv2  # Its type stubs lack optical flow and refuse absent rectangles.
SEGMENTATION_STAGE = "segmentation"
_BACKGROUND = 0

# Colors.
_BINS = (32, 64, 64)
"""Bins of a color histogram along L, a and b of CIELAB, each 0 to 255."""
_BLUR = 1.0
"""Width of the kernel that makes a density of a histogram [bins]."""
_BLUR_REACH = 4
"""Distance at which that kernel ends [bins]."""
_NEW_ON_BACKGROUND = 0.01
"""Density of colors that the background has not shown; 1 is that of all colors being alike."""
_NEW_ON_OBJECT = 0.06
"""Density of colors that the object has not shown."""
_NEW_ON_SKIN = 0.02
"""Density of colors that a hand has not shown."""
_SHADOWS = (1.0, 0.8, 0.6)
"""Shares of its lightness with which background is seen, the smaller ones in shadows."""
_SHADED = 0.1
"""Share of the object's pixels that count as seen in a shadow, too: that of a hand falls on it."""
_LEAST_INNER = 0.3
"""Share of an object's pixels that must lie off its rim for its colors to be learned from these
alone: a rim shows some of what is behind it, too."""
_WIDEST_PIXEL = 0.0025
"""Width of a pixel on the object up to which that is done [m]; a wider rim holds all that a thing
shows of its shaded sides."""
_MEMORY = 6.0
"""Frames' worth of pixels that the colors of a thing are remembered by."""
_OBJECT_RATE = 0.33
"""Share of an object's pixels that are learned from in a frame."""
_SKIN_RATE = 0.02
"""Share of a hand's pixels that are learned from: skin stays as it is, and what a hand holds must
not be taken for skin."""
_SURE = 3.0
"""Lead of a label's score from which its pixel is learned from."""

# Heights above the support.
_SUPPORT_BAND = 0.04
"""Distance from the given ground within which the support is looked for [m]."""
_LEAST_SUPPORT = 0.25
"""Share of an image's points that must lie in one plane to call it the support."""
_SUPPORT_NOISE = 0.002
"""Least standard deviation of measured heights [m]."""
_HIGHEST = 0.5
"""Things are expected up to this height above their support [m]."""
_LOW = 0.02
"""Half of the object is expected below this height above its support [m]."""
_RAISED = 3.0
"""Evidence against background where something goes on in space that is not on the support."""

# From frame to frame.
_REACH = 0.010
"""Distance from where a label is expected that costs nothing [m]."""
_SLACK = 0.006
"""Distance beyond `_REACH` that makes a label less likely by a factor e [m]."""
_FARTHEST = 8.0
"""Most that distance costs."""
_STAY = 0.1
"""Share of pixels whose label is not what flow brings."""
_SOFT = 1.0
"""Error of flow [px]."""
_CORE = 1.0
"""Evidence for a hand on its bones and palm."""

# What looks alike is decided together.
_ALIKE = 6.0
"""Difference of colors that look alike [levels of CIELAB, 0 to 255]."""
_AROUND = 1.5
"""Distance within which they count [px]."""

_BRIDGE = 0.015
"""Pieces that are this near to a hand may hang together behind it [m]."""
_LEAST_WIDTHS = 14.0
"""Area of a long thin object in an image, in squares of its width."""
_TOO_THICK = 1.5
"""Thickness of what is hardly a part of it, in its widths."""
_WIDEST = 16
"""Width from which nothing is called thin [px]."""
_STRIP, _STRIP_WIDTHS = 3.0, 0.7
"""Least radius (standard deviation) in which the direction of a thin object is looked for [px], and
that radius in its widths."""
_LEAST_MIDDLE = 10
"""Pixels in its middle from which its rims are looked for."""
_WAY = np.arange(-11.0, 11.01, 0.25)
"""Ways across it at which its color is looked at [px]."""
_COLOR_ALONG, _EDGE_ALONG = 1.5, 5.0
"""Radii in which colors, and their changes, are averaged along it [px]."""
_TOO_WIDE, _TOO_NARROW, _RIM_ERROR = 0.3, 0.1, 0.5
"""How much too far out its rims are before, or too far in where its colors are learned off its rim,
and by how much that varies [px]."""
_LEAST_CHANGE = 2.0
"""Change of color from which it is seen to have a rim there [levels of CIELAB a pixel]."""
_LEAST_PIECE = 8
"""Pixels of the smallest piece that a hand may cut off."""
_HAND_DEPTH = 0.09
"""Distance of a hand's pixels from its middle, along the view [m]."""
_HAND_HEIGHT = 0.008
"""Height above the support from which a pixel can be a hand's [m]."""
_FLESH = 0.025
"""Distance of a hand's skin from its bones that costs nothing, where these are known in space [m]:
half of a palm's thickness, and what depth and keypoints err by."""
_AGREEMENT = 0.18
"""Views agree about a keypoint that all see within this share of the hand's size in the image."""
_APART = 0.08
"""Distance from which the middles of one hand, as two views show it, are not the same place [m]."""
_ROUNDS = 4
"""Times that colors and labels of a view's first frame are found from each other."""
_CLICK_RADIUS = 0.012
"""Radius around a click in which the object's color is looked at [m]."""
_CLICK_COLOR = 14.0
"""Difference from the clicked color that is still the object's [levels of CIELAB, 0 to 255]."""
_LEAST_BOX, _MOST_OF_WINDOW = 6, 0.8
"""Least width and height of a box [px], and most that it may cover of what is looked at."""
_AROUND_BOX = 16
"""Least that is looked at around a box [px]."""
_LEAST_OBJECT = 12
"""Pixels of the smallest object."""
_LEAST_JOINTS = 6
"""Keypoints of a hand from which its place is known."""
_WIDER = 0.08
"""How far a hand goes beyond its core, where it was seen before [core's width]."""
_BONES = (
    (0, 1, 2, 3, 4),
    (5, 6, 7, 8),
    (9, 10, 11, 12),
    (13, 14, 15, 16),
    (17, 18, 19, 20),
)
_PALM = (0, 1, 5, 9, 13, 17)
_PALM_BONES = ((0, 5), (0, 9), (0, 13), (0, 17), (1, 5), (5, 9), (9, 13), (13, 17))
"""Lines that a palm lies around in space, besides those of the fingers."""
_PALM_SIDES = ((0, 5), (0, 9), (0, 13), (0, 17), (5, 17))
_LONGEST = 480
"""Longer side of the images in which views without depth are judged [px]."""
_CHUNK = 12
"""Images that are kept while a video is read backwards."""

# What a mask model is told.
_PLACES = 3
"""Places of a thing that one frame tells, where nobody clicked."""
_REMINDED = 30
"""Frames after which a hand is shown to the model again."""
_ARM = 0.6
"""How far a hand goes beyond its bones and palm; what a model finds farther off is the arm [core's
width]."""

_Window = tuple[slice, slice]


@dataclass(frozen=True, eq=False)
class _Anchor:
    """Where a hand is expected in an image."""

    core: Bool[ndarray, "row column"]
    """What of it is surely there."""
    wide: Bool[ndarray, "row column"]
    """From where its distance is counted."""
    off_bones: Float[ndarray, "row column"] | None = None
    """What it costs to be far from its bones in space; None if it is not known where these are."""


_Anchors = dict[int, _Anchor]
"""By a hand's label, where it is."""


@dataclass(frozen=True)
class Click:
    """A place on the object, in one image, or a box around it."""

    view: str
    """Name of the view."""
    frame: int
    """Number of the frame."""
    x: float
    """Column, of a box that of its middle [px]."""
    y: float
    """Row, of a box that of its middle [px]."""
    width: float = 0.0
    """Width of the box; 0 if only the place is known [px]."""
    height: float = 0.0
    """Height of the box; 0 if only the place is known [px]."""

    def to_dict(self) -> dict[str, str | int | float]:
        """Give it as plain data, without the size of a box where there is none."""
        place = {"view": self.view, "frame": self.frame, "x": self.x, "y": self.y}
        return place | ({"width": self.width, "height": self.height} if self.width else {})


def segment(
    sequence: Sequence,
    clicks: Many[Click],
    progress: Progress | None = None,
    model: MaskModel | None = None,
    detected: Mapping[str, Float[ndarray, "frame hand 21 3"]] | None = None,
) -> dict[str, UInt8[ndarray, "frame row column"]]:
    """Label the pixels of all views with color.

    Args:
        sequence: Recording; its own masks are not read. Hands start at its keypoints, which are
            detected in views that have none stored.
        clicks: Places on the object; more than one in a view, or in several views, help where one
            is not enough. Without any, hands alone are labelled.
        progress: Told after every frame; may cancel.
        model: Follows object and hands in the place of what is built in.
        detected: What `detected_keypoints` found; None if that is still to be done.

    Returns:
        By view: 0 background, 1 object, 2 right hand, 3 left hand.

    Raises:
        MissingInputError: If no view has color.
        UsageError: If a click is not on an object; says what to do.
        CancelledError: If the user asked to stop.
    """
    progress = progress or NullProgress()
    colored = [view for view in sequence.views if view.has_color]
    if not colored:
        raise MissingInputError(
            f"Sequence '{sequence.name}': no view has color images, in which object and hands "
            "could be found. Add views/<view>/color.mp4 or color/, or give masks."
        )
    check_places(sequence, clicks)
    if detected is None:
        detected = detected_keypoints(sequence, progress)
    all_seen: list[_Seen] = []
    for view in colored:
        keypoint = detected.get(view.name, view.keypoint)
        if model is None and not view.has_depth:
            smaller = _SmallerView(view)
            all_seen.append(_Seen(smaller, sequence, smaller.shrunk(keypoint)))
        else:
            all_seen.append(_Seen(view, sequence, keypoint))
    for seen in all_seen:
        seen.others = [other for other in all_seen if other is not seen and other.view.has_depth]
    _leave_out_wrong_hands(all_seen)
    _place_hands(sequence, all_seen)
    clicked = [seen for seen in all_seen if any(click.view == seen.view.name for click in clicks)]
    done, total = 0, len(all_seen) * sequence.frame_count
    for seen in [*clicked, *(seen for seen in all_seen if seen not in clicked)]:
        mine = [click for click in clicks if click.view == seen.view.name]
        starts = _clicked_starts(seen, mine) if mine else _borrowed_start(seen, clicked)
        if model is None:
            steps = _follow(seen, starts)
        else:
            steps = _follow_by_model(model, seen, starts, mine)
        for _ in steps:
            progress.check_cancelled()
            done += 1
            progress.report(SEGMENTATION_STAGE, done, total, None, f"View {seen.view.name}")
        seen.view.close()
    return {
        whole.name: seen.view.enlarged(seen.label)
        if isinstance(seen.view, _SmallerView)
        else seen.label
        for seen, whole in zip(all_seen, colored, strict=True)
    }


def carry_on(
    sequence: Sequence,
    masks: Mapping[str, UInt8[ndarray, "frame row column"]],
    right: Mapping[str, Many[int]],
    fixed: Mapping[str, Many[int]],
    progress: Progress | None = None,
) -> dict[str, UInt8[ndarray, "frame row column"]]:
    """Follow the labels of frames that are right, forwards and backwards.

    Args:
        sequence: Recording.
        masks: Labels of views with color.
        right: By view, frames to follow from; each goes as far as the next one that is fixed, and
            halfway to the next one of these.
        fixed: By view, further frames that stay as they are.
        progress: Told after every frame; may cancel.

    Returns:
        The labels of the views that `right` names.

    Raises:
        CancelledError: If the user asked to stop.
    """
    progress = progress or NullProgress()
    views = [view for view in sequence.views if view.name in right]
    result: dict[str, ndarray] = {}
    all_seen = [_Seen(view, sequence, _keypoints(view, sequence, progress)) for view in views]
    _leave_out_wrong_hands(all_seen)
    _place_hands(sequence, all_seen)
    for number, (view, seen) in enumerate(zip(views, all_seen, strict=True)):
        seen.label[:] = masks[view.name]
        count, starts = view.frame_count, sorted(set(right[view.name]))
        ends = [(start, 0) for start in starts] + [(f, 1) for f in fixed.get(view.name, ())]
        for start in starts:
            below = max((end for end in ends if end[0] < start), default=(-1, 1))
            above = min((end for end in ends if end[0] > start), default=(count, 1))
            low = below[0] + 1 if below[1] else (below[0] + start) // 2 + 1
            high = above[0] if above[1] else (start + above[0]) // 2 + 1
            image = _Image(view, start)
            seen.find_support(image.depth)
            for way in (range(start + 1, high), range(start - 1, low - 1, -1)):
                _learn_given(seen, image, seen.label[start])
                before, label = image, seen.label[start]
                for now in _images(view, way):
                    progress.check_cancelled()
                    label = seen.label[now.frame] = _advance(seen, before, label, now)
                    before = now
                    message = f"View {view.name}"
                    done, total = number * count + now.frame + 1, len(views) * count
                    progress.report(SEGMENTATION_STAGE, done, total, None, message)
        view.close()
        result[view.name] = seen.label
    return result


def _told(click: Click) -> str:
    return f"Click {click.view},{click.frame},{click.x:g},{click.y:g}"


@dataclass(frozen=True)
class ShownView:
    """What a view has to click on."""

    size: tuple[int, int]
    """Width and height of its images [px]."""
    has_color: bool
    """Whether it has color images."""
    has_depth: bool
    """Whether it has depth images."""


def _check_click(click: Click, views: Mapping[str, ShownView], frame_count: int) -> None:
    where = _told(click)
    view = views.get(click.view)
    if view is None:
        names = ", ".join(views) or "none"
        raise UsageError(f"{where}: there is no view '{click.view}'. Views are: {names}.")
    if not (view.has_color and view.has_depth):
        part = "depth" if view.has_color else "color"
        raise UsageError(
            f"{where}: view '{click.view}' has no {part}. Click in a view with color and depth."
        )
    if not 0 <= click.frame < frame_count:
        raise UsageError(
            f"{where}: there is no frame {click.frame}. Name one from 0 to {frame_count - 1}."
        )
    width, height = view.size
    if not (0 <= click.width <= 2 * width and 0 <= click.height <= 2 * height):
        raise UsageError(f"{where}: a box has a width and a height in pixels, both positive.")
    if not (-0.5 <= click.x <= width - 0.5 and -0.5 <= click.y <= height - 0.5):
        raise UsageError(
            f"{where}: is outside of the image. x goes from 0 to {width - 1}, y to {height - 1}."
        )


def check_clicks(clicks: Many[Click], views: Mapping[str, ShownView], frame_count: int) -> None:
    """Refuse clicks where there is nothing to click on.

    Args:
        clicks: Places on the object.
        views: The views of the recording, by name.
        frame_count: Its frames.

    Raises:
        UsageError: If there is one.
    """
    for click in clicks:
        _check_click(click, views, frame_count)


def check_places(sequence: Sequence, clicks: Many[Click]) -> None:
    """Refuse clicks where a sequence shows nothing to click on.

    Raises:
        UsageError: If there is one.
    """
    views = {
        view.name: ShownView(
            (view.camera.width, view.camera.height), view.has_color, view.has_depth
        )
        for view in sequence.views
    }
    check_clicks(clicks, views, sequence.frame_count)


def detected_keypoints(
    sequence: Sequence, progress: Progress
) -> dict[str, Float[ndarray, "frame hand 21 3"]]:
    """Detect the hands of a sequence in views with color that have no keypoints, by their names."""
    keypoints = {
        view.name: _keypoints(view, sequence, progress)
        for view in sequence.views
        if view.has_color and view.keypoint is None
    }
    return {name: keypoint for name, keypoint in keypoints.items() if keypoint is not None}


def _keypoints(
    view: View, sequence: Sequence, progress: Progress
) -> Float[ndarray, "frame hand 21 3"] | None:
    if view.keypoint is not None or not sequence.hands:
        return view.keypoint
    return detect_view(view, sequence.hands, progress, KeypointDetector())


class _SmallerView(View):
    """A view without depth in smaller images: its masks measure nothing, they only show."""

    def __init__(self, view: View) -> None:
        camera = view.camera
        self._whole = view
        part = min(1.0, _LONGEST / max(camera.width, camera.height))
        self._size = max(1, round(part * camera.width)), max(1, round(part * camera.height))
        # Pixel (0, 0) has its centre half a pixel from the corner of the image.
        self._scale = np.array(self._size) / (camera.width, camera.height)
        to_smaller = np.diag([*self._scale, 1.0])
        to_smaller[:2, 2] = 0.5 * self._scale - 0.5
        smaller = dataclasses.replace(
            camera, K=to_smaller @ camera.K, width=self._size[0], height=self._size[1]
        )
        super().__init__(view.folder, "", smaller, view.frame_count)

    def color(self, frame: int) -> UInt8[ndarray, "row column 3"]:
        """Read a smaller color image of a frame (RGB)."""
        image = cv2.resize(self._whole.color(frame), self._size, interpolation=cv2.INTER_AREA)
        return image.astype(np.uint8)

    def close(self) -> None:
        """Close the video of the whole view."""
        self._whole.close()

    def shrunk(
        self, keypoint: Float[ndarray, "frame hand 21 3"] | None
    ) -> Float[ndarray, "frame hand 21 3"] | None:
        """Move keypoints of the whole view to the smaller images."""
        if keypoint is None:
            return None
        pixel = (keypoint[..., :2] + 0.5) * self._scale - 0.5
        return np.concatenate([pixel, keypoint[..., 2:]], axis=-1).astype(np.float32)

    def enlarged(
        self, label: UInt8[ndarray, "frame row column"]
    ) -> UInt8[ndarray, "frame row column"]:
        """Bring labels of the smaller images to the size of the whole view's."""
        size = self._whole.camera.width, self._whole.camera.height
        if size == self._size:
            return label
        nearest = cv2.INTER_NEAREST_EXACT
        return np.stack([cv2.resize(one, size, interpolation=nearest) for one in label])


class _Colors:
    """How often something shows each color: a histogram, smoothed into a density."""

    def __init__(self, new: float) -> None:
        self._new = new
        self._count = np.zeros(int(np.prod(_BINS)), dtype=np.float32)
        self._logarithm: ndarray | None = None

    def add(self, code: Int[ndarray, " pixel"], weight: float = 1.0) -> None:
        """Count pixels by the number of their color."""
        count = np.bincount(code)
        seen = np.flatnonzero(count)  # Pixels show few of all colors.
        self._count[seen] += np.float32(weight) * count[seen]
        self._logarithm = None

    def replace(self, code: Int[ndarray, " pixel"]) -> None:
        """Forget what was counted, and count these pixels."""
        self._count[:] = 0
        self.add(code)

    def inherit(self, other: "_Colors") -> None:
        """Take over what another view has seen."""
        self._count += other._count  # noqa: SLF001  # of its own class
        self._logarithm = None

    def fade(self, most: float) -> None:
        """Let at most so many pixels count."""
        self._count *= np.float32(min(1.0, most / max(float(self._count.sum()), 1e-9)))

    def is_known(self) -> bool:
        """Tell whether any color was seen."""
        return bool(self._count.any())

    def log_density(self, code: Int[ndarray, "*shape"]) -> Float[ndarray, "*shape"]:
        """Compute how much more often than all colors on average these are shown (logarithm)."""
        if self._logarithm is None:
            count = self._count.reshape(_BINS)
            dense = np.zeros_like(count)
            near = _near_nonzero(count, _BLUR_REACH)
            dense[near] = gaussian_filter(count[near], _BLUR, mode="nearest", radius=_BLUR_REACH)
            dense *= dense.size / max(float(dense.sum()), 1e-9)
            logarithm = np.full_like(dense, np.log(np.float32(self._new)))
            logarithm[near] = np.log((1 - self._new) * dense[near] + self._new)
            self._logarithm = logarithm.reshape(-1)
        return self._logarithm[code]


def _near_nonzero(count: Float[ndarray, "a b c"], reach: int) -> tuple[slice, ...]:
    """Find the smallest box with everything that is not zero, and cells around it.

    A filter of that reach gives the same there as in the whole array, and zero elsewhere.
    """
    box: list[slice] = []
    inner = count
    for axis in range(3):
        used = np.flatnonzero(inner.any(axis=tuple(other for other in range(3) if other != axis)))
        low, high = (used[0], used[-1] + 1) if len(used) else (0, 0)
        box.append(slice(max(0, int(low) - reach), int(high) + reach))
        inner = count[*box]
    return tuple(box)


class _Image:
    """One frame of one view."""

    def __init__(self, view: View, frame: int) -> None:
        self.frame = frame
        self.color = view.color(frame)
        self.gray = cv2.cvtColor(self.color, cv2.COLOR_RGB2GRAY)
        self.depth = view.depth(frame) if view.has_depth else np.zeros(self.gray.shape, np.float32)


class _Seen:
    """What is known of a view: its labels, and how object, hands and background look in it."""

    def __init__(
        self, view: View, sequence: Sequence, keypoint: Float[ndarray, "frame hand 21 3"] | None
    ) -> None:
        camera = view.camera
        self.view = view
        self.hands = sequence.hands
        self.ground = sequence.ground_height
        self.keypoint = keypoint
        self.others: list[_Seen] = []
        """Other views with depth, which may show hands that this one's detector did not find."""
        self.joint: dict[int, ndarray] = {}
        """By a hand's label, its 21 keypoints in each frame, where several views agree about them;
        else NaN [m]."""
        self.whole: _Window = (slice(0, camera.height), slice(0, camera.width))
        self.label = np.zeros((view.frame_count, camera.height, camera.width), dtype=np.uint8)
        self.background = _Colors(_NEW_ON_BACKGROUND)
        self.things = {OBJECT_LABEL: _Colors(_NEW_ON_OBJECT)}
        self.things |= {value: _Colors(_NEW_ON_SKIN) for value in HAND_LABEL.values()}
        row, column = np.mgrid[: camera.height, : camera.width]
        pixel = np.stack([column, row], axis=-1).astype(np.float64)
        self.origin = camera.T_world_camera[:3, 3]
        self.ray = (camera.unproject(pixel, np.ones(row.shape)) - self.origin).astype(np.float32)
        self.focal = float(np.sqrt(camera.K[0, 0] * camera.K[1, 1]))
        self.noise = _SUPPORT_NOISE
        """Standard deviation of heights of the support [m]."""
        self.clutter = 0.05
        """Share of the background that is not on the support."""
        self._rise: ndarray | None = None
        self._start = 0.0

    def find_support(self, depth: Float[ndarray, "row column"]) -> None:
        """Find the plane that carries the object, if there is one."""
        point = self.origin + self.ray[depth > 0][::5] * depth[depth > 0][::5, None]
        plane, self.noise = _support(point, self.origin, self.ground)
        if plane is not None:
            self._rise = (self.ray @ plane[:3]).astype(np.float32)
            self._start = float(self.origin @ plane[:3] + plane[3])

    def height(
        self, depth: Float[ndarray, "row column"], window: _Window
    ) -> Float[ndarray, "row column"]:
        """Compute heights above the support [m]; NaN where they are not known."""
        if self._rise is None:
            return np.full(depth.shape, np.nan, dtype=np.float32)
        height = self._start + self._rise[window] * depth
        return np.where(depth > 0, height, np.float32(np.nan))

    def points(
        self, depth: Float[ndarray, "row column"], mask: Bool[ndarray, "row column"]
    ) -> Float[ndarray, "point 3"]:
        """Lift the pixels of a mask that have depth into the world [m]."""
        at = mask & (depth > 0)
        return self.origin + self.ray[at].astype(np.float64) * depth[at][:, None]


def _support(
    point: Float[ndarray, "point 3"], eye: Float[ndarray, " 3"], ground: float | None
) -> tuple[Float[ndarray, " 4"] | None, float]:
    """Fit the plane that most points lie in, by RANSAC and least squares.

    Returns:
        Normal towards the eye and offset, None if no plane holds enough points; and the standard
        deviation of the points' heights [m].
    """
    if ground is not None:
        point = point[np.abs(point[:, 2] - ground) < _SUPPORT_BAND]
    if len(point) < 200:
        return None, _SUPPORT_NOISE
    random = np.random.default_rng(0)
    inside = np.zeros(len(point), dtype=bool)
    for _ in range(150):
        a, b, c = point[random.choice(len(point), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length < 1e-6 or (ground is not None and abs(normal[2]) < 0.98 * length):
            continue
        near = np.abs((point - a) @ (normal / length)) < 2 * _SUPPORT_NOISE
        if near.sum() > inside.sum():
            inside = near
    if inside.sum() < max(3, _LEAST_SUPPORT * len(point)):
        return None, _SUPPORT_NOISE
    normal, mean, noise = np.zeros(3), np.zeros(3), _SUPPORT_NOISE
    for _ in range(3):
        mean = point[inside].mean(axis=0)
        normal = np.linalg.svd((point[inside] - mean).T @ (point[inside] - mean))[0][:, 2]
        height = (point - mean) @ normal
        noise = max(1.4826 * float(np.median(np.abs(height[inside]))), _SUPPORT_NOISE / 2)
        inside = np.abs(height) < 2.5 * noise
    normal = normal if (eye - mean) @ normal > 0 else -normal
    return np.append(normal, -mean @ normal), max(noise, _SUPPORT_NOISE)


class _Patch:
    """What is computed from a window of an image."""

    def __init__(self, seen: _Seen, image: _Image, window: _Window) -> None:
        self.window = window
        self.color = np.ascontiguousarray(image.color[window])
        self.lab = cv2.cvtColor(self.color, cv2.COLOR_RGB2LAB)
        self.code = _code(self.lab, 1.0)
        self.depth = image.depth[window]
        self.has_depth = self.depth > 0
        self.height = seen.height(self.depth, window)


def _code(lab: UInt8[ndarray, "row column 3"], lightness: float) -> Int[ndarray, "row column"]:
    """Number each pixel's color, seen in that share of its light."""
    code = np.zeros(lab.shape[:2], dtype=np.int64)
    for axis, bins in enumerate(_BINS):
        value = lab[..., axis] * (lightness if axis == 0 else 1.0)
        code = code * bins + (value.astype(np.int64) * bins) // 256
    return code


@dataclass(frozen=True)
class _Start:
    """A frame in which a view's object is known before it is followed."""

    image: _Image
    seed: Bool[ndarray, "row column"]
    """Pixels that are surely the object."""
    click: Click | None = None


def _clicked_starts(seen: _Seen, clicks: Many[Click]) -> dict[int, _Start]:
    starts: dict[int, _Start] = {}
    for click in clicks:
        earlier = starts.get(click.frame)
        image = earlier.image if earlier else _Image(seen.view, click.frame)
        seed = _around_click(seen, image, click)
        seed = seed | earlier.seed if earlier else seed
        starts[click.frame] = _Start(image, seed, click)
    return starts


def _around_click(seen: _Seen, image: _Image, click: Click) -> Bool[ndarray, "row column"]:
    """Choose the pixels next to a click that have its color and depth."""
    if click.width > 0 or click.height > 0:
        return _within_box(seen, image, click)
    where = _told(click)
    height, width = image.gray.shape
    row, column = min(round(click.y), height - 1), min(round(click.x), width - 1)
    near = image.depth[max(0, row - 1) : row + 2, max(0, column - 1) : column + 2]
    if not (near > 0).any():
        raise UsageError(
            f"{where}: no depth was measured there. Click where the object shows its face to the "
            "camera, away from its rim."
        )
    depth = float(np.median(near[near > 0]))
    for value, core in _hand_cores(seen, click.frame):
        if core[row, column]:
            side = next(side for side, label in HAND_LABEL.items() if label == value)
            raise UsageError(
                f"{where}: is on the {side} hand. Click on a part of the object that no hand "
                "covers, or in another frame."
            )
    disc = np.zeros(image.gray.shape, dtype=np.uint8)
    radius = int(np.clip(_CLICK_RADIUS * seen.focal / depth, 3, 30))
    cv2.circle(disc, (column, row), radius, 1, -1)
    lab = cv2.cvtColor(image.color, cv2.COLOR_RGB2LAB).astype(np.float32)
    alike = (disc > 0) & (np.linalg.norm(lab - lab[row, column], axis=-1) < _CLICK_COLOR)
    alike &= (image.depth == 0) | (np.abs(image.depth - depth) < EDGE_STEP)
    alike[row, column] = True
    label = cv2.connectedComponents(alike.astype(np.uint8))[1]
    return np.asarray(label == label[row, column])


def _within_box(seen: _Seen, image: _Image, click: Click) -> Bool[ndarray, "row column"]:
    """Choose the pixels in a box that GrabCut tells from what is around it; no hand's."""
    where, size = _told(click), image.gray.shape
    middle, half = np.array([click.y, click.x]), np.array([click.height, click.width]) / 2
    low = np.maximum(np.round(middle - half), 0).astype(int)
    high = np.minimum(np.round(middle + half) + 1, size).astype(int)
    pad = np.maximum(_AROUND_BOX, (high - low) // 2)
    begin, end = np.maximum(low - pad, 0), np.minimum(high + pad, size)
    share = float(np.prod(high - low) / np.prod(end - begin))
    if (high - low).min() < _LEAST_BOX or share > _MOST_OF_WINDOW:
        raise UsageError(
            f"{where}: the box is {high[1] - low[1]}x{high[0] - low[0]} px. Draw it around the "
            f"object, at least {_LEAST_BOX} px wide and high, so that something else remains."
        )
    window = np.s_[begin[0] : end[0], begin[1] : end[1]]
    state = np.full(tuple(end - begin), cv2.GC_BGD, dtype=np.uint8)
    state[low[0] - begin[0] : high[0] - begin[0], low[1] - begin[1] : high[1] - begin[1]] = (
        cv2.GC_PR_FGD
    )
    cv2.setRNGSeed(0)  # Its mixtures of Gaussians start from random places.
    nothing = np.zeros((1, 65))
    color = np.ascontiguousarray(image.color[window])
    _cv2.grabCut(color, state, None, nothing, nothing.copy(), 4, cv2.GC_INIT_WITH_MASK)
    inside = np.zeros(size, dtype=np.uint8)
    inside[window] = (state == cv2.GC_FGD) | (state == cv2.GC_PR_FGD)
    for _, core in _hand_cores(seen, click.frame):
        inside[core > 0] = 0
    inside = cv2.erode(inside, np.ones((3, 3), np.uint8))
    count, label, parts, _ = cv2.connectedComponentsWithStats(inside)
    if count < 2 or parts[1:, cv2.CC_STAT_AREA].max() < _LEAST_OBJECT:
        raise UsageError(
            f"{where}: nothing in the box stands out from what is around it. Click on the object "
            "instead, or choose another view or frame."
        )
    return np.asarray(label == 1 + int(parts[1:, cv2.CC_STAT_AREA].argmax()))


def _borrowed_start(seen: _Seen, clicked: list[_Seen]) -> dict[int, _Start]:
    """Choose the frame in which a view sees most of what the clicked views call the object."""
    count = seen.view.frame_count
    best, most = (0, np.zeros(seen.label.shape[1:], dtype=bool)), -1
    for frame in sorted({0, count - 1, *range(0, count, max(1, count // 6))}):
        depth = seen.view.depth(frame) if seen.view.has_depth else None
        seed = np.zeros(seen.label.shape[1:], dtype=bool)
        for other in clicked:
            mask = other.label[frame] == OBJECT_LABEL
            seed |= _projected(seen, depth, other.points(other.view.depth(frame), mask))
        for _, core in _hand_cores(seen, frame):
            seed &= core == 0
        if seed.sum() > most:
            best, most = (frame, seed), int(seed.sum())
    for other in clicked:
        for value, colors in seen.things.items():
            colors.inherit(other.things[value])
    return {best[0]: _Start(_Image(seen.view, best[0]), best[1])}


def _projected(
    seen: _Seen, depth: Float[ndarray, "row column"] | None, point: Float[ndarray, "point 3"]
) -> Bool[ndarray, "row column"]:
    """Mark the pixels in which a view sees points of the world."""
    mark = np.zeros(seen.label.shape[1:], dtype=bool)
    pixel = np.nan_to_num(seen.view.camera.project(point), nan=-1e6)
    column, row = np.clip(pixel.round(), -1e6, 1e6).astype(np.int64).T
    inside: ndarray = (row >= 0) & (column >= 0) & (row < mark.shape[0]) & (column < mark.shape[1])
    if depth is not None:
        there = depth[row[inside], column[inside]]
        gap = np.abs(there - seen.view.camera.camera_depth(point[inside]))
        inside[inside] = (there == 0) | (gap < EDGE_STEP)
    mark[row[inside], column[inside]] = True
    return mark


def _follow(seen: _Seen, starts: dict[int, _Start]) -> Iterator[int]:
    """Label all frames from their nearest start on; yields each that is finished."""
    frames = sorted(starts)
    ends = [(a + b) // 2 + 1 for a, b in itertools.pairwise(frames)]
    bounds = [0, *ends, seen.view.frame_count]
    for start, low, high in zip(frames, bounds, bounds[1:], strict=False):
        image, click = starts[start].image, starts[start].click
        seen.find_support(image.depth)
        first = seen.label[start] = _begin(seen, image, starts[start].seed)
        if click is not None and (first == OBJECT_LABEL).sum() < _LEAST_OBJECT:
            raise UsageError(
                f"{_told(click)}: nothing there stands out from what is around it. Click on a part "
                "of the object with a color of its own, or in another view or frame."
            )
        yield start
        for way in (range(start + 1, high), range(start - 1, low - 1, -1)):
            before, label = image, first
            for now in _images(seen.view, way):
                label = seen.label[now.frame] = _advance(seen, before, label, now)
                before = now
                yield now.frame


def _follow_by_model(
    model: MaskModel, seen: _Seen, starts: dict[int, _Start], clicks: list[Click]
) -> Iterator[int]:
    """Label all frames as a model finds them; yields each that is finished."""
    for start in starts.values():
        seen.find_support(start.image.depth)
    prompts = _prompts(seen, starts, clicks)
    if not prompts:
        yield from range(seen.view.frame_count)
        return
    for frame, logits in model.follow(seen.view, prompts):
        things = list(logits)
        score = np.stack([np.zeros_like(logits[things[0]]), *logits.values()])
        label = np.array([_BACKGROUND, *things], dtype=np.uint8)[score.argmax(axis=0)]
        for value, core in _hand_cores(seen, frame):
            away = cv2.distanceTransform((core == 0).astype(np.uint8), cv2.DIST_L2, 3)
            label[(label == value) & (away > _ARM * np.sqrt(core.sum()))] = _BACKGROUND
        seen.label[frame] = label
        for click in clicks:
            if click.frame == frame and not (label == OBJECT_LABEL).any():
                raise UsageError(
                    f"{_told(click)}: the mask model finds nothing there. Click on another part of "
                    "the object, or do without --mask-model."
                )
        yield frame


def _prompts(
    seen: _Seen, starts: dict[int, _Start], clicks: list[Click]
) -> dict[int, list[Prompt]]:
    """Choose what a model is told of object and hands."""
    nothing = np.zeros((0, 2))
    places: dict[int, ndarray] = {}
    for frame in sorted(starts):
        clicked = [(click.x, click.y) for click in clicks if click.frame == frame]
        place = np.array(clicked) if clicked else _spread(starts[frame].seed)
        if len(place):
            places[frame] = place
    hands = {HAND_LABEL[side]: _hand_places(seen, HAND_LABEL[side]) for side in seen.hands}
    prompts: dict[int, list[Prompt]] = {}
    for frame, place in places.items():
        others = [own[frame] for own in hands.values() if frame in own]
        other = np.concatenate(others) if others else nothing
        prompts.setdefault(OBJECT_LABEL, []).append(Prompt(frame, place, other))
    for value, own in hands.items():
        shown = [Prompt(at, place, places.get(at, nothing)) for at, place in own.items()]
        if shown:
            prompts[value] = shown
    return prompts


def _hand_places(seen: _Seen, value: int) -> dict[int, Float[ndarray, "point 2"]]:
    """Find places on a hand in a few frames: of its palm, or as other views show it."""
    places: dict[int, ndarray] = {}
    count = seen.view.frame_count
    if seen.keypoint is not None:
        hand = [HAND_LABEL[side] for side in seen.hands].index(value)
        last = -_REMINDED
        for frame in range(count):
            palm = seen.keypoint[frame, hand, list(_PALM), :2].astype(np.float64)
            inside = (palm > -0.5) & (palm < np.array(seen.label.shape[:0:-1]) - 0.5)
            palm = palm[inside.all(axis=1)]
            if len(palm) >= _PLACES and frame - last >= _REMINDED:
                places[frame], last = palm, frame
    if not places:
        for frame in sorted({*range(0, count, max(1, count // 6))}):
            for _, core in _borrowed_cores(seen, frame, {value}):
                places[frame] = _spread(core > 0)
    return places


def _spread(mask: Bool[ndarray, "row column"]) -> Float[ndarray, "point 2"]:
    """Choose places inside of a mask, far from its rim and from each other [px]."""
    room = np.pad(mask, 1).astype(np.uint8)
    chosen: list[tuple[float, float]] = []
    while len(chosen) < _PLACES and room.any():
        inside = cv2.distanceTransform(room, cv2.DIST_L2, 3)
        row, column = np.unravel_index(int(inside.argmax()), inside.shape)
        chosen.append((float(column) - 1, float(row) - 1))
        reach = max(1, round(0.3 * float(np.sqrt(mask.sum()))))
        cv2.circle(room, (int(column), int(row)), reach, 0, -1)
    return np.array(chosen).reshape(-1, 2)


def _images(view: View, frames: range) -> Iterator[_Image]:
    """Read images in any direction; videos, which go forwards only, piece by piece."""
    if frames.step > 0:
        yield from (_Image(view, frame) for frame in frames)
        return
    for start in range(0, len(frames), _CHUNK):
        piece = frames[start : start + _CHUNK]
        yield from reversed([_Image(view, frame) for frame in reversed(piece)])


def _hand_cores(seen: _Seen, frame: int) -> Iterator[tuple[int, UInt8[ndarray, "row column"]]]:
    """Draw bones and palm of each hand whose keypoints are known; yields label and picture."""
    if seen.keypoint is None:
        return
    for hand, side in enumerate(seen.hands):
        core = draw_hand(seen.keypoint[frame, hand, :, :2], seen.label.shape[1:])
        if core is None:
            continue
        yield HAND_LABEL[side], core


def draw_hand(
    keypoint: Float[ndarray, "21 2"], shape: tuple[int, ...]
) -> UInt8[ndarray, "row column"] | None:
    """Draw bones and palm of a hand into an image, 1 where they are.

    Args:
        keypoint: Its keypoints; NaN where not known [px].
        shape: Rows and columns of the image.

    Returns:
        The picture; None if too few keypoints are known.
    """
    pixel = keypoint.astype(np.float64)
    is_seen = np.asarray(np.isfinite(pixel).all(axis=1))
    if is_seen.sum() < _LEAST_JOINTS:
        return None
    core = np.zeros(shape, dtype=np.uint8)
    at = np.clip(np.where(is_seen[:, None], pixel, 0), -1e4, 1e4).round().astype(np.int32)
    hull = at[[joint for joint in _PALM if is_seen[joint]]]
    if is_seen[0] and is_seen[9]:
        # Keypoint 0 is inside of the wrist; the hand goes on a little.
        beyond = np.clip(pixel[0] + 0.25 * (pixel[0] - pixel[9]), -1e4, 1e4)
        hull = np.concatenate([hull, beyond.round().astype(np.int32)[None]])
    if len(hull) > 2:
        cv2.fillConvexPoly(core, cv2.convexHull(hull), 1)
    width = max(1, round(0.16 * _palm_size(pixel)))
    for bone in _BONES:
        line = at[[joint for joint in bone if is_seen[joint]]]
        if len(line) > 1:
            cv2.polylines(core, [line], isClosed=False, color=1, thickness=width)
    return core


def _palm_size(pixel: Float[ndarray, "21 2"]) -> float:
    """Measure a palm in the image by the longest of its sides that are seen [px]."""
    sides = np.array([np.linalg.norm(pixel[a] - pixel[b]) for a, b in _PALM_SIDES])
    if np.isfinite(sides).any():
        return float(np.nanmax(sides))
    return float(np.nanmax(np.nanmax(pixel, axis=0) - np.nanmin(pixel, axis=0))) / 2


def _is_raised_hand(
    core: Bool[ndarray, "row column"],
    depth: Float[ndarray, "row column"],
    height: Float[ndarray, "row column"],
) -> Bool[ndarray, "row column"]:
    """Leave out what lies on the support, or far before or behind the hand, if depth tells."""
    raised = core & (depth > 0) & ~(height < 1.5 * _HAND_HEIGHT)
    if raised.sum() < 5:
        return core
    middle = float(np.median(depth[raised]))
    near = np.abs(depth - middle) < _HAND_DEPTH
    return core & (depth > 0) & near & ~(height < _HAND_HEIGHT)


def _borrowed_cores(seen: _Seen, frame: int, missing: set[int]) -> Iterator[tuple[int, ndarray]]:
    """Show hands in a view whose keypoints are not known, by those of the others and depth."""
    own = seen.view.depth(frame) if seen.view.has_depth else None
    mark = {value: np.zeros(seen.label.shape[1:], dtype=bool) for value in missing}
    for other in seen.others:
        for value, core in _hand_cores(other, frame):
            if value in missing:
                depth = other.view.depth(frame)
                at = _is_raised_hand(core > 0, depth, other.height(depth, other.whole))
                mark[value] |= _projected(seen, own, other.points(depth, at))
    for value, at in mark.items():
        closed = cv2.morphologyEx(at.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        if closed.sum() >= _LEAST_OBJECT:
            yield value, closed


def _hand_anchors(
    seen: _Seen, patch: _Patch, frame: int, carried: UInt8[ndarray, "row column"] | None
) -> _Anchors:
    """Find where hands are: at their keypoints, at those of other views, or where they were."""
    anchors: _Anchors = {}
    cores = dict(_hand_cores(seen, frame))
    missing = {HAND_LABEL[side] for side in seen.hands} - set(cores)
    if missing:
        cores |= dict(_borrowed_cores(seen, frame, missing))
    for value, core in cores.items():
        inside = _is_raised_hand(core[patch.window] > 0, patch.depth, patch.height)
        off_bones = _off_bones(seen, patch, frame, value)
        if off_bones is not None:
            inside &= off_bones == 0
        wide = inside
        if carried is not None and inside.any():
            reach = max(2, round(_WIDER * float(np.sqrt(core.sum()))))
            near = cv2.dilate(inside.astype(np.uint8), _disc(reach)) > 0
            wide = inside | (near & (carried == value))
        if inside.any():
            anchors[value] = _Anchor(inside, wide, off_bones)
    if carried is not None:
        for value in missing - set(anchors):
            if (carried == value).sum() >= _LEAST_OBJECT:
                anchors[value] = _Anchor(np.zeros(carried.shape, dtype=bool), carried == value)
    return anchors


def _leave_out_wrong_hands(all_seen: Many[_Seen]) -> None:
    """Drop keypoints that depth puts elsewhere than those of a view that is surer of its hand.

    A detector may take something for a hand that is none, the object's pattern for instance. The
    view is then shown the hand by the others, like one in which none was detected.
    """
    judged = [seen for seen in all_seen if seen.keypoint is not None and seen.view.has_depth]
    if len(judged) < 2:
        return
    keypoint = np.stack([np.asarray(seen.keypoint) for seen in judged])
    # Over the whole recording: a wrong hand is found in few frames, but may be sure in some.
    trust = np.nan_to_num(keypoint[..., 2]).mean(axis=(1, 3))
    for frame, hand in np.ndindex(*keypoint.shape[1:3]):
        middle = np.stack(
            [
                _middle_of_hand(seen, frame, keypoint[view, frame, hand])
                for view, seen in enumerate(judged)
            ]
        )
        for view in np.argsort(trust[:, hand]):
            apart = np.linalg.norm(middle - middle[view], axis=1) > _APART
            together = np.isfinite(middle[:, 0]) & ~apart
            if trust[apart, hand].sum() > trust[together, hand].sum():
                keypoint[view, frame, hand] = middle[view] = np.nan
    for seen, own in zip(judged, keypoint, strict=True):
        seen.keypoint = own


def _middle_of_hand(
    seen: _Seen, frame: int, keypoint: Float[ndarray, "21 3"]
) -> Float[ndarray, " 3"]:
    """Find where depth puts a hand's keypoints, on the median [m]; NaN if it tells of few."""
    height, width = seen.label.shape[1:]
    column, row = np.nan_to_num(keypoint[:, :2], nan=-1.0).round().astype(np.int64).T
    inside: ndarray = (row >= 0) & (column >= 0) & (row < height) & (column < width)
    if inside.sum() < _LEAST_JOINTS:
        return np.full(3, np.nan)
    depth = seen.view.depth(frame)[row[inside], column[inside]]
    if (depth > 0).sum() < _LEAST_JOINTS:
        return np.full(3, np.nan)
    pixel = keypoint[inside, :2][depth > 0].astype(np.float64)
    return np.median(seen.view.camera.unproject(pixel, depth[depth > 0]), axis=0)


def _place_hands(sequence: Sequence, all_seen: Many[_Seen]) -> None:
    """Triangulate the keypoints of each hand, in the frames in which views agree about all."""
    pairs = [(seen, seen.keypoint) for seen in all_seen if seen.keypoint is not None]
    cameras = [seen.view.camera for seen, _ in pairs]
    if len(pairs) < 2:
        return
    for number, side in enumerate(sequence.hands):
        keypoint = np.stack([part[:, number] for _, part in pairs]).astype(np.float64)
        is_whole = np.isfinite(keypoint).all(axis=(2, 3))
        if not is_whole.any():
            continue
        pixel = keypoint[is_whole][..., :2]
        size = float(np.median(np.linalg.norm(np.ptp(pixel, axis=1), axis=1)))
        flat = keypoint.reshape(len(pairs), -1, 3)
        weight = np.nan_to_num(flat[..., 2])
        joint = triangulate(cameras, flat[..., :2], weight, _AGREEMENT * size).reshape(-1, 21, 3)
        joint[~np.isfinite(joint).all(axis=(1, 2))] = np.nan
        for seen in all_seen:
            seen.joint[HAND_LABEL[side]] = joint


def _off_bones(
    seen: _Seen, patch: _Patch, frame: int, value: int
) -> Float[ndarray, "row column"] | None:
    """Compute what being a hand costs by the distance in space from its bones.

    A finger that is behind something is drawn there, too; depth tells them apart. Pixels without
    depth cost nothing.
    """
    joint = seen.joint.get(value)
    if joint is None or not np.isfinite(joint[frame]).all():
        return None
    cost = np.where(patch.has_depth, np.float32(_FARTHEST), np.float32(0.0))
    reach = _FLESH + _FARTHEST * _SLACK
    depth = seen.view.camera.camera_depth(joint[frame])
    pixel = seen.view.camera.project(joint[frame])
    if not np.isfinite(pixel).all() or depth.min() < 2 * reach:
        return None
    around = reach * seen.focal / (depth.min() - reach)
    # Nothing outside of this box is near enough.
    start = np.array([side.start for side in patch.window])
    low = np.maximum(np.floor(pixel[:, ::-1].min(axis=0) - around) - start, 0).astype(int)
    high = np.maximum(np.ceil(pixel[:, ::-1].max(axis=0) + around) + 1 - start, low).astype(int)
    box = np.s_[low[0] : high[0], low[1] : high[1]]
    at = patch.has_depth[box]
    point = (seen.origin + seen.ray[patch.window][box][at] * patch.depth[box][at][:, None]).T
    nearest = np.full(point.shape[1], np.inf)
    pairs = [pair for bone in _BONES for pair in itertools.pairwise(bone)]
    for first, last in (*pairs, *_PALM_BONES):
        begin, bone = joint[frame, first], joint[frame, last] - joint[frame, first]
        offset = point - begin[:, None]
        share = np.clip(bone @ offset / max(float(bone @ bone), 1e-9), 0.0, 1.0)
        nearest = np.minimum(nearest, ((offset - share * bone[:, None]) ** 2).sum(axis=0))
    cost[box][at] = np.clip((np.sqrt(nearest) - _FLESH) / _SLACK, 0.0, _FARTHEST)
    return cost


def _disc(radius: int) -> UInt8[ndarray, "row column"]:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2).astype(np.uint8)


def _farness(
    seen: _Seen, patch: _Patch, anchor: Bool[ndarray, "row column"]
) -> Float[ndarray, "row column"]:
    """Compute what a label costs by the distance, in space, from where it is expected."""
    distance, nearest = _cv2.distanceTransformWithLabels(
        (~anchor).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    rows, columns = np.nonzero(anchor)
    number = np.zeros(int(nearest.max()) + 1, dtype=np.int64)
    number[nearest[rows, columns]] = np.arange(len(rows))
    there = patch.depth[rows, columns]
    typical = float(np.median(there[there > 0])) if (there > 0).any() else 1.0
    there = there[number[nearest]]
    across = distance * np.where(there > 0, there, typical) / seen.focal
    along = np.where((there > 0) & patch.has_depth, np.abs(patch.depth - there), 0.0)
    return np.clip((np.hypot(across, along) - _REACH) / _SLACK, 0.0, _FARTHEST)


def _height_scores(
    seen: _Seen, height: Float[ndarray, "row column"]
) -> tuple[Float[ndarray, "row column"], ...]:
    """Compute log-likelihoods of heights for background, object and hands."""
    is_measured = np.isfinite(height)
    h = np.where(is_measured, height, 0.0)
    sigma = 1.2 * seen.noise
    flat = np.exp(-0.5 * (h / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi))
    above = 1 / (1 + np.exp(-np.clip(h / (0.7 * sigma), -30, 30)))
    low = above / (1 + np.exp(np.clip((h - _LOW) / (2 * sigma), -30, 30)))
    background = (1 - seen.clutter) * flat + seen.clutter / _HIGHEST
    object_ = 0.5 * low / _LOW + (0.5 * above + 0.02) / _HIGHEST
    hand = 0.3 * low / _LOW + (above + 0.02) / _HIGHEST
    return tuple(np.where(is_measured, np.log(x), 0.0) for x in (background, object_, hand))


def _judge(
    seen: _Seen,
    patch: _Patch,
    hands: _Anchors,
    farness: Float[ndarray, "row column"] | None,
    carried: UInt8[ndarray, "row column"] | None,
    *,
    has_object: bool,
) -> tuple[list[int], Float[ndarray, "label row column"]]:
    """Score every label in every pixel.

    Args:
        seen: The view.
        patch: What is judged.
        hands: Where hands are.
        farness: What the object costs by its distance; None where nobody knows where it was.
        carried: Labels that flow brings.
        has_object: Whether there is an object to be found.
    """
    background, object_, hand = _height_scores(seen, patch.height)
    background = background + seen.background.log_density(patch.code)
    labels, scores = [_BACKGROUND], [background]
    if has_object:
        score = object_ + seen.things[OBJECT_LABEL].log_density(patch.code)
        if farness is not None:
            score = score - farness
            background -= _RAISED * ((farness < 0.5) & (patch.height > 4 * seen.noise))
        labels.append(OBJECT_LABEL)
        scores.append(score)
    for value, anchor in hands.items():
        score = hand + seen.things[value].log_density(patch.code)
        cost = _farness(seen, patch, anchor.wide)
        if anchor.off_bones is not None:
            cost = np.maximum(cost, anchor.off_bones)
        labels.append(value)
        scores.append(score - cost + _CORE * anchor.core)
    if carried is not None:
        for index, value in enumerate(labels):
            share = cv2.GaussianBlur((carried == value).astype(np.float32), (0, 0), _SOFT)
            scores[index] = scores[index] + np.log((1 - _STAY) * share + _STAY / 3)
    return labels, _decided_together(patch, np.stack(scores).astype(np.float32))


def _decided_together(
    patch: _Patch, score: Float[ndarray, "label row column"]
) -> Float[ndarray, "label row column"]:
    """Average scores over the pixels around that look alike."""
    planes = [patch.lab[..., axis].astype(np.float32) for axis in range(3)]
    height, width = planes[0].shape
    total, weight = np.zeros_like(score), np.zeros((height, width), dtype=np.float32)
    wide_score = np.stack([np.pad(plane, 2, mode="edge") for plane in score])
    wide = [np.pad(plane, 2, mode="edge") for plane in planes]
    for down in range(5):
        for across in range(5):
            at = np.s_[down : down + height, across : across + width]
            far = ((down - 2) ** 2 + (across - 2) ** 2) / (2 * _AROUND**2)
            # Channel by channel: a sum over a last axis of three is ten times as slow.
            a, b, c = (
                np.square(there[at] - here) for there, here in zip(wide, planes, strict=True)
            )
            share = np.exp(-(a + b + c) / np.float32(2 * _ALIKE**2) - np.float32(far))
            total += share * wide_score[:, *at]
            weight += share
    return total / weight


def _begin(
    seen: _Seen, image: _Image, seed: Bool[ndarray, "row column"]
) -> UInt8[ndarray, "row column"]:
    """Label a first frame, and learn from it how everything looks."""
    patch = _Patch(seen, image, seen.whole)
    hands = _hand_anchors(seen, patch, image.frame, None)
    shadowed = [_code(patch.lab, share) for share in _SHADOWS]
    for code in shadowed:
        seen.background.add(code.reshape(-1), 1 / len(_SHADOWS))
    colors = seen.things[OBJECT_LABEL]
    for value, hand in hands.items():
        seen.things[value].add(patch.code[hand.core])
        seed = seed & ~hand.core
    is_whole = colors.is_known()  # Other views have shown it, and where all of it is.
    if is_whole and seed.any():
        seed = _own_seed(seen, patch, seed, list(hands))
    has_object = int(seed.sum()) > 0
    _learn_object(colors, shadowed, seed)
    label = np.zeros(seed.shape, dtype=np.uint8)
    farness = None
    for _ in range(_ROUNDS):
        labels, score = _judge(seen, patch, hands, None, None, has_object=has_object)
        if farness is not None:
            score[0] -= _RAISED * ((farness < 0.5) & (patch.height > 4 * seen.noise))
        label = np.array(labels, dtype=np.uint8)[score.argmax(axis=0)]
        if has_object:
            label = _hanging_together(seen, patch, label, seed)
            label, unsure = _without_thick_hands(seen, patch, label)
            is_object = (label == OBJECT_LABEL) | seed
            # From a click, an object of several colors is found by what lies between them.
            sure = is_object & ~unsure
            _learn_object(colors, shadowed, _off_rim(seen, patch, sure) if is_whole else sure)
            farness = _farness(seen, patch, is_object)
        for value, hand in hands.items():
            seen.things[value].replace(patch.code[hand.core & (label == value)])
        _learn_background(seen, patch, shadowed, label)
    return _outlined(seen, patch, label)


def _learn_given(seen: _Seen, image: _Image, label: UInt8[ndarray, "row column"]) -> None:
    """Learn from a frame whose labels are right how everything looks."""
    patch = _Patch(seen, image, seen.whole)
    shadowed = [_code(patch.lab, share) for share in _SHADOWS]
    inner = _off_rim(seen, patch, label == OBJECT_LABEL)
    _learn_object(seen.things[OBJECT_LABEL], shadowed, inner)
    for value in HAND_LABEL.values():
        seen.things[value].replace(patch.code[label == value])
    _learn_background(seen, patch, shadowed, label)


def _learn_background(
    seen: _Seen,
    patch: _Patch,
    shadowed: list[Int[ndarray, "row column"]],
    label: UInt8[ndarray, "row column"],
) -> None:
    """Learn the colors of what is neither object nor hand, and how much of it is not support."""
    free = cv2.dilate(label, np.ones((3, 3), np.uint8)) == 0
    seen.background.replace(np.concatenate([code[free] for code in shadowed]))
    is_measured = free & np.isfinite(patch.height)
    if is_measured.sum() > 200:
        off = np.abs(patch.height[is_measured]) > 5 * seen.noise
        seen.clutter = float(np.clip(off.mean(), 0.003, 0.3))


def _learn_object(
    colors: _Colors, shadowed: list[Int[ndarray, "row column"]], mask: Bool[ndarray, "row column"]
) -> None:
    """Learn the object's colors, and what they are in shadows."""
    colors.replace(shadowed[0][mask])
    for code in shadowed[1:]:
        colors.add(code[mask], _SHADED)


def _off_rim(
    seen: _Seen, patch: _Patch, mask: Bool[ndarray, "row column"]
) -> Bool[ndarray, "row column"]:
    """Leave out the rim of the object, unless that is most of it or shows much of its surface."""
    if not _has_narrow_rim(seen, patch, mask):
        return mask
    inner = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return inner if inner.sum() > _LEAST_INNER * mask.sum() else mask


def _has_narrow_rim(seen: _Seen, patch: _Patch, mask: Bool[ndarray, "row column"]) -> bool:
    """Tell whether a pixel is so narrow on the object that its rim shows little of it."""
    depth = patch.depth[mask & patch.has_depth]
    return depth.size > 0 and float(np.median(depth)) <= _WIDEST_PIXEL * seen.focal


def _own_seed(
    seen: _Seen, patch: _Patch, seed: Bool[ndarray, "row column"], hands: list[int]
) -> Bool[ndarray, "row column"]:
    """Keep of what other views show where the color is the object's: calibration errs a little."""
    own = seen.things[OBJECT_LABEL].log_density(patch.code)
    rivals = [seen.background, *(seen.things[value] for value in hands)]
    alike = np.all([own > rival.log_density(patch.code) for rival in rivals], axis=0)
    return alike & (cv2.dilate(seed.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0)


def _advance(
    seen: _Seen, before: _Image, label: UInt8[ndarray, "row column"], now: _Image
) -> UInt8[ndarray, "row column"]:
    """Label the frame after (or before) a labelled one."""
    window = _window(seen, label, now.frame)
    patch = _Patch(seen, now, window)
    flow = _cv2.DISOpticalFlow_create(_cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(
        np.ascontiguousarray(now.gray[window]), np.ascontiguousarray(before.gray[window]), None
    )
    row, column = np.mgrid[: flow.shape[0], : flow.shape[1]].astype(np.float32)
    carried = cv2.remap(
        np.ascontiguousarray(label[window]),
        column + flow[..., 0],
        row + flow[..., 1],
        cv2.INTER_NEAREST,
        borderMode=cv2.BORDER_REPLICATE,
    )
    hands = _hand_anchors(seen, patch, now.frame, carried)
    anchor = carried == OBJECT_LABEL
    has_object = bool(anchor.any())
    for value, hand in hands.items():
        if not seen.things[value].is_known():
            seen.things[value].add(patch.code[hand.core])
    farness = _farness(seen, patch, anchor) if has_object else None
    labels, score = _judge(seen, patch, hands, farness, carried, has_object=has_object)
    inner = np.array(labels, dtype=np.uint8)[score.argmax(axis=0)]
    unsure = np.zeros(inner.shape, dtype=bool)
    if has_object:
        inner = _hanging_together(seen, patch, inner, anchor)
        inner, unsure = _without_thick_hands(seen, patch, inner)
    _learn(seen, patch, labels, score, inner, unsure=unsure)
    result = np.zeros_like(label)
    result[window] = _outlined(seen, patch, inner)
    return result


def _learn(
    seen: _Seen,
    patch: _Patch,
    labels: list[int],
    score: Float[ndarray, "label row column"],
    label: UInt8[ndarray, "row column"],
    *,
    unsure: Bool[ndarray, "row column"],
) -> None:
    """Follow colors as light and sides of things change, but for what is unsure of the object."""
    if len(labels) < 2:
        return
    ordered = np.sort(score, axis=0)
    is_sure = ordered[-1] - ordered[-2] > _SURE
    for value in labels[1:]:
        rate = _OBJECT_RATE if value == OBJECT_LABEL else _SKIN_RATE
        seen.things[value].fade(_MEMORY * max(50, int((label == value).sum())))
        mine = label == value
        if value == OBJECT_LABEL:
            mine = _off_rim(seen, patch, mine & ~unsure)
        of_thing = is_sure & mine
        seen.things[value].add(patch.code[of_thing], rate)
        if value == OBJECT_LABEL:
            for share in _SHADOWS[1:]:
                code = _code(patch.lab[of_thing][None], share)[0]
                seen.things[value].add(code, _SHADED * rate)


def _window(seen: _Seen, label: UInt8[ndarray, "row column"], frame: int) -> _Window:
    """Choose the part of an image in which all things will be."""
    mask = label > 0
    for _, core in _hand_cores(seen, frame):
        mask = mask | (core > 0)
    if not mask.any() or (seen.hands and not (label > OBJECT_LABEL).any()):
        return seen.whole
    pad = max(24, round(0.08 * mask.shape[1]))
    spans: list[slice] = []
    for axis in (0, 1):
        at = np.flatnonzero(mask.any(axis=1 - axis))
        low, high = int(at[0]) - pad, int(at[-1]) + pad + 1
        short = max(0, 96 - (high - low))
        spans.append(slice(max(0, low - short), min(mask.shape[axis], high + short)))
    return spans[0], spans[1]


def _hanging_together(
    seen: _Seen,
    patch: _Patch,
    label: UInt8[ndarray, "row column"],
    seed: Bool[ndarray, "row column"],
) -> UInt8[ndarray, "row column"]:
    """Keep the pieces of the object that hold a seed, or hang on such a piece behind a hand.

    What begins beside a hand and has its colors rather than the object's is the hand's: a wrist
    that its keypoints do not reach, for instance. Other pieces are background.
    """
    is_object = label == OBJECT_LABEL
    piece = _pieces(seen, patch, is_object)
    count = int(piece.max()) + 1
    size = np.bincount(piece[is_object], minlength=count)
    is_kept = np.bincount(piece[is_object & seed], minlength=count) > 0
    stays = is_object & is_kept[piece]
    hand = label > OBJECT_LABEL
    owner = np.zeros(count, dtype=np.uint8)
    if is_kept.any() and hand.any():
        touches, owner = _beside_hands(seen, patch, label, piece, is_kept=is_kept)
        if touches[is_kept].any():
            least = max(_LEAST_PIECE, 0.02 * float(stays.sum()))
            is_kept |= touches & (owner == _BACKGROUND) & (size >= least)
            stays = is_object & is_kept[piece]
    # At depth edges single pixels are pieces of their own.
    stays = is_object & (cv2.dilate(stays.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)
    return np.where(is_object & ~stays, owner[piece], label)


def _without_thick_hands(
    seen: _Seen, patch: _Patch, label: UInt8[ndarray, "row column"]
) -> tuple[UInt8[ndarray, "row column"], Bool[ndarray, "row column"]]:
    """Give hands what is beside them and too thick for a long thin object, if it may be theirs.

    What keypoints do not reach of a hand goes on in space from the rope that it holds. But a rope
    is as thin beside a hand as elsewhere, unless it is wound there, which its colors tell.

    Returns:
        Labels, and what of a long thin object is too near to a hand, or too thick beside one, for
        its colors to be learned: they may be the hand's, or those of its shadow.
    """
    mask = (label == OBJECT_LABEL).astype(np.uint8)
    hands = np.unique(label[label > OBJECT_LABEL]).tolist()
    width = _width_of_thin(mask) if hands else None
    if width is None:
        return label, np.zeros(label.shape, dtype=bool)
    thick = _opened(mask, max(2, round(0.5 * (_TOO_THICK * width - 1.0))))
    thick = mask & cv2.dilate(thick, _disc(round(0.5 * width) + 1))
    count, piece = cv2.connectedComponents(thick)
    owner, most = np.zeros_like(label), np.full(label.shape, -np.inf, dtype=np.float32)
    near, unsure = _disc(_hand_reach(seen, patch, label)), np.zeros(label.shape, dtype=bool)
    for value in hands:
        beside = cv2.dilate((label == value).astype(np.uint8), near) > 0
        density = seen.things[value].log_density(patch.code)
        is_more = (np.bincount(piece[beside], minlength=count) > 0)[piece] & (density > most)
        is_more &= thick > 0
        owner[is_more], most[is_more] = value, density[is_more]
        unsure |= beside | is_more
    # What neither shows elsewhere, like shaded skin, is thick as a hand is.
    own = seen.things[OBJECT_LABEL].log_density(patch.code)
    return np.where((owner > 0) & (own <= np.maximum(most, 0.0)), owner, label), unsure


def _width_of_thin(mask: UInt8[ndarray, "row column"]) -> float | None:
    """Find the width of a long thin object [px]; None of other things."""
    width = _typical_width(mask)
    return None if width is None or mask.sum() < _LEAST_WIDTHS * width**2 else width


def _typical_width(mask: UInt8[ndarray, "row column"]) -> float | None:
    """Find the width that half of a mask is narrower than [px]; None from `_WIDEST` on."""
    half = 0.5 * float(mask.sum())
    area = 2.0 * half
    for radius in range(1, _WIDEST // 2 if half else 1):
        left = float(_opened(mask, radius).sum())
        if left < half:
            return 2.0 * (radius - 1 + (area - half) / (area - left)) + 1.0
        area = left
    return None


def _opened(mask: UInt8[ndarray, "row column"], radius: int) -> UInt8[ndarray, "row column"]:
    """Keep what discs of a radius fit into; what goes on beyond the image has room there."""
    wide = cv2.copyMakeBorder(mask, *(radius,) * 4, cv2.BORDER_REPLICATE)
    opened = cv2.morphologyEx(wide, cv2.MORPH_OPEN, _disc(radius))
    return opened[radius:-radius, radius:-radius]


def _beside_hands(
    seen: _Seen,
    patch: _Patch,
    label: UInt8[ndarray, "row column"],
    piece: Int[ndarray, "row column"],
    *,
    is_kept: Bool[ndarray, " piece"],
) -> tuple[Bool[ndarray, " piece"], UInt8[ndarray, " piece"]]:
    """Tell which pieces of the object are beside a hand, and which of these are its skin.

    Args:
        seen: The view.
        patch: What is judged.
        label: Labels.
        piece: Numbers of the object's pieces.
        is_kept: Pieces that are the object's.

    Returns:
        Whether each piece is beside a hand; and the label of the hand whose colors it has rather
        than the object's, 0 of those that are the object's or no hand's.
    """
    is_object = label == OBJECT_LABEL
    near = _disc(_hand_reach(seen, patch, label))
    is_asked = is_object & ~is_kept[piece]
    count = len(is_kept)
    touches, owner, most = np.zeros(count, bool), np.zeros(count, np.uint8), np.zeros(count)
    own = seen.things[OBJECT_LABEL].log_density(patch.code[is_asked])
    for value in np.unique(label[label > OBJECT_LABEL]).tolist():
        beside = cv2.dilate((label == value).astype(np.uint8), near) > 0
        is_beside = np.bincount(piece[is_object & beside], minlength=count) > 0
        touches |= is_beside
        lead = seen.things[value].log_density(patch.code[is_asked]) - own
        lead = np.bincount(piece[is_asked], weights=lead, minlength=count)
        owner[is_beside & (lead > most)] = value
        most = np.where(is_beside, np.maximum(most, lead), most)
    return touches, owner


def _hand_reach(seen: _Seen, patch: _Patch, label: UInt8[ndarray, "row column"]) -> int:
    """Tell how far from a hand something is beside it [px]."""
    depth = patch.depth[(label > OBJECT_LABEL) & patch.has_depth]
    return max(1, round(_BRIDGE * seen.focal / float(np.median(depth)))) if depth.size else 3


def _pieces(
    seen: _Seen, patch: _Patch, mask: Bool[ndarray, "row column"]
) -> Int[ndarray, "row column"]:
    """Number the pieces of a mask within which no neighbours are a step of depth apart."""
    result = np.zeros(mask.shape, dtype=np.int64)
    size = int(mask.sum())
    if size == 0:
        return result
    number = np.zeros(mask.shape, dtype=np.int64)
    number[mask] = np.arange(size)
    height, width = mask.shape
    starts: list[ndarray] = []
    ends: list[ndarray] = []
    for down, across in ((0, 1), (1, 0), (1, 1), (1, -1)):
        a = np.s_[: height - down, max(0, -across) : width - max(0, across)]
        b = np.s_[down:, max(0, across) : width - max(0, -across)]
        step = np.abs(patch.depth[a] - patch.depth[b])
        # A surface may be seen from its side: four times as deep as wide.
        is_one = step < np.maximum(EDGE_STEP, 4 * patch.depth[a] / seen.focal)
        is_one |= ~patch.has_depth[a] | ~patch.has_depth[b]
        is_one &= mask[a] & mask[b]
        starts.append(number[a][is_one])
        ends.append(number[b][is_one])
    start, end = np.concatenate(starts), np.concatenate(ends)
    graph = coo_array((np.ones(len(start), np.int8), (start, end)), shape=(size, size))
    result[mask] = connected_components(graph, directed=False)[1]
    return result


def _outlined(
    seen: _Seen, patch: _Patch, label: UInt8[ndarray, "row column"]
) -> UInt8[ndarray, "row column"]:
    """Decide the object's outermost pixels, by GrabCut where it is thick enough for it.

    Its smoothness term would eat what is only a few pixels wide, like a rope.
    """
    mask = (label == OBJECT_LABEL).astype(np.uint8)
    width = _width_of_thin(mask)
    if width is not None:
        too_wide = -_TOO_NARROW if _has_narrow_rim(seen, patch, mask > 0) else _TOO_WIDE
        return _outlined_along(patch, label, max(_STRIP, _STRIP_WIDTHS * width), too_wide)
    thick = cv2.morphologyEx(mask, cv2.MORPH_OPEN, _disc(3))
    sure = cv2.erode(thick, np.ones((3, 3), np.uint8))
    rim = (cv2.dilate(thick, np.ones((3, 3), np.uint8)) > 0) & (sure == 0)
    free = rim & (label <= OBJECT_LABEL)
    if not sure.any() or not free.any():
        return label
    state = np.where(mask > 0, cv2.GC_FGD, cv2.GC_BGD).astype(np.uint8)
    state[free] = np.where(mask[free] > 0, cv2.GC_PR_FGD, cv2.GC_PR_BGD)
    cv2.setRNGSeed(0)  # Its mixtures of Gaussians start from random places.
    _cv2.grabCut(
        patch.color, state, None, np.zeros((1, 65)), np.zeros((1, 65)), 2, cv2.GC_INIT_WITH_MASK
    )
    result = label.copy()
    is_object = (state == cv2.GC_FGD) | (state == cv2.GC_PR_FGD)
    result[free] = np.where(is_object[free], OBJECT_LABEL, _BACKGROUND)
    return result


def _outlined_along(
    patch: _Patch, label: UInt8[ndarray, "row column"], radius: float, too_wide: float
) -> UInt8[ndarray, "row column"]:
    """Put the rims of a long thin object where hue and saturation change most, on average along it.

    Videos keep color at half of their resolution, so the object's reaches a pixel farther than it
    does, and pixels of which a fifth is the object's count as it. Lightness changes more across a
    lit round thing than at its rims.

    Args:
        patch: The image.
        label: Labels.
        radius: Of the surroundings that tell its direction [px].
        too_wide: How much too far out its rims are expected to be [px].
    """
    mask = label == OBJECT_LABEL
    normal, off, width = _across(mask, radius)
    is_middle = mask & (np.abs(off) < 0.5)
    row, column = np.nonzero(is_middle)
    if len(row) < _LEAST_MIDDLE:
        return label
    normal, width = normal[is_middle], width[is_middle]
    middle = np.stack([column, row], axis=1) - off[is_middle, None] * normal
    pair = KDTree(middle).query_pairs(3 * _EDGE_ALONG, output_type="ndarray")
    pair = np.concatenate([pair, pair[:, ::-1], np.arange(len(row))[:, None].repeat(2, axis=1)])
    apart = np.linalg.norm(middle[pair[:, 0]] - middle[pair[:, 1]], axis=1)
    is_turned = (normal[pair[:, 0]] * normal[pair[:, 1]]).sum(axis=1) < 0

    def along(
        value: Float[ndarray, "place value"], flipped: Float[ndarray, "place value"], radius: float
    ) -> Float[ndarray, "place value"]:
        """Average over places along it; where the direction across it is opposite, flipped ones."""
        share = np.exp(-0.5 * (apart / radius) ** 2)
        same, other = (
            csr_array((share * part, (pair[:, 0], pair[:, 1])), shape=(len(row),) * 2)
            for part in (~is_turned, is_turned)
        )
        return (same @ value + other @ flipped) / (same + other).sum(axis=1)[:, None]

    place = (middle[:, None] + _WAY[:, None] * normal[:, None]).astype(np.float32)
    color = cv2.remap(
        np.ascontiguousarray(patch.lab[..., 1:]),
        place[..., 0],
        place[..., 1],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    ).astype(np.float32)
    size = (len(row), -1)
    color = along(color.reshape(size), color[:, ::-1].reshape(size), _COLOR_ALONG)
    color = color.reshape(len(row), len(_WAY), 2)
    change = np.linalg.norm(color[:, 2:] - color[:, :-2], axis=2) / (_WAY[2] - _WAY[0])
    change = along(change, change[:, ::-1], _EDGE_ALONG)
    edge = np.stack([_edge(change, side, width, too_wide) for side in (-1, 1)], axis=1)
    is_seen = np.isfinite(edge).astype(float)
    edge = np.nan_to_num(edge)
    share = along(is_seen, is_seen[:, ::-1], _EDGE_ALONG)
    edge = along(edge, -edge[:, ::-1], _EDGE_ALONG) / np.maximum(share, 1e-9)
    rows, columns = np.nonzero(
        (label <= OBJECT_LABEL) & (cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)
    )
    near = KDTree(middle).query(np.stack([columns, rows], axis=1))[1]
    away = np.stack([columns, rows], axis=1) - middle[near]
    across = (away * normal[near]).sum(axis=1)
    # Beyond its ends, or where its rims do not stand out, it is as it was.
    is_beside = np.abs(away @ [0, 1] * normal[near, 0] - away @ [1, 0] * normal[near, 1]) < 1.0
    is_beside &= (share[near] > 0.5).all(axis=1)
    is_inside = (across >= edge[near, 0]) & (across <= edge[near, 1])
    result = label.copy()
    result[rows[is_beside], columns[is_beside]] = np.where(
        is_inside[is_beside], OBJECT_LABEL, _BACKGROUND
    )
    return result


def _across(
    mask: Bool[ndarray, "row column"], radius: float
) -> tuple[
    Float[ndarray, "row column 2"], Float[ndarray, "row column"], Float[ndarray, "row column"]
]:
    """Fit a strip to what of a mask is around each pixel, in a Gaussian of that radius [px].

    Returns:
        The direction across it (x, y); how far the pixel is from its middle, that way; and its
        width [px].
    """
    row, column = np.mgrid[: mask.shape[0], : mask.shape[1]].astype(np.float64)

    def mean(value: Float[ndarray, "row column"]) -> Float[ndarray, "row column"]:
        return cv2.GaussianBlur(np.where(mask, value, 0.0), (0, 0), radius) / total

    total = np.maximum(cv2.GaussianBlur(mask.astype(np.float64), (0, 0), radius), 1e-9)
    x, y = mean(column), mean(row)
    xx, yy, xy = mean(column**2) - x**2, mean(row**2) - y**2, mean(column * row) - x * y
    turn = 0.5 * np.arctan2(2 * xy, xx - yy)
    normal = np.stack([-np.sin(turn), np.cos(turn)], axis=-1)
    spread = 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy**2)
    off = (column - x) * normal[..., 0] + (row - y) * normal[..., 1]
    return normal, off, np.sqrt(12 * np.maximum(spread, 1 / 12))


def _edge(
    change: Float[ndarray, "place way"], side: int, width: Float[ndarray, " place"], too_wide: float
) -> Float[ndarray, " place"]:
    """Find where across a strip its color changes most on one side [px]; NaN where hardly."""
    way, half = side * _WAY[1:-1], 0.5 * width[:, None]
    is_asked = (way >= 0.35 * half) & (way <= 1.25 * half)
    expected = np.exp(-0.5 * ((way - half + too_wide) / _RIM_ERROR) ** 2)
    best = np.where(is_asked, change * expected, -1.0).argmax(axis=1)
    most = change[np.arange(len(change)), best]
    return np.where(most > _LEAST_CHANGE, _WAY[1:-1][best], np.nan)
