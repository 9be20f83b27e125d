"""What a view recorded of an object in a frame, as pictures of splats are compared with it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray

from physhandi.data.camera import PinholeCamera
from physhandi.data.view import View
from physhandi.errors import MissingInputError
from physhandi.perception.lifting import OBJECT_LABEL

_MARGIN = 12
"""Pixels around the object in which splats must cover nothing [px]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RecordedObject:
    """The part of an image around the object, as a lens without distortion would have seen it."""

    camera: PinholeCamera
    """Camera of this part."""
    color: Float32[ndarray, "row column 3"]
    """The object over black, from 0 to 1."""
    is_object: Bool[ndarray, "row column"]
    """Pixels of the object."""
    is_unmixed: Bool[ndarray, "row column"]
    """Pixels at no outline of the object. In those beside it, the object's color is mixed with that
    of what is behind, by no share that anybody knows."""
    is_known: Bool[ndarray, "row column"]
    """Pixels that tell whether the object is there: those that no hand is at or near."""
    depth: Float32[ndarray, "row column"]
    """Measured depth of the object [m]; 0 where there is none."""


def cut_out_object(views: Sequence[View], frame: int, *, hand_margin: int) -> list[RecordedObject]:
    """Cut the object out of what views recorded of a frame.

    Args:
        views: Those with color and masks in which the object is seen count.
        frame: The frame.
        hand_margin: Pixels around hands of which nothing is known.

    Raises:
        MissingInputError: If no view with color and masks shows the object.
    """
    objects = [
        _cut_out(view.straightened(), frame, hand_margin)
        for view in views
        if view.has_color and view.has_mask and (view.mask(frame) == OBJECT_LABEL).any()
    ]
    if not objects:
        raise MissingInputError(
            f"No view with color and masks shows the object in frame {frame}, so its appearance "
            "cannot be fitted. Add views/<view>/mask/ and views/<view>/color/."
        )
    return objects


def _cut_out(view: View, frame: int, hand_margin: int) -> RecordedObject:
    camera, mask, color = view.camera, view.mask(frame), view.color(frame)
    depth = view.depth(frame) if view.has_depth else np.zeros(mask.shape, np.float32)
    is_object = mask == OBJECT_LABEL
    side = np.ones((2 * hand_margin + 1, 2 * hand_margin + 1), np.uint8)
    near_hand = cv2.dilate((mask > OBJECT_LABEL).astype(np.uint8), side) > 0
    rows, columns = np.flatnonzero(is_object.any(axis=1)), np.flatnonzero(is_object.any(axis=0))
    top, left = max(int(rows[0]) - _MARGIN, 0), max(int(columns[0]) - _MARGIN, 0)
    part = np.s_[top : int(rows[-1]) + _MARGIN + 1, left : int(columns[-1]) + _MARGIN + 1]
    K = camera.K.copy()
    K[:2, 2] -= [left, top]
    is_object, near_hand = is_object[part], near_hand[part]
    height, width = is_object.shape
    whole, beside = is_object.astype(np.uint8), np.ones((3, 3), np.uint8)
    return RecordedObject(
        camera=replace(camera, K=K, width=width, height=height),
        color=np.where(is_object[..., None], color[part] / np.float32(255.0), np.float32(0.0)),
        is_object=is_object,
        is_unmixed=cv2.dilate(whole, beside) == cv2.erode(whole, beside),
        is_known=~near_hand,
        depth=np.where(is_object, depth[part], np.float32(0.0)),
    )
