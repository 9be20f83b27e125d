"""The color scale in the corner of a painted picture."""

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from app.viewer.color.coloring import Legend
from app.viewer.color.colormaps import table
from app.viewer.color.legend import number, tick_values

_INK = {False: (30, 36, 44), True: (226, 230, 236)}
_SMALLEST = 160


def draw_scale(
    image: UInt8[ndarray, "row column 3"], legend: Legend, *, is_dark: bool
) -> UInt8[ndarray, "row column 3"]:
    """Draw what the colors tell, with its unit and numbers, into the lower left corner.

    Args:
        image: The picture; small ones have no room and stay as they are.
        legend: What has to be said.
        is_dark: Whether the background is dark.

    Returns:
        The picture with the scale.
    """
    rows, columns = image.shape[:2]
    if min(rows, columns) < _SMALLEST:
        return image
    image = image.copy()
    unit = max(round(min(rows, columns) / 45), 4)
    wide, high = min(16 * unit, columns - 4 * unit), unit
    left, top = 2 * unit, rows - 5 * unit
    place = np.linspace(0, len(table(legend.quantity.scale)) - 1, wide).round().astype(int)
    ramp = table(legend.quantity.scale)[place]
    image[top : top + high, left : left + wide] = ramp[None]
    font, size, ink = cv2.FontFace("sans"), unit, _INK[is_dark]
    about = legend.quantity
    title = f"{about.label} [{about.unit}]" if about.unit else about.label
    title += ", logarithmic" if about.is_logarithmic else ""
    cv2.putText(image, title, (left, top - unit // 2), ink, font, size)
    values = tick_values(legend)
    for index, value in enumerate(values):
        text = number(value)
        box = cv2.getTextSize((0, 0), text, (0, 0), font, size)
        x = left + round(wide * index / (len(values) - 1)) - box[2] // 2
        cv2.putText(image, text, (max(x, 0), top + high + round(1.3 * unit)), ink, font, size)
    return image
