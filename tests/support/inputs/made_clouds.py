"""Clouds of surfaces whose shape is known, as cameras would see them [m]."""

import numpy as np

STEP = 0.0045
"""Distance between points, as fused clouds have it."""


def noisy(cloud: np.ndarray, seed: int = 0) -> np.ndarray:
    """Move every point by about a millimetre."""
    return cloud + np.random.default_rng(seed).normal(scale=0.001, size=cloud.shape)


def flat(length: float, width: float, step: float = STEP) -> np.ndarray:
    """A sheet in the plane z = 0 about the origin."""
    x, y = np.meshgrid(np.arange(0, length, step), np.arange(0, width, step))
    return np.stack([x.ravel() - length / 2, y.ravel() - width / 2, np.zeros(x.size)], axis=1)


def hanging(relief: float, *, size: tuple[float, float], height: float = 0.4) -> np.ndarray:
    """A sheet that hangs in waves; its lower edge is at `height`."""
    sheet = flat(*size)
    wave = relief / 2 * np.cos(sheet[:, 0] * 2 * np.pi / 0.25)
    return np.stack([sheet[:, 0], wave, sheet[:, 1] + size[1] / 2 + height], axis=1)


def arc(radius: float, width: float) -> np.ndarray:
    """A sheet bent to half a cylinder that stands on two of its edges."""
    angle, y = np.meshgrid(np.arange(0, np.pi, STEP / radius), np.arange(0, width, STEP))
    return np.stack(
        [radius * np.cos(angle).ravel(), y.ravel(), radius * np.sin(angle).ravel()], axis=1
    )


def folded(gap: float, *, height: float = 0.3) -> np.ndarray:
    """A sheet of two layers of 150 x 200 mm, `gap` apart and joined by a bend at +x."""
    side, radius = 0.15, gap / 2
    along = np.arange(0, 2 * side + np.pi * radius, STEP)
    angle = np.clip((along - side) / radius, 0, np.pi)
    straight = np.where(along < side, along, np.minimum(side, 2 * side + np.pi * radius - along))
    x, y = np.meshgrid(straight + radius * np.sin(angle), np.arange(0, 0.2, STEP))
    z = np.tile(radius * (1 - np.cos(angle)) + height, (len(y), 1))
    return np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)


def leaning() -> np.ndarray:
    """A sheet of 300 x 200 mm at 45 degrees, one edge on the ground."""
    sheet = flat(0.3, 0.2)
    along = (sheet[:, 0] + 0.15) / np.sqrt(2)
    return np.stack([along, sheet[:, 1], along], axis=1)


def lifted_corner() -> np.ndarray:
    """A sheet on the ground, one corner of which is 80 mm high."""
    sheet = flat(0.3, 0.3)
    sheet[:, 2] = 0.002 + np.maximum(sheet[:, 0] + sheet[:, 1] - 0.08, 0) * 0.08 / 0.22
    return sheet


def rope(radius: float, *, bend: float = 0.12, height: float = 0.0) -> np.ndarray:
    """A rope along three quarters of a circle; its upper half, or all of it in the air."""
    along = np.arange(0, 1.5 * np.pi, 0.003 / bend)[:, None]
    around = np.linspace(-np.pi if height else 0, np.pi, 12)[None]
    away = bend + radius * np.cos(around)
    z = np.broadcast_to(radius + radius * np.sin(around) + height, (len(along), 12))
    x, y = away * np.cos(along), away * np.sin(along)
    return np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)


def box(size: tuple[float, float, float]) -> np.ndarray:
    """Top and walls of a box on the ground."""
    length, width, height = size
    parts = [flat(length, width) + np.array([0, 0, height])]
    for sign in (-1, 1):
        wall = flat(width, height)
        x = np.full(len(wall), sign * length / 2)
        parts.append(np.stack([x, wall[:, 0], wall[:, 1] + height / 2], axis=1))
        wall = flat(length, height)
        y = np.full(len(wall), sign * width / 2)
        parts.append(np.stack([wall[:, 0], y, wall[:, 1] + height / 2], axis=1))
    return np.concatenate(parts)


def ellipsoid(half: tuple[float, ...], height: float, *, lowest: float = -1.0) -> np.ndarray:
    """An ellipsoid about a center at `height`, without what is lower than `lowest` half axes."""
    count = int(4 * np.pi * half[0] * half[1] / STEP**2)
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    angle = np.pi * (1 + np.sqrt(5)) * index
    ring = np.sqrt(1 - z * z)
    unit = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)
    return unit[z >= lowest] * half + [0, 0, height]
