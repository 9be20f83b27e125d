"""Pictures of the object against its recording: PSNR, SSIM, IoU and LPIPS by two definitions.

Both take a picture of the object alone, drawn over black, and what a camera recorded.
`phystwin_scores` follows PhysTwin's evaluation, in which the black background counts;
`proper_scores` counts only pixels that the object or its picture covers. `seen_colors` reads the
colors of points from views.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray

from physhandi.data.view import View
from physhandi.metrics.geometry import nearest_node

OBJECT = 1
"""Mask value of the object; larger values are hands."""
LEAST_ALPHA = 0.5
"""Least alpha of a pixel that a picture is taken to cover, by the proper definition."""
WINDOW, SIGMA = 11, 1.5
"""Width of the window in which SSIM compares, and deviation of its Gaussian weights [px]."""
_C1, _C2 = 0.01**2, 0.03**2
_LEAST_ERROR = 1e-10
_BEHIND = 0.015
"""A node farther behind the measured surface than this is hidden [m]."""
_STRAIGHT, _LEAST_COSINE = 4, 0.05
"""Power of the cosine by which views count that look at a surface, and the least such cosine."""
_FULL = 255.0
Perceptual = Callable[
    [
        Float[ndarray, "row column 3"],
        Float[ndarray, "row column 3"],
        Bool[ndarray, "row column"] | None,
    ],
    float,
]
"""Network that compares two images (sRGB, 0 to 1), over some pixels or as a whole."""


@dataclass(frozen=True, kw_only=True)
class ImageScores:
    """How one picture agrees with what was recorded; NaN where there is nothing to compare."""

    psnr: float
    """Peak signal-to-noise ratio [dB]."""
    ssim: float
    """Structural similarity, at most 1."""
    iou: float
    """Intersection over union of the silhouettes."""
    lpips: float | None = None
    """Perceptual distance, 0 for equal images; None without the network."""

    def to_dict(self) -> dict[str, float]:
        """Give the scores by name, ``lpips`` only with the network."""
        return {name: value for name, value in asdict(self).items() if value is not None}


def phystwin_scores(
    color: Float[ndarray, "row column 3"],
    alpha: Float[ndarray, "row column"],
    mask: UInt8[ndarray, "row column"],
    recorded: UInt8[ndarray, "row column 3"] | None,
    perceptual: Perceptual | None = None,
) -> ImageScores:
    """Compare as PhysTwin's evaluation does: the whole image, with its black background.

    The recorded object is shown on black; in the picture, which is rounded to 8 bits, pixels of
    hands are black. The picture covers a pixel whose rounded alpha is not 0, unless it is a hand's.

    Args:
        color: The object alone over black (sRGB, 0 to 1).
        alpha: How far it covers each pixel, 0 to 1.
        mask: Labels of the recording: 0 background, 1 object, larger ones hands.
        recorded: The recorded image (sRGB); None if there is none: then only the IoU is known.
        perceptual: Network for LPIPS; None leaves it unknown.
    """
    is_object, is_hand = mask == OBJECT, mask > OBJECT
    is_drawn = (np.rint(_FULL * np.clip(alpha, 0.0, 1.0)) > 0) & ~is_hand
    iou = intersection_over_union(is_object, is_drawn)
    if recorded is None:
        return ImageScores(psnr=float("nan"), ssim=float("nan"), iou=iou)
    seen = _on_black(recorded / _FULL, is_object)
    shown = _on_black(np.rint(_FULL * np.clip(color, 0.0, 1.0)) / _FULL, ~is_hand)
    # Where windows hold nothing but black in both, the similarity is 1.
    rows, columns = _box(np.asarray((seen + shown).any(axis=2)))
    similarity = structural_similarity(seen[rows, columns], shown[rows, columns])
    missing = float(np.sum(1.0 - similarity.mean(axis=2)))
    return ImageScores(
        psnr=psnr(((seen - shown) ** 2).mean()),
        ssim=1.0 - missing / mask.size,
        iou=iou,
        lpips=None if perceptual is None else perceptual(seen, shown, None),
    )


def proper_scores(
    color: Float[ndarray, "row column 3"],
    alpha: Float[ndarray, "row column"],
    mask: UInt8[ndarray, "row column"],
    recorded: UInt8[ndarray, "row column 3"] | None,
    perceptual: Perceptual | None = None,
) -> ImageScores:
    """Compare only what belongs to the object: pixels that its mask or its picture covers.

    Pixels of hands count nowhere, since nobody sees what the object looks like behind them. A pixel
    that is covered in one image alone is compared with black. SSIM and LPIPS are means over counted
    pixels; what they look at reaches into pixels that do not count, which are black in both images.

    Args:
        color: The object alone over black (sRGB, 0 to 1).
        alpha: How far it covers each pixel, 0 to 1; it counts as covered from `LEAST_ALPHA` on.
        mask: Labels of the recording: 0 background, 1 object, larger ones hands.
        recorded: The recorded image (sRGB); None if there is none: then only the IoU is known.
        perceptual: Network for LPIPS; None leaves it unknown.

    Returns:
        NaN if no pixel counts.
    """
    is_object = mask == OBJECT
    is_drawn = (alpha >= LEAST_ALPHA) & (mask <= OBJECT)
    is_counted = is_object | is_drawn
    iou = intersection_over_union(is_object, is_drawn)
    if recorded is None or not is_counted.any():
        return ImageScores(psnr=float("nan"), ssim=float("nan"), iou=iou)
    rows, columns = _box(is_counted)
    counted = is_counted[rows, columns]
    seen = _on_black(recorded[rows, columns] / _FULL, is_object[rows, columns])
    shown = _on_black(np.clip(color[rows, columns], 0.0, 1.0), counted)
    similarity = structural_similarity(seen, shown)[counted]
    distance = None
    if perceptual is not None:
        whole = np.clip(color, 0.0, 1.0)
        distance = perceptual(
            _on_black(recorded / _FULL, is_object), _on_black(whole, is_counted), is_counted
        )
    return ImageScores(
        psnr=psnr(((seen - shown)[counted] ** 2).mean()),
        ssim=float(similarity.mean()),
        iou=iou,
        lpips=distance,
    )


def psnr(squared_error: float) -> float:
    """Turn a mean squared error of values from 0 to 1 into decibels; 100 dB at most."""
    return -10.0 * float(np.log10(max(squared_error, _LEAST_ERROR)))


def structural_similarity(
    first: Float[ndarray, "row column channel"], second: Float[ndarray, "row column channel"]
) -> Float[ndarray, "row column channel"]:
    """Compute the structural similarity around each pixel (Wang et al. 2004), each channel apart.

    As in the code of 3D Gaussian splatting: Gaussian weights, variances by the whole weight, and
    zeros outside of the image.

    Args:
        first: Values from 0 to 1.
        second: Values from 0 to 1.
    """
    one, other = (np.ascontiguousarray(image, dtype=np.float64) for image in (first, second))
    mean_1, mean_2 = _blurred(one), _blurred(other)
    variance_1 = _blurred(one * one) - mean_1 * mean_1
    variance_2 = _blurred(other * other) - mean_2 * mean_2
    covariance = _blurred(one * other) - mean_1 * mean_2
    return ((2 * mean_1 * mean_2 + _C1) * (2 * covariance + _C2)) / (
        (mean_1 * mean_1 + mean_2 * mean_2 + _C1) * (variance_1 + variance_2 + _C2)
    )


def _blurred(image: Float[ndarray, "row column channel"]) -> Float[ndarray, "row column channel"]:
    kernel = cv2.getGaussianKernel(WINDOW, SIGMA, cv2.CV_64F)
    blurred = cv2.sepFilter2D(image, cv2.CV_64F, kernel, kernel, borderType=cv2.BORDER_CONSTANT)
    return blurred.reshape(image.shape)


def _on_black(
    image: Float[ndarray, "row column 3"], where: Bool[ndarray, "row column"]
) -> Float[ndarray, "row column 3"]:
    return np.where(where[..., None], image, 0.0).astype(np.float64)


def intersection_over_union(
    one: Bool[ndarray, "row column"], other: Bool[ndarray, "row column"]
) -> float:
    """Compute intersection over union; NaN if both are empty."""
    either = int((one | other).sum())
    return int((one & other).sum()) / either if either else float("nan")


def _box(where: Bool[ndarray, "row column"]) -> tuple[slice, slice]:
    """Bound the pixels, and all whose windows reach to one of them; one pixel if there are none."""
    slices: list[slice] = []
    for axis in (1, 0):
        numbers = np.flatnonzero(where.any(axis=axis))
        low, high = (int(numbers[0]), int(numbers[-1])) if len(numbers) else (0, 0)
        slices.append(slice(max(0, low - WINDOW // 2), high + WINDOW // 2 + 1))
    return slices[0], slices[1]


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
