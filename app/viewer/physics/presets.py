"""Sets of parameters with a name, and those that come with the program."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from app.viewer.physics.kept_files import KeptFiles, checked_kept_name
from physhandi.data.files import named_fields, parse_yaml, write_json, write_yaml
from physhandi.errors import UsageError
from physhandi.fitting.config import named_profile
from physhandi.simulation.parameters import (
    AUTOMATIC,
    PARAMETERS,
    SimulationParameters,
    changed_parameters,
)

AS_FITTED = "as fitted"
BY_HAND = "by hand"
"""Entry of the list while the parameters are those of no preset."""
OWN = "★ "
"""Before the name of a user's preset in the list."""
_OF_RECORDING = frozenset(name for name, p in PARAMETERS.items() if p.is_of_recording)
"""Parameters that belong to the recording, which no preset changes."""
_LENGTHS = frozenset(name for name, p in PARAMETERS.items() if p.is_length)
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
    """Named differences from the fitted parameters."""

    name: str
    """Its name for people."""
    changes: Mapping[str, Any]
    """Parameters and their values; `substeps_per_frame` may be ``"auto"``."""
    length_unit: str = "m"
    """Unit of the lengths among them."""
    is_own: bool = False
    """Whether a user keeps it, so that it can be deleted."""

    @property
    def label(self) -> str:
        """Its entry in the list."""
        return f"{OWN}{self.name}" if self.is_own else self.name

    def apply(self, fitted: SimulationParameters) -> tuple[SimulationParameters, bool]:
        """Give the parameters of an object, and whether its substeps are automatic."""
        return changed_parameters(fitted, self.changes)

    def suits(self, fitted: SimulationParameters, length_unit: str) -> bool:
        """Tell whether it makes sense for an object: in its unit, and with its ground."""
        is_in_unit = length_unit == self.length_unit or not _LENGTHS & set(self.changes)
        needs_ground = {"friction", "restitution"} & set(self.changes)
        has_ground = self.changes.get("ground_height", fitted.ground_height) is not None
        return is_in_unit and (has_ground or self.is_own or not needs_ground)


@cache
def builtin_presets() -> tuple[Preset, ...]:
    """List the presets that come with the program; the first changes nothing."""

    def hold(profile: str) -> dict[str, Any]:
        """Take how a profile lets the hand hold the object; its stiffness is for other springs."""
        simulation = named_profile(profile).simulation
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


PRESET_FORMAT = "physhandi-preset/1"
_FIELDS = frozenset({"format", "name", "parameters", "length_unit"})
_MOST_BYTES = 64 * 1024


class PresetStore(KeptFiles[Preset]):
    """The presets of a server, as YAML or JSON."""

    what = "preset"
    kinds = frozenset({".yaml", ".yml", ".json"})
    new_kind = ".yaml"

    def __init__(self, folder: Path) -> None:
        """Prepare; the folder is made when the first preset is saved."""
        super().__init__(folder, folder.name)

    def read(self, path: Path) -> Preset:
        """Read a preset; see `read_preset`."""
        return read_preset(path)

    def save(self, name: str, changes: Mapping[str, Any], length_unit: str) -> Preset:
        """Keep a preset; one of the same name is replaced.

        Raises:
            UsageError: If the name cannot be used, nothing is changed, or there are too many.
        """
        name = checked_name(name)
        changes = {field: value for field, value in changes.items() if field not in _OF_RECORDING}
        if not changes:
            raise UsageError("Nothing is changed yet, so nothing can be kept. Move a slider first.")
        content: dict[str, Any] = {"format": PRESET_FORMAT, "name": name}
        if _LENGTHS & set(changes):
            content["length_unit"] = length_unit
        content["parameters"] = dict(changes)

        def write(path: Path) -> None:
            (write_json if path.suffix == ".json" else write_yaml)(path, content)

        self._put(name, write)
        return Preset(name=name, changes=changes, length_unit=length_unit, is_own=True)


def read_preset(path: Path) -> Preset:
    """Read a user's preset.

    Raises:
        UsageError: If the file is no preset; names the field and what is expected.
        OSError: If it cannot be read.
    """
    if path.stat().st_size > _MOST_BYTES:
        raise UsageError(f"it has more than {_MOST_BYTES // 1024} kB. A preset is a short list.")
    try:
        fields = named_fields(parse_yaml(path.read_text(encoding="utf-8")))
    except ValueError as error:
        raise UsageError(f"it is not YAML or JSON ({error}). Correct or delete it.") from error
    if fields is None:
        raise UsageError("it holds no fields. Expected: format, name, parameters.")
    if fields.get("format") != PRESET_FORMAT:
        raise UsageError(f"format is missing or another one; expected '{PRESET_FORMAT}'.")
    unknown = sorted(set(fields) - _FIELDS)
    if unknown:
        raise UsageError(f"field '{unknown[0]}' is unknown; known: {', '.join(sorted(_FIELDS))}.")
    name, unit = fields.get("name"), fields.get("length_unit", "m")
    if not isinstance(name, str) or not isinstance(unit, str):
        raise UsageError("name and length_unit must be text.")
    changes = named_fields(fields.get("parameters"))
    if not changes:
        raise UsageError("parameters is empty or no list of values, for example 'drag: 5.0'.")
    nested = [field for field, value in changes.items() if isinstance(value, dict | list)]
    if nested:
        raise UsageError(f"parameters.{nested[0]} is a list; expected one value.")
    recorded = sorted(_OF_RECORDING & set(changes))
    if recorded:
        raise UsageError(f"parameters.{recorded[0]} belongs to the recording. Take it out.")
    changed_parameters(SimulationParameters(), changes)  # Names a wrong field and what it may be.
    return Preset(name=checked_name(name), changes=changes, length_unit=unit, is_own=True)


def checked_name(name: str) -> str:
    """Give a name without blanks around it.

    Raises:
        UsageError: If it is empty, too long, odd or taken by the program.
    """
    taken = frozenset({preset.name.casefold() for preset in builtin_presets()} | {BY_HAND})
    return checked_kept_name(name, taken, "preset")
