"""Sets of parameters with a name, and those that come with the program."""

import logging
import re
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from app.viewer.ui.guard import plain
from physhandi.data.files import named_fields, parse_yaml, write_json, write_yaml
from physhandi.errors import PhysHandiError, UsageError, describe
from physhandi.fitting.config import named_profile
from physhandi.simulation.parameters import (
    AUTOMATIC,
    PARAMETERS,
    SimulationParameters,
    changed_parameters,
)

AS_FITTED = "as fitted"
BY_HAND = "by hand"
"""What the list shows while the parameters are those of no preset."""
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


logger = logging.getLogger(__name__)

PRESET_FORMAT = "physhandi-preset/1"
_FIELDS = frozenset({"format", "name", "parameters", "length_unit"})
_MOST_FILES = 200
_MOST_BYTES = 64 * 1024
_MOST_LETTERS = 60


class PresetStore:
    """The presets of a server: one YAML or JSON file each, which people may edit and copy.

    Safe to use from several threads; every session that shows the list hears of changes.
    """

    def __init__(self, folder: Path) -> None:
        """Prepare; the folder is made when the first preset is saved."""
        self.folder = folder
        self._lock = threading.RLock()
        self._listeners: list[Callable[[], None]] = []

    def subscribe(self, listener: Callable[[], None]) -> Callable[[], None]:
        """Call a function after every change; returns what ends that."""
        with self._lock:
            self._listeners.append(listener)

        def unsubscribe() -> None:
            with self._lock:
                if listener in self._listeners:
                    self._listeners.remove(listener)

        return unsubscribe

    def presets(self) -> tuple[tuple[Preset, ...], tuple[str, ...]]:
        """Read the users' presets, and say of each bad file what is wrong with it."""
        presets: list[Preset] = []
        problems: list[str] = []
        for path, preset, problem in self._read():
            if preset is None:
                problems.append(f"{self.folder.name}/{path.name}: {problem}")
            else:
                presets.append(preset)
        return tuple(sorted(presets, key=lambda preset: preset.name.casefold())), tuple(problems)

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
        with self._lock:
            self.folder.mkdir(parents=True, exist_ok=True)
            path = self._place(name)
            (write_json if path.suffix == ".json" else write_yaml)(path, content)
        self._tell()
        return Preset(name=name, changes=changes, length_unit=length_unit, is_own=True)

    def delete(self, name: str) -> None:
        """Remove a user's preset.

        Raises:
            UsageError: If there is none of that name.
        """
        with self._lock:
            found = [path for path, preset, _ in self._read() if preset and preset.name == name]
            if not found:
                raise UsageError(f"There is no preset of yours called '{name}'.")
            found[0].unlink(missing_ok=True)
        self._tell()

    def _place(self, name: str) -> Path:
        """Choose the file of a preset: its own, or a free one named after it."""
        known = list(self._read())
        for path, preset, _ in known:
            if preset is not None and preset.name.casefold() == name.casefold():
                return path
        if len(known) >= _MOST_FILES:
            raise UsageError(f"{_MOST_FILES} presets are kept already. Delete one of them first.")
        stem = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-") or "preset"
        used = {path.stem for path, _, _ in known}
        numbered = (stem if number == 1 else f"{stem}-{number}" for number in range(1, 10**6))
        return self.folder / f"{next(free for free in numbered if free not in used)}.yaml"

    def _read(self) -> list[tuple[Path, Preset | None, str]]:
        """Read every file: its preset, or else its problem."""
        if not self.folder.is_dir():
            return []
        kinds = {".yaml", ".yml", ".json"}
        paths = [path for path in sorted(self.folder.iterdir()) if path.suffix in kinds]
        found: list[tuple[Path, Preset | None, str]] = []
        names: dict[str, str] = {}
        for path in paths[:_MOST_FILES]:
            if path.name.startswith("."):
                continue
            try:
                preset = read_preset(path)
                first = names.setdefault(preset.name.casefold(), path.name)
                if first != path.name:
                    raise UsageError(f"name '{preset.name}' is that of {first} too. Rename one.")
                found.append((path, preset, ""))
            except (PhysHandiError, OSError) as error:
                found.append((path, None, describe(error)))
        return found

    def _tell(self) -> None:
        with self._lock:
            listeners = list(self._listeners)
        for listener in listeners:
            try:
                listener()
            except Exception:
                # Its session may have just ended, which is no matter of whoever made the change.
                logger.exception("a session could not be told of changed presets")


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
    name = " ".join(name.split())
    if not name or len(name) > _MOST_LETTERS:
        raise UsageError(f"Type a name of 1 to {_MOST_LETTERS} letters first.")
    if plain(name) != name:
        raise UsageError("A preset's name is made of letters, digits, blanks and . , : ( ) + - / _")
    if name.casefold() in {preset.name.casefold() for preset in builtin_presets()} | {BY_HAND}:
        raise UsageError(f"'{name}' is a preset of the program. Choose another name.")
    return name
