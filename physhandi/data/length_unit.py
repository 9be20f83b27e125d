"""Tells lengths that were given in another unit: metres off by a thousand, parts of an image."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

FARTHEST_POSITION = 20.0
"""A point or camera farther from the origin than this was not given in metres [m]."""
_FAR_OUTSIDE = 5.0  # From the centre, in image sizes; a hand may reach out of the image.
SMALLEST_EXTENT = 2e-3
"""An object smaller than this was not given in metres [m]."""


def doubt_position(
    position: Float[ndarray, "*axis 3"], farthest: float = FARTHEST_POSITION
) -> tuple[tuple[int, ...], str] | None:
    """Find the first position that is too far from the origin to be in metres.

    Args:
        position: Positions; those that are not finite are not looked at [m].
        farthest: Largest coordinate that is believed [m].

    Returns:
        Where in the array it is, and what is wrong with it; None if all is well.
    """
    size = np.where(np.isfinite(position), np.abs(position), 0.0).max(axis=-1, initial=0.0)
    if not (size > farthest).any():
        return None
    place = tuple(int(index) for index in np.argwhere(size > farthest)[0])
    return place, (
        f"is {size[place]:.4g} m from the origin, which looks like millimetres; divide by 1000, "
        "metres are expected"
    )


def doubt_extent(point: Float[ndarray, "point 3"], smallest: float = SMALLEST_EXTENT) -> str | None:
    """Tell what is wrong with an object that is too small to be in metres; None if all is well.

    Args:
        point: Points of the object; those that are not finite are not looked at [m].
        smallest: Least extent that is believed [m].
    """
    seen = point[np.isfinite(point).all(axis=-1)]
    extent = float(np.ptp(seen, axis=0).max()) if len(seen) > 1 else 0.0
    if extent == 0.0 or extent >= smallest:
        return None
    return (
        f"shows an object of only {extent * 1e3:.2g} mm, whose unit looks 1000 times too large; "
        "multiply by 1000, metres are expected"
    )


def doubt_keypoints(
    keypoint: Float[ndarray, "frame hand 21 3"], width: int, height: int
) -> tuple[tuple[int, ...], str] | None:
    """Find a keypoint that cannot be given in pixels of its view.

    Args:
        keypoint: Pixel x, pixel y and confidence; those that nobody saw are not looked at.
        width: Width of the view's images [px].
        height: Their height [px].

    Returns:
        Its frame, hand and joint, and what is wrong with it; None if all is well.
    """
    is_seen = np.isfinite(keypoint).all(axis=-1) & (np.nan_to_num(keypoint[..., 2]) > 0)
    size = np.array([width, height])
    is_far = (np.abs(keypoint[..., :2] / size - 0.5) > _FAR_OUTSIDE).any(axis=-1) & is_seen
    x, y = keypoint[..., 0][is_seen], keypoint[..., 1][is_seen]
    is_part = min(width, height) > 2 and len(x) > 0 and max(x.max(), y.max()) <= 1.0
    wrong = np.argwhere(is_far if not is_part else is_seen)
    if not len(wrong):
        return None
    place = tuple(int(index) for index in wrong[0])
    at = f"is at ({keypoint[place][0]:.4g}, {keypoint[place][1]:.4g})"
    if is_part:
        return place, f"{at}, a part of the image; multiply by {width} and {height}, pixels count"
    return place, f"{at} px, far outside of the {width}x{height} image; repair it or make it NaN"


def doubt_depth(largest: int) -> str | None:
    """Tell what is wrong with depth images whose largest value [mm] is too small; else None."""
    if largest == 0 or largest >= 20:
        return None
    return (
        f"is {largest} mm at most in all frames, which looks like metres; multiply by 1000, "
        "millimetres are expected"
    )
