"""Sliders and tick boxes that the table of parameters asks for, and the words for what changed."""

import math
from dataclasses import dataclass

from physhandi.simulation.edits import Edits
from physhandi.simulation.parameters import (
    AUTOMATIC,
    PARAMETERS,
    Parameter,
    SimulationParameters,
    Slider,
    SliderGroup,
    parameter_changes,
)

_DIGITS = 3
_FACTOR_DIGITS = 4
POWER_DIGITS = 6
"""Decimals of the logarithm of a factor, so that a factor of four digits is met exactly."""
_POWERS = (-2.0, 1.0)
"""Ends of a slider of a power of ten."""
FACTOR_MARKS = ((-2.0, "×0.01"), (-1.0, "×0.1"), (0.0, "×1"), (1.0, "×10"))
"""Marks of a slider of a power of ten, by which the page recognises it and shows factors."""


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
    """Its effect, for the control's hint."""
    name: str = ""
    """Its name outside of its folder; empty for the label."""
    scale: float = 1.0
    """Slider value for a parameter of 1."""
    is_integer: bool = False
    """Whether only whole numbers make sense."""
    is_logarithm: bool = False
    """Whether the slider moves the decimal logarithm; its marks are factors."""

    def to_slider(self, parameters: SimulationParameters) -> float:
        """Find the slider value of a parameter, moved into the slider's range.

        Rounded to what a person reads; a slider that nobody moves leaves the parameter as it is.
        """
        value = float(getattr(parameters, self.field)) * self.scale
        if self.is_logarithm:
            value = math.log10(max(value, 1e-12))
        value = min(max(value, self.low), self.high)
        if self.is_logarithm:
            return round(value, POWER_DIGITS)
        return round(value) if self.is_integer else float(f"{value:.{_DIGITS}g}")

    def from_slider(self, value: float) -> float:
        """Find the parameter of a slider value; values outside the range are moved into it."""
        value = min(max(value, self.low), self.high)
        if self.is_logarithm:
            value = float(f"{10.0**value:.{_FACTOR_DIGITS}g}")
        return round(value) if self.is_integer else value / self.scale

    def text(self, parameters: SimulationParameters) -> str:
        """Write the parameter as a person reads it."""
        value = getattr(parameters, self.field) * self.scale
        return f"×{value:.3g}" if self.is_logarithm else f"{value:.4g}"

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
    """Its effect, for the control's hint."""
    name: str = ""
    """Its name outside of its folder; empty for the label."""

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
    return knob.name or knob.label


def knobs(parameters: SimulationParameters, *, length_unit: str) -> tuple[Knob | Switch, ...]:
    """List the sliders of an object; each range includes the fitted value.

    Args:
        parameters: The fitted parameters.
        length_unit: Unit of lengths; ``"m"`` is shown as millimetres.
    """
    return (
        *knobs_of("springs", parameters, length_unit=length_unit),
        *knobs_of("more", parameters, length_unit=length_unit),
    )


def knobs_of(
    group: SliderGroup, parameters: SimulationParameters, *, length_unit: str
) -> tuple[Knob | Switch, ...]:
    """List the controls of one folder of the panel; see `knobs`."""
    made = (
        _control(parameter, parameter.slider, parameters, length_unit)
        for parameter in PARAMETERS.values()
        if parameter.slider and parameter.slider.group == group
    )
    return tuple(control for control in made if control is not None)


def _control(
    parameter: Parameter, slider: Slider, fitted: SimulationParameters, length_unit: str
) -> Knob | Switch | None:
    """Make the control of a parameter; none where it multiplies what was fitted to 0."""
    name, label, value = parameter.name, parameter.title, float(getattr(fitted, parameter.name))
    if parameter.kind == "switch":
        return Switch(field=name, label=label, hint=slider.hint)
    if slider.scale != "linear":
        is_relative = slider.scale == "relative power"
        if is_relative and value <= 0:
            return None
        return Knob(
            field=name,
            label=label,
            low=_POWERS[0],
            high=min(_POWERS[1], _power_to(parameter, value if is_relative else 1.0)),
            step=slider.step,
            hint=slider.hint,
            scale=1.0 / max(value, 1e-30) if is_relative else 1.0,
            is_logarithm=True,
        )
    if parameter.unit == "m":
        return _length_knob(parameter, slider, value, length_unit)
    low, high = 0.0, parameter.high or math.inf
    if slider.widest is not None:
        is_whole = parameter.kind == "whole"
        low = 1.0 if is_whole else 0.0
        wide = max(slider.widest, value if is_whole else round_up(2 * value))
        high = min(wide, high)
    return Knob(
        field=name,
        label=f"{label} [{parameter.unit}]" if parameter.unit else label,
        low=low,
        high=high,
        step=slider.step,
        hint=slider.hint,
        is_integer=parameter.kind == "whole",
    )


def _power_to(parameter: Parameter, start: float) -> float:
    """Give the power of ten by which a value may be multiplied until the parameter's bound."""
    return math.log10(parameter.high / start) if parameter.high else math.inf


def _length_knob(parameter: Parameter, slider: Slider, value: float, length_unit: str) -> Knob:
    """Make the slider of a length: in millimetres, or in the recording's unit."""
    if length_unit == "m":
        scale, unit, step = 1e3, "mm", round(1e3 * slider.step, 9)
        high = max(round(1e3 * (slider.widest or 0.0), 9), round_up(1.5e3 * value))
    else:
        scale, unit, high = 1.0, length_unit, max(4 * value, 1e-6)
        step = high / 200
    high = min(high, scale * (parameter.high or math.inf))
    return Knob(
        field=parameter.name,
        label=f"{parameter.title} [{unit}]",
        low=step,
        high=high,
        step=step,
        hint=slider.hint,
        scale=scale,
    )


def round_up(value: float) -> float:
    """Give the next number of two digits, as the end of a slider."""
    unit = 10.0 ** (math.floor(math.log10(max(value, 1e-12))) - 1)
    return float(f"{math.ceil(value / unit) * unit:.3g}")


@dataclass(frozen=True)
class Change:
    """One parameter that is not as fitted."""

    name: str
    """Its name for people."""
    fields: tuple[str, ...]
    """Fields of `SimulationParameters` that it is."""
    text: str
    """Description of the change, for example ``δ object [mm] 20 → 35``."""


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
    said = [
        Change(name := name_of(k), (k.field,), f"{name} {k.text(start)} → {k.text(now)}")
        for k in knobs
        if k.differs(start, now)
    ]
    moved = {knob.field for knob in knobs}
    for field, value in parameter_changes(start, now, is_automatic=is_automatic).items():
        if field not in moved:
            parameter = PARAMETERS[field]
            unit = f" [{parameter.unit}]" if parameter.label and parameter.unit else ""
            name = f"{parameter.title}{unit}"
            texts = f"{_said(getattr(start, field))} → {_said(value)}"
            said.append(Change(name, (field,), f"{name} {texts}"))
    return tuple(said)


def edits_text(before: Edits, after: Edits) -> list[str]:
    """Say what became of edits: the titles of new ones, and how many there are no more."""
    shared = 0
    while shared < min(len(before), len(after)) and before[shared] == after[shared]:
        shared += 1
    gone = len(before) - shared
    texts = [f"{gone} edit{'' if gone == 1 else 's'} taken back"] if gone else []
    return texts + [edit.title for edit in after[shared:]]


def _said(value: object) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    if value == AUTOMATIC:
        return "automatic"
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
            name=f"{PARAMETERS['ground_height'].title} [{unit}]",
            low=math.floor(ends[0] / step) * step,
            high=max(math.floor(ends[1] / step) * step, base * per_metre),
            step=step,
            hint="Height of the ground, at most that of the object's lowest node at frame 0.",
            scale=per_metre,
            base=base,
        ),
        *knobs_of("ground", parameters, length_unit=length_unit),
    )
