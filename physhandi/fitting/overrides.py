"""Settings of a fit that differ from its profile: told apart, checked and put in their place."""

import difflib
from collections.abc import Mapping
from typing import Any

from physhandi.errors import SettingsError, UsageError
from physhandi.fitting.profile import PipelineConfig, config_from_dict, config_to_dict
from physhandi.fitting.settings import FROM_SEQUENCE, INTERVALS, Setting, all_settings

_LARGEST = 1e30
"""Larger numbers leave the simulator's float32; NaN is not below it either."""


def value_of(config: PipelineConfig, path: str) -> Any:
    """Give the value of a setting, in plain data; none where an interval is not searched."""
    value: Any = config_to_dict(config)
    for name in path.split("."):
        value = value.get(name)
    return value


def values_of(config: PipelineConfig) -> dict[str, Any]:
    """Give the values of all settings by their paths, in plain data."""
    return {setting.path: value_of(config, setting.path) for setting in all_settings()}


def changes(config: PipelineConfig, base: PipelineConfig) -> dict[str, Any]:
    """Give the settings in which a configuration differs from another one."""
    before = values_of(base)
    return {path: v for path, v in values_of(config).items() if v != before[path]}


def apply_overrides(base: PipelineConfig, overrides: Mapping[str, Any]) -> PipelineConfig:
    """Change settings of a configuration.

    Args:
        base: What is changed, such as a profile.
        overrides: New values by their paths, such as ``{"object_.search.generations": 12}``.

    Returns:
        The changed configuration; it keeps the name of the profile.

    Raises:
        SettingsError: If settings are unknown or out of bounds, or do not go together; names all.
    """
    known = {setting.path: setting for setting in all_settings()}
    problems: dict[str, str] = {}
    mapping = config_to_dict(base)
    for path, value in overrides.items():
        setting = known.get(path)
        problem = _unknown(path, known) if setting is None else _problem(setting, value)
        if problem:
            problems[path] = problem
        elif setting is not None:
            _place(mapping, setting, value)
    if problems:
        raise SettingsError(problems)
    try:
        config = config_from_dict(mapping)
    except UsageError as error:
        raise SettingsError({next(iter(overrides), ""): str(error)}) from error
    for name, variable in config.object_.search.variables.items():
        start = getattr(config.simulation, name)
        if variable.scale == "log" and start <= 0:
            path = f"simulation.{name}"
            told = f"{path} is {start}; a search on a log scale must start above 0."
            problems[path if path in overrides else f"{INTERVALS}.{name}"] = told
    if problems:
        raise SettingsError(problems)
    return config


def _place(mapping: dict[str, Any], setting: Setting, value: Any) -> None:
    *folders, name = setting.path.split(".")
    for folder in folders:
        mapping = mapping[folder]
    if setting.kind == "interval" and value is None:
        mapping.pop(name, None)
    elif setting.kind == "number" and value is not None:
        mapping[name] = float(value)
    else:
        mapping[name] = value


def _unknown(path: str, known: Mapping[str, Setting]) -> str:
    if path in FROM_SEQUENCE:
        return f"{path} is what the sequence says; it cannot be set."
    near = difflib.get_close_matches(path, known, n=1, cutoff=0.6)
    return f"There is no setting '{path[:80]}'." + (f" Do you mean '{near[0]}'?" if near else "")


def _problem(setting: Setting, value: Any) -> str:
    """Say what is wrong with a value; empty if nothing is."""
    if value is None:
        is_right = setting.is_optional
    elif setting.kind == "interval":
        return _interval_problem(setting, value)
    elif setting.kind == "switch":
        is_right = isinstance(value, bool)
    elif setting.kind == "choice":
        is_right = isinstance(value, str) and value in setting.choices
    else:
        is_right = _is_number(setting, value)
    shown = "empty" if value is None else _shown(value)
    return "" if is_right else f"{setting.path} is {shown}; expected {_wanted(setting)}."


def _is_number(setting: Setting, value: Any) -> bool:
    kinds = int if setting.kind == "whole" else (int, float)
    return isinstance(value, kinds) and not isinstance(value, bool) and _is_inside(setting, value)


def _interval_problem(setting: Setting, value: Any) -> str:
    names = {"low", "high", "scale"}
    if not isinstance(value, Mapping) or set(value) != names:
        return f"{setting.path} is {_shown(value)}; expected low, high and scale, or nothing."
    low, high, scale = value["low"], value["high"], value["scale"]
    if not (_is_number(setting, low) and _is_number(setting, high)):
        shown = f"{_shown(low)} to {_shown(high)}"
        return f"{setting.path} reaches from {shown}; expected numbers {_range(setting)}."
    if not low < high:
        return f"{setting.path} reaches from {low} to {high}: the low end must be lower."
    if scale not in setting.choices:
        wanted = " or ".join(setting.choices)
        return f"{setting.path} has the scale {_shown(scale)}; expected {wanted}."
    if scale == "log" and low <= 0:
        return f"{setting.path} begins at {low}; on a log scale it must begin above 0."
    return ""


def _is_inside(setting: Setting, value: int | float) -> bool:
    if not abs(value) <= _LARGEST:
        return False
    low, high = setting.low, setting.high
    return (low is None or value >= low) and (high is None or value <= high)


def _wanted(setting: Setting) -> str:
    if setting.kind == "switch":
        return "true or false"
    if setting.kind == "choice":
        return f"one of {', '.join(setting.choices)}"
    kind = "a whole number" if setting.kind == "whole" else "a number"
    empty = ", or nothing" if setting.is_optional else ""
    return f"{kind} {_range(setting)}{empty}"


def _range(setting: Setting) -> str:
    low, high = (None if end is None else f"{end:g}" for end in (setting.low, setting.high))
    if low is not None and high is not None:
        return f"from {low} to {high}"
    return f"from {low} on" if low is not None else f"up to {high}" if high else "that is finite"


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}…"
