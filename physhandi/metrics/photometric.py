"""Silhouette and color of a rollout in one view: IoU, and PSNR of shaded points.

Nodes are drawn as discs, near ones over far ones, in the colors that frame 0 shows of them. Points
are no surface: figures compare methods with each other, not with renderers of splats.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray

from physhandi.data.camera import PinholeCamera
from physhandi.data.view import View
from physhandi.metrics.geometry import nearest_node
from physhandi.metrics.topology import resolution

OBJECT = 1
"""Mask value of the object; larger values are hands."""
DISC = 0.75
"""Radius of a drawn node, in distances between nodes: neighbouring discs overlap."""
_BEHIND = 0.015
"""A node farther behind the measured surface than this is hidden [m]."""
_STRAIGHT, _LEAST_COSINE = 4, 0.05
"""Power of the cosine by which views count that look at a surface, and the least such cosine."""
_FULL = 255.0
_LEAST_ERROR = 1e-10


@dataclass(frozen=True, eq=False, kw_only=True)
class Drawing:
    """Nodes as a camera sees them."""

    image: UInt8[ndarray, "row column 3"]
    """Colors on black."""
    is_covered: Bool[ndarray, "row column"]
    """Pixels that a disc covers."""


def draw_nodes(
    camera: PinholeCamera,
    node: Float[ndarray, "node 3"],
    color: UInt8[ndarray, "node 3"],
    radius: float,
) -> Drawing:
    """Draw nodes as discs, from the farthest to the nearest.

    Args:
        camera: The camera.
        node: Nodes [m]; those behind the camera are left out.
        color: Color of each of them.
        radius: Radius of a disc in the world [m].
    """
    image = np.zeros((camera.height, camera.width, 3), dtype=np.uint8)
    covered = np.zeros((camera.height, camera.width), dtype=np.uint8)
    depth = camera.camera_depth(node)
    pixel = np.nan_to_num(camera.project(node), nan=-1e4)
    size = radius * float(camera.K[0, 0]) / np.maximum(depth, 1e-6)
    for index in np.argsort(-depth):
        if depth[index] <= 0 or not np.abs(pixel[index]).max() < 1e4:
            continue
        center = (round(float(pixel[index, 0])), round(float(pixel[index, 1])))
        width = max(1, round(float(size[index])))
        red, green, blue = (int(value) for value in color[index])
        cv2.circle(image, center, width, (red, green, blue), -1)
        cv2.circle(covered, center, width, (1,), -1)
    return Drawing(image=image, is_covered=covered > 0)


def silhouette_iou(drawing: Drawing, mask: UInt8[ndarray, "row column"]) -> float:
    """Compute intersection over union of the object outside the hands; NaN if both are empty."""
    is_object = mask == OBJECT
    drawn = drawing.is_covered & (mask <= OBJECT)
    either = int((is_object | drawn).sum())
    return int((is_object & drawn).sum()) / either if either else float("nan")


def shaded_psnr(
    drawing: Drawing, color: UInt8[ndarray, "row column 3"], mask: UInt8[ndarray, "row column"]
) -> float:
    """Compute the PSNR of the object on black over the whole image, hands left out of both [dB].

    This is PhysTwin's protocol, in which the black background counts.
    """
    observed = np.where((mask == OBJECT)[..., None], color, 0).astype(np.float64)
    drawn = np.where((mask <= OBJECT)[..., None], drawing.image, 0).astype(np.float64)
    error = float(((observed - drawn) ** 2).mean())
    return 10.0 * float(np.log10(_FULL**2 / max(error, _LEAST_ERROR)))


def seen_colors(
    views: Sequence[View],
    node: Float[ndarray, "node 3"],
    normal: Float[ndarray, "node 3"] | None = None,
    *,
    frame: int = 0,
) -> UInt8[ndarray, "node 3"] | None:
    """Assign each node the mean color of the views that see it in a frame.

    Args:
        views: Those that have color and masks count.
        node: Points on the object's surface in that frame [m].
        normal: Directions of the surface there, of either sign. With them the color is that of the
            views that look straight at it, and not of pixels at the object's outline, into which
            what is behind it is mixed; without, all views count alike.
        frame: The frame, which all of these views have.

    Returns:
        Colors; a node that no view sees takes that of the nearest visible one. None without
        visible nodes.
    """
    total, count = np.zeros((len(node), 3)), np.zeros(len(node))
    for view in views:
        if not (view.has_color and view.has_mask):
            continue
        mask, color = view.mask(frame), view.color(frame)
        pixel = np.nan_to_num(view.camera.project(node), nan=-1.0).round().astype(np.int64)
        height, width = mask.shape
        inside = np.asarray((pixel >= 0).all(axis=1))
        inside &= (pixel[:, 0] < width) & (pixel[:, 1] < height)
        column, row = np.where(inside[:, None], pixel, 0).T
        is_object = mask == OBJECT
        if normal is not None:
            is_object = cv2.erode(is_object.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        is_seen = inside & is_object[row, column]
        if view.has_depth:
            measured = view.depth(frame)[row, column]
            is_seen &= view.camera.camera_depth(node) < measured + _BEHIND
        weight = np.ones(len(node))
        if normal is not None:
            ray = node - view.camera.T_world_camera[:3, 3]
            ray /= np.linalg.norm(ray, axis=1, keepdims=True)
            weight = np.maximum(np.abs(np.sum(ray * normal, axis=1)), _LEAST_COSINE) ** _STRAIGHT
        total[is_seen] += weight[is_seen, None] * color[row, column][is_seen]
        count[is_seen] += weight[is_seen]
    colored = np.flatnonzero(count)
    if not len(colored):
        return None
    nearest = colored[nearest_node(node, node[colored])]
    return (total[nearest] / count[nearest, None]).round().astype(np.uint8)


def photometric_curves(
    views: Sequence[View],
    rollout: Float[ndarray, "frame node 3"],
    *,
    scored: View | None = None,
) -> dict[str, Float[ndarray, " frame"]]:
    """Measure every frame in one view.

    Args:
        views: Views of the recording; all that have color lend it to the nodes.
        rollout: Surface nodes, finite [m].
        scored: The view, which may be one that is held out and lends no color; None takes the first
            one that has masks, as PhysTwin does.

    Returns:
        ``iou``, and ``psnr`` [dB] if that view has color; nothing if no view has masks.
    """
    view = scored or next((view for view in views if view.has_mask), None)
    if view is None or not view.has_mask or rollout.shape[1] < 2:
        return {}
    node = rollout.astype(np.float64)
    radius = DISC * resolution(node[0])
    color = seen_colors(views, node[0]) if view.has_color else None
    shown = np.zeros((node.shape[1], 3), dtype=np.uint8) if color is None else color
    iou, psnr = np.full(len(node), np.nan), np.full(len(node), np.nan)
    for frame in range(min(len(node), view.frame_count)):
        mask = view.mask(frame)
        drawing = draw_nodes(view.camera, node[frame], shown, radius)
        iou[frame] = silhouette_iou(drawing, mask)
        if color is not None:
            psnr[frame] = shaded_psnr(drawing, view.color(frame), mask)
    return {"iou": iou} if color is None else {"iou": iou, "psnr": psnr}
