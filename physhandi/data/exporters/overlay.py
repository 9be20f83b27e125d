"""A mesh drawn over the picture of a camera, to see how well the two agree."""

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from physhandi.data.camera import PinholeCamera

_SUBPIXEL_BITS = 4
_AMBIENT = 0.35


def hand_overlay(
    image: UInt8[ndarray, "row column 3"],
    camera: PinholeCamera,
    vertex: Float[ndarray, "vertex 3"],
    faces: Int[ndarray, "face 3"],
    *,
    color: tuple[int, int, int] = (240, 150, 90),
    opacity: float = 0.75,
) -> UInt8[ndarray, "row column 3"]:
    """Draw a shaded mesh over an image, the farthest triangles first.

    Args:
        image: The camera's image (RGB); not modified.
        camera: The camera.
        vertex: Vertices in the world frame.
        faces: Triangles, counter-clockwise from outside; those that look away are not drawn.
        color: Colour of the mesh where it faces the camera (RGB).
        opacity: Share of the mesh's colour in the result, 0 to 1.

    Returns:
        The image with the mesh.
    """
    local = camera.to_camera(vertex.astype(np.float64))
    pixel = camera.project(vertex.astype(np.float64))
    corner = local[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    center = corner.mean(1)
    facing = -(normal * center).sum(1) / np.maximum(np.linalg.norm(center, axis=1), 1e-12)
    is_drawn = (facing > 0) & np.isfinite(pixel[faces]).all((1, 2))
    is_drawn &= (np.abs(pixel[faces]) < 4 * max(image.shape)).all((1, 2))
    order = np.flatnonzero(is_drawn)[np.argsort(-center[is_drawn, 2], kind="stable")]

    painted = image.copy()
    covered = np.zeros(image.shape[:2], np.uint8)
    shade = (_AMBIENT + (1 - _AMBIENT) * facing)[:, None] * np.array(color)
    polygon = np.round(np.nan_to_num(pixel[faces]) * 2**_SUBPIXEL_BITS).astype(np.int32)
    for face in order:
        value = [float(channel) for channel in shade[face]]
        cv2.fillConvexPoly(painted, polygon[face], value, cv2.LINE_8, _SUBPIXEL_BITS)
        cv2.fillConvexPoly(covered, polygon[face], (255.0,), cv2.LINE_8, _SUBPIXEL_BITS)
    mixed = cv2.addWeighted(painted, opacity, image, 1 - opacity, 0)
    return np.where(covered[..., None] > 0, mixed, image)
