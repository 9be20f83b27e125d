"""The presets that users keep: one YAML or JSON file each in the data folder."""

import logging
import re
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from app.viewer.guard import plain
from app.viewer.presets import BY_HAND, IN_LENGTHS, RECORDED, Preset, builtin_presets
from physhandi.data.atomic import named_fields, write_json, write_yaml
from physhandi.data.plain_yaml import parse_yaml
from physhandi.errors import PhysHandiError, UsageError, describe
from physhandi.fitting.parameter_changes import changed_parameters
from physhandi.simulation.model import SimulationParameters

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
        changes = {field: value for field, value in changes.items() if field not in RECORDED}
        if not changes:
            raise UsageError("Nothing is changed yet, so nothing can be kept. Move a slider first.")
        content: dict[str, Any] = {"format": PRESET_FORMAT, "name": name}
        if IN_LENGTHS & set(changes):
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
    recorded = sorted(RECORDED & set(changes))
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
