"""Profiles: every setting of the pipeline under one name."""

import types
import typing
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal

import yaml

from physhandi.errors import UsageError
from physhandi.fitting.hand_config import HandFitConfig
from physhandi.fitting.object_config import ObjectFitConfig
from physhandi.fitting.refinement_config import RefinementConfig
from physhandi.simulation.model import SimulationParameters

FOLDER = Path(__file__).parent / "profiles"


@dataclass(frozen=True, kw_only=True)
class PipelineConfig:
    """Settings of all stages."""

    profile: str = "default"
    """Name of the profile that these settings come from."""
    description: str = ""
    """What the profile is for, in one line."""
    node_spacing: float = 0.01
    """Distance between object nodes sampled from what was seen [m]."""
    control_nodes: Literal["all", "visible"] = "all"
    """Which hand vertices become control nodes: all, or a few that a camera sees at frame 0."""
    control_count: int = 30
    """How many control nodes are kept of the visible ones, far from each other."""
    hand: HandFitConfig = field(default_factory=HandFitConfig)
    """Stage 1."""
    object_: ObjectFitConfig = field(default_factory=ObjectFitConfig)
    """Stage 2."""
    refinement: RefinementConfig = field(default_factory=RefinementConfig)
    """Stage 3."""
    simulation: SimulationParameters = field(default_factory=SimulationParameters)
    """Values that the search starts from, and all that are not searched."""


def profile_names() -> list[str]:
    """Names of the profiles that ship with the package."""
    return sorted(path.stem for path in FOLDER.glob("*.yaml"))


def load_profile(name: str) -> PipelineConfig:
    """Read a profile by name.

    Raises:
        UsageError: If there is no such profile, or it has a wrong field; names the field.
    """
    if name not in profile_names():
        raise UsageError(
            f"There is no profile '{name}'. Choose one of: {', '.join(profile_names())}."
        )
    path = FOLDER / f"{name}.yaml"
    mapping = yaml.safe_load(path.read_text(encoding="utf-8"))
    return _build(PipelineConfig, {"profile": name, **mapping}, f"profile '{name}'")


def config_to_dict(config: Any) -> dict[str, Any]:
    """Turn settings into plain data that `config_from_dict` reads back."""
    result = {}
    for entry in fields(config):
        value = getattr(config, entry.name)
        if is_dataclass(value):
            value = config_to_dict(value)
        elif isinstance(value, dict):
            value = {k: config_to_dict(v) if is_dataclass(v) else v for k, v in value.items()}
        elif isinstance(value, tuple):
            value = list(value)
        result[entry.name] = value
    return result


def config_from_dict(mapping: dict[str, Any]) -> PipelineConfig:
    """Read settings back from plain data.

    Raises:
        UsageError: If a field is unknown or has a value of a wrong kind; names the field.
    """
    return _build(PipelineConfig, mapping, "configuration")


def _build(kind: Any, mapping: Any, where: str) -> Any:
    if not isinstance(mapping, dict):
        raise UsageError(f"{where} is {mapping!r}; expected a mapping of fields.")
    known = {entry.name for entry in fields(kind)}
    for key in mapping:
        if key not in known:
            raise UsageError(f"{where} has no field '{key}'. It has: {', '.join(sorted(known))}.")
    hints = typing.get_type_hints(kind)
    values = {key: _convert(hints[key], value, f"{where}: {key}") for key, value in mapping.items()}
    absent = [e.name for e in fields(kind) if e.default is MISSING and e.default_factory is MISSING]
    for name in absent:
        if name not in values:
            raise UsageError(f"{where} lacks the field '{name}'.")
    try:
        return kind(**values)
    except (TypeError, ValueError) as error:
        raise UsageError(f"{where}: {error}") from error


def _convert(hint: Any, value: Any, where: str) -> Any:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in {types.UnionType, typing.Union}:
        inner = next(a for a in arguments if a is not type(None))
        return None if value is None else _convert(inner, value, where)
    if is_dataclass(hint):
        return _build(hint, value, where)
    if origin is dict:
        return {key: _convert(arguments[1], item, f"{where}.{key}") for key, item in value.items()}
    if origin is tuple:
        return tuple(value)
    return _convert_plain(hint, value, where)


def _convert_plain(hint: Any, value: Any, where: str) -> Any:
    if typing.get_origin(hint) is Literal:
        choices = typing.get_args(hint)
        if value not in choices:
            shown = ", ".join(map(repr, choices))
            raise UsageError(f"{where} is {value!r}; expected one of {shown}.")
        return value
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if hint is float and is_number:
        return float(value)
    if not isinstance(value, hint) or (hint is int and not is_number):
        raise UsageError(f"{where} is {value!r}; expected {hint.__name__}.")
    return value
