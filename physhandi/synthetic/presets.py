"""Named sets of degradation levels.

They were set once, from what is published of the sensors, before any method was tried on them.
"""

import math
from collections.abc import Mapping
from dataclasses import fields, replace
from difflib import get_close_matches

from physhandi.errors import UsageError
from physhandi.synthetic.degradations import Degradations

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
        known = ", ".join(PRESETS)
        raise UsageError(f"There is no preset named {name!r}. Choose one of: {known}.")
    return PRESETS[name]


def changed(level: Degradations, changes: Mapping[str, float]) -> Degradations:
    """Change some levels.

    Args:
        level: Levels to start from.
        changes: New levels by name.

    Raises:
        UsageError: If there is no such degradation, or the level makes no sense.
    """
    known = [field.name for field in fields(Degradations)]
    for name, value in changes.items():
        if name not in known:
            near = get_close_matches(name, known, 1)
            hint = f"Did you mean {near[0]!r}?" if near else f"Choose one of: {', '.join(known)}."
            raise UsageError(f"There is no degradation named {name!r}. {hint}")
        largest = _LARGEST.get(name, _MOST_PIXELS)
        if not math.isfinite(value) or not 0 <= value <= largest:
            raise UsageError(f"{name} is {value:g}; expected a level from 0 to {largest:g}.")
    return replace(level, **changes)
