"""Shapes of all kinds before a camera."""

import numpy as np

from physhandi.data.camera import PinholeCamera
from physhandi.rendering.shapes import Balls, Image, Segments, Surface


def camera(width: int = 64, height: int = 48) -> PinholeCamera:
    K = np.array([[50.0, 0, 31.5], [0, 50.0, 23.5], [0, 0, 1]])
    return PinholeCamera(K=K, T_world_camera=np.eye(4), width=width, height=height)


def crowd() -> tuple[PinholeCamera, list[Surface | Balls | Segments | Image]]:
    """Shapes of all kinds that cross each other."""
    random = np.random.default_rng(7)
    view = camera()
    corner = random.normal(size=(300, 3, 3)) * 0.3 + random.uniform(-1, 1, (300, 1, 3)) + [0, 0, 2]
    color = random.uniform(0, 255, (900, 3))
    faces = np.arange(900).reshape(-1, 3)
    sheet = Surface(vertex=corner.reshape(-1, 3), faces=faces, color=color, shading=0.5)
    veil = Surface(
        vertex=corner.reshape(-1, 3) - [0, 0, 0.4], faces=faces, color=color[::-1], opacity=0.4
    )
    balls = Balls(
        center=random.uniform([-1, -1, 1], [1, 1, 3], (50, 3)),
        radius=np.full(1, 0.1),
        color=color[:50],
        shading=0.7,
    )
    wires = Segments(ends=random.normal([0, 0, 2], 1, (80, 2, 3)), width=1.5, color=color[:80])
    image = Image(
        corner=np.array([[-1, -1, 1.4], [1, -1, 0.9], [1, 0, 0.9], [-1, 0, 1.4]]),
        image=random.integers(0, 255, (6, 8, 3)).astype(np.uint8),
    )
    return view, [sheet, veil, balls, wires, image]
