"""Mass of an object: as its recording says, or estimated from its size and kind."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, get_args

from physhandi.data.sequence_meta import DIMENSION, HEAVIEST, LIGHTEST, ShapeClass

_DENSITY: dict[ShapeClass, float] = {"rope": 0.08, "sheet": 0.3, "shell": 0.5, "solid": 110.0}
_UNIT = {1: "kg/m", 2: "kg/m²", 3: "kg/m³"}
_SIZE = {1: (1e2, "cm"), 2: (1e4, "cm²"), 3: (1e6, "cm³")}


@dataclass(frozen=True, kw_only=True)
class ObjectMass:
    """Mass of an object.

    Each node of the model has a mass of 1 kg, as in PhysTwin, so that its forces are those of an
    object of `node_count` kilograms. Divided by the mass of all nodes and multiplied by what the
    object weighs, forces, stiffness and damping are those of the object itself: accelerations, and
    with them all motion, stay the same.
    """

    kilograms: float
    """Mass [kg]."""
    source: str
    """Where it comes from, in words for people: ``given``, or what it was estimated from."""

    def force_factor(self, node_count: int) -> float:
        """Force on the object for one newton of a model of so many nodes of 1 kg."""
        return self.kilograms / node_count

    @property
    def text(self) -> str:
        """The mass as people read it, such as ``8.2 g``."""
        if self.kilograms < 1.0:
            return f"{1e3 * self.kilograms:.3g} g"
        return f"{self.kilograms:.3g} kg"


def given_mass(kilograms: float) -> ObjectMass:
    """Tell what somebody weighed."""
    return ObjectMass(kilograms=kilograms, source="given")


def estimated_mass(shape: Mapping[str, Any]) -> ObjectMass | None:
    """Estimate what an object weighs from what ``object/shape.yaml`` says of it.

    Every node stands for one spacing of length, area or volume. Densities are typical ones of what
    people handle: cloth and towels have 0.15 to 0.5 kg/m², filled pouches about 0.5 kg/m², ropes
    as thick as a finger 0.06 to 0.1 kg/m, stuffed toys 80 to 140 kg/m³. Expect a factor of two.

    Args:
        shape: Its ``shape``, ``node_count`` and ``node_spacing`` [m] are used.

    Returns:
        The estimate; None if one of the three is missing or makes no sense.
    """
    kind = next((kind for kind in get_args(ShapeClass) if kind == shape.get("shape")), None)
    count, spacing = _positive(shape.get("node_count")), _positive(shape.get("node_spacing"))
    if kind is None or count is None or spacing is None:
        return None
    dimension = DIMENSION[kind]
    size = count * spacing**dimension
    kilograms = float(f"{_DENSITY[kind] * size:.2g}")  # It is not known any better.
    if not LIGHTEST <= kilograms <= HEAVIEST:
        return None
    factor, unit = _SIZE[dimension]
    source = (
        f"estimated: a {kind} of {factor * size:.0f} {unit} "
        f"with {_DENSITY[kind]:g} {_UNIT[dimension]}"
    )
    return ObjectMass(kilograms=kilograms, source=source)


def _positive(value: Any) -> float | None:
    """Take a positive number; None for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if math.isfinite(value) and value > 0 else None
