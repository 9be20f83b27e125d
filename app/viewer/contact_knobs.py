"""The sliders of contact: of object nodes with the ground and with each other."""

import math
from dataclasses import dataclass

from app.viewer.parameters import Knob, Switch, length_knob
from physhandi.simulation.model import SimulationParameters


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
