"""The color scale of a quantity, and its legend: in a panel as HTML, in a picture as pixels."""

import html
from collections.abc import Iterable
from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from app.viewer.color.colormaps import UNKNOWN, levels, paint_values, table
from app.viewer.color.quantities import Quantity

TICKS = 5
"""Numbers below the scale."""
_STOPS = 17
_SHARES = 32
"""Bars that show how often values are there."""
_STRONG = 0.98
"""Part of the values that the range covers; the strongest few are shown as its end."""
_LEAST = 1e-12
_INK = {False: (30, 36, 44), True: (226, 230, 236)}
"""Color of the numbers in a picture on a light and on a dark background."""
_SMALLEST_PICTURE = 160
"""Smaller pictures have no room for a legend [px]."""

Limits = tuple[float, float]
"""Values at the low and the high end of a color scale, in SI units."""


@dataclass(frozen=True, kw_only=True)
class ColorScale:
    """Color scale of a quantity."""

    quantity: Quantity
    """The quantity, in the units of the content."""
    limits: Limits
    """Values at both ends."""
    is_open: bool = False
    """Whether the color of the high end also means larger values, and the legend says so."""

    def levels(self, value: Float[ndarray, "*item"]) -> Float[ndarray, "*item"]:
        """Find where values lie on the scale, from 0 to 1; NaN stays NaN."""
        return levels(value, self.limits, is_logarithmic=self.quantity.is_logarithmic)

    def paint(self, value: Float[ndarray, "*item"]) -> UInt8[ndarray, "*item 3"]:
        """Give values their colors; NaN gets `UNKNOWN`."""
        quantity = self.quantity
        return paint_values(
            value, self.limits, quantity.scale, is_logarithmic=quantity.is_logarithmic
        )

    @property
    def ramp(self) -> UInt8[ndarray, "step 3"]:
        """All colors from the low to the high end."""
        return table(self.quantity.scale)

    @property
    def ticks(self) -> list[float]:
        """Values that are written below the scale, in the quantity's unit."""
        low, high = self.limits
        place = np.linspace(0.0, 1.0, TICKS)
        if self.quantity.is_logarithmic and low > 0:
            value = np.exp(np.log(low) + place * (np.log(high) - np.log(low)))
        else:
            value = low + place * (high - low)
        return [float(v) for v in value * self.quantity.factor]

    @property
    def tick_labels(self) -> list[str]:
        """The ticks as text."""
        labels = [number(value) for value in self.ticks]
        return [*labels[:-1], f"≥{labels[-1]}"] if self.is_open else labels


@dataclass(frozen=True, kw_only=True, eq=False)
class Legend:
    """Legend of the current coloring: its scale, and what the frame on the screen has of it."""

    scale: ColorScale
    """The color scale."""
    unknown: int = 0
    """Items without a value in this frame."""
    is_known: bool = True
    """Whether any item has a value in this frame."""
    highest: float | None = None
    """Highest value in this frame, in SI units; None if it is not written."""
    item: str = "node"
    """Item that has the values: ``node`` or ``vertex``."""
    shown: Float[ndarray, " value"] = field(default_factory=lambda: np.zeros(0))
    """Known values of all that is shown in this frame, in SI units."""

    @classmethod
    def of(
        cls,
        scale: ColorScale,
        value: Float[ndarray, " item"],
        *,
        shown: Float[ndarray, " value"],
        item: str = "node",
    ) -> "Legend":
        """Say what a frame has of a quantity.

        Args:
            scale: Which color means which value.
            value: Values of the nodes or vertices, NaN where not known.
            shown: Known values of all that is shown.
            item: What has the values: ``node`` or ``vertex``.
        """
        finite = value[np.isfinite(value)]
        return cls(
            scale=scale,
            unknown=len(value) - len(finite),
            is_known=bool(len(finite)),
            highest=float(finite.max(initial=0.0)),
            item=item,
            shown=shown,
        )

    @property
    def shares(self) -> list[float]:
        """Histogram of the values by color, as shares of its highest bar; empty without values.

        From the low to the high end of the scale, where what lies beyond is counted, too.
        """
        level = np.clip(self.scale.levels(self.shown), 0.0, 1.0)
        count, _ = np.histogram(level, _SHARES, (0.0, 1.0))
        return (count / count.max()).tolist() if len(level) else []

    @property
    def frame_limits(self) -> Limits | None:
        """Range that nearly all values of this frame lie in; None if there are none."""
        quantity = self.scale.quantity
        limits = nearly_all(self.shown, quantity)
        return None if limits is None else with_width(limits, quantity)


def nearly_all(value: Float[ndarray, " value"], quantity: Quantity) -> Limits | None:
    """Find a range that nearly all values lie in; None if there are none."""
    if len(value) == 0:
        return None
    if quantity.scale == "diverging":
        high = _rounded_up(float(np.quantile(np.abs(value), _STRONG)), quantity.factor)
        return -high, high
    if quantity.is_static:
        low, high = np.quantile(value, [1.0 - _STRONG, _STRONG])
        return float(low), float(high)
    some = value[value > 0.0]  # Forces are zero wherever the hand holds nothing.
    if len(some) == 0:
        return 0.0, 0.0
    return 0.0, _rounded_up(float(np.quantile(some, _STRONG)), quantity.factor)


def _rounded_up(value: float, factor: float) -> float:
    """Round up to two digits of what is written, so that the legend is easy to read."""
    if value <= _LEAST:
        return 0.0
    step = 10.0 ** (np.floor(np.log10(factor * value)) - 1)
    return float(np.ceil(factor * value / step - 1e-9) * step / factor)


def with_width(limits: Limits | None, quantity: Quantity) -> Limits:
    """Take a range that has a width, even if all values are the same or none is known."""
    low, high = limits or (0.0, 1.0 / quantity.factor)
    return (low, high) if high > low else (low, low + (abs(low) or 1.0 / quantity.factor))


def number(value: float) -> str:
    """Write a value with three digits and without an exponent where that is shorter."""
    if value == 0 or abs(value) < 1e-12:
        return "0"
    text = f"{value:.3g}"
    if "e" in text and 1e-3 <= abs(value) < 1e6:
        return f"{float(text):.0f}"
    return text.replace("e-0", "e-").replace("e+0", "e")


def legend_html(legend: Legend, *, highest: bool = True) -> str:
    """Draw the scale with its numbers and a description, for light and dark panels.

    Args:
        legend: The legend.
        highest: Whether to write the highest value of the frame, if the legend has one.
    """
    quantity = legend.scale.quantity
    ramp = legend.scale.ramp
    at = np.round(np.linspace(0, len(ramp) - 1, _STOPS)).astype(int)
    stops = ",".join(f"rgb({r},{g},{b})" for r, g, b in ramp[at].tolist())
    ticks = "".join(f"<span>{label}</span>" for label in legend.scale.tick_labels)
    bars = _bars(legend) if highest else ""
    notes = [html.escape(quantity.about)]
    if quantity.is_logarithmic:
        notes.append("logarithmic")
    if not legend.is_known:
        notes.append("<b>not known in this frame</b>")
    elif highest and legend.highest is not None:
        top = number(legend.highest * quantity.factor)
        notes.append(f"highest {legend.item} now {top}&nbsp;{html.escape(quantity.unit)}")
        if legend.unknown:
            plural = {"vertex": "vertices"}.get(legend.item, f"{legend.item}s")
            gray = "rgb({},{},{})".format(*UNKNOWN)
            notes.append(f'<span style="color:{gray}">■</span> {legend.unknown} {plural} not known')
    return (
        '<div style="padding:0.1em 0.9em 0.5em;font-size:0.8em" data-legend>'
        '<div style="display:flex;justify-content:space-between;margin-bottom:0.2em">'
        f"<b>{html.escape(quantity.label)}</b><span>{html.escape(quantity.unit)}</span></div>"
        f"{bars}"
        '<div style="height:0.9em;border-radius:0.2em;border:1px solid rgba(128,128,128,0.6);'
        f'background:linear-gradient(to right,{stops})"></div>'
        '<div style="display:flex;justify-content:space-between;'
        f'font-variant-numeric:tabular-nums">{ticks}</div>'
        f'<div style="opacity:0.8;line-height:1.35;margin-top:0.2em">{" · ".join(notes)}</div>'
        "</div>"
    )


def legend_head(written: str) -> str:
    """Cut off what a legend's HTML says of a single frame."""
    before, mark, after = written.partition(_BARS)
    head = before + after.partition("</div>")[2] if mark else written
    return head.partition(" · highest ")[0]


_BARS = "<div data-shares "


def _bars(legend: Legend) -> str:
    """Draw how often each color is there, above the scale."""
    shares = legend.shares
    if not shares:
        return ""
    ramp = legend.scale.ramp
    place = (np.arange(len(shares)) + 0.5) / len(shares)
    colors = ramp[np.round(place * (len(ramp) - 1)).astype(int)].tolist()
    bars = "".join(
        f'<i style="flex:1;height:{100 * share:.0f}%;background:rgb({r},{g},{b})"></i>'
        for share, (r, g, b) in zip(shares, colors, strict=True)
    )
    style = "display:flex;align-items:flex-end;height:2.2em;gap:1px"
    return f'{_BARS}style="{style}" title="How often each value is there now">{bars}</div>'


def swatches_html(swatches: Iterable[tuple[tuple[int, int, int], str]], *, is_list: bool) -> str:
    """Draw a legend of parts: a dot of its color before each name.

    Args:
        swatches: Color and name; names are escaped.
        is_list: Whether each has a line of its own, which may be broken, instead of one row.
    """
    dots: list[str] = []
    for color, name in swatches:
        dot = (
            '<span style="display:inline-block;width:0.7em;height:0.7em;border-radius:50%;'
            f'background:rgb{tuple(color)};margin-right:0.35em"></span>{html.escape(name)}'
        )
        if is_list:
            dots.append(f'<div style="overflow-wrap:anywhere">{dot}</div>')
        else:
            dots.append(f'<span style="white-space:nowrap;margin-right:0.8em">{dot}</span>')
    return f'<div style="font-size:0.8em;padding:0.2em 0.9em 0.5em">{"".join(dots)}</div>'


def draw_legend(
    image: UInt8[ndarray, "row column 3"], legend: Legend, *, is_dark: bool
) -> UInt8[ndarray, "row column 3"]:
    """Draw the scale with its name, unit and numbers into the lower left corner of a picture.

    Args:
        image: The picture; a small one has no room and stays as it is.
        legend: The legend.
        is_dark: Whether the background is dark.

    Returns:
        The picture with the legend.
    """
    rows, columns = image.shape[:2]
    if min(rows, columns) < _SMALLEST_PICTURE:
        return image
    image = image.copy()
    unit = max(round(min(rows, columns) / 45), 4)
    wide, high = min(16 * unit, columns - 4 * unit), unit
    left, top = 2 * unit, rows - 5 * unit
    ramp = legend.scale.ramp
    place = np.linspace(0, len(ramp) - 1, wide).round().astype(int)
    image[top : top + high, left : left + wide] = ramp[place][None]
    font, size, ink = cv2.FontFace("sans"), unit, _INK[is_dark]
    quantity = legend.scale.quantity
    title = f"{quantity.label} [{quantity.unit}]" if quantity.unit else quantity.label
    title += ", logarithmic" if quantity.is_logarithmic else ""
    cv2.putText(image, title, (left, top - unit // 2), ink, font, size)
    labels = legend.scale.tick_labels
    for index, label in enumerate(labels):
        box = cv2.getTextSize((0, 0), label, (0, 0), font, size)
        x = left + round(wide * index / (len(labels) - 1)) - box[2] // 2
        cv2.putText(image, label, (max(x, 0), top + high + round(1.3 * unit)), ink, font, size)
    return image
