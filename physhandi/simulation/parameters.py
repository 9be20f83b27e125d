"""The parameters of a simulation: what each means, its unit and its bounds."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np

from physhandi.errors import UsageError

BOUNDS: dict[str, tuple[float | None, float | None]] = {
    "connection_radius": (0.0, None),
    "max_neighbors": (0, 1000),
    "virtual_connection_radius": (0.0, None),
    "virtual_max_neighbors": (0, 1000),
    "stiffness": (0.0, None),
    "stiffness_scale": (0.0, None),
    "virtual_stiffness": (0.0, None),
    "damping": (0.0, None),
    "drag": (0.0, None),
    "restitution": (0.0, 1.0),
    "friction": (0.0, 2.0),
    "collision_distance": (0.0, None),
    "self_restitution": (0.0, 1.0),
    "self_friction": (0.0, 2.0),
    "ground_height": (None, None),
    "gravity": (None, None),
    "frame_rate": (1e-3, None),
    "frame_duration": (1e-6, None),
    "substeps_per_frame": (1, 1_000_000),
    "rest_length_floor": (0.0, None),
    "virtual_rest_length_floor": (0.0, None),
}
"""Lowest and highest value of each parameter that is a number; None leaves that side open."""
_INTEGERS = ("max_neighbors", "virtual_max_neighbors", "substeps_per_frame")
_SWITCHES = (
    "use_control_velocity",
    "self_collision",
    "collides_rest_neighbors",
    "uses_sequence_gravity",
    "uses_sequence_ground",
    "rounds_decay",
)
_LARGEST = 1e30  # Larger numbers, squared or multiplied, leave the simulator's float32.
_OPTIONAL = ("ground_height", "frame_duration")
# float32 exp(-5e-5 drag) on an H200 for drag 0, 1, …, 20, less the nearest float32, in units of
# 2^-24 (measured). PhysTwin truncates its drag to a whole number.
_DECAY_UNITS = (0, 1, 1, -1, 0, 0, 0, 0, 1, 1, 1, 1, -1, 0, 0, 0, 0, 1, 1, 1, 1)


@dataclass(frozen=True, kw_only=True)
class SimulationParameters:
    """The few numbers that describe an object as a whole; sliders and searches move these."""

    connection_radius: float = 0.02
    """δ: object nodes nearer than this get a spring [m]."""
    max_neighbors: int = 29
    """d_max: most object springs that one node may start, the node itself not counted."""
    virtual_connection_radius: float = 0.01
    """Object nodes nearer to a control node than this are held by it [m]."""
    virtual_max_neighbors: int = 6
    """Most virtual springs that one control node may start."""
    stiffness: float = 3e4
    """Force per unit strain that a new object spring gets [N]."""
    stiffness_scale: float = 1.0
    """Multiplies the stiffness of every spring."""
    virtual_stiffness: float = 3e4
    """Force per unit strain that a new virtual spring gets [N]."""
    damping: float = 100.0
    """Dashpot along each spring [N·s/m]."""
    drag: float = 3.0
    """Decay rate of every node's velocity [1/s]."""
    restitution: float = 0.5
    """Part of the normal speed that a bounce on the ground gives back."""
    friction: float = 0.3
    """Coulomb friction coefficient of the ground."""
    ground_height: float | None = 0.0
    """Height of the ground plane [m]; none for no ground."""
    gravity: float = 9.81
    """Acceleration along -z [m/s²]."""
    uses_sequence_gravity: bool = True
    """Whether `in_world` takes the sequence's gravity; PhysTwin's own is 9.8 everywhere."""
    uses_sequence_ground: bool = True
    """Whether `in_world` takes the sequence's ground."""
    frame_rate: float = 30.0
    """Frames in a second [Hz]."""
    frame_duration: float | None = None
    """Time that the simulation takes a frame to last [s]; none for 1 / frame_rate. PhysTwin's 667
    substeps of 5e-5 s make 33.35 ms, whatever the rate of the recording."""
    substeps_per_frame: int = 667
    """Integration steps in one frame; stiffer springs need more."""
    rest_length_floor: float = 1e-3
    """Shortest rest length of an object spring [m]; 0 for none."""
    virtual_rest_length_floor: float = 1e-3
    """Shortest rest length of a virtual spring [m]; 0 for none."""
    use_control_velocity: bool = True
    """Whether the dashpots of virtual springs see the control nodes move."""
    rounds_decay: bool = False
    """Whether a substep's drag is rounded as in PhysTwin's float32 factor; see `velocity_loss`."""
    self_collision: bool = False
    """Whether object nodes bounce off each other."""
    collision_distance: float = 0.005
    """Object nodes that approach each other nearer than this collide [m]."""
    self_restitution: float = 0.7
    """Part of the approach speed that a collision of two nodes gives back."""
    self_friction: float = 0.3
    """Coulomb friction coefficient between two nodes."""
    collides_rest_neighbors: bool = False
    """Whether nodes collide that are nearer than `collision_distance` at frame 0 (PhysTwin)."""

    def __post_init__(self) -> None:
        for name, (low, high) in BOUNDS.items():
            value = getattr(self, name)
            if value is None and name in _OPTIONAL:
                continue
            if isinstance(value, bool) or not isinstance(value, int | float | np.number):
                raise UsageError(f"Simulation parameter {name} is {value!r}; expected a number.")
            is_inside = (low is None or value >= low) and (high is None or value <= high)
            if not (math.isfinite(value) and is_inside and abs(value) <= _LARGEST):
                raise UsageError(
                    f"Simulation parameter {name} is {value}; expected a finite value in "
                    f"[{-_LARGEST if low is None else low}, {_LARGEST if high is None else high}]."
                )

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
        return replace(
            self,
            frame_rate=frame_rate,
            ground_height=ground_height if self.uses_sequence_ground else self.ground_height,
            gravity=gravity if self.uses_sequence_gravity else self.gravity,
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as plain values, ready for YAML or JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "SimulationParameters":
        """Read parameters from plain values; fields that are left out keep their default.

        Args:
            values: Field names and values, as `to_dict` returns them.

        Raises:
            UsageError: If a key is unknown or a value is of the wrong kind or out of bounds.
        """
        unknown = sorted(set(values) - {field.name for field in fields(cls)})
        if unknown:
            raise UsageError(
                f"Unknown simulation parameter {', '.join(map(repr, unknown))}. "
                f"Known are {', '.join(field.name for field in fields(cls))}."
            )
        return cls(**{name: _converted(name, value) for name, value in values.items()})


def _converted(name: str, value: Any) -> Any:
    """Return a value in the type of its field."""
    if value is None:
        if name in _OPTIONAL:
            return None
        raise UsageError(f"Simulation parameter {name} is empty; expected a value.")
    if name in _SWITCHES:
        if not isinstance(value, bool | np.bool_):
            raise UsageError(f"Simulation parameter {name} is {value!r}; expected true or false.")
        return bool(value)
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        raise UsageError(f"Simulation parameter {name} is {value!r}; expected a number.") from None
    if isinstance(value, bool):
        raise UsageError(f"Simulation parameter {name} is {value!r}; expected a number.")
    if name not in _INTEGERS:
        return number
    if not number.is_integer():
        raise UsageError(f"Simulation parameter {name} is {value!r}; expected a whole number.")
    return int(number)
