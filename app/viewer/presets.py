"""Sets of parameters with a name, and those that come with the program."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

from physhandi.fitting.parameter_changes import AUTOMATIC, changed_parameters
from physhandi.fitting.profile import load_profile
from physhandi.simulation.model import SimulationParameters

AS_FITTED = "as fitted"
BY_HAND = "by hand"
"""What the list shows while the parameters are those of no preset."""
OWN = "★ "
"""Before the name of a user's preset in the list."""
RECORDED = frozenset(
    {"frame_rate", "frame_duration", "uses_sequence_gravity", "uses_sequence_ground"}
)
"""Parameters that belong to the recording, which no preset changes."""
IN_LENGTHS = frozenset(
    {
        "connection_radius",
        "virtual_connection_radius",
        "collision_distance",
        "rest_length_floor",
        "virtual_rest_length_floor",
        "ground_height",
        "gravity",
    }
)
"""Parameters that are measured in the recording's unit of length."""
_HOLD = (
    "virtual_connection_radius",
    "virtual_max_neighbors",
    "virtual_rest_length_floor",
    "rest_length_floor",
    "use_control_velocity",
    "substeps_per_frame",
)


@dataclass(frozen=True, kw_only=True)
class Preset:
    """What differs from the fitted parameters, under a name."""

    name: str
    """What people call it."""
    changes: Mapping[str, Any]
    """Parameters and their values; `substeps_per_frame` may be ``"auto"``."""
    length_unit: str = "m"
    """Unit of the lengths among them."""
    is_own: bool = False
    """Whether a user keeps it, so that it can be deleted."""

    @property
    def label(self) -> str:
        """What the list shows."""
        return f"{OWN}{self.name}" if self.is_own else self.name

    def apply(self, fitted: SimulationParameters) -> tuple[SimulationParameters, bool]:
        """Give the parameters of an object, and whether its substeps are automatic."""
        return changed_parameters(fitted, self.changes)

    def suits(self, fitted: SimulationParameters, length_unit: str) -> bool:
        """Tell whether it makes sense for an object: in its unit, and with its ground."""
        is_in_unit = length_unit == self.length_unit or not IN_LENGTHS & set(self.changes)
        needs_ground = {"friction", "restitution"} & set(self.changes)
        has_ground = self.changes.get("ground_height", fitted.ground_height) is not None
        return is_in_unit and (has_ground or self.is_own or not needs_ground)


@cache
def builtin_presets() -> tuple[Preset, ...]:
    """List the presets that come with the program; the first changes nothing."""

    def hold(profile: str) -> dict[str, Any]:
        """Take how a profile lets the hand hold the object; its stiffness is for other springs."""
        simulation = load_profile(profile).simulation
        return {name: getattr(simulation, name) for name in _HOLD}

    stiff = {"stiffness_scale": 5.0, "substeps_per_frame": AUTOMATIC}
    changes: dict[str, dict[str, Any]] = {
        AS_FITTED: {},
        "paper's hold": hold("paper"),
        "PhysTwin's hold": hold("phystwin"),
        "soft": {"stiffness_scale": 0.1},
        "stiff": stiff,
        "limp": {"stiffness_scale": 0.1, "damping": 0.0, "drag": 0.5},
        "syrup": {"drag": 20.0},
        "on the moon": {"gravity": 1.62},
        "weightless": {"gravity": 0.0},
        "ice": {"friction": 0.0},
        "trampoline": {"restitution": 0.95},
        "layers collide": {"self_collision": True},
    }
    return tuple(Preset(name=name, changes=change) for name, change in changes.items())


def changes_of(
    fitted: SimulationParameters, now: SimulationParameters, *, is_automatic: bool
) -> dict[str, Any]:
    """Find what makes parameters out of the fitted ones, as a preset keeps it."""
    was = fitted.to_dict()
    changes = {name: value for name, value in now.to_dict().items() if value != was[name]}
    if is_automatic:
        changes["substeps_per_frame"] = AUTOMATIC
    return changes
