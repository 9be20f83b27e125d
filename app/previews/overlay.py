"""Draws what a recording says of a frame over its picture: masks, keypoints and tracks."""

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from physhandi.data.view import View

WIDTH = 960
"""Width of a drawn frame [px]."""
LAYERS = ("mask", "keypoint", "track")
"""Overlays of a picture."""
_QUALITY = 85
_LABEL_COLOR = np.array([[0, 0, 0], [74, 155, 232], [233, 149, 60], [166, 108, 230]], np.float32)
"""Colors of object, right and left hand in masks (RGB), as the legend of the page has them."""
_TINT = 0.45
_HAND_COLOR = {"right": (255, 196, 92), "left": (214, 164, 255)}
_TRACK_COLOR, _TAIL_COLOR = (120, 255, 140), (40, 170, 80)
_SHADE = (40, 30, 20)
_TAIL = 6
"""Frames before the shown one in which a track's way is drawn."""
_FINGERS = tuple((0, *range(first, first + 4)) for first in (1, 5, 9, 13, 17))
_PALM = (5, 9, 13, 17)
_FARTHEST = 0.98
"""Quantile of a depth image from which on pixels are equally dark."""


@dataclass(frozen=True)
class _Canvas:
    """A picture that is drawn on, and how much larger than the recording's it is."""

    image: UInt8[ndarray, "row column 3"]
    scale: float

    def place(self, pixel: Float[ndarray, "*axis 2"]) -> list[tuple[int, int]]:
        """Turn positions in the recording's image into whole pixels of the picture."""
        placed = np.clip((pixel + 0.5) * self.scale - 0.5, -1e4, 1e4)
        return [(round(float(x)), round(float(y))) for x, y in placed.reshape(-1, 2)]


def draw_frame(
    view: View,
    frame: int,
    *,
    sides: tuple[str, ...],
    layers: frozenset[str],
    shows_depth: bool = False,
) -> bytes:
    """Draw a frame of a view as JPEG.

    Args:
        view: The view.
        frame: The frame.
        sides: Hands of the recording, in the order of its keypoints.
        layers: Which of `LAYERS` to draw; those that are not there are left out.
        shows_depth: Whether depth is the ground even where there is color.

    Raises:
        SequenceError: If a file of the frame is damaged; names it.
    """
    picture = _ground(view, frame, shows_depth=shows_depth)
    scale = WIDTH / picture.shape[1]
    size = (WIDTH, max(1, round(picture.shape[0] * scale)))
    shrinks = scale < 1
    image = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    canvas = _Canvas(np.ascontiguousarray(image), scale)
    if "mask" in layers and view.has_mask:
        _draw_mask(canvas, view.mask(frame))
    if "track" in layers and view.track is not None and view.track_visible is not None:
        first = max(0, frame - _TAIL)
        rows = slice(first, frame + 1)
        _draw_tracks(canvas, view.track[rows], view.track_visible[rows])
    if "keypoint" in layers and view.keypoint is not None:
        for side, hand in zip(sides, view.keypoint[frame], strict=True):
            _draw_hand(canvas, hand, _HAND_COLOR[side])
    options = [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
    _, content = cv2.imencode(".jpg", canvas.image[..., ::-1], options)
    return content.tobytes()


def _ground(view: View, frame: int, *, shows_depth: bool) -> UInt8[ndarray, "row column 3"]:
    """Give color, else depth as grey (near is bright), else grey."""
    if view.has_color and not (shows_depth and view.has_depth):
        return view.color(frame)
    if not view.has_depth:
        return np.full((view.camera.height, view.camera.width, 3), 90, np.uint8)
    depth = view.depth(frame)
    is_measured = depth > 0
    if not is_measured.any():
        return np.zeros((*depth.shape, 3), np.uint8)
    near = float(depth[is_measured].min())
    far = max(float(np.quantile(depth[is_measured], _FARTHEST)), near + 1e-3)
    level = 255 - 200 * np.clip((depth - near) / (far - near), 0, 1)
    return np.repeat(np.where(is_measured, level, 0).astype(np.uint8)[..., None], 3, axis=2)


def _draw_mask(canvas: _Canvas, mask: UInt8[ndarray, "row column"]) -> None:
    height, width = canvas.image.shape[:2]
    resized = cv2.resize(mask, (width, height), interpolation=cv2.INTER_NEAREST)
    large = np.asarray(resized, np.uint8)
    is_labelled = large > 0
    tint = _LABEL_COLOR[large[is_labelled].astype(np.intp)]
    blended: ndarray = (1 - _TINT) * canvas.image[is_labelled] + _TINT * tint
    canvas.image[is_labelled] = blended.astype(np.uint8)
    for label in range(1, 4):
        region = (large == label).astype(np.uint8)
        is_inner = cv2.erode(region, np.ones((3, 3), np.uint8)) > 0
        canvas.image[(region > 0) & ~is_inner] = _LABEL_COLOR[label].astype(np.uint8)


def _draw_tracks(
    canvas: _Canvas,
    track: Float[ndarray, "frame track 2"],
    is_visible: ndarray,
) -> None:
    """Draw where tracks are in the last frame, and the way that they came."""
    is_there = np.asarray(is_visible & np.isfinite(track).all(axis=-1))
    shown = np.flatnonzero(is_there[-1])
    for number in shown:
        way = canvas.place(track[is_there[:, number], number].astype(np.float64))
        for begin, end in pairwise(way):
            cv2.line(canvas.image, begin, end, _TAIL_COLOR, 1, cv2.LINE_AA)
    for at in canvas.place(track[-1, shown].astype(np.float64)):
        cv2.circle(canvas.image, at, 2, _TRACK_COLOR, -1, cv2.LINE_AA)


def _draw_hand(
    canvas: _Canvas, keypoint: Float[ndarray, "21 3"], color: tuple[int, int, int]
) -> None:
    """Draw joints and bones, the finer the smaller the hand is."""
    is_seen = np.isfinite(keypoint).all(axis=-1) & (np.nan_to_num(keypoint[:, 2]) > 0)
    if not is_seen.any():
        return
    at = canvas.place(np.nan_to_num(keypoint[:, :2]).astype(np.float64))
    extent = canvas.scale * float(np.ptp(keypoint[is_seen, :2], axis=0).max())
    width = int(np.clip(extent / 60, 1, 4))
    bones = [bone for chain in (*_FINGERS, _PALM) for bone in pairwise(chain)]
    lines = [(at[begin], at[end]) for begin, end in bones if is_seen[begin] and is_seen[end]]
    joints = [at[joint] for joint in np.flatnonzero(is_seen)]
    # Dark below light, so that hands stand out from skin and from cloth.
    for tone, more in ((_SHADE, 2), (color, 0)):
        for begin, end in lines:
            cv2.line(canvas.image, begin, end, tone, width + more, cv2.LINE_AA)
        for joint in joints:
            cv2.circle(canvas.image, joint, width + more // 2, tone, -1, cv2.LINE_AA)
