"""Cameras around a table: where they stand, and cut-outs of their pictures."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.random import Generator

from physhandi.data.camera import PinholeCamera
from physhandi.errors import UsageError
from physhandi.synthetic.film.degradations import Degradations, delays, miscalibrated
from physhandi.synthetic.film.rendering import look_at, resized

SIZE = (848, 480)
"""Width and height of a D455's depth image [px]."""
FOCAL_LENGTH = 447.0
"""Its focal length [px]."""
ImageSize = Literal["full", "half", "quarter"]
"""How wide stored pictures are: 848, 424 or 212 px."""
HELD_OUT = "held_out"
"""Name of the view that is held out."""
MOST_CAMERAS = 4
"""A recording has at most this many cameras."""
NEAREST_CAMERA, FARTHEST_CAMERA = 0.6, 1.0
"""Distances of the cameras from what they look at [m]."""
_ELEVATION = (30.0, 55.0)
_MARGIN = 12
_STEP = 0.02
_FACTOR: dict[ImageSize, float] = {"full": 1.0, "half": 0.5, "quarter": 0.25}


@dataclass(frozen=True, eq=False, kw_only=True)
class Viewpoint:
    """One camera as it is, and as its recording describes it."""

    name: str
    """Name of the view."""
    camera: PinholeCamera
    """The true camera."""
    calibrated: PinholeCamera
    """The camera as its calibration states it."""
    delay: float
    """How much later than the first camera it takes its pictures [s]."""


def make_viewpoints(
    point: Float[ndarray, "point 3"], count: int, level: Degradations, seed: int
) -> tuple[Viewpoint, ...]:
    """Place cameras evenly around what is to be filmed, 0.6 to 1.0 m away.

    They look down by 30 to 55 degrees, and stand as much farther away than drawn as they must to
    have all of it in the picture, up to 1.0 m.

    Args:
        point: Everything that shall be seen, of all frames [m].
        count: Number of cameras.
        level: How far calibration and clocks are off.
        seed: Decides the rest.

    Raises:
        UsageError: If there are no cameras, or more than four.
    """
    if not 1 <= count <= MOST_CAMERAS:
        raise UsageError(f"cameras is {count}; expected 1 to {MOST_CAMERAS}.")
    random, first = _around(seed)
    cameras = [_place(point, first + 2 * np.pi * number / count, random) for number in range(count)]
    errors = np.random.default_rng([seed, 11])
    late = delays(count, level, errors)
    return tuple(
        Viewpoint(
            name=f"camera{number}",
            camera=camera,
            calibrated=miscalibrated(camera, level, errors),
            delay=float(late[number]),
        )
        for number, camera in enumerate(cameras)
    )


def make_held_out_viewpoint(point: Float[ndarray, "point 3"], count: int, seed: int) -> Viewpoint:
    """Place a camera halfway between the first two of `make_viewpoints`, which stay as they are.

    Its calibration is exact and its clock that of the truth, since it is for scoring alone.

    Args:
        point: Everything that shall be seen, of all frames [m].
        count: Number of the other cameras; beside a single one it stands opposite.
        seed: Seed of the other cameras.
    """
    azimuth = _around(seed)[1] + np.pi / count
    camera = _place(point, azimuth, np.random.default_rng([seed, 12]))
    return Viewpoint(name=HELD_OUT, camera=camera, calibrated=camera, delay=0.0)


def with_image_size(view: Viewpoint, size: ImageSize) -> Viewpoint:
    """Let a camera store its pictures in another size."""
    factor = _FACTOR[size]
    return replace(
        view, camera=resized(view.camera, factor), calibrated=resized(view.calibrated, factor)
    )


def _around(seed: int) -> tuple[Generator, float]:
    """Draw the direction in which the first camera stands, and return where the drawing goes on."""
    random = np.random.default_rng([seed, 10])
    return random, float(random.uniform(0, 2 * np.pi))


def _place(point: Float[ndarray, "point 3"], azimuth: float, random: Generator) -> PinholeCamera:
    center = (point.min(axis=0) + point.max(axis=0)) / 2
    azimuth += np.deg2rad(random.uniform(-15, 15))
    elevation = np.deg2rad(random.uniform(*_ELEVATION))
    distance = random.uniform(NEAREST_CAMERA, FARTHEST_CAMERA)
    level = np.cos(elevation)
    towards = np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
    while True:
        camera = look_at(center + distance * towards, center, focal_length=FOCAL_LENGTH, size=SIZE)
        pixel = np.nan_to_num(camera.project(point), nan=-1e6)
        low, high = pixel.min(axis=0), pixel.max(axis=0)
        is_whole = (low >= _MARGIN).all() and (high <= np.array(SIZE) - 1 - _MARGIN).all()
        if is_whole or distance + _STEP > FARTHEST_CAMERA:
            return camera
        distance += _STEP


@dataclass(frozen=True)
class CropWindow:
    """A part of a camera's picture."""

    rows: slice
    """Rows of the picture."""
    columns: slice
    """Columns of the picture."""
    camera: PinholeCamera
    """Sees exactly this part."""


def window_around(
    camera: PinholeCamera, point: Float[ndarray, "point 3"], margin: int
) -> CropWindow:
    """Cut out the part of a picture that shows some points.

    Args:
        camera: Camera without distortion.
        point: Points, all in front of the camera; those that are not count as anywhere [m].
        margin: Pixels around them that are kept.
    """
    size = np.array([camera.width, camera.height])
    pixel = camera.project(point)
    if np.isfinite(pixel).all() and len(pixel):
        low = np.clip(np.floor(pixel.min(axis=0)) - margin, 0, size - 2).astype(int)
        high = np.clip(np.ceil(pixel.max(axis=0)) + margin + 1, low + 2, size).astype(int)
    else:
        low, high = np.zeros(2, dtype=int), size
    K = camera.K.copy()
    K[:2, 2] -= low
    return CropWindow(
        slice(int(low[1]), int(high[1])),
        slice(int(low[0]), int(high[0])),
        PinholeCamera(
            K=K,
            T_world_camera=camera.T_world_camera,
            width=int(high[0] - low[0]),
            height=int(high[1] - low[1]),
        ),
    )
