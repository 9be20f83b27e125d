"""Splats drawn by the book, in float64: every pixel asks every splat, without tiles or lists."""

from dataclasses import dataclass

import numpy as np

from physhandi.data.camera import PinholeCamera


@dataclass
class Drawn:
    color: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray
    clearance: np.ndarray
    """How near a pixel is to where rounding decides whether a splat counts, relative."""


def draw(
    camera: PinholeCamera,
    center: np.ndarray,
    scale: np.ndarray,
    color: np.ndarray,
    opacity: np.ndarray,
    background: np.ndarray | None = None,
    occluder: np.ndarray | None = None,
) -> Drawn:
    """Blend front to back as Kerbl et al. (2023) say it, with their 0.3 px² and 1/255."""
    shape = (camera.height, camera.width)
    occluder = np.zeros(shape) if occluder is None else occluder
    row, column = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    local = camera.to_camera(np.asarray(center, np.float64))
    rotation = camera.T_camera_world[:3, :3]
    light, total, far = np.ones(shape), np.zeros((*shape, 3)), np.zeros(shape)
    is_done, clearance = np.zeros(shape, bool), np.full(shape, np.inf)
    for splat in np.argsort(local[:, 2], kind="stable"):
        x, y, z = local[splat]
        if z <= 0.01:
            continue
        middle = camera.K @ [x / z, y / z, 1.0]
        jacobian = camera.K[:2, :2] @ np.array(
            [
                [1 / z, 0.0, -_limit(x / z, camera.K[0, 0], camera.K[0, 2], camera.width) / z],
                [0.0, 1 / z, -_limit(y / z, camera.K[1, 1], camera.K[1, 2], camera.height) / z],
            ]
        )
        flat = jacobian @ rotation @ (scale[splat] ** 2 * np.eye(3)) @ rotation.T @ jacobian.T
        offset = np.stack([column - middle[0], row - middle[1]], axis=-1)
        squared = np.sum(offset @ np.linalg.inv(flat + 0.3 * np.eye(2)) * offset, axis=-1)
        cover = np.minimum(0.999, opacity[splat] * np.exp(-0.5 * squared))
        is_before = (occluder == 0.0) | (z <= occluder)
        clearance = np.where(
            is_before & ~is_done, np.minimum(clearance, abs(cover * 255 - 1)), clearance
        )
        counts = is_before & ~is_done & (cover >= 1 / 255)
        rest = light * (1.0 - cover)
        clearance = np.where(counts, np.minimum(clearance, abs(rest / 1e-4 - 1)), clearance)
        is_done |= counts & (rest <= 1e-4)
        counts &= ~is_done
        share = np.where(counts, light * cover, 0.0)
        total += share[..., None] * color[splat]
        far += share * z
        light = np.where(counts, rest, light)
    if background is not None:
        total += light[..., None] * background
    alpha = 1.0 - light
    depth = np.where(alpha > 0, far / np.maximum(alpha, 1e-300), 0.0)
    return Drawn(total, alpha, depth, clearance)


def _limit(slope: float, focal: float, middle: float, size: int) -> float:
    # The border is half a pixel beyond the outer pixels' centres.
    beyond = 0.15 * size / focal
    low, high = (-0.5 - middle) / focal, (size - 0.5 - middle) / focal
    return float(np.clip(slope, low - beyond, high + beyond))
