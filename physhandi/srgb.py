"""The curve of sRGB (IEC 61966-2-1): color values against the amounts of light that they stand for.

Both go from 0 to 1.
"""

import numpy as np
from jaxtyping import Float
from numpy import ndarray


def to_linear(value: Float[ndarray, "*color"]) -> Float[ndarray, "*color"]:
    """Give the amounts of light of color values."""
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def to_srgb(light: Float[ndarray, "*color"]) -> Float[ndarray, "*color"]:
    """Give the color values of amounts of light."""
    bright = 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055
    return np.where(light <= 0.0031308, 12.92 * light, bright)
