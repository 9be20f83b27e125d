"""The color scale with its numbers, as HTML that suits a light and a dark panel."""

import html

import numpy as np

from app.viewer.color.coloring import Legend
from app.viewer.color.colormaps import UNKNOWN, table

TICKS = 5
"""Numbers below the scale."""
_STOPS = 17


def tick_values(legend: Legend) -> list[float]:
    """Choose the values that are written below the scale, in the unit of the legend."""
    low, high = legend.limits
    place = np.linspace(0.0, 1.0, TICKS)
    if legend.quantity.is_logarithmic and low > 0:
        value = np.exp(np.log(low) + place * (np.log(high) - np.log(low)))
    else:
        value = low + place * (high - low)
    return [float(v) for v in value * legend.quantity.factor]


def number(value: float) -> str:
    """Write a value with three digits and without an exponent where that is shorter."""
    if value == 0 or abs(value) < 1e-12:
        return "0"
    text = f"{value:.3g}"
    if "e" in text and 1e-3 <= abs(value) < 1e6:
        return f"{float(text):.0f}"
    return text.replace("e-0", "e-").replace("e+0", "e")


def legend_html(legend: Legend, *, highest: bool) -> str:
    """Draw the scale with its numbers, and say what it tells.

    Args:
        legend: What is painted.
        highest: Whether to add the highest value of the frame.
    """
    quantity = legend.quantity
    ramp = table(quantity.scale)
    at = np.round(np.linspace(0, len(ramp) - 1, _STOPS)).astype(int)
    stops = ",".join(f"rgb({r},{g},{b})" for r, g, b in ramp[at].tolist())
    ticks = "".join(f"<span>{number(value)}</span>" for value in tick_values(legend))
    notes = [html.escape(quantity.about)]
    if quantity.is_logarithmic:
        notes.append("logarithmic")
    if not legend.is_known:
        notes.append("<b>not known in this frame</b>")
    elif highest:
        top = number(legend.highest * quantity.factor)
        notes.append(f"highest {legend.thing} now {top}&nbsp;{html.escape(quantity.unit)}")
        if legend.unknown:
            plural = {"vertex": "vertices"}.get(legend.thing, f"{legend.thing}s")
            gray = "rgb({},{},{})".format(*UNKNOWN)
            notes.append(f'<span style="color:{gray}">■</span> {legend.unknown} {plural} not known')
    return (
        '<div style="padding:0.1em 0.9em 0.5em;font-size:0.8em" data-legend>'
        '<div style="display:flex;justify-content:space-between;margin-bottom:0.2em">'
        f"<b>{html.escape(quantity.label)}</b><span>{html.escape(quantity.unit)}</span></div>"
        '<div style="height:0.9em;border-radius:0.2em;border:1px solid rgba(128,128,128,0.6);'
        f'background:linear-gradient(to right,{stops})"></div>'
        '<div style="display:flex;justify-content:space-between;'
        f'font-variant-numeric:tabular-nums">{ticks}</div>'
        f'<div style="opacity:0.8;line-height:1.35;margin-top:0.2em">{" · ".join(notes)}</div>'
        "</div>"
    )
