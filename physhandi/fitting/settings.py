"""Which settings of a fit may be changed, one by one: their kind, bounds and meaning."""

import types
import typing
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, Literal

from physhandi.fitting.field_notes import notes_of
from physhandi.fitting.hand_config import HandFitConfig
from physhandi.fitting.object_config import FirstOrderConfig, ObjectFitConfig
from physhandi.fitting.profile import PipelineConfig
from physhandi.fitting.refinement_config import RefinementConfig
from physhandi.fitting.search import SearchConfig
from physhandi.simulation.model import BOUNDS, SimulationParameters

Kind = Literal["number", "whole", "switch", "choice", "interval"]
Bounds = tuple[float | None, float | None]
INTERVALS = "object_.search.variables"
"""Where the intervals of the search are; one setting for each parameter that can be searched."""
GROUPS = {
    "": "Nodes",
    "simulation": "Simulation at the start",
    "hand": "Stage 1: hands",
    "object_": "Stage 2: what is compared",
    "object_.search": "Stage 2: search",
    INTERVALS: "Stage 2: searched intervals",
    "object_.first_order": "Stage 2: springs one by one",
    "refinement": "Stage 3: hands again",
}
"""Settings that belong together, by the path that they share."""
FROM_SEQUENCE = ("simulation.frame_rate", "simulation.ground_height")
"""What the sequence says, whatever the settings are."""
_NO_SETTINGS = {"profile", "description", "object_.search.tied", *FROM_SEQUENCE}
_NOT_SEARCHED = {
    "frame_rate",
    "frame_duration",
    "ground_height",
    "gravity",
    "substeps_per_frame",
}
_MANY, _COUNT, _RATE = (0.0, 1e9), (0, 100_000), (1e-9, 1.0)
_LIMITS: dict[type, dict[str, Bounds]] = {
    PipelineConfig: {"node_spacing": (0.001, 0.5), "control_count": (1, 10_000)},
    HandFitConfig: {
        "iterations": (1, 100_000),
        "depth_iterations": _COUNT,
        "learning_rate": _RATE,
        "keypoint_noise": (1e-4, 1.0),
        "doubt": (0.1, 1e3),
        "agreement": (0.1, 1e4),
        "limit_weight": _MANY,
        "pose_weight": _MANY,
        "shape_weight": _MANY,
        "acceleration_noise": (1e-3, 1e4),
        "turn_noise": (1e-4, 1e3),
        "depth_noise": (1e-5, 1.0),
        "depth_weight": _MANY,
        "depth_points": (1, 10_000),
    },
    SearchConfig: {
        "generations": (0, 10_000),
        "population": (2, 1000),
        "sigma": (1e-4, 1.0),
        "longest_step": (1e-4, 1.0),
        "seed": (1, 2**31 - 1),
    },
    FirstOrderConfig: {
        "iterations": _COUNT,
        "learning_rate": _RATE,
        "beta_2": (0.0, 0.99999),
        "window": (1, 100_000),
        "prior_weight": _MANY,
        "most_stiffness": (1.0, 1e9),
        "steepest": (1e-3, 1e9),
        "judged_every": (1, 100_000),
    },
    ObjectFitConfig: {
        "track_weight": _MANY,
        "acceleration_weight": _MANY,
        "cloud_points": (1, 100_000),
        "most_substeps": (1, 1_000_000),
    },
    RefinementConfig: {
        "iterations": _COUNT,
        "articulation_rate": (0.0, 1.0),
        "rotation_rate": (0.0, 1.0),
        "translation_rate": (0.0, 1.0),
        "track_weight": _MANY,
        "decay": (1e-3, 1.0),
        "beta_2": (0.0, 0.99999),
        "window": (1, 100_000),
        "prior_weight": _MANY,
        "smoothness_weight": _MANY,
        "keypoint_weight": _MANY,
        "carry_time": (0.0, 1e3),
    },
    SimulationParameters: BOUNDS,
}


@dataclass(frozen=True, kw_only=True)
class Setting:
    """One setting that a fit can be given another value of."""

    path: str
    """Where it is in the configuration: names joined by dots."""
    group: str
    """Path that it shares with those that belong to it; see `GROUPS`."""
    name: str
    """Its own name."""
    title: str
    """Its name in words, with where it belongs if others have the same name."""
    about: str
    """What it means, in a sentence."""
    unit: str
    """What it is measured in; empty for a mere number."""
    kind: Kind
    """``interval`` is ``{low, high, scale}`` of a searched parameter."""
    low: float | None = None
    """Lowest value; of an interval, of its lower end."""
    high: float | None = None
    """Highest value; of an interval, of its upper end."""
    choices: tuple[str, ...] = ()
    """Values of a choice; scales of an interval."""
    is_optional: bool = False
    """Whether it may be empty: none, or not searched."""


def all_settings() -> tuple[Setting, ...]:
    """List all settings, those that belong together in a row."""
    found = [*_settings_of(PipelineConfig, ""), *_intervals()]
    order, names = list(GROUPS), [s.name for s in found if s.kind != "interval"]
    shared = {name for name in names if names.count(name) > 1}
    titled = [replace(s, title=_title(s, is_shared=s.name in shared)) for s in found]
    return tuple(sorted(titled, key=lambda setting: order.index(setting.group)))


def _title(setting: Setting, *, is_shared: bool) -> str:
    if setting.kind == "interval":
        return f"search of {setting.name}".replace("_", " ")
    owner = f"{setting.group.rpartition('.')[2].strip('_')} " if is_shared else ""
    return f"{owner}{setting.name}".replace("_", " ")


def _settings_of(kind: Any, path: str) -> list[Setting]:
    notes, hints = notes_of(kind), typing.get_type_hints(kind)
    found: list[Setting] = []
    for entry in fields(kind):
        own = f"{path}.{entry.name}" if path else entry.name
        hint = hints[entry.name]
        if own in _NO_SETTINGS or own == INTERVALS:
            continue
        if is_dataclass(hint):
            found += _settings_of(hint, own)
            continue
        about, unit = notes.get(entry.name, ("", ""))
        low, high = _LIMITS[kind].get(entry.name, (None, None))
        is_optional = type(None) in typing.get_args(hint)
        if isinstance(hint, types.UnionType):
            hint = next(a for a in typing.get_args(hint) if a is not type(None))
        is_choice = typing.get_origin(hint) is Literal
        found.append(
            Setting(
                path=own,
                group=path,
                name=entry.name,
                title="",
                about=about,
                unit=unit,
                kind="choice" if is_choice else _KINDS[hint],
                low=_as_float(low),
                high=_as_float(high),
                choices=typing.get_args(hint) if is_choice else (),
                is_optional=is_optional,
            )
        )
    return found


_KINDS: dict[Any, Kind] = {float: "number", int: "whole", bool: "switch"}


def _as_float(end: int | float | None) -> float | None:
    return None if end is None else float(end)


def _intervals() -> list[Setting]:
    notes, hints = notes_of(SimulationParameters), typing.get_type_hints(SimulationParameters)
    return [
        Setting(
            path=f"{INTERVALS}.{name}",
            group=INTERVALS,
            name=name,
            title="",
            about=notes[name][0],
            unit=notes[name][1],
            kind="interval",
            low=_as_float(low),
            high=_as_float(high),
            choices=("integer",) if hints[name] is int else ("linear", "log"),
            is_optional=True,
        )
        for name, (low, high) in BOUNDS.items()
        if name not in _NOT_SEARCHED
    ]
