"""Errors of synthetic recordings: one level each, 0 switches it off."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from difflib import get_close_matches

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.random import Generator
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from physhandi.data.camera import PinholeCamera
from physhandi.errors import UsageError
from physhandi.synthetic.film.sensors import DepthSensor

_HAND_WANDERS = 0.3
"""Time over which the place of a misplaced hand changes [s]."""


@dataclass(frozen=True, kw_only=True)
class Degradations:
    """Levels of all errors; 0 switches one off."""

    depth_noise: float = 0.0
    """Standard deviation of the disparity [px]; 0.08 is a D455. Depth errs by
    z²·level / (447 px · 95 mm), and disparity is rounded to 1/32 px."""
    depth_error: float = 0.0
    """Standard deviation of a further depth error that is alike at all distances [m]."""
    depth_bias: float = 0.0
    """Largest slow offset of each camera's depth [m]."""
    holes: float = 0.0
    """Part of the pixels lost to speckle; at angles of more than 70° to the surface's normal it is
    ten times the level more, at most half."""
    flying_pixels: float = 0.0
    """Part of the pixels within 2 px of a depth edge that mix fore- and background."""
    shadow: float = 0.0
    """Width of the blind band to the left of near things; 1 is what the stereo pair causes."""
    mask_error: float = 0.0
    """Largest shift of an outline [px]; its standard deviation is half of that before it is cut."""
    track_noise: float = 0.0
    """Standard deviation of each coordinate of a track [px]."""
    track_drift: float = 0.0
    """How far each coordinate of a track has drifted for good after a second, standard deviation
    [px]."""
    track_loss: float = 0.0
    """Probability in each frame that a track is lost for three frames."""
    keypoint_noise: float = 0.0
    """Standard deviation of each coordinate of a hand's keypoint [px]; twice that where it is
    hidden. If there is any, one keypoint in a hundred is not found."""
    camera_shift: float = 0.0
    """How far each camera is from where its calibration says [m]."""
    camera_turn: float = 0.0
    """How far it is turned from what its calibration says [degrees]."""
    time_skew: float = 0.0
    """How much earlier or later than the first camera the others take their pictures, at most; at
    least half as much [s]."""
    hand_mismatch: float = 0.0
    """Soft tissue on the true hand that no hand model knows; 1 is 1 to 2 mm."""
    hand_error: float = 0.0
    """How far from their true place the hands are filmed and found, on average over the frames.
    It changes over about a third of a second [m]."""


def depth_sensor(level: Degradations) -> DepthSensor:
    """Build the depth camera of these levels."""
    return DepthSensor(
        disparity_noise=level.depth_noise,
        disparity_step=1 / 32 if level.depth_noise > 0 else 0.0,
        hole_rate=level.holes,
        grazing_rate=min(0.5, 10 * level.holes),
        flying_rate=level.flying_pixels,
        edge_reach=2,
        shadow=level.shadow,
        even_noise=level.depth_error,
        bias=level.depth_bias,
    )


def miscalibrated(camera: PinholeCamera, level: Degradations, random: Generator) -> PinholeCamera:
    """Simulate the calibration of a camera: shifted and turned in random directions."""
    shift, axis = (_direction(random) for _ in range(2))
    pose = camera.T_world_camera.copy()
    turn = Rotation.from_rotvec(np.deg2rad(level.camera_turn) * axis).as_matrix()
    pose[:3, :3] = turn @ pose[:3, :3]
    pose[:3, 3] += level.camera_shift * shift
    return PinholeCamera(K=camera.K, T_world_camera=pose, width=camera.width, height=camera.height)


def delays(count: int, level: Degradations, random: Generator) -> Float[ndarray, " camera"]:
    """Draw how much later than the first camera each one takes its pictures [s]."""
    amount = level.time_skew * random.uniform(0.5, 1.0, count) * random.choice([-1.0, 1.0], count)
    amount[0] = 0.0
    return amount


def hand_shift(
    frame_count: int, frame_rate: float, level: Degradations, random: Generator
) -> Float[ndarray, "frame 3"]:
    """Draw how far from its true place a hand seems to be in each frame [m].

    The mean of the distances is the level, exactly.
    """
    noise = random.standard_normal((frame_count + 60, 3))
    smooth = gaussian_filter1d(noise, _HAND_WANDERS * frame_rate, axis=0)[30 : 30 + frame_count]
    return level.hand_error * smooth / np.linalg.norm(smooth, axis=1).mean()


def _direction(random: Generator) -> Float[ndarray, " 3"]:
    vector = random.standard_normal(3)
    return vector / np.linalg.norm(vector)


PRESETS: dict[str, Degradations] = {
    # Depth is whole millimetres, the true hand is not the one that is fitted; nothing else errs.
    "clean": Degradations(),
    # A D455 at its published noise, calibrated and synchronised with care.
    "default": Degradations(
        depth_noise=0.08,
        depth_bias=0.001,
        holes=0.03,
        flying_pixels=0.4,
        shadow=1.0,
        mask_error=2.0,
        track_noise=0.5,
        track_drift=0.5,
        track_loss=0.01,
        keypoint_noise=1.5,
        camera_shift=0.001,
        camera_turn=0.1,
        time_skew=0.010,
        hand_mismatch=1.0,
    ),
    # The far end of what is published.
    "hard": Degradations(
        depth_noise=0.10,
        depth_bias=0.002,
        holes=0.05,
        flying_pixels=0.4,
        shadow=1.0,
        mask_error=3.0,
        track_noise=1.0,
        track_drift=1.5,
        track_loss=0.03,
        keypoint_noise=3.0,
        camera_shift=0.002,
        camera_turn=0.2,
        time_skew=0.020,
        hand_mismatch=1.5,
    ),
    # The paper's three perturbations, all at once: depth 1 mm, tracks 1 px, hand 10 mm.
    "paper": Degradations(depth_error=0.001, track_noise=1.0, hand_error=0.010),
}
"""Levels by name."""

_LARGEST = {
    "holes": 0.9,
    "flying_pixels": 1.0,
    "shadow": 1.0,
    "track_loss": 1.0,
    "time_skew": 0.5,
    "camera_turn": 45.0,
    "camera_shift": 0.5,
    "depth_noise": 2.0,
    "depth_error": 0.5,
    "depth_bias": 0.5,
    "hand_error": 0.5,
    "hand_mismatch": 10.0,
}
_MOST_PIXELS = 100.0


def find_preset(name: str) -> Degradations:
    """Look up a preset.

    Raises:
        UsageError: If there is none of this name.
    """
    if name not in PRESETS:
        names = ", ".join(PRESETS)
        raise UsageError(f"There is no preset named {name!r}. Choose one of: {names}.")
    return PRESETS[name]


def changed(level: Degradations, changes: Mapping[str, float]) -> Degradations:
    """Change some levels.

    Args:
        level: Levels to start from.
        changes: New levels by name.

    Raises:
        UsageError: If there is no such degradation, or the level is out of bounds.
    """
    names = [field.name for field in fields(Degradations)]
    for name, value in changes.items():
        if name not in names:
            near = get_close_matches(name, names, 1)
            hint = f"Did you mean {near[0]!r}?" if near else f"Choose one of: {', '.join(names)}."
            raise UsageError(f"There is no degradation named {name!r}. {hint}")
        largest = _LARGEST.get(name, _MOST_PIXELS)
        if not math.isfinite(value) or not 0 <= value <= largest:
            raise UsageError(f"{name} is {value:g}; expected a level from 0 to {largest:g}.")
    return replace(level, **changes)
