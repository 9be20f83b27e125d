"""Which settings of a fit may be changed, one by one: their kind, bounds and meaning."""

import ast
import difflib
import inspect
import re
import types
import typing
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import yaml

from physhandi.errors import SettingsError, UsageError
from physhandi.fitting.search import SearchConfig
from physhandi.simulation.parameters import BOUNDS, SimulationParameters


@dataclass(frozen=True, kw_only=True)
class HandFitConfig:
    """Settings of stage 1."""

    model: Literal["open", "mano"] = "open"
    """Hand model to fit: the built-in open hand, or MANO that `physhandi import mano` imported."""
    iterations: int = 500
    """Updates of the fit to keypoints."""
    depth_iterations: int = 150
    """Updates of the fit to keypoints and depth that follow, if a view has depth and masks."""
    learning_rate: float = 0.03
    """First step size of the joints [rad]; it falls to a twentieth along a cosine."""
    keypoint_noise: float = 0.015
    """Error to be expected of a keypoint, as a share of the hand's size in the image."""
    doubt: float = 3.0
    """Keypoints that are wrong by more than so many times the expected error lose their pull."""
    agreement: float = 12.0
    """Views agree about a keypoint if it triangulates to so many times the expected error."""
    limit_weight: float = 300.0
    """Weight of the joints' limits [1/rad²]."""
    pose_weight: float = 0.3
    """Weight that pulls all joints towards the template's pose [1/rad²]."""
    shape_weight: float = 0.1
    """Weight that pulls the shape towards the template's."""
    acceleration_noise: float = 4.0
    """Acceleration to be expected of a keypoint [m/s²]."""
    turn_noise: float = 0.3
    """Turn of a joint to be expected from frame to frame [rad]."""
    depth_noise: float = 0.004
    """Error to be expected of a depth measurement on the hand [m]."""
    depth_weight: float = 100.0
    """Weight of a frame's mean depth error, in units of the expected error, squared."""
    depth_points: int = 128
    """Most observed points of a hand that are used in a frame."""

    def __post_init__(self) -> None:
        if self.iterations < 1 or self.depth_iterations < 0 or self.depth_points < 1:
            raise ValueError("iterations and depth_points must be at least 1, depth_iterations 0")


@dataclass(frozen=True, kw_only=True)
class FirstOrderConfig:
    """How per-spring stiffness and damping are optimised (Adam)."""

    iterations: int = 60
    """Passes over all sequences; 0 skips the stage."""
    learning_rate: float = 0.02
    """Step of Adam: of the logarithms, and of the contact coefficients where they are learned."""
    beta_2: float = 0.99
    """Adam's second moment decay."""
    window: int | None = None
    """Frames that a gradient reaches back, with one update a window; none is the whole sequence."""
    is_annealed: bool = True
    """Fit the first frames first and lengthen the horizon over the first half of the iterations."""
    learns_damping: bool = True
    """Whether each spring gets its own damping (paper) or all keep the searched one (PhysTwin)."""
    learns_contact: bool = False
    """Whether restitution and friction, of the ground and of self-collision, are optimised too."""
    prior_weight: float = 1e-8
    """Pull of every logarithm towards its searched value [m²]."""
    most_stiffness: float | None = None
    """A spring acts no stiffer than this, and has no gradient above it [N]; none for no limit."""
    steepest: float | None = 100.0
    """Largest sane gradient, in losses per unit of the logarithm of a stiffness; a steeper one
    reaches back over fewer frames, or is not used. None uses every gradient, as PhysTwin does."""
    truncates_damping: bool = False
    """Whether damping and drag lose their fraction between the search and this stage.

    PhysTwin's quirk: its configuration holds both as whole numbers and casts what the search found
    to them, so the stage starts from another object than the one that was searched."""
    judged_every: int = 1
    """Iterations between those whose springs may be returned; the first and last always may."""
    judges_online: bool = False
    """Whether iterations are ranked by the loss met on the way, while the springs still changed
    after every window (PhysTwin), or by simulating once more with the springs at their end. Ranked
    on the way, the start is no candidate."""

    def __post_init__(self) -> None:
        if self.judged_every < 1:
            raise ValueError(f"judged_every is {self.judged_every}; expected at least 1")


@dataclass(frozen=True, kw_only=True)
class ObjectFitConfig:
    """What stage 2 does."""

    search: SearchConfig = field(default_factory=SearchConfig)
    """Zeroth-order part: global parameters."""
    first_order: FirstOrderConfig = field(default_factory=FirstOrderConfig)
    """First-order part: one stiffness and one damping for each spring."""
    track_weight: float = 1.0
    """Weight of the track term beside the Chamfer term; PhysTwin's is 1/6."""
    acceleration_weight: float = 0.0
    """Weight of the acceleration term, in the search only [s²]; PhysTwin's is 0.01."""
    freezes_counts: bool = False
    """Divide every frame's loss by the counts of frame 1, as PhysTwin does."""
    chamfer_points: Literal["cloud", "tracks"] = "cloud"
    """What the Chamfer term compares with: the fused cloud, or the tracks that are visible."""
    cloud_points: int | None = 300
    """Most points of a frame that enter the Chamfer term; none for all."""
    starts_at_rest: bool = False
    """Take the object to rest at frame 0 instead of estimating its velocity (PhysTwin)."""
    automatic_substeps: bool = False
    """Give each candidate the substeps that its own stability limit asks for."""
    most_substeps: int = 2000
    """A candidate that needs more substeps a frame than this is not tried."""


@dataclass(frozen=True, kw_only=True)
class RefinementConfig:
    """How hands are corrected through the simulator."""

    iterations: int = 40
    """Updates; 0 skips the stage."""
    articulation_rate: float = 0.01
    """Step of the joints [rad]."""
    rotation_rate: float = 0.01
    """Step of the wrist's rotation [rad]."""
    translation_rate: float = 1e-3
    """Step of the wrist's position [m]."""
    decay: float = 0.97
    """What each step is of the one before."""
    beta_2: float = 0.99
    """Adam's second moment decay."""
    steps_by_parameter: bool = False
    """Every number steps by itself (Adam, as the paper), or all of one frame share one step."""
    window: int | None = 2
    """Frames that a gradient reaches back; none is the whole sequence."""
    track_weight: float = 1.0
    """Weight of the track term beside the Chamfer term (paper: 1)."""
    prior_weight: float = 3.0
    """Weight of the surface's squared displacement from stage 1, beside the object's error."""
    smoothness_weight: float = 10.0
    """Weight of the squared change of that displacement from frame to frame."""
    keypoint_weight: float = 1e-6
    """Weight of stage 1's keypoint term, which keeps the hands in the images [m²]."""
    carry_time: float = 0.5
    """Time in which the last correction fades after the frames that are fitted [s]."""

    def __post_init__(self) -> None:
        if self.iterations < 0 or (self.window is not None and self.window < 1):
            raise ValueError("iterations must be at least 0, and window at least 1 or none")
        rates = (self.articulation_rate, self.rotation_rate, self.translation_rate)
        if min(rates) < 0 or not 0 < self.decay <= 1 or not 0 <= self.beta_2 < 1:
            raise ValueError("rates must not be negative, decay in ]0, 1], beta_2 in [0, 1[")

    @property
    def rates(self) -> dict[str, float]:
        """The step of every kind of correction, by the names of `HandOffsets`."""
        return {
            "articulation": self.articulation_rate,
            "rotation": self.rotation_rate,
            "translation": self.translation_rate,
        }


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


_UNIT = re.compile(r"\s*\[((?:1/)?[A-Za-z][^\]\d]*)\]")


@cache
def notes_of(kind: type) -> dict[str, tuple[str, str]]:
    """Read what each field of a dataclass means, and its unit; empty where none is given."""
    (declared,) = ast.parse(inspect.getsource(kind)).body
    notes: dict[str, tuple[str, str]] = {}
    body = declared.body if isinstance(declared, ast.ClassDef) else []
    for declaration, note in pairwise(body):
        if (
            isinstance(declaration, ast.AnnAssign)
            and isinstance(declaration.target, ast.Name)
            and isinstance(note, ast.Expr)
            and isinstance(note.value, ast.Constant)
        ):
            text = " ".join(str(note.value.value).split())
            unit = _UNIT.search(text)
            notes[declaration.target.id] = (_UNIT.sub("", text), unit[1].strip() if unit else "")
    return notes


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


AUTOMATIC = "auto"
"""Instead of a number of substeps: as few as are stable and fine enough."""


def changed_parameters(
    fitted: SimulationParameters, changes: Mapping[str, Any]
) -> tuple[SimulationParameters, bool]:
    """Apply changes to fitted parameters.

    Returns:
        The new parameters, and whether their substeps are yet to be chosen automatically.

    Raises:
        UsageError: If a parameter is unknown or out of bounds.
    """
    given = dict(changes)
    is_automatic = given.get("substeps_per_frame") == AUTOMATIC
    if is_automatic:
        del given["substeps_per_frame"]
    return SimulationParameters.from_dict(fitted.to_dict() | given), is_automatic


HANDS, OBSERVATION, SEARCH, SPRINGS, REFINEMENT, EVALUATION = (
    "hand_reconstruction",
    "observation",
    "zeroth_order",
    "first_order",
    "hand_refinement",
    "evaluation",
)
STAGES = (HANDS, OBSERVATION, SEARCH, SPRINGS, REFINEMENT, EVALUATION)
"""Stages of a reconstruction."""
SIMULATION = "simulation"
"""The first stage of a simulation."""
