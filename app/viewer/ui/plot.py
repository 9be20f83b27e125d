"""The one small plot of the viewer's panels: curves over the frames, and a mark at one of them."""

from collections.abc import Sequence as Listing
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
from jaxtyping import Float, Int
from numpy import ndarray
from viser import uplot

_AXIS = "rgb(120,130,145)"
_GRID = "rgba(120,130,145,0.2)"
_MARGIN = 0.05
"""Room above and below the curves, as a part of their range."""
_PADDING = (8, 12, 0, 0)
"""Room for the uppermost and the last number of the axes: top, right, bottom, left [px]."""
_LONGEST_LABEL = 16
"""Characters that fit along the axis; of a longer label only the unit is written."""


@dataclass(frozen=True, kw_only=True)
class PlotCurve:
    """One line of a plot."""

    label: str
    """Name of its quantity."""
    color: str
    """CSS color."""


class FramePlot:
    """Curves over the frames, with a vertical mark at the frame on the screen.

    The plot has no gaps: a frame is drawn where all curves that have any value have one.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        curves: Listing[PlotCurve],
        *,
        frame_count: int,
        unit: str,
        quantity: str = "",
        mark_color: str = "rgba(214,39,40,0.7)",
        starts_at_zero: bool = True,
        height: int = 120,
        order: float | None = None,
    ) -> None:
        """Add the plot where the caller stands, without values yet.

        Args:
            gui: Where to.
            curves: The lines in the order of the values of `show`.
            frame_count: Number of frames of the horizontal axis.
            unit: Unit of the values.
            quantity: What the vertical axis says before the unit; empty for the unit alone.
            mark_color: CSS color of the mark.
            starts_at_zero: Whether the vertical axis starts at zero instead of the lowest value.
            height: Height [px].
            order: Place among the controls of its folder; None for the last.
        """
        self._curve_count = len(curves)
        self._frame_count = max(frame_count, 2)
        self._starts_at_zero = starts_at_zero
        self._range = (0.0, 1.0)
        self._label = _axis_label(quantity, unit)
        points: Any = {"show": False}
        series = [
            uplot.Series(label=curve.label, stroke=curve.color, width=1.5, points=points)
            for curve in curves
        ]
        self._plot = gui.add_uplot(
            (np.arange(2.0), *np.zeros((self._curve_count + 1, 2))),
            (
                uplot.Series(label="frame"),
                *series,
                uplot.Series(label="now", stroke=mark_color, width=1, points=points),
            ),
            scales=self._scales(),
            axes=self._axes(),
            legend=uplot.Legend(show=False),
            height=height,
            padding=_PADDING,
            order=order,
        )

    @property
    def data(self) -> tuple[ndarray, ...]:
        """Frames, curves and mark as they are drawn."""
        return self._plot.data

    def offer(self, *, on: bool) -> None:
        """Show the plot, or hide it where there is nothing to be drawn."""
        if self._plot.visible != on:
            self._plot.visible = on

    def measure_in(self, unit: str, frame_count: int) -> None:
        """Change the unit and the number of frames."""
        self._frame_count = max(frame_count, 2)
        self._label = unit
        self._plot.axes = self._axes()
        self._plot.scales = self._scales()

    def show(self, values: Listing[Float[ndarray, " frame"]], frame: int) -> None:
        """Draw the curves.

        Args:
            values: One array a curve, in the plot's unit; NaN, or no entry, where it has no value.
            frame: Frame to mark.
        """
        column = np.full((self._curve_count, self._frame_count), np.nan)
        for row, value in zip(column, values, strict=True):
            row[: len(value)] = value[: self._frame_count]
        drawn = _drawn_frames(column)
        column = np.nan_to_num(column[:, drawn])
        low, high = self._fit(column)
        mark = np.full(len(drawn), low)
        mark[np.argmin(np.abs(drawn - frame))] = high
        self._plot.data = (drawn.astype(np.float64), *column, mark)

    def remove(self) -> None:
        """Take the plot away."""
        self._plot.remove()

    def _fit(self, column: Float[ndarray, "curve frame"]) -> tuple[float, float]:
        """Let the vertical axis span the curves; returns its ends.

        The browser's own choice fails after a plot was empty once, so every range is told to it.
        """
        low, high = float(column.min()), float(column.max())
        if self._starts_at_zero:
            low, high = min(low, 0.0), rounded_up(high) or 1.0
        else:
            margin = _MARGIN * (high - low) or _MARGIN * abs(high) or 1.0
            low, high = low - margin, high + margin
        if (low, high) != self._range:
            self._range = low, high
            self._plot.scales = self._scales()
        return self._range

    def _scales(self) -> dict[str, uplot.Scale]:
        last = float(self._frame_count - 1)
        return {
            "x": uplot.Scale(time=False, range=(0.0, last)),
            "y": uplot.Scale(range=self._range),
        }

    def _axes(self) -> tuple[uplot.Axis, uplot.Axis]:
        grid: Any = {"show": True, "stroke": _GRID}
        return (
            uplot.Axis(stroke=_AXIS, grid=grid, size=26),
            uplot.Axis(stroke=_AXIS, grid=grid, size=44, label=self._label, labelSize=14),
        )


def rounded_up(value: float) -> float:
    """Choose the next of 1, 2, 5 times a power of ten; 0 unless the value is positive."""
    if not np.isfinite(value) or value <= 0.0:
        return 0.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(step * power for step in (1, 2, 5, 10) if step * power >= 0.999999 * value))


def _drawn_frames(column: Float[ndarray, "curve frame"]) -> Int[ndarray, " drawn"]:
    """Find the frames at which every curve with any value has one; at least two frames."""
    has_value = np.isfinite(column)
    measured = has_value[has_value.any(axis=1)]
    drawn = np.flatnonzero(measured.all(axis=0)) if len(measured) else np.arange(0)
    return drawn if len(drawn) >= 2 else np.arange(2)


def _axis_label(quantity: str, unit: str) -> str:
    label = f"{quantity} [{unit}]" if quantity else unit
    return label if len(label) <= _LONGEST_LABEL else unit
