"""The parameters of a simulation in one table: meaning, unit, bounds, and how people change them.

`SimulationParameters` declares each once; `PARAMETERS` is the table that follows from it. Bounds,
errors, sliders, links, presets, pages and docs/parameters.md are read there.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from physhandi.errors import SettingsError
from physhandi.settings import Field, Settings, changes, fields_of, no_such

AUTOMATIC = "auto"
"""Instead of a number of substeps: as few as are stable and fine enough."""

# float32 exp(-5e-5 drag) on an H200 for drag 0, 1, …, 20, less the nearest float32, in units of
# 2^-24 (measured). PhysTwin truncates its drag to a whole number.
_DECAY_UNITS = (0, 1, 1, -1, 0, 0, 0, 0, 1, 1, 1, 1, -1, 0, 0, 0, 0, 1, 1, 1, 1)

# Wide enough for recordings in millimetres and for wild candidates of a search; beyond these no
# object is meant, and squares and products of them stay within the simulator's float32.
Length = Annotated[float, Meta(ge=0.0, le=1e3)]
Stiffness = Annotated[float, Meta(ge=0.0, le=1e8)]
Coordinate = Annotated[float, Meta(ge=-1e5, le=1e5)]

Effect = Literal["live", "material", "topology", "step", "world"]
"""Work that a new value needs: ``live`` is assigned to the device at once; ``material``
scales the fitted springs; ``topology`` lays the springs anew; ``step`` needs another simulator;
``world`` only decides what `SimulationParameters.in_world` takes from a recording."""

SliderGroup = Literal["springs", "more", "ground", "self-collision", "hands"]
SliderScale = Literal["linear", "power", "relative power"]


@dataclass(frozen=True, kw_only=True)
class Slider:
    """How people move a parameter; a switch gets a tick box instead."""

    group: SliderGroup
    """Folder in which it is."""
    hint: str
    """Effect of the parameter, in a sentence for the panel."""
    widest: float | None = None
    """End of the slider, in the parameter's unit; a larger fitted value moves it. None takes the
    parameter's own upper bound."""
    step: float = 1.0
    """Distance of two slider values, in the parameter's unit; of the exponent on a power scale."""
    scale: SliderScale = "linear"
    """``power`` moves the decimal logarithm, ``relative power`` that of the ratio to the fit."""


@dataclass(frozen=True, kw_only=True)
class Role:
    """Role of a parameter in the simulation and in user interfaces."""

    effect: Effect = "live"
    """Work that a new value needs."""
    label: str = ""
    """Name for people; empty for the parameter's own name."""
    slider: Slider | None = None
    """How people move it live; None where they do not."""
    is_length: bool = False
    """Whether it is measured in the recording's unit of length, which need not be the metre."""
    is_of_recording: bool = False
    """Whether it belongs to the recording, so that no preset changes it."""
    is_in_links: bool = True
    """Whether a link may say it."""
    is_searched: bool = True
    """Whether the zeroth-order stage may search it, if it is a number."""


@dataclass(frozen=True, kw_only=True)
class Parameter(Field, Role):
    """One row of the table of parameters."""

    @property
    def title(self) -> str:
        """Name for people."""
        return self.label or self.name


class SimulationParameters(Settings, frozen=True, kw_only=True):
    """The few numbers that describe an object as a whole; sliders and searches move these."""

    connection_radius: Annotated[
        Length,
        Role(
            effect="topology",
            label="δ object",
            is_length=True,
            slider=Slider(
                group="springs",
                hint="Connection radius: object nodes nearer than this get a spring.",
                widest=0.08,
                step=0.0005,
            ),
        ),
    ] = 0.02
    """δ: object nodes nearer than this get a spring [m]."""
    max_neighbors: Annotated[
        int,
        Meta(ge=0, le=1000),
        Role(
            effect="topology",
            label="d_max object",
            slider=Slider(
                group="springs",
                hint="Max neighbors: most object springs that one node starts.",
                widest=80,
            ),
        ),
    ] = 29
    """d_max: most object springs that one node may start, the node itself not counted."""
    virtual_connection_radius: Annotated[
        Length,
        Role(
            effect="topology",
            label="δ virtual",
            is_length=True,
            slider=Slider(
                group="springs",
                hint="Connection radius: a control node of the hand holds the object nodes nearer "
                "than this.",
                widest=0.08,
                step=0.0005,
            ),
        ),
    ] = 0.01
    """Object nodes nearer to a control node than this are held by it [m]."""
    virtual_max_neighbors: Annotated[
        int,
        Meta(ge=0, le=1000),
        Role(
            effect="topology",
            label="d_max virtual",
            slider=Slider(
                group="springs",
                hint="Max neighbors: most virtual springs of one control node of the hand.",
                widest=80,
            ),
        ),
    ] = 6
    """Most virtual springs that one control node may start."""
    stiffness: Annotated[
        Stiffness,
        Role(
            effect="material",
            label="k object",
            slider=Slider(
                group="more",
                hint="Multiplies the stiffness of object springs alone; ×1 is as fitted.",
                step=0.05,
                scale="relative power",
            ),
        ),
    ] = 3e4
    """Force per unit strain that a new object spring gets [N]."""
    stiffness_scale: Annotated[
        float,
        Meta(ge=0.0, le=1e6),
        Role(
            label="stiffness",
            slider=Slider(
                group="springs",
                hint="Multiplies the stiffness of every spring; ×1 is as fitted.",
                step=0.05,
                scale="power",
            ),
        ),
    ] = 1.0
    """Multiplies the stiffness of every spring."""
    virtual_stiffness: Annotated[
        Stiffness,
        Role(
            effect="material",
            label="k virtual",
            slider=Slider(
                group="more",
                hint="Multiplies the stiffness of virtual springs alone; ×1 is as fitted.",
                step=0.05,
                scale="relative power",
            ),
        ),
    ] = 3e4
    """Force per unit strain that a new virtual spring gets [N]."""
    damping: Annotated[
        float,
        Meta(ge=0.0, le=1e6),
        Role(
            effect="material",
            label="damping",
            slider=Slider(group="more", hint="Dashpot along each spring.", widest=300.0),
        ),
    ] = 100.0
    """Dashpot along each spring [N·s/m]."""
    drag: Annotated[
        float,
        Meta(ge=0.0, le=1e6),
        Role(
            label="drag",
            slider=Slider(
                group="more", hint="How fast every motion dies out.", widest=20.0, step=0.1
            ),
        ),
    ] = 3.0
    """Decay rate of every node's velocity [1/s]."""
    restitution: Annotated[
        float,
        Meta(ge=0.0, le=1.0),
        Role(
            label="restitution",
            slider=Slider(
                group="ground",
                hint="Part of its speed that a node that hits the ground bounces back with.",
                step=0.05,
            ),
        ),
    ] = 0.5
    """Part of the normal speed that a bounce on the ground gives back."""
    friction: Annotated[
        float,
        Meta(ge=0.0, le=2.0),
        Role(
            label="friction",
            slider=Slider(
                group="ground",
                hint="How much nodes on the ground resist sliding; 0 is ice.",
                step=0.05,
            ),
        ),
    ] = 0.3
    """Coulomb friction coefficient of the ground."""
    ground_height: Annotated[
        Coordinate | None, Role(label="ground height", is_length=True, is_searched=False)
    ] = 0.0
    """Height of the ground plane [m]; none for no ground."""
    gravity: Annotated[
        Coordinate,
        Role(
            label="gravity",
            is_length=True,
            is_searched=False,
            slider=Slider(group="more", hint="Acceleration downwards.", widest=20.0, step=0.1),
        ),
    ] = 9.81
    """Acceleration along -z [m/s²]."""
    uses_sequence_gravity: Annotated[
        bool, Role(effect="world", is_of_recording=True, is_in_links=False)
    ] = True
    """Whether `in_world` takes the sequence's gravity; PhysTwin's own is 9.8 everywhere."""
    uses_sequence_ground: Annotated[bool, Role(effect="world", is_of_recording=True)] = True
    """Whether `in_world` takes the sequence's ground."""
    frame_rate: Annotated[
        float,
        Meta(ge=1e-3, le=1e6),
        Role(effect="step", is_of_recording=True, is_in_links=False, is_searched=False),
    ] = 30.0
    """Frames in a second [Hz]."""
    frame_duration: Annotated[
        Annotated[float, Meta(ge=1e-6, le=1e3)] | None,
        Role(effect="step", is_of_recording=True, is_in_links=False, is_searched=False),
    ] = None
    """Time that the simulation takes a frame to last [s]; none for 1 / frame_rate. PhysTwin's 667
    substeps of 5e-5 s make 33.35 ms, whatever the rate of the recording."""
    substeps_per_frame: Annotated[
        int,
        Meta(ge=1, le=1_000_000),
        Role(effect="step", label="substeps", is_searched=False),
    ] = 667
    """Integration steps in one frame; stiffer springs need more."""
    rest_length_floor: Annotated[
        Length, Role(effect="topology", label="shortest object spring", is_length=True)
    ] = 1e-3
    """Shortest rest length of an object spring [m]; 0 for none."""
    virtual_rest_length_floor: Annotated[
        Length, Role(effect="topology", label="shortest virtual spring", is_length=True)
    ] = 1e-3
    """Shortest rest length of a virtual spring [m]; 0 for none."""
    use_control_velocity: Annotated[bool, Role(label="dashpots see the hand move")] = True
    """Whether the dashpots of virtual springs see the control nodes move."""
    rounds_decay: Annotated[bool, Role(is_in_links=False)] = False
    """Whether a substep's drag is rounded as in PhysTwin's float32 factor; see `velocity_loss`."""
    self_collision: Annotated[
        bool,
        Role(
            label="nodes collide",
            slider=Slider(
                group="self-collision",
                hint="Object nodes bounce off each other, so that layers of cloth stay apart.",
            ),
        ),
    ] = False
    """Whether object nodes bounce off each other."""
    collision_distance: Annotated[
        Length,
        Role(
            label="distance",
            is_length=True,
            slider=Slider(
                group="self-collision",
                hint="Nodes that approach each other nearer than this collide.",
                widest=0.02,
                step=0.0001,
            ),
        ),
    ] = 0.005
    """Object nodes that approach each other nearer than this collide [m]."""
    self_restitution: Annotated[
        float,
        Meta(ge=0.0, le=1.0),
        Role(
            label="restitution of nodes",
            slider=Slider(
                group="self-collision",
                hint="Part of the approach speed that a collision gives back.",
                step=0.05,
            ),
        ),
    ] = 0.7
    """Part of the approach speed that a collision of two nodes gives back."""
    self_friction: Annotated[
        float,
        Meta(ge=0.0, le=2.0),
        Role(
            label="friction of nodes",
            slider=Slider(
                group="self-collision",
                hint="How much nodes that touch resist sliding past each other.",
                step=0.05,
            ),
        ),
    ] = 0.3
    """Coulomb friction coefficient between two nodes."""
    collides_rest_neighbors: Annotated[
        bool,
        Role(
            label="also rest neighbors",
            slider=Slider(
                group="self-collision",
                hint="Also collide nodes nearer than the distance at frame 0, as PhysTwin does.",
            ),
        ),
    ] = False
    """Whether nodes collide that are nearer than `collision_distance` at frame 0 (PhysTwin)."""
    hand_pushes: Annotated[
        bool,
        Role(
            label="hands push",
            slider=Slider(
                group="hands",
                hint="The surface of the hands pushes object nodes that they do not hold. Arrows "
                "show what virtual springs do alone.",
            ),
        ),
    ] = False
    """Whether the surface of the hands pushes object nodes that no virtual spring holds."""
    push_stiffness: Annotated[
        float,
        Meta(ge=0.0, le=1e8),
        Role(
            label="push stiffness",
            slider=Slider(
                group="hands",
                hint="Push of a hand on a node, for each metre that the node is inside of it.",
                step=0.05,
                scale="relative power",
            ),
        ),
    ] = 1e5
    """Push of a hand on a node, for each metre that the node is inside of it [N/m]."""
    hand_friction: Annotated[
        float,
        Meta(ge=0.0, le=2.0),
        Role(
            label="friction of hands",
            slider=Slider(
                group="hands",
                hint="How much nodes that a hand pushes resist sliding along it; 0 is wet soap.",
                step=0.05,
            ),
        ),
    ] = 0.5
    """Coulomb friction coefficient between a node and the hand that pushes it."""
    speed_limit: Annotated[
        float,
        Meta(ge=1e-3, le=1e6),
        Role(label="speed limit", is_length=True, is_searched=False),
    ] = 50.0
    """A node faster than this counts as diverged [m/s]."""

    def __post_init__(self) -> None:
        """Check the values; see `Settings.__post_init__`."""
        try:
            super().__post_init__()
        except SettingsError as error:
            raise _of_parameters(error) from None

    @property
    def has_contacts(self) -> bool:
        """Whether nodes collide with each other or with hands, which no batch simulates."""
        return self.self_collision or self.hand_pushes

    @property
    def simulated_frame_rate(self) -> float:
        """Frames in a second of simulated time [Hz]."""
        return self.frame_rate if self.frame_duration is None else 1.0 / self.frame_duration

    @property
    def dt(self) -> float:
        """Length of one substep [s]."""
        return 1.0 / (self.simulated_frame_rate * self.substeps_per_frame)

    def velocity_loss(self, drag: float | None = None) -> float:
        """Part of the velocity that drag takes in one substep, 1 - exp(-dt drag).

        With `rounds_decay` the factor exp(-dt drag) is the float32 that PhysTwin's GPU computes:
        next to 1, one unit of it is 0.04 % of a drag of 3/s, which moves a thrown object by
        0.1 mm in half a second. Where the GPU's rounding was not measured (drag that is no whole
        number in [0, 20], or another dt than 5e-5 s) the nearest float32 is taken.

        Args:
            drag: Decay rate [1/s]; that of the parameters if left out.
        """
        drag = self.drag if drag is None else drag
        if not self.rounds_decay:
            return -math.expm1(-self.dt * drag)
        decay = float(np.float32(math.exp(-self.dt * drag)))
        is_measured = drag == int(drag) and 0 <= drag < len(_DECAY_UNITS)
        if is_measured and math.isclose(self.dt, 5e-5, rel_tol=1e-6):
            decay += _DECAY_UNITS[int(drag)] * 2.0**-24
        return 1.0 - decay

    def in_world(
        self, *, frame_rate: float, ground_height: float | None, gravity: float
    ) -> "SimulationParameters":
        """Take over what a sequence says of its world, as far as these parameters let it.

        Args:
            frame_rate: Frames in a second of the recording [Hz]; `frame_duration` stays.
            ground_height: Height of its ground plane [m], or none; ignored without
                `uses_sequence_ground`.
            gravity: Acceleration along -z [m/s²]; ignored without `uses_sequence_gravity`.
        """
        return self.replace(
            frame_rate=frame_rate,
            ground_height=ground_height if self.uses_sequence_ground else self.ground_height,
            gravity=gravity if self.uses_sequence_gravity else self.gravity,
        )

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "SimulationParameters":
        """Read parameters from plain values; fields that are left out keep their default.

        Numbers may be written as text or as NumPy's, and whole ones with a point, as people and
        other programs store them.

        Raises:
            SettingsError: If a name is unknown or a value is of the wrong kind or out of bounds.
        """
        unknown = {
            name: no_such("simulation parameter", name, PARAMETERS)
            for name in values
            if name not in PARAMETERS
        }
        if unknown:
            raise SettingsError(unknown)
        return cls(**{name: PARAMETERS[name].converted(v) for name, v in values.items()})


def _parameter(field: Field) -> Parameter:
    (role,) = (note for note in field.notes if isinstance(note, Role))
    return Parameter(**vars(field), **vars(role))


PARAMETERS: dict[str, Parameter] = {
    field.name: _parameter(field) for field in fields_of(SimulationParameters)
}
"""The table of all parameters by their names, in the order of their declaration."""


def parameter_names(*effects: Effect) -> tuple[str, ...]:
    """Name the parameters whose new values have one of some effects."""
    return tuple(name for name, parameter in PARAMETERS.items() if parameter.effect in effects)


def changed_parameters(
    fitted: SimulationParameters, changed: Mapping[str, Any]
) -> tuple[SimulationParameters, bool]:
    """Apply changes to fitted parameters.

    Args:
        fitted: What is changed.
        changed: New values by name; `substeps_per_frame` may be `AUTOMATIC`.

    Returns:
        The new parameters, and whether their substeps are yet to be chosen automatically.

    Raises:
        SettingsError: If a parameter is unknown or out of bounds.
    """
    given = dict(changed)
    is_automatic = given.get("substeps_per_frame") == AUTOMATIC
    if is_automatic:
        del given["substeps_per_frame"]
    return SimulationParameters.from_dict(fitted.to_dict() | given), is_automatic


def parameter_changes(
    fitted: SimulationParameters, now: SimulationParameters, *, is_automatic: bool = False
) -> dict[str, Any]:
    """Give what makes parameters out of the fitted ones: the reverse of `changed_parameters`.

    Args:
        fitted: What was changed.
        now: What became of it.
        is_automatic: Whether the substeps are chosen automatically.
    """
    automatic = {"substeps_per_frame": AUTOMATIC} if is_automatic else {}
    return changes(fitted, now.to_dict() | automatic)


def _of_parameters(error: SettingsError) -> SettingsError:
    return SettingsError(
        {name: f"Simulation parameter {problem}" for name, problem in error.fields.items()}
    )
