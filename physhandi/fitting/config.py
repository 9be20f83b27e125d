"""The settings of a reconstruction: what there is, profiles of them, and changes to a profile.

A profile is a YAML file of `PipelineConfig`; four ship with the package. Single settings are named
by paths such as ``object_.search.generations`` and are listed by `all_settings`.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import yaml
from msgspec import Meta, field

from physhandi.appearance.config import APPEARANCE as APPEARANCE
from physhandi.appearance.config import AppearanceConfig
from physhandi.data.files import named_fields, parse_yaml
from physhandi.errors import SettingsError, UsageError
from physhandi.settings import (
    Field,
    Finite,
    Settings,
    ValueKind,
    changes,
    fields_of,
    no_such,
    problems_in,
    shown,
)
from physhandi.simulation.parameters import PARAMETERS, SimulationParameters

HANDS, OBSERVATION, SEARCH, SPRINGS, REFINEMENT, EVALUATION = (
    "hand_reconstruction",
    "observation",
    "zeroth_order",
    "first_order",
    "hand_refinement",
    "evaluation",
)
STAGES = (HANDS, OBSERVATION, SEARCH, SPRINGS, REFINEMENT, EVALUATION)
"""Stages of every reconstruction; see `planned_stages`."""
SIMULATION = "simulation"
"""The first stage of a simulation."""

SEARCHABLE = tuple(
    name
    for name, parameter in PARAMETERS.items()
    if parameter.is_searched and parameter.kind in {"number", "whole"}
)
"""Parameters that the zeroth-order stage may search."""

Count = Annotated[int, Meta(ge=0, le=100_000)]
Weight = Annotated[float, Meta(ge=0.0, le=1e6)]
Rate = Annotated[float, Meta(ge=1e-9, le=1.0)]
Window = Annotated[int, Meta(ge=1, le=100_000)]


class HandFitConfig(Settings, frozen=True, kw_only=True):
    """Settings of stage 1."""

    model: Literal["open", "mano"] = "open"
    """Hand model to fit: the built-in open hand, or MANO that `physhandi import mano` imported."""
    gauss_newton: bool = True
    """Whether updates are damped steps of Gauss and Newton in the place of gradient descent. A
    dozen of them come nearer to the best hand than hundreds of the others."""
    iterations: Annotated[int, Meta(ge=1, le=100_000)] = 500
    """Updates of the fit to keypoints. Gauss and Newton's end when the loss falls no more, or after
    40."""
    depth_iterations: Count = 150
    """Updates of the fit to keypoints and depth that follow, if a view has depth and masks;
    likewise."""
    learning_rate: Rate = 0.03
    """First step size of the joints in gradient descent [rad]; it falls to a twentieth along a
    cosine."""
    depth_learning_rate: Rate = 0.03
    """The same for the fit to keypoints and depth."""
    starts_at_depth: bool = True
    """Whether the hand is moved to where depth was measured before the first update. In views
    without masks, the hand's depth is that at its keypoints."""
    search_iterations: Count = 80
    """Updates of the search that takes the place of the fit to keypoints where one view alone
    places the hand and it starts at depth: it tells how the hand is turned and bent; 0 for none."""
    free_space_weight: Weight = 1.0
    """Weight, after that search, of keypoints that stand before the surface that was measured, in
    units of the expected depth error, squared."""
    fixed_normals: bool = True
    """Whether the hand's normals stay as they are between two searches for the vertices that
    measured points correspond to, as they always do in steps of Gauss and Newton. Only these
    vertices are computed then, which is much faster."""
    judges_keypoints: bool = True
    """Whether keypoints lose their weight that contradict what other views triangulate, and all of
    a view's keypoints of a hand if most of them do."""
    smooths_motion: bool = False
    """Whether the motion is smoothed in the end, as far as its keypoints allow: what they err by
    from frame to frame shakes what the hand holds."""
    keypoint_noise: Annotated[float, Meta(ge=1e-4, le=1.0)] = 0.015
    """Error to be expected of a keypoint, as a share of the hand's size in the image."""
    doubt: Annotated[float, Meta(ge=0.1, le=1e3)] = 3.0
    """Keypoints that are wrong by more than so many times the expected error lose their pull."""
    agreement: Annotated[float, Meta(ge=0.1, le=1e4)] = 12.0
    """Views agree about a keypoint if it triangulates to so many times the expected error."""
    limit_weight: Weight = 300.0
    """Weight of the joints' limits [1/rad²]."""
    pose_weight: Weight = 0.3
    """Weight that pulls all joints towards the template's pose [1/rad²]."""
    shape_weight: Weight = 0.1
    """Weight that pulls the shape towards the template's."""
    acceleration_noise: Annotated[float, Meta(ge=1e-3, le=1e4)] = 4.0
    """Acceleration to be expected of a keypoint [m/s²]."""
    turn_noise: Annotated[float, Meta(ge=1e-4, le=1e3)] = 0.3
    """Turn of a joint to be expected from frame to frame [rad]."""
    depth_noise: Annotated[float, Meta(ge=1e-5, le=1.0)] = 0.004
    """Error to be expected of a depth measurement on the hand [m]."""
    depth_weight: Weight = 100.0
    """Weight of a frame's mean depth error, in units of the expected error, squared."""
    depth_points: Annotated[int, Meta(ge=1, le=10_000)] = 128
    """Most observed points of a hand that are used in a frame."""


class SearchVariable(Settings, frozen=True, kw_only=True):
    """One searched parameter and the interval in which it is looked for."""

    low: Finite
    """Lower end of the interval, in the parameter's unit."""
    high: Finite
    """Upper end of the interval, in the parameter's unit."""
    scale: Literal["linear", "log", "integer"] = "linear"
    """How the interval is walked: ``linear``, ``log`` or ``integer``."""
    is_scaled: bool = False
    """Whether the interval is that of the reference object and is scaled to others."""

    def __post_init__(self) -> None:
        """Check the values, and that the interval is one."""
        super().__post_init__()
        if not self.low < self.high:
            interval = f"The interval reaches from {self.low:g} to {self.high:g}"
            raise SettingsError({"": f"{interval}: the low end must be lower."})
        if self.scale == "log" and self.low <= 0:
            problem = f"The interval begins at {self.low:g}; on a log scale it must begin above 0."
            raise SettingsError({"": problem})

    def to_unit(self, value: float) -> float:
        """Map a value to [0, 1]; values outside the interval land on its ends."""
        if self.scale == "log":
            unit = math.log(value / self.low) / math.log(self.high / self.low)
        else:
            unit = (value - self.low) / (self.high - self.low)
        return min(max(unit, 0.0), 1.0)

    def from_unit(self, unit: float) -> float | int:
        """Map a number in [0, 1] to a value of the parameter."""
        if self.scale == "log":
            return float(self.low * (self.high / self.low) ** unit)
        value = self.low + unit * (self.high - self.low)
        return math.floor(value) if self.scale == "integer" else value


class SearchConfig(Settings, frozen=True, kw_only=True):
    """How the global parameters are searched (CMA-ES)."""

    generations: Annotated[int, Meta(ge=0, le=10_000)] = 20
    """Generations of the evolution strategy; 0 keeps the start values."""
    population: Annotated[int, Meta(ge=2, le=1000)] | None = None
    """Candidates a generation; none leaves it to the number of variables."""
    sigma: Annotated[float, Meta(ge=1e-4, le=1.0)] = 1.0 / 6.0
    """First step, as a part of each interval."""
    longest_step: Annotated[float, Meta(ge=1e-4, le=1.0)] | None = None
    """Most that the step may grow to, as a part of each interval; none for no limit."""
    keeps_start: bool = True
    """Whether the start values are returned if nothing better was found; PhysTwin returns the best
    of the evolution alone."""
    seed: Annotated[int, Meta(ge=1, le=2**31 - 1)] = 42
    """Seed of the random numbers."""
    reference_spacing: Annotated[float, Meta(ge=1e-4, le=1e3)] | None = None
    """Mean distance of neighboring nodes for which scaled intervals are meant [m]; for another
    object radii, stiffness and damping are scaled (`search_bounds.scale_factors`). None takes all
    intervals as they are."""
    reference_length: Annotated[float, Meta(ge=1e-3, le=1e4)] | None = None
    """Length of the object for which scaled intervals are meant [m]; with it, and the reference
    spacing, stiffness and damping go with the weight that a strand carries. None leaves them."""
    widening_generations: Count = 0
    """Generations that follow, once, with wider intervals where a parameter ended at a bound; 0 for
    none."""
    variables: dict[str, SearchVariable] = field(default_factory=dict[str, SearchVariable])
    """Interval of each searched parameter, by its name in the simulation parameters."""
    tied: dict[str, str] = field(default_factory=dict[str, str])
    """Parameters that take the value of another one, such as virtual_stiffness: stiffness."""

    def __post_init__(self) -> None:
        """Check the values, and that there are such parameters to be searched."""
        super().__post_init__()
        problems = {
            f"variables.{name}": no_such("parameter that can be searched", name, SEARCHABLE)
            for name in self.variables
            if name not in SEARCHABLE
        } | {
            f"tied.{name}": no_such("parameter", name, PARAMETERS)
            for name in self.tied
            if name not in PARAMETERS
        }
        if problems:
            raise SettingsError(problems)


class FirstOrderConfig(Settings, frozen=True, kw_only=True):
    """How per-spring stiffness and damping are optimised (Adam)."""

    iterations: Count = 60
    """Passes over all sequences; 0 skips the stage."""
    learning_rate: Rate = 0.02
    """Step of Adam: of the logarithms, and of the contact coefficients where they are learned."""
    beta_2: Annotated[float, Meta(ge=0.0, le=0.99999)] = 0.99
    """Adam's second moment decay."""
    window: Window | None = None
    """Frames that a gradient reaches back, with one update a window; none is the whole sequence."""
    is_annealed: bool = True
    """Fit the first frames first and lengthen the horizon over the first half of the iterations."""
    learns_damping: bool = True
    """Whether each spring gets its own damping (paper) or all keep the searched one (PhysTwin)."""
    learns_contact: bool = False
    """Whether restitution and friction, of the ground and of self-collision, are optimised too."""
    prior_weight: Weight = 1e-8
    """Pull of every logarithm towards its searched value [m²]."""
    most_stiffness: Annotated[float, Meta(ge=1.0, le=1e8)] | None = None
    """A spring acts no stiffer than this, and has no gradient above it [N]; none for no limit."""
    steepest: Annotated[float, Meta(ge=1e-3, le=1e6)] | None = 100.0
    """Largest sane gradient, in losses per unit of the logarithm of a stiffness; a steeper one
    reaches back over fewer frames, or is not used. None uses every gradient, as PhysTwin does."""
    truncates_damping: bool = False
    """Whether damping and drag lose their fraction between the search and this stage.

    PhysTwin's quirk: its configuration holds both as whole numbers and casts what the search found
    to them, so the stage starts from another object than the one that was searched."""
    judged_every: Annotated[int, Meta(ge=1, le=100_000)] = 1
    """Iterations between those whose springs may be returned; the first and last always may."""
    judges_online: bool = False
    """Whether iterations are ranked by the loss met on the way, while the springs still changed
    after every window (PhysTwin), or by simulating once more with the springs at their end. Ranked
    on the way, the start is no candidate."""
    most_starts: Annotated[int, Meta(ge=1, le=100)] = 1
    """Candidates of the search that springs may be fitted from, the best first. The next one has
    its turn where the fitted motion is unsteady: 1 % of stiffness moves it elsewhere."""


class CudaConfig(Settings, frozen=True, kw_only=True):
    """What stage 2 does otherwise on CUDA; none for the same as elsewhere.

    There candidates side by side cost little, and every substep waits for the one before.
    """

    population: Annotated[int, Meta(ge=2, le=1000)] | None = None
    """Candidates a generation on CUDA."""
    most_generations: Count | None = None
    """Most generations of the search on CUDA, those with wider intervals not counted."""
    least_damping: Annotated[float, Meta(ge=0.0, le=1e6)] | None = None
    """Lowest damping that the search tries on CUDA, scaled as its interval is [N·s/m]. Springs that
    hardly damp are found by a search of many candidates; they explain the fitted frames and swing
    in the predicted ones."""
    most_iterations: Count | None = None
    """Most passes that fit springs one by one on CUDA; their steps are the longer."""
    most_substeps: Annotated[int, Meta(ge=1, le=1_000_000)] | None = None
    """Most substeps of a candidate on CUDA, if that is less than elsewhere."""
    most_grips: Annotated[int, Meta(ge=1, le=100_000)] | None = None
    """Most control nodes that hold one object node at a time on CUDA. Hundreds of springs at a node
    hold it no better than a few, but they need several times as many substeps."""


class ObjectFitConfig(Settings, frozen=True, kw_only=True):
    """What stage 2 does."""

    search: SearchConfig = field(default_factory=SearchConfig)
    """Zeroth-order part: global parameters."""
    first_order: FirstOrderConfig = field(default_factory=FirstOrderConfig)
    """First-order part: one stiffness and one damping for each spring."""
    track_weight: Weight = 1.0
    """Weight of the track term beside the Chamfer term; PhysTwin's is 1/6."""
    acceleration_weight: Weight = 0.0
    """Weight of the acceleration term, in the search only [s²]; PhysTwin's is 0.01."""
    freezes_counts: bool = False
    """Divide every frame's loss by the counts of frame 1, as PhysTwin does."""
    chamfer_points: Literal["cloud", "tracks"] = "cloud"
    """What the Chamfer term compares with: the fused cloud, or the tracks that are visible."""
    cloud_points: Annotated[int, Meta(ge=1, le=100_000)] | None = 300
    """Most points of a frame that enter the Chamfer term; none for all."""
    rests_where_seen: bool = False
    """Whether nodes that lie on the ground at frame 0 stay as high above it as they were seen,
    instead of falling by the object's thickness."""
    follows_late_tracks: bool = False
    """Whether tracks that come into view after frame 0 take part, and those that slide over the
    object do not: it is laid onto what was seen of it, and tells which are which."""
    holds_still: bool = False
    """Whether springs have rest lengths with which they carry the object at frame 0, against its
    weight, instead of their lengths there, with which it sags."""
    bends_into_place: bool = False
    """Whether an object that is simulated in another recording is bent into the shape in which
    frame 0 shows it there, and is at rest in that, instead of keeping the shape of the fit."""
    bends_ropes: bool = False
    """Whether a rope whose recordings say how it is held (held_point.npy) bends as an elastic rod,
    whose numbers are fitted in the place of the springs'."""
    rope_steps: Count = 6
    """Most steps of that fit: over windows of a second, and again over whole rollouts."""
    starts_at_rest: bool = False
    """Take the object to rest at frame 0 instead of estimating its velocity (PhysTwin)."""
    contact_over_time: bool = False
    """Whether virtual springs are attached when a hand is seen to take hold of the object and let
    go when it leaves or slides, instead of being laid at frame 0 for all frames."""
    most_grips: Annotated[int, Meta(ge=1, le=100_000)] | None = None
    """Most control nodes, the nearest ones, that hold one object node at a time, with contact over
    time; none for all within the virtual radius."""
    automatic_substeps: bool = False
    """Give each candidate the substeps that its own stability limit asks for."""
    most_substeps: Annotated[int, Meta(ge=1, le=1_000_000)] = 2000
    """A candidate that needs more substeps a frame than this is not tried, nor, with automatic
    ones, if it needs more than twice as many as the start of the search, if that is more."""
    on_cuda: CudaConfig = field(default_factory=CudaConfig)
    """What is done otherwise on CUDA."""

    def on(self, device: str) -> "ObjectFitConfig":
        """Give the settings that hold on a device."""
        if not device.startswith("cuda"):
            return self
        search, springs, cuda = self.search, self.first_order, self.on_cuda
        if cuda.most_generations is not None:
            fewer = min(search.generations, cuda.most_generations)
            search = search.replace(generations=fewer)
        if cuda.population is not None:
            search = search.replace(population=cuda.population)
        damping = search.variables.get("damping")
        if damping is not None and cuda.least_damping is not None:
            low = min(max(damping.low, cuda.least_damping), 0.5 * damping.high)
            variables = search.variables | {"damping": damping.replace(low=low)}
            search = search.replace(variables=variables)
        if cuda.most_iterations is not None and springs.iterations > cuda.most_iterations:
            rate = springs.learning_rate * springs.iterations / max(1, cuda.most_iterations)
            springs = springs.replace(iterations=cuda.most_iterations, learning_rate=min(rate, 1.0))
        return self.replace(
            search=search,
            first_order=springs,
            most_substeps=min(self.most_substeps, cuda.most_substeps or self.most_substeps),
            most_grips=self.most_grips if cuda.most_grips is None else cuda.most_grips,
        )


class RefinementConfig(Settings, frozen=True, kw_only=True):
    """How hands are corrected through the simulator."""

    iterations: Count = 40
    """Updates; 0 skips the stage."""
    articulation_rate: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.01
    """Step of the joints [rad]."""
    rotation_rate: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.01
    """Step of the wrist's rotation [rad]."""
    translation_rate: Annotated[float, Meta(ge=0.0, le=1.0)] = 1e-3
    """Step of the wrist's position [m]."""
    decay: Annotated[float, Meta(ge=1e-3, le=1.0)] = 0.97
    """What each step is of the one before."""
    beta_2: Annotated[float, Meta(ge=0.0, le=0.99999)] = 0.99
    """Adam's second moment decay."""
    steps_by_parameter: bool = False
    """Every number steps by itself (Adam, as the paper), or all of one frame share one step."""
    window: Window | None = 2
    """Frames that a gradient reaches back; none is the whole sequence."""
    track_weight: Weight = 1.0
    """Weight of the track term beside the Chamfer term (paper: 1)."""
    prior_weight: Weight = 3.0
    """Weight of the surface's squared displacement from stage 1, beside the object's error."""
    smoothness_weight: Weight = 10.0
    """Weight of the squared change of that displacement from frame to frame."""
    keypoint_weight: Weight = 1e-6
    """Weight of stage 1's keypoint term, which keeps the hands in the images [m²]."""
    carry_time: Annotated[float, Meta(ge=0.0, le=1e3)] = 0.5
    """Time in which the last correction fades after the frames that are fitted [s]."""

    @property
    def rates(self) -> dict[str, float]:
        """The step of every kind of correction, by the names of `HandOffsets`."""
        return {
            "articulation": self.articulation_rate,
            "rotation": self.rotation_rate,
            "translation": self.translation_rate,
        }


class PredictionConfig(Settings, frozen=True, kw_only=True):
    """How the frames after the fitted ones are simulated."""

    restarts: bool = False
    """Whether they start from where the object was seen in the last fitted frame, with its strain
    kept, instead of the rollout's own state. Off where a run's settings say nothing of it, as those
    of older runs, which do not restart."""
    strain_time: Annotated[float, Meta(ge=0.0, le=1e3)] = 1.0
    """Time until the last fitted frame over which the strain that springs keep is averaged, except
    of what lies on the ground; 0 keeps that of the frame alone [s]."""
    grip_strength: Annotated[float, Meta(ge=0.0, le=1e6)] = 30.0
    """How many times its weight the object may be pulled by all virtual springs that act in the
    last fitted frame, shared by them evenly. One that is pulled harder slips; 0 if none does."""
    keeps_sliding: bool = True
    """Whether less friction is left where what lies on the ground was seen to slide in the last
    fitted frames and would be stuck: as much as it goes on with as fast."""


class PipelineConfig(Settings, frozen=True, kw_only=True):
    """Settings of all stages."""

    profile: str = "default"
    """Name of the profile that these settings come from."""
    description: str = ""
    """What the profile is for, in one line."""
    node_spacing: Annotated[float, Meta(ge=0.001, le=0.5)] = 0.01
    """Distance between object nodes sampled from what was seen [m]."""
    most_nodes: Annotated[int, Meta(ge=1, le=1_000_000)] | None = None
    """Most object nodes that may be sampled from what was seen; none for any number."""
    control_nodes: Literal["all", "visible"] = "all"
    """Which hand vertices become control nodes: all, or a few that a camera sees at frame 0."""
    control_count: Annotated[int, Meta(ge=1, le=10_000)] = 30
    """How many control nodes are kept of the visible ones, far from each other."""
    hand: HandFitConfig = field(default_factory=HandFitConfig)
    """Stage 1."""
    object_: ObjectFitConfig = field(default_factory=ObjectFitConfig)
    """Stage 2."""
    refinement: RefinementConfig = field(default_factory=RefinementConfig)
    """Stage 3."""
    prediction: PredictionConfig = field(default_factory=PredictionConfig)
    """The frames after the fitted ones."""
    appearance: AppearanceConfig = field(default_factory=AppearanceConfig)
    """What the object looks like, which is fitted last of all."""
    simulation: SimulationParameters = field(default_factory=SimulationParameters)
    """Values that the search starts from, and all that are not searched."""


def planned_stages(settings: Any) -> tuple[str, ...]:
    """List the stages of a reconstruction: `APPEARANCE` is one only if its settings ask for it.

    Args:
        settings: Settings in plain data, as a run stores them; damaged ones ask for nothing.
    """
    appearance = named_fields((named_fields(settings) or {}).get("appearance")) or {}
    if appearance.get("enabled") is not True:
        return STAGES
    return (*STAGES[:-1], APPEARANCE, EVALUATION)


PROFILES = Path(__file__).parent / "profiles"


def profile_names() -> list[str]:
    """Names of the profiles that ship with the package."""
    return sorted(path.stem for path in PROFILES.glob("*.yaml"))


def named_profile(name: str) -> PipelineConfig:
    """Read a profile that ships with the package.

    Raises:
        UsageError: If there is no such profile.
    """
    if name not in profile_names():
        raise UsageError(
            f"There is no profile '{name[:80]}'. Choose one of: {', '.join(profile_names())}."
        )
    return _shipped(PROFILES / f"{name}.yaml")


@cache
def _shipped(path: Path) -> PipelineConfig:
    """Read a file of the package once: pages and suites ask for it again and again."""
    return _profile_file(path)


def load_profile(name: str | Path) -> PipelineConfig:
    """Read a profile: one that ships with the package by its name, or a file of the user's own.

    A file holds what `PipelineConfig` has. ``base`` names the profile that it extends, a name or
    another file beside it; then only what differs is written. A searched variable that is empty is
    not searched.

    Args:
        name: A name, or the path of a ``.yaml`` file.

    Raises:
        UsageError: If there is no such profile.
        SettingsError: If a field is unknown or has a wrong value; names file, line and field.
    """
    path = Path(name)
    if path.suffix.lower() not in {".yaml", ".yml"}:
        if isinstance(name, Path):
            raise UsageError(f"{name} is no profile: expected a file that ends in .yaml.")
        if name not in profile_names() and path.is_file():
            raise UsageError(f"{name} is no profile: expected a file that ends in .yaml.")
        return named_profile(name)
    if not path.is_file():
        raise UsageError(f"There is no profile file {path}.")
    return _profile_file(path)


def _profile_file(path: Path, extended: tuple[Path, ...] = ()) -> PipelineConfig:
    """Read a profile's file; `extended` are those that led to it."""
    try:
        text = path.read_text(encoding="utf-8")
        own = named_fields(parse_yaml(text))
    except (ValueError, OSError) as error:
        raise UsageError(f"{path}: it cannot be read as YAML ({error}).") from error
    if own is None:
        raise UsageError(f"{path}: it holds no fields. Expected those of a profile.")
    values: dict[str, Any] = {}
    if "base" in own:
        values = _base_of(path, own.pop("base"), extended).to_dict()
    own = {"profile": path.stem, "description": "", **own}
    merged = _merged(values, _with_numbers(PipelineConfig, own))
    if problems := problems_in(PipelineConfig, merged):
        raise SettingsError(
            {
                place: f"{path}{_line_of(text, place)}: {problem}"
                for place, problem in problems.items()
            }
        )
    config = PipelineConfig.from_dict(merged)
    if clashes := _clashes(config):
        raise SettingsError({place: f"{path}: {message}" for place, message in clashes.items()})
    return config


def _base_of(path: Path, base: Any, extended: tuple[Path, ...]) -> PipelineConfig:
    if not isinstance(base, str):
        raise UsageError(f"{path}: base is {shown(base)}; expected a profile's name or its file.")
    if not base.endswith((".yaml", ".yml")):
        try:
            return named_profile(base)
        except UsageError as error:
            raise UsageError(f"{path}: base: {error}") from None
    other = (path.parent / base).resolve()
    if other in {path.resolve(), *extended}:
        raise UsageError(f"{path}: base: {base} extends this file itself.")
    if not other.is_file():
        raise UsageError(f"{path}: base: there is no file {other}.")
    return _profile_file(other, (*extended, path.resolve()))


def _is_whole_interval(value: Mapping[str, Any]) -> bool:
    """Tell whether an interval is given with both ends and its scale."""
    return set(_NEEDED_FIELDS) <= set(value)


def _merged(base: Mapping[str, Any], own: Mapping[str, Any], path: str = "") -> dict[str, Any]:
    """Lay fields over those of a base; a searched variable that is empty goes.

    A whole interval takes nothing over, not even that the base's is scaled.
    """
    merged = dict(base)
    for name, value in own.items():
        before, place = merged.get(name), f"{path}.{name}" if path else name
        if value is None and path == INTERVALS:
            merged.pop(name, None)
        elif path == INTERVALS and isinstance(value, Mapping) and _is_whole_interval(value):
            merged[name] = dict(cast("Mapping[str, Any]", value))
        elif isinstance(before, dict) and isinstance(value, Mapping):
            merged[name] = _merged(
                cast("dict[str, Any]", before), cast("Mapping[str, Any]", value), place
            )
        else:
            merged[name] = value
    return merged


def _with_numbers(kind: type[Settings], values: Mapping[str, Any]) -> dict[str, Any]:
    """Read numbers such as 1e6, which YAML takes for text without a point."""
    fields = {field.name: field for field in fields_of(kind)}
    result = dict(values)
    for name, value in values.items():
        entry = fields.get(name)
        if entry is None:
            continue
        if entry.kind == "settings" and isinstance(value, Mapping) and entry.inner:
            result[name] = _with_numbers(entry.inner, cast("Mapping[str, Any]", value))
        elif entry.kind == "mapping" and isinstance(value, Mapping) and (inner := entry.inner):
            result[name] = {
                key: _with_numbers(inner, cast("Any", item)) if isinstance(item, Mapping) else item
                for key, item in cast("Mapping[str, Any]", value).items()
            }
        else:
            result[name] = entry.converted(value)
    return result


def _line_of(text: str, path: str) -> str:
    """Say in which line of a YAML text a field is, or the nearest that holds it."""
    node = yaml.compose(text, Loader=yaml.SafeLoader)
    line = 0
    for name in path.split("."):
        items = node.value if isinstance(node, yaml.MappingNode) else ()
        near = next((pair for pair in items if pair[0].value == name), None)
        if near is None:
            break
        line, node = near[0].start_mark.line + 1, near[1]
    return f", line {line}" if line else ""


SettingKind = ValueKind | Literal["interval"]
INTERVALS = "object_.search.variables"
"""Where the intervals of the search are; one setting for each parameter that can be searched."""
GROUPS = {
    "": "Nodes",
    "simulation": "Simulation at the start",
    "hand": "Stage 1: hands",
    "object_": "Stage 2: what is compared",
    "object_.on_cuda": "Stage 2: on CUDA",
    "object_.search": "Stage 2: search",
    INTERVALS: "Stage 2: searched intervals",
    "object_.first_order": "Stage 2: springs one by one",
    "refinement": "Stage 3: hands again",
    "prediction": "Predicted frames",
    "appearance": "What the object looks like",
}
"""Settings that belong together, by the path that they share."""
FROM_SEQUENCE = ("simulation.frame_rate", "simulation.ground_height")
"""What the sequence says, whatever the settings are."""
_NO_SETTINGS = {"profile", "description", "object_.search.tied", INTERVALS, *FROM_SEQUENCE}


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
    """Its path in words, such as ``appearance / enabled``; of an interval, what is searched."""
    about: str
    """Meaning, in a sentence."""
    unit: str
    """Unit; empty for a mere number."""
    kind: SettingKind
    """``interval`` is ``{low, high, scale}`` of a searched parameter, taken as it is unless it says
    ``is_scaled``."""
    low: float | None = None
    """Lowest value; of an interval, of its lower end."""
    high: float | None = None
    """Highest value; of an interval, of its upper end."""
    choices: tuple[str, ...] = ()
    """Values of a choice; scales of an interval."""
    is_optional: bool = False
    """Whether it may be empty: none, or not searched."""


@cache
def all_settings() -> tuple[Setting, ...]:
    """List all settings, those that belong together in a row."""
    settings = [_setting(path, entry) for path, entry in _plain_fields().items()]
    intervals = [_interval(PARAMETERS[name]) for name in SEARCHABLE]
    order = list(GROUPS)
    return tuple(sorted([*settings, *intervals], key=lambda setting: order.index(setting.group)))


@cache
def _plain_fields() -> dict[str, Field]:
    """Find the fields of a configuration that are settings, by their paths."""

    def inside(kind: type[Settings], path: str) -> dict[str, Field]:
        entries: dict[str, Field] = {}
        for entry in fields_of(kind):
            own = f"{path}.{entry.name}" if path else entry.name
            if own in _NO_SETTINGS:
                continue
            entries |= inside(entry.inner, own) if entry.inner else {own: entry}
        return entries

    return inside(PipelineConfig, "")


def _setting(path: str, entry: Field) -> Setting:
    return Setting(
        path=path,
        group=path.rpartition(".")[0],
        name=entry.name,
        title=" / ".join(part.strip("_").replace("_", " ") for part in path.split(".")),
        about=entry.about,
        unit=entry.unit,
        kind=entry.kind,
        low=entry.low,
        high=entry.high,
        choices=entry.choices,
        is_optional=entry.is_optional,
    )


def _interval(parameter: Field) -> Setting:
    return Setting(
        path=f"{INTERVALS}.{parameter.name}",
        group=INTERVALS,
        name=parameter.name,
        title=f"search of {parameter.name}".replace("_", " "),
        about=parameter.about,
        unit=parameter.unit,
        kind="interval",
        low=parameter.low,
        high=parameter.high,
        choices=("integer",) if parameter.kind == "whole" else ("linear", "log"),
        is_optional=True,
    )


def values_of(config: PipelineConfig) -> dict[str, Any]:
    """Give the values of all settings by their paths, in plain data.

    An interval is none where its parameter is not searched, and says ``is_scaled`` only if it is.
    """
    plain = config.to_dict()

    def at(path: str) -> Any:
        value: Any = plain
        for name in path.split("."):
            value = value.get(name)
        return value

    values = {setting.path: at(setting.path) for setting in all_settings()}
    for path, value in values.items():
        if path.startswith(f"{INTERVALS}.") and value and not value["is_scaled"]:
            values[path] = {name: value[name] for name in _NEEDED_FIELDS}
    return values


_LATER_INTERVALS = {("quick", "friction"): ("hand", "smooths_motion")}
"""Intervals that a profile has got since runs were made with it, each with a setting, by its group
and name, that came at the same time: a run that is without that is older."""


def without_newer(config: Mapping[str, Any], stored: Mapping[str, Any]) -> dict[str, Any]:
    """Drop the settings of a configuration that a stored one was made without, in plain data.

    A searched parameter is a choice and stays, unless its profile got it only later.
    """

    def inside(kind: type[Settings], own: Mapping[str, Any], then: Mapping[str, Any]) -> Any:
        entries = {entry.name: entry for entry in fields_of(kind)}
        return {
            name: within(entries[name], value, then[name])
            for name, value in own.items()
            if name in then
        }

    def within(entry: Field, own: Any, then: Any) -> Any:
        if entry.inner is None:
            return own
        if entry.kind == "settings":
            return inside(entry.inner, own, then)
        return {
            key: inside(entry.inner, v, then[key]) if key in then else v
            for key, v in own.items()
            if key in then or not is_later(key, v)
        }

    def is_later(name: str, interval: Any) -> bool:
        group, setting = _LATER_INTERVALS.get((config["profile"], name), ("", ""))
        if not setting or setting in stored.get(group, {}):
            return False
        shipped = named_profile(config["profile"]).object_.search.variables
        return interval == shipped[name].to_dict()

    return inside(PipelineConfig, config, stored)


def overrides_of(config: PipelineConfig, base: PipelineConfig) -> dict[str, Any]:
    """Give what `apply_overrides` must be told to make a configuration out of another one."""
    return changes(values_of(base), values_of(config))


def apply_overrides(base: PipelineConfig, overrides: Mapping[str, Any]) -> PipelineConfig:
    """Change settings of a configuration.

    Args:
        base: What is changed, such as a profile.
        overrides: New values by their paths, such as ``{"object_.search.generations": 12}``; one
            end of an interval may be given alone, as ``object_.search.variables.drag.high``.

    Returns:
        The changed configuration; it keeps the name of the profile.

    Raises:
        SettingsError: If settings are unknown or out of bounds, or do not go together; names all.
    """
    settings = {setting.path: setting for setting in all_settings()}
    values = base.to_dict()
    problems: dict[str, str] = {}
    for path, value in overrides.items():
        parent, _, name = path.rpartition(".")
        if parent in settings and settings[parent].kind == "interval" and name in _INTERVAL_FIELDS:
            problem = _override_end(values, settings[parent], name, value)
        elif path not in settings:
            problem = _unknown(path, settings)
        elif settings[path].kind == "interval":
            problem = _override_interval(values, settings[path], value)
        elif expected := _plain_fields()[path].problem_of(value):
            problem = f"{path} is {shown(value)}; expected {expected}."
        else:
            problem = ""
            _place(values, path, value)
        if problem:
            problems[path] = problem
    if problems:
        raise SettingsError(problems)
    config = PipelineConfig.from_dict(values)
    for name, clash in _clashes(config).items():
        start = f"simulation.{name}"
        problems[start if start in overrides else f"{INTERVALS}.{name}"] = clash
    if problems:
        raise SettingsError(problems)
    return config


def parse_override(text: str) -> tuple[str, Any]:
    """Read one override as it is typed, such as ``object_.search.variables.drag.high=1e2``.

    The value is YAML: a number, true or false, a word, ``none``, or ``{low: 0, high: 5, scale:
    linear}`` for an interval.

    Raises:
        UsageError: If it is not PATH=VALUE.
    """
    path, sign, typed = (part.strip() for part in text.partition("="))
    if not (path and sign and typed):
        raise UsageError(f"'{text[:80]}' is no setting: write PATH=VALUE, as in node_spacing=0.02.")
    try:
        value = parse_yaml(typed)
    except ValueError as error:
        raise UsageError(f"{path}: '{typed[:80]}' cannot be read ({error}).") from error
    return path, _number_or_none(value)


def _number_or_none(value: Any) -> Any:
    if isinstance(value, Mapping):
        items = cast("Mapping[str, Any]", value).items()
        return {name: _number_or_none(item) for name, item in items}
    if not isinstance(value, str):
        return value
    if value.lower() == "none":
        return None
    try:
        number = float(value)  # YAML takes 1e6 for text.
    except ValueError:
        return value
    return number if math.isfinite(number) else value


_INTERVAL_FIELDS = tuple(entry.name for entry in fields_of(SearchVariable))
_NEEDED_FIELDS = ("low", "high", "scale")


def _override_interval(values: dict[str, Any], setting: Setting, value: Any) -> str:
    """Replace an interval, or say what is wrong with it."""
    if value is None:
        values["object_"]["search"]["variables"].pop(setting.name, None)
        return ""
    problem = _interval_problem(setting, value)
    if not problem:
        _place(values, setting.path, dict(value))
    return problem


def _override_end(values: dict[str, Any], setting: Setting, name: str, value: Any) -> str:
    """Replace one field of an interval, or say what is wrong with it."""
    before = values["object_"]["search"]["variables"].get(setting.name)
    if before is None:
        return (
            f"{setting.path} is not searched in this profile; "
            f"give {setting.path} as a whole: {{low: …, high: …, scale: {setting.choices[-1]}}}."
        )
    return _override_interval(values, setting, {**before, name: value})


def _place(values: dict[str, Any], path: str, value: Any) -> None:
    *folders, name = path.split(".")
    for folder in folders:
        values = values[folder]
    values[name] = value


def _unknown(path: str, settings: Mapping[str, Setting]) -> str:
    if path in FROM_SEQUENCE:
        return f"{path} is what the sequence says; it cannot be set."
    return no_such("setting", path, settings)


def _interval_problem(setting: Setting, value: Any) -> str:
    given = cast("Mapping[str, Any]", value) if isinstance(value, Mapping) else {}
    if not _is_whole_interval(given) or not set(given) <= set(_INTERVAL_FIELDS):
        return f"{setting.path} is {shown(value)}; expected low, high and scale, or nothing."
    interval = cast("Mapping[str, Any]", value)
    parameter, scale = PARAMETERS[setting.name], interval["scale"]
    ends = (interval["low"], interval["high"])
    if any(end is None or parameter.problem_of(parameter.converted(end)) for end in ends):
        ends_text = " to ".join(map(shown, ends))
        return f"{setting.path} reaches from {ends_text}; expected numbers {parameter.range}."
    if scale not in setting.choices:
        expected = " or ".join(setting.choices)
        return f"{setting.path} has the scale {shown(scale)}; expected {expected}."
    problems = problems_in(SearchVariable, interval, setting.path)
    return next(iter(problems.values()), "")


def _clashes(config: PipelineConfig) -> dict[str, str]:
    """Find searched parameters that cannot start where they do."""
    starts = {
        name: getattr(config.simulation, name)
        for name, variable in config.object_.search.variables.items()
        if variable.scale == "log"
    }
    return {
        name: f"simulation.{name} is {start}; a search on a log scale must start above 0."
        for name, start in starts.items()
        if start <= 0
    }
