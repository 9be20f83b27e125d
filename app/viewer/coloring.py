"""Colors of an object's nodes, surface and springs, and the range that they span."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from app.viewer.colormaps import levels, paint
from app.viewer.content import Content
from app.viewer.layers import COLORINGS, Coloring, Layers
from app.viewer.observed_error import ObservedError
from app.viewer.quantities import QUANTITIES, Quantity, Values, measure
from app.viewer.take import Take

_SAMPLED_FRAMES = 16
_STRONG = 0.98
"""Part of the values that the range covers; the strongest few are shown as its end."""
_LEAST = 1e-12

Range = tuple[float, float]


@dataclass(frozen=True, kw_only=True, eq=False)
class Legend:
    """What has to be said about the colors on the screen."""

    quantity: Quantity
    """What they tell; its unit fits the content."""
    limits: Range
    """Values at the ends, in SI units."""
    is_fixed: bool
    """Whether the user has fixed the ends."""
    unknown: int
    """Nodes of which nothing is known in this frame."""
    is_known: bool
    """Whether any value is known in this frame."""
    highest: float
    """Highest value on the screen, in SI units."""
    thing: str = "node"
    """What has the values."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Painted:
    """An object's colors in one frame."""

    values: Values
    """What they tell."""
    node: UInt8[ndarray, "node 3"]
    """Of object nodes."""
    level: Float[ndarray, " node"]
    """Where on the scale the nodes lie, from 0 to 1; NaN where nothing is known."""
    quantity: Quantity
    """Which quantity it is."""
    limits: Range
    """Values at the ends of the scale, in SI units."""

    def springs(self, chosen: slice | ndarray) -> UInt8[ndarray, "segment 2 3"]:
        """Give the colors of both ends of some springs."""
        return paint_values(self.values.spring[chosen], self.quantity, self.limits)

    def points(self, value: Float[ndarray, " point"]) -> UInt8[ndarray, "point 3"]:
        """Give the colors of other points that have this quantity."""
        return paint_values(value, self.quantity, self.limits)


class Painter:
    """Paints the rollouts of one content; used by one thread.

    The range belongs to a whole rollout, not to a frame: colors keep their meaning while it plays.

    Attributes:
        reference: Rollout that ``difference`` compares with.
        errors: Distances from what was observed.
    """

    def __init__(self, content: Content) -> None:
        self.reference: Take | None = content.fitted
        self.errors = ObservedError(content)
        self._has_object = content.fitted is not None
        self._has_hands = bool(content.hands)
        self._is_metric = content.is_metric
        self._length_unit = content.length_unit
        self._ranges: dict[Coloring, tuple[Take, Take | None, int, Range]] = {}
        self._legend: Legend | None = None

    @property
    def legend(self) -> Legend | None:
        """What the colors painted last mean; None if they are plain."""
        return self._legend

    @property
    def offered(self) -> tuple[Coloring, ...]:
        """What can be told of the content's object; nothing without one."""
        if not self._has_object:
            return ()
        return tuple(c for c in COLORINGS[1:] if c != "error" or self.errors.is_known)

    def quantity(self, coloring: Coloring) -> Quantity:
        """Describe a coloring in the units of the content."""
        quantity = QUANTITIES[coloring]
        if coloring == "error":
            about = f"Distance from {self.errors.source} in this frame"
            quantity = replace(quantity, about=about)
        if coloring == "force" and not self._has_hands:
            quantity = replace(
                quantity,
                about=quantity.about.replace(
                    "by which the hand holds it", "that hold it from outside"
                ),
            )
        if self._is_metric:
            return quantity
        length = self._length_unit
        units = {"mm": (length, 1.0), "m/s": (f"{length}/s", quantity.factor)}
        unit, factor = units.get(quantity.unit, (quantity.unit, quantity.factor))
        return replace(quantity, unit=unit, factor=factor)

    def paint(self, take: Take, frame: int, layers: Layers) -> Painted | None:
        """Give nodes and springs their colors; None if they are plain.

        Args:
            take: The rollout.
            frame: One of its frames that is ready.
            layers: Which quantity, and in which range.
        """
        if layers.color == "plain":
            self._legend = None
            return None
        quantity = self.quantity(layers.color)
        values = self.measure(layers.color, take, frame)
        limits = layers.color_range or self.limits(layers.color, take)
        known = values.node[np.isfinite(values.node)]
        self._legend = Legend(
            quantity=quantity,
            limits=limits,
            is_fixed=layers.color_range is not None,
            unknown=len(values.node) - len(known),
            is_known=bool(len(known)),
            highest=float(known.max(initial=0.0)),
        )
        return Painted(
            values=values,
            node=paint_values(values.node, quantity, limits),
            level=levels(values.node, limits, is_logarithmic=quantity.is_logarithmic),
            quantity=quantity,
            limits=limits,
        )

    def measure(self, coloring: Coloring, take: Take, frame: int) -> Values:
        """Measure a quantity in one frame of a rollout."""
        error_of = self.errors.nodes if self.errors.is_known else None
        return measure(coloring, take, frame, error_of=error_of, reference=self.reference)

    def limits(self, coloring: Coloring, take: Take) -> Range:
        """Find the range of a quantity over a rollout.

        While a rollout is being computed, the range is measured anew each time that twice as many
        frames are ready.
        """
        known = self._ranges.get(coloring)
        if known is not None and known[0] is take and known[1] is self.reference:
            is_enough = take.ready == known[2] or (
                not take.is_complete and take.ready < 2 * known[2]
            )
            if is_enough:
                return known[3]
        found = self._measure_range(coloring, take)
        self._ranges[coloring] = (take, self.reference, take.ready, found)
        return found

    def _measure_range(self, coloring: Coloring, take: Take) -> Range:
        quantity = QUANTITIES[coloring]
        count = 1 if quantity.is_static else min(_SAMPLED_FRAMES, take.ready)
        frames = np.unique(np.linspace(0, take.ready - 1, count).astype(int))
        # The virtual springs are so short that their strain would hide that of all others.
        springs = slice(0, take.model.object_spring_count if coloring == "strain" else None)
        parts: list[list[ndarray]] = [[], []]
        for frame in frames:
            values = self.measure(coloring, take, int(frame))
            for part, value in zip(parts, (values.node, values.spring[springs]), strict=True):
                part.append(value[np.isfinite(value)])
        ends = [nearly_all(np.concatenate(part), quantity) for part in parts]
        found = [end for end in ends if end is not None]
        if not found:
            return (0.0, 1.0 / quantity.factor)
        low, high = min(end[0] for end in found), max(end[1] for end in found)
        return (low, high) if high > low else (low, low + (abs(low) or 1.0 / quantity.factor))


def nearly_all(value: Float[ndarray, " value"], quantity: Quantity) -> Range | None:
    """Find a range that nearly all values lie in; None if there are none."""
    if len(value) == 0:
        return None
    if quantity.scale == "diverging":
        high = _rounded_up(float(np.quantile(np.abs(value), _STRONG)))
        return -high, high
    if quantity.is_static:
        low, high = np.quantile(value, [1.0 - _STRONG, _STRONG])
        return float(low), float(high)
    some = value[value > 0.0]  # Forces are zero wherever the hand holds nothing.
    return 0.0, _rounded_up(float(np.quantile(some, _STRONG))) if len(some) else 0.0


def _rounded_up(value: float) -> float:
    """Round up to two digits, so that the legend is easy to read."""
    if value <= _LEAST:
        return 0.0
    step = 10.0 ** (np.floor(np.log10(value)) - 1)
    return float(np.ceil(value / step - 1e-9) * step)


def paint_values(
    value: Float[ndarray, "*item"], quantity: Quantity, limits: Range
) -> UInt8[ndarray, "*item 3"]:
    """Give values the colors of a quantity's scale."""
    return paint(value, limits, quantity.scale, is_logarithmic=quantity.is_logarithmic)
