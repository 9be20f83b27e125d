"""The model that is simulated: nodes and the springs that join them."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32
from numpy import ndarray

from physhandi.simulation.contact_intervals import acts_in, always
from physhandi.simulation.rod import PREFIX, Rod

_OPTIONAL = {"pin_place", "hand_face"}
"""Arrays that are stored only if there is something in them."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SpringMassModel:
    """Nodes, springs and material of one deformable object and what holds it.

    Every object node weighs 1 kg. Nodes are numbered object nodes first, then control
    nodes: control `c` is node `node_count + c`. Object springs come first, then virtual ones.
    """

    object_node: Float32[ndarray, "node 3"]
    """Positions of the object nodes at frame 0 [m]."""
    initial_velocity: Float32[ndarray, "node 3"]
    """Velocities of the object nodes at frame 0 [m/s]."""
    spring_nodes: Int32[ndarray, "spring 2"]
    """The two nodes that each spring joins."""
    rest_length: Float32[ndarray, " spring"]
    """Length at which a spring pulls with no force [m]."""
    stiffness: Float32[ndarray, " spring"]
    """Force per unit strain [N]; divide by rest_length for N/m."""
    damping: Float32[ndarray, " spring"]
    """Dashpot along the spring [N·s/m]."""
    object_spring_count: int
    """Number of leading springs that join two object nodes; the others are virtual."""
    control_count: int
    """Number of control nodes."""
    clearance: Float32[ndarray, " #node"] = field(default_factory=lambda: np.zeros(1, np.float32))
    """Height above the ground at which each object node touches it [m]; one for all, or each."""
    attached: Int32[ndarray, "#virtual 2"] = field(default_factory=lambda: always(1))
    """Frame in whose state each virtual spring is attached, and the last one before it lets go: it
    acts on the way from the first to the last; one pair for all, or each."""
    pin_place: Float32[ndarray, "pin 3"] = field(
        default_factory=lambda: np.zeros((0, 3), np.float32)
    )
    """Where the last control nodes are that never move because nodes are pinned to them [m]."""
    hand_face: Int32[ndarray, "face 3"] = field(default_factory=lambda: np.zeros((0, 3), np.int32))
    """Triangles of the hands' surface, their corners control nodes counted from 0, in the order in
    which they are seen counterclockwise from outside; none if control nodes are no surface."""
    rod: Rod | None = None
    """How the object bends, if it is a rope; None if springs alone hold its shape."""

    def __post_init__(self) -> None:
        self._spread()
        spring_count = len(self.spring_nodes)
        for name in ("rest_length", "stiffness", "damping"):
            value = getattr(self, name)
            if value.shape != (spring_count,) or not np.all(np.isfinite(value)):
                raise ValueError(
                    f"{name} has shape {value.shape} or values that are not finite; "
                    f"expected {spring_count} finite values, one a spring."
                )
        if spring_count and float(self.rest_length.min()) <= 0.0:
            raise ValueError("rest_length must be positive; raise the rest length floor.")
        for name in ("object_node", "initial_velocity"):
            value = getattr(self, name)
            if value.shape != (self.node_count, 3) or not np.all(np.isfinite(value)):
                raise ValueError(
                    f"{name} has shape {value.shape} or values that are not finite; "
                    f"expected ({self.node_count}, 3)."
                )
        if self.clearance.shape != (self.node_count,) or not np.all(np.isfinite(self.clearance)):
            raise ValueError(
                f"clearance has shape {self.clearance.shape} or values that are not finite; "
                f"expected {self.node_count} finite values, one an object node."
            )
        if not 0 <= self.object_spring_count <= spring_count:
            raise ValueError(
                f"object_spring_count is {self.object_spring_count}, "
                f"but there are {spring_count} springs."
            )
        self._check_nodes()
        if self.attached.shape != (self.virtual_spring_count, 2):
            raise ValueError(
                f"attached has shape {self.attached.shape}; "
                f"expected ({self.virtual_spring_count}, 2), two frames a virtual spring."
            )
        self._check_pins()
        self._check_hands()
        if self.rod is not None:
            self.rod.check(self.node_count, self.control_count)

    def _spread(self) -> None:
        """Give each node and spring its own value where one is given for all."""
        counts = {"clearance": self.node_count, "attached": self.virtual_spring_count}
        for name, count in counts.items():
            value = getattr(self, name)
            if len(value) == 1:
                object.__setattr__(self, name, np.repeat(value, max(count, 0), axis=0))

    def _check_nodes(self) -> None:
        """Refuse springs whose ends are not the nodes that their kind joins."""
        is_control = self.spring_nodes >= self.node_count
        count = self.node_count + self.control_count
        if np.any(self.spring_nodes < 0) or np.any(self.spring_nodes >= count):
            raise ValueError(f"spring_nodes names a node outside 0…{count - 1}.")
        if np.any(self.spring_nodes[:, 0] == self.spring_nodes[:, 1]):
            raise ValueError("spring_nodes has a spring that joins a node to itself.")
        if np.any(is_control[: self.object_spring_count]):
            raise ValueError("An object spring (one of the first) ends at a control node.")
        if np.any(is_control[self.object_spring_count :].sum(axis=1) != 1):
            raise ValueError("A virtual spring must join one object node and one control node.")

    def _check_pins(self) -> None:
        place, count = self.pin_place, self.pin_count
        if place.shape != (count, 3) or count > self.control_count or not np.isfinite(place).all():
            raise ValueError(
                f"pin_place has shape {place.shape} or values that are not finite; expected three "
                f"numbers for each of at most {self.control_count} control nodes."
            )

    def _check_hands(self) -> None:
        corners = self.hand_face
        if corners.shape[1:] != (3,) or not np.all((corners >= 0) & (corners < self.control_count)):
            raise ValueError(
                f"hand_face has shape {corners.shape} or names a control node outside "
                f"0…{self.control_count - 1}; expected three of them for each triangle."
            )

    @property
    def node_count(self) -> int:
        """Number of object nodes."""
        return len(self.object_node)

    @property
    def pin_count(self) -> int:
        """Number of control nodes, the last ones, that never move."""
        return len(self.pin_place)

    def with_pins(
        self, control: Float32[ndarray, "frame some 3"]
    ) -> Float32[ndarray, "frame control 3"]:
        """Give the motion of all control nodes.

        Args:
            control: That of the control nodes that move, with or without any pins behind them [m].
        """
        moving = self.control_count - self.pin_count
        if control.shape[1] == moving and not self.pin_count:
            return control
        pin = np.broadcast_to(self.pin_place, (len(control), self.pin_count, 3))
        return np.concatenate([control[:, :moving], pin.astype(control.dtype)], axis=1)

    @property
    def virtual_spring_count(self) -> int:
        """Number of springs that join a control node to an object node."""
        return len(self.spring_nodes) - self.object_spring_count

    @property
    def is_always_attached(self) -> bool:
        """Whether every virtual spring acts in all frames."""
        return bool(np.all(self.attached == always(1)))

    def hand_face_of(self, controls: Int[ndarray, " chosen"]) -> Int32[ndarray, "some_face 3"]:
        """Keep the hands' triangles of some control nodes, numbered anew in the order given."""
        place = np.full(self.control_count, -1, np.int32)
        place[controls] = np.arange(len(controls), dtype=np.int32)
        face = place[self.hand_face]
        return face[(face >= 0).all(axis=1)]

    def acts_in(self, frame: int) -> Bool[ndarray, " spring"]:
        """Mark the springs that act on the way to a frame; to frame 0, those of frame 1."""
        acts = np.ones(len(self.spring_nodes), dtype=bool)
        acts[self.object_spring_count :] = acts_in(self.attached, frame)
        return acts

    def held_in(self, frame: int) -> "SpringMassModel":
        """Give the model of a frame: springs that do not act in it have no stiffness or damping."""
        if self.is_always_attached:
            return self
        acts = self.acts_in(frame).astype(np.float32)
        return replace(
            self,
            stiffness=self.stiffness * acts,
            damping=self.damping * acts,
            attached=always(self.virtual_spring_count),
        )

    def to_tensors(self) -> dict[str, ndarray]:
        """Return every field as an array, ready for safetensors; no pins or hands if none."""
        names = [field.name for field in fields(self) if field.name != "rod"]
        values = {name: getattr(self, name) for name in names}
        tensors = {
            name: value if isinstance(value, np.ndarray) else np.array([value], dtype=np.int32)
            for name, value in values.items()
            if name not in _OPTIONAL or len(value)
        }
        return tensors if self.rod is None else tensors | self.rod.to_tensors()

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, ndarray]) -> "SpringMassModel":
        """Rebuild a model from the arrays of `to_tensors`.

        Models that were stored before nodes had a clearance have none; the virtual springs of those
        that were stored before springs could be attached later are always attached. Objects that
        are no ropes, and those that were stored before ropes could bend, have no rod. Without pins
        none are stored, nor triangles without hands.

        Raises:
            ValueError: If an array is missing, unknown or inconsistent.
        """
        names = {field.name for field in fields(cls) if field.name != "rod"}
        values: dict[str, Any] = {
            name: np.asarray(a) for name, a in tensors.items() if not name.startswith(PREFIX)
        }
        if set(values) | {"clearance", "attached"} | _OPTIONAL != names:
            raise ValueError(
                f"A spring-mass model needs the arrays {', '.join(sorted(names))}; "
                f"got {', '.join(sorted(values))}."
            )
        for name in ("object_spring_count", "control_count"):
            values[name] = int(values[name][0])
        return cls(**values, rod=Rod.from_tensors(tensors))


def checked_control(control: Float[ndarray, "frame control 3"], count: int) -> ndarray:
    """Return a control trajectory as float32.

    Args:
        control: Positions of the control nodes in every frame [m].
        count: Number of control nodes that there must be.

    Raises:
        ValueError: If it is of another shape or not finite.
    """
    control = np.asarray(control, dtype=np.float32)
    if control.ndim != 3 or control.shape[1:] != (count, 3):
        raise ValueError(f"control has shape {control.shape}; expected (frames, {count}, 3).")
    bad = np.argwhere(~np.isfinite(control))
    if len(bad):
        raise ValueError(f"control is not finite at frame {bad[0][0]}, node {bad[0][1]}.")
    return control
