"""The parameters that sliders move: their ranges, their history and how to say what changed."""

import math
from dataclasses import dataclass

from physhandi.simulation.parameters import SimulationParameters

_DIGITS = 3
_OTHERS = {
    "substeps_per_frame": "substeps",
    "rest_length_floor": "shortest object spring [m]",
    "virtual_rest_length_floor": "shortest virtual spring [m]",
    "use_control_velocity": "dashpots see the hand move",
}


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
    name: str = ""
    """What it is called outside of its folder; empty for the label."""
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

    def differs(self, start: SimulationParameters, now: SimulationParameters) -> bool:
        """Tell whether two sets of parameters differ in this one."""
        return getattr(start, self.field) != getattr(now, self.field)


@dataclass(frozen=True, kw_only=True)
class Switch:
    """One tick box and the parameter that it switches."""

    field: str
    """Field of `SimulationParameters`."""
    label: str
    """Name beside the box."""
    hint: str
    """What it does."""
    name: str = ""
    """What it is called outside of its folder; empty for the label."""

    def to_slider(self, parameters: SimulationParameters) -> bool:
        """Find whether the box is ticked."""
        return bool(getattr(parameters, self.field))

    def from_slider(self, value: float) -> bool | float | None:
        """Find the parameter of a box."""
        return bool(value)

    def text(self, parameters: SimulationParameters) -> str:
        """Write the parameter as a person reads it."""
        return "on" if self.to_slider(parameters) else "off"

    def differs(self, start: SimulationParameters, now: SimulationParameters) -> bool:
        """Tell whether the box is ticked in one of two sets of parameters only."""
        return self.to_slider(start) != self.to_slider(now)


def name_of(knob: Knob | Switch) -> str:
    """Give the name by which a parameter is known outside of its folder."""
    return (knob.name or knob.label).replace(" 10^", "")


def knobs(parameters: SimulationParameters, *, length_unit: str) -> tuple[Knob, ...]:
    """List the sliders of an object; each range includes the fitted value.

    Args:
        parameters: The fitted parameters.
        length_unit: Unit of lengths; ``"m"`` is shown as millimetres.
    """

    def radius(field: str, label: str, hint: str) -> Knob:
        return length_knob(parameters, field, label, hint, length_unit, widest=80.0, step=0.5)

    def neighbors(field: str, label: str, hint: str) -> Knob:
        high = max(80, getattr(parameters, field))
        return Knob(field=field, label=label, low=1, high=high, step=1, hint=hint, is_integer=True)

    def plain(field: str, label: str, high: float, step: float, hint: str) -> Knob:
        high = max(high, round_up(2 * getattr(parameters, field)))
        return Knob(field=field, label=label, low=0.0, high=high, step=step, hint=hint)

    def apart(field: str, label: str, hint: str) -> tuple[Knob, ...]:
        """Make a slider that multiplies one kind of stiffness; none where it was fitted to 0."""
        fitted = getattr(parameters, field)
        knob = Knob(
            field=field,
            label=label,
            low=-2.0,
            high=1.0,
            step=0.05,
            hint=hint,
            scale=1.0 / max(fitted, 1e-30),
            is_logarithm=True,
        )
        return (knob,) if fitted > 0 else ()

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
        *apart("stiffness", "k object 10^", "Multiplies the stiffness of object springs alone."),
        *apart(
            "virtual_stiffness",
            "k virtual 10^",
            "Multiplies the stiffness of virtual springs alone.",
        ),
        plain("damping", "damping [N·s/m]", 300.0, 1.0, "Dashpot along each spring."),
        plain("drag", "drag [1/s]", 20.0, 0.1, "How fast every motion dies out."),
        plain("gravity", "gravity [m/s²]", 20.0, 0.1, "Acceleration downwards."),
    )


def length_knob(
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
    high = max(widest, round_up(1.5 * fitted)) if is_metric else max(4 * fitted, 1e-6)
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


def round_up(value: float) -> float:
    """Give the next number of two digits, as the end of a slider."""
    unit = 10.0 ** (math.floor(math.log10(max(value, 1e-12))) - 1)
    return float(f"{math.ceil(value / unit) * unit:.3g}")


@dataclass(frozen=True)
class Change:
    """One parameter that is not as fitted."""

    name: str
    """What people call it."""
    fields: tuple[str, ...]
    """Fields of `SimulationParameters` that it is."""
    text: str
    """What became of it, for example ``δ object [mm] 20 → 35``."""


def changes_in(
    knobs: tuple[Knob | Switch, ...],
    start: SimulationParameters,
    now: SimulationParameters,
    *,
    is_automatic: bool = False,
) -> tuple[Change, ...]:
    """List what is not as fitted: in the sliders' words, and what no slider moves by its field.

    Args:
        knobs: The sliders and boxes.
        start: The fitted parameters.
        now: Those in force.
        is_automatic: Whether the substeps are chosen automatically.
    """
    changes = [
        Change(name := name_of(k), (k.field,), f"{name} {k.text(start)} → {k.text(now)}")
        for k in knobs
        if k.differs(start, now)
    ]
    shown = {knob.field for knob in knobs}
    was, values = start.to_dict(), now.to_dict()
    if is_automatic:
        values["substeps_per_frame"] = "automatic"
    for field, value in values.items():
        if field not in shown and value != was[field]:
            name = _OTHERS.get(field, field)
            changes.append(Change(name, (field,), f"{name} {_said(was[field])} → {_said(value)}"))
    return tuple(changes)


def _said(value: object) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


@dataclass(frozen=True, kw_only=True)
class HeightKnob(Knob):
    """The slider of the ground's height, which rests while there is no ground."""

    base: float = 0.0
    """Height that it shows while there is no ground."""

    def to_slider(self, parameters: SimulationParameters) -> float:
        """Find the slider value; see `Knob.to_slider`."""
        height = parameters.ground_height
        value = (self.base if height is None else height) * self.scale
        # A height can be anything, so it is rounded by the slider's step and not by its digits.
        return min(max(round(value, 6), self.low), self.high)

    def differs(self, start: SimulationParameters, now: SimulationParameters) -> bool:
        """Tell whether two grounds are at different heights."""
        return None not in {start.ground_height, now.ground_height} and super().differs(start, now)


@dataclass(frozen=True, kw_only=True)
class GroundSwitch(Switch):
    """The tick box of the ground."""

    base: float
    """Height at which it appears."""

    def to_slider(self, parameters: SimulationParameters) -> bool:
        """Find whether there is a ground."""
        return parameters.ground_height is not None

    def from_slider(self, value: float) -> float | None:
        """Find the ground's height, or none."""
        return self.base if value else None


def ground_knobs(
    parameters: SimulationParameters, *, length_unit: str, low: float, high: float
) -> tuple[Knob | Switch, ...]:
    """List what changes the ground and how nodes bounce and slide on it.

    Args:
        parameters: The fitted parameters.
        length_unit: Unit of lengths; ``"m"`` is shown as millimetres.
        low: Lowest point of the object at frame 0.
        high: Its highest point there.
    """
    per_metre, unit = (1e3, "mm") if length_unit == "m" else (1.0, length_unit)
    fitted = parameters.ground_height
    base = low if fitted is None else fitted
    margin = max(high - low, 0.1 if length_unit == "m" else 1e-6)
    # Nodes that start below the ground would be thrown out of it, faster than anything may be.
    ends = (min(base, low) - 2 * margin) * per_metre, max(base, low) * per_metre
    step = 1.0 if length_unit == "m" else (ends[1] - ends[0]) / 200
    return (
        GroundSwitch(
            field="ground_height",
            label="ground",
            hint="Whether there is a ground that nodes do not fall through.",
            base=base,
        ),
        HeightKnob(
            field="ground_height",
            label=f"height [{unit}]",
            name=f"ground height [{unit}]",
            low=math.floor(ends[0] / step) * step,
            high=max(math.floor(ends[1] / step) * step, base * per_metre),
            step=step,
            hint="Height of the ground, at most that of the object's lowest node at frame 0.",
            scale=per_metre,
            base=base,
        ),
        Knob(
            field="friction",
            label="friction",
            low=0.0,
            high=2.0,
            step=0.05,
            hint="How much nodes on the ground resist sliding; 0 is ice.",
        ),
        Knob(
            field="restitution",
            label="restitution",
            low=0.0,
            high=1.0,
            step=0.05,
            hint="Part of its speed that a node that hits the ground bounces back with.",
        ),
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
        length_knob(
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
