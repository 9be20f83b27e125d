"""The parameters that sliders move: their ranges, their history and how to say what changed."""

import math
from dataclasses import dataclass

from physhandi.simulation.model import SimulationParameters

_DIGITS = 3


@dataclass(frozen=True, kw_only=True)
class Knob:
    """One slider and the parameter that it moves."""

    field: str
    """Field of `SimulationParameters`."""
    label: str
    """Name on the slider, with its unit."""
    low: float
    """Smallest slider value."""
    high: float
    """Largest slider value."""
    step: float
    """Distance of two slider values."""
    hint: str
    """What it does."""
    scale: float = 1.0
    """Slider value for a parameter of 1."""
    is_integer: bool = False
    """Whether only whole numbers make sense."""
    is_logarithm: bool = False
    """Whether the slider shows the decimal logarithm."""

    def to_slider(self, parameters: SimulationParameters) -> float:
        """Find the slider value of a parameter, moved into the slider's range.

        Rounded to what a person reads; a slider that nobody moves leaves the parameter as it is.
        """
        value = float(getattr(parameters, self.field)) * self.scale
        if self.is_logarithm:
            value = math.log10(max(value, 1e-12))
        value = min(max(value, self.low), self.high)
        return round(value) if self.is_integer else float(f"{value:.{_DIGITS}g}")

    def from_slider(self, value: float) -> float:
        """Find the parameter of a slider value; values outside the range are moved into it."""
        value = min(max(value, self.low), self.high)
        if self.is_logarithm:
            value = 10.0**value
        return round(value) if self.is_integer else value / self.scale

    def text(self, parameters: SimulationParameters) -> str:
        """Write the parameter as a person reads it."""
        value = getattr(parameters, self.field) * self.scale
        return f"x{value:.3g}" if self.is_logarithm else f"{value:.4g}"


@dataclass(frozen=True, kw_only=True)
class Switch:
    """One tick box and the parameter that it switches."""

    field: str
    """Field of `SimulationParameters`."""
    label: str
    """Name beside the box."""
    hint: str
    """What it does."""

    def to_slider(self, parameters: SimulationParameters) -> bool:
        """Find whether the box is ticked."""
        return bool(getattr(parameters, self.field))

    def from_slider(self, value: float) -> bool:
        """Find the parameter of a box."""
        return bool(value)

    def text(self, parameters: SimulationParameters) -> str:
        """Write the parameter as a person reads it."""
        return "on" if self.to_slider(parameters) else "off"


def knobs(parameters: SimulationParameters, *, length_unit: str) -> tuple[Knob, ...]:
    """List the sliders of an object; each range includes the fitted value.

    Args:
        parameters: The fitted parameters.
        length_unit: Unit of lengths; ``"m"`` is shown as millimetres.
    """

    def radius(field: str, label: str, hint: str) -> Knob:
        return _length(parameters, field, label, hint, length_unit, widest=80.0, step=0.5)

    def neighbors(field: str, label: str, hint: str) -> Knob:
        high = max(80, getattr(parameters, field))
        return Knob(field=field, label=label, low=1, high=high, step=1, hint=hint, is_integer=True)

    def plain(field: str, label: str, high: float, step: float, hint: str) -> Knob:
        high = max(high, 2 * getattr(parameters, field))
        return Knob(field=field, label=label, low=0.0, high=high, step=step, hint=hint)

    return (
        radius("connection_radius", "δ object", "Object nodes nearer than this get a spring."),
        neighbors("max_neighbors", "d_max object", "Most object springs that one node starts."),
        radius(
            "virtual_connection_radius",
            "δ virtual",
            "A control node holds the object nodes nearer than this.",
        ),
        neighbors(
            "virtual_max_neighbors", "d_max virtual", "Most virtual springs of one control node."
        ),
        Knob(
            field="stiffness_scale",
            label="stiffness 10^",
            low=-2.0,
            high=1.0,
            step=0.05,
            hint="Multiplies the stiffness of every spring: 0 is as fitted, -1 a tenth.",
            is_logarithm=True,
        ),
        plain("damping", "damping [N·s/m]", 300.0, 1.0, "Dashpot along each spring."),
        plain("drag", "drag [1/s]", 20.0, 0.1, "How fast every motion dies out."),
        plain("gravity", "gravity [m/s²]", 20.0, 0.1, "Acceleration downwards."),
    )


def self_collision_knobs(
    parameters: SimulationParameters, *, length_unit: str
) -> tuple[Knob | Switch, ...]:
    """List what changes the collisions of object nodes with each other; see `knobs`."""
    return (
        Switch(
            field="self_collision",
            label="nodes collide",
            hint="Object nodes bounce off each other, so that layers of cloth stay apart.",
        ),
        _length(
            parameters,
            "collision_distance",
            "distance",
            "Nodes that approach each other nearer than this collide.",
            length_unit,
            widest=20.0,
            step=0.1,
        ),
        Knob(
            field="self_restitution",
            label="restitution of nodes",
            low=0.0,
            high=1.0,
            step=0.05,
            hint="Part of the approach speed that a collision gives back.",
        ),
        Knob(
            field="self_friction",
            label="friction of nodes",
            low=0.0,
            high=2.0,
            step=0.05,
            hint="How much nodes that touch resist sliding past each other.",
        ),
        Switch(
            field="collides_rest_neighbors",
            label="also rest neighbors",
            hint="Also collide nodes nearer than the distance at frame 0, as PhysTwin does.",
        ),
    )


def _length(
    parameters: SimulationParameters,
    field: str,
    label: str,
    hint: str,
    length_unit: str,
    *,
    widest: float,
    step: float,
) -> Knob:
    """Make the slider of a length; `widest` and `step` are in millimetres."""
    is_metric = length_unit == "m"
    per_metre, unit = (1e3, "mm") if is_metric else (1.0, length_unit)
    fitted = getattr(parameters, field) * per_metre
    high = max(widest, 1.5 * fitted) if is_metric else max(4 * fitted, 1e-6)
    step = step if is_metric else high / 200
    return Knob(
        field=field,
        label=f"{label} [{unit}]",
        low=step,
        high=high,
        step=step,
        hint=hint,
        scale=per_metre,
    )


def what_changed(
    knobs: tuple[Knob | Switch, ...], start: SimulationParameters, now: SimulationParameters
) -> str:
    """Say which parameters differ from the fitted ones, for example ``δ object 20 → 35 mm``."""
    parts = [
        f"{knob.label.replace(' 10^', '')} {knob.text(start)} → {knob.text(now)}"
        for knob in knobs
        if getattr(start, knob.field) != getattr(now, knob.field)
    ]
    return ", ".join(parts) or "nothing: parameters as fitted"
