"""A rollout that continues from another state than its own, with strain and contact kept.

Moved nodes alone would not stay: springs would pull them back to the shape that the old rest
lengths describe. With the rest length r of a spring of length L scaled to ``r' = r L' / L``, where
L' is its length in the new state, its strain ``L' / r' - 1`` and with it its tension are what they
were. Nodes that lie on the ground would fall, or slide off while they do, if they are seen a little
higher; they lie on it where they are seen.

But directions of springs are then others, and each spring that is a little turned throws its nodes.
So springs may go on where the rollout has them, and every node is shown as far beside that as it
was seen there: what a fit missed is a shift, not a force.

A spring between hand and object holds however hard it is pulled. Where nobody observes any more
whether a finger slips, it does beyond a tension (`grip_strength`). And what lies still tells no
more of friction than that it is enough; if it was seen to slide at last, less is left of it
(`friction_share`).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray

from physhandi.simulation.forces import spring_lengths, spring_strains
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.stability import SAFETY

SHORTEST_SHARE = 1.0 / SAFETY**2
"""Least share of its rest length that a spring keeps: shorter ones are stiffer [N/m], and this is
what the margin of automatic substeps leaves room for."""
TOUCHING = 3e-3
"""Height above where it touches the ground up to which a node is taken to lie there [m]."""
FIRM_HOLD = 4
"""Virtual springs that fix the place of a node, whatever hangs on it."""
COINCIDENT = 1e-6
"""Nodes nearer to each other than this have no strain that could be kept [m]."""
_OPTIONAL = {
    "moves_hands": 0,
    "eases_grips": 0,
    "strain_frames": 1,
    "averages_in_air": 0,
    "shifts_nodes": 0,
    "grip_strength": 0.0,
    "friction_share": 1.0,
}
"""Single numbers that a stored restart may lack, and what they are then."""

NodeState = tuple[Float32[ndarray, "node 3"], Float32[ndarray, "node 3"]]
"""Positions [m] and velocities [m/s] of the object nodes."""


def start_to_tensors(start: NodeState) -> dict[str, ndarray]:
    """Give the arrays that `start_from_tensors` reads."""
    position, velocity = start
    return {"position": position, "velocity": velocity}


def start_from_tensors(tensors: Mapping[str, ndarray], node_count: int) -> NodeState:
    """Read the state of frame 0 that a rollout has in place of its model's.

    Args:
        tensors: Arrays ``position`` [m] and ``velocity`` [m/s].
        node_count: Number of nodes that they must have.

    Raises:
        ValueError: If an array is missing, unknown or inconsistent.
    """
    if set(tensors) != {"position", "velocity"}:
        raise ValueError(
            f"A state needs the arrays position and velocity; got {', '.join(sorted(tensors))}."
        )
    position, velocity = (
        np.asarray(tensors[name], np.float32) for name in ("position", "velocity")
    )
    first = Restart(frame=0, position=position, velocity=velocity)
    first.check_nodes(node_count)
    return first.position, first.velocity


@dataclass(frozen=True, kw_only=True, eq=False)
class Restart:
    """The state from which a rollout continues after a frame."""

    frame: int
    """The last frame that is the rollout's own; the next one starts from the state below."""
    position: Float32[ndarray, "node 3"]
    """Object nodes in that frame [m]."""
    velocity: Float32[ndarray, "node 3"]
    """Their velocities [m/s]."""
    moves_hands: bool = False
    """Whether control nodes go on beside themselves, moved as what they hold is (`hand_shift`), so
    that virtual springs keep their directions and not only their strain: a grip is what it was."""
    eases_grips: bool = False
    """Whether virtual springs of nodes that lie on the ground start without strain. What they were
    stretched by stands for what the hand slipped over the object by, which does not come back when
    the hand turns, and the ground's friction holds these nodes without them."""
    strain_frames: int = 1
    """Frames, that of the restart and those before it, over which the strain that springs keep is
    averaged; 1 keeps that of the moment."""
    averages_in_air: bool = False
    """Whether springs between nodes that lie on the ground, and virtual springs of such nodes, keep
    the strain of the moment however many frames that of the others is averaged over. Friction holds
    what lies: it does not swing, and what it is pulled by turns as soon as the hand does."""
    shifts_nodes: bool = False
    """Whether springs go on where the rollout has them, and every node is from then on as far
    beside that as `position` is (`node_shift`). No spring is turned, so none throws its nodes.
    (`moves_hands` and `eases_grips` are of older runs, which moved the nodes themselves.)"""
    grip_strength: float = 0.0
    """Tension beyond which a virtual spring slips at the end of a frame after the restart (see
    `slipped`), as a finger does that friction no longer holds [N]; 0 if none ever slips."""
    friction_share: float = 1.0
    """Part of the ground's friction that is left after the restart. Frames in which what lies does
    not move tell no more than a lower bound of it."""

    def __post_init__(self) -> None:
        if self.frame < 0:
            raise ValueError(f"frame is {self.frame}; expected 0 or later.")
        if not 0.0 <= self.grip_strength < np.inf:
            raise ValueError(
                f"grip_strength is {self.grip_strength}; expected 0 or more, and finite."
            )
        if not 0.0 <= self.friction_share <= 1.0:
            raise ValueError(f"friction_share is {self.friction_share}; expected 0 to 1.")
        if self.strain_frames < 1:
            raise ValueError(f"strain_frames is {self.strain_frames}; expected 1 or more.")
        for name in ("position", "velocity"):
            value = getattr(self, name)
            if value.ndim != 2 or value.shape[1:] != (3,) or len(value) != len(self.position):
                raise ValueError(f"{name} has shape {value.shape}; expected (node, 3).")
            wrong = np.argwhere(~np.isfinite(value))
            if len(wrong):
                raise ValueError(f"{name} is not finite at node {wrong[0][0]}.")

    def check_nodes(self, count: int) -> None:
        """Raise `ValueError` unless it is a state of so many nodes."""
        if len(self.position) != count:
            has = len(self.position)
            raise ValueError(f"position has {has} nodes, but the object has {count}.")

    @property
    def strained_frames(self) -> range:
        """The frames over which strain is averaged, the last one that of the restart."""
        return range(max(0, self.frame + 1 - self.strain_frames), self.frame + 1)

    def continued(
        self,
        model: SpringMassModel,
        parameters: SimulationParameters,
        position: Float[ndarray, "strained node 3"],
        control: Float[ndarray, "strained control 3"],
    ) -> SpringMassModel:
        """Give the model with which the frames after the restart are simulated.

        A spring keeps its strain, or has none where grips are eased, unless its rest length would
        fall below its floor or below `SHORTEST_SHARE` of what it was. One whose ends coincide in
        the rollout has no strain to keep: its rest length stays. A node that lies on the ground in
        the rollout has its height in the new state as its clearance from then on. Of nodes
        that are shifted it is that in the rollout.

        Args:
            model: The springs until then; virtual ones are changed as the object's own.
            parameters: For the floors of the rest lengths, and the ground.
            position: The rollout's own nodes in the `strained_frames` [m].
            control: Control nodes in them [m].
        """
        rest = model.rest_length.astype(np.float64)
        own = position[-1]
        rests = rests_on(model, parameters.ground_height, own)
        before = rest * (1.0 + self._kept_strain(model, position, control, rests))
        shift = self.hand_shift(model, own)
        moved = control[-1] if shift is None else control[-1] + shift
        start = self.start_of_springs(own)
        after = rest * (1.0 + spring_strains(model, start, moved))
        scale = np.divide(after, before, out=np.ones_like(rest), where=before > COINCIDENT)
        scaled = scale * rest
        if self.eases_grips:
            held = model.spring_nodes[model.object_spring_count :].min(axis=1)
            is_eased = np.zeros(len(rest), bool)
            is_eased[model.object_spring_count :] = rests[held]
            scaled = np.where(is_eased, after, scaled)
        scaled = np.maximum(scaled, shortest_rest_lengths(model, parameters)).astype(np.float32)
        clearance = model.clearance
        if parameters.ground_height is not None:
            height = np.maximum(start[:, 2] - parameters.ground_height, 0.0)
            clearance = np.where(rests, height, clearance).astype(np.float32)
        return replace(model, rest_length=scaled, clearance=clearance)

    def _kept_strain(
        self,
        model: SpringMassModel,
        position: Float[ndarray, "strained node 3"],
        control: Float[ndarray, "strained control 3"],
        rests: Bool[ndarray, " node"],
    ) -> Float[ndarray, " spring"]:
        """Average strain over the frames in which a spring acts, if it does in the last one.

        Args:
            model: The springs until the restart.
            position: The rollout's own nodes in the `strained_frames` [m].
            control: Control nodes in them [m].
            rests: Nodes that lie on the ground in the last of them.
        """
        acts = np.stack([model.acts_in(frame) for frame in self.strained_frames]).astype(np.float64)
        acts[:-1] *= acts[-1]
        acts[-1] = 1.0
        if self.averages_in_air:
            lies = np.append(rests, np.ones(model.control_count, bool))
            acts[:-1, lies[model.spring_nodes].all(axis=1)] = 0.0
        each = zip(acts, position, control, strict=True)
        total = sum(share * spring_strains(model, *place) for share, *place in each)
        return total / acts.sum(axis=0)

    def parameters_after(self, parameters: SimulationParameters) -> SimulationParameters:
        """Give the parameters of the frames after the restart, with the friction that is left."""
        if self.friction_share == 1.0:
            return parameters
        return parameters.replace(friction=self.friction_share * parameters.friction)

    def slipped(  # noqa: PLR0917  (the springs, then the state at a frame's end)
        self,
        model: SpringMassModel,
        parameters: SimulationParameters,
        rest_length: Float32[ndarray, " spring"],
        frame: int,
        position: Float[ndarray, "node 3"],
        control: Float[ndarray, "control 3"],
    ) -> Float32[ndarray, " spring"]:
        """Give the rest lengths for what follows a frame, at whose end some grips slip.

        A virtual spring of stiffness Y whose tension is beyond the `grip_strength` T goes on with
        that: ``r = L / (1 + T / Y)``, or ``L / (1 - T / Y)`` if it is pressed, where L is its
        length, but no shorter than `continued` may make it. What has slipped does not come back
        when the hand turns, as what a spring was stretched by would.

        Args:
            model: The springs, with the rest lengths that they have until the restart.
            parameters: For the stiffness and the floors of the rest lengths.
            rest_length: What springs had on the way to the frame [m].
            frame: The frame, after the restart.
            position: Where springs have the object nodes at its end [m].
            control: Where virtual springs end then [m].

        Returns:
            Rest lengths [m]; the given array itself if nothing slips.
        """
        virtual = slice(model.object_spring_count, None)
        if self.grip_strength == 0.0 or model.virtual_spring_count == 0:
            return rest_length
        length = spring_lengths(model, position, control, virtual)
        rest = rest_length[virtual].astype(np.float64)
        stiffness = parameters.stiffness_scale * model.stiffness[virtual].astype(np.float64)
        strain = length / rest - 1.0
        slips = model.acts_in(frame)[virtual] & (stiffness * np.abs(strain) > self.grip_strength)
        if not slips.any():
            return rest_length
        borne = np.copysign(self.grip_strength / stiffness[slips], strain[slips])
        rest[slips] = np.maximum(
            length[slips] / (1.0 + borne),
            shortest_rest_lengths(model, parameters)[virtual][slips],
        )
        later = rest_length.copy()
        later[virtual] = rest
        return later

    def hand_shift(
        self, model: SpringMassModel, position: Float[ndarray, "node 3"]
    ) -> Float32[ndarray, "control 3"] | None:
        """Give how far control nodes are from where they were seen, in the frames that follow [m].

        A control node is moved as the nodes that it holds are on average; of these, one that
        `FIRM_HOLD` springs or more hold counts as not moved, because it cannot swing around them.

        Args:
            model: The springs until the restart.
            position: The rollout's own nodes in the frame of the restart [m].

        Returns:
            The shifts; None if hands are not moved.
        """
        if not self.moves_hands:
            return None
        acts = model.acts_in(self.frame)[model.object_spring_count :]
        ends = np.sort(model.spring_nodes[model.object_spring_count :][acts], axis=1)
        control = ends[:, 1] - model.node_count
        swings = np.bincount(ends[:, 0], minlength=model.node_count) < FIRM_HOLD
        moved = (swings[:, None] * (np.asarray(self.position, np.float64) - position))[ends[:, 0]]
        total = [np.bincount(control, moved[:, i], model.control_count) for i in range(3)]
        count = np.maximum(np.bincount(control, minlength=model.control_count), 1)
        return (np.stack(total, axis=1) / count[:, None]).astype(np.float32)

    def start_of_springs(self, position: Float[ndarray, "node 3"]) -> Float[ndarray, "node 3"]:
        """Give where springs have the nodes when the rollout goes on [m].

        Args:
            position: The rollout's own nodes in the frame of the restart [m].
        """
        return position if self.shifts_nodes else self.position

    def node_shift(self, position: Float[ndarray, "node 3"]) -> Float32[ndarray, "node 3"] | None:
        """Give how far nodes are from where springs have them, in the frames that follow [m].

        Args:
            position: The rollout's own nodes in the frame of the restart [m].

        Returns:
            The shifts; None if nodes are not shifted.
        """
        return self.position - np.asarray(position, np.float32) if self.shifts_nodes else None

    def to_tensors(self) -> dict[str, ndarray]:
        """Return every field as an array, ready for safetensors."""
        frame = np.array([self.frame], dtype=np.int32)
        state = {"frame": frame, "position": self.position, "velocity": self.velocity}
        return state | {
            name: np.array(
                [getattr(self, name)], np.float32 if isinstance(default, float) else np.int32
            )
            for name, default in _OPTIONAL.items()
        }

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, ndarray]) -> "Restart":
        """Rebuild it from the arrays of `to_tensors`; what it does not say was not done.

        Raises:
            ValueError: If an array is missing, unknown or inconsistent.
        """
        needed = {"frame", "position", "velocity"}
        if not needed <= set(tensors) <= needed | set(_OPTIONAL):
            *others, last = _OPTIONAL
            raise ValueError(
                "A restart needs the arrays frame, position and velocity, and may have "
                f"{', '.join(others)} and {last}; got {', '.join(sorted(tensors))}."
            )
        single = {
            name: np.asarray(tensors.get(name, _OPTIONAL.get(name))).reshape(-1)
            for name in ("frame", *_OPTIONAL)
        }
        for name, value in single.items():
            if len(value) != 1:
                raise ValueError(f"{name} has {len(value)} values; expected one.")
        return cls(
            frame=int(single["frame"][0]),
            position=np.asarray(tensors["position"], np.float32),
            velocity=np.asarray(tensors["velocity"], np.float32),
            moves_hands=bool(single["moves_hands"][0]),
            eases_grips=bool(single["eases_grips"][0]),
            strain_frames=int(single["strain_frames"][0]),
            averages_in_air=bool(single["averages_in_air"][0]),
            shifts_nodes=bool(single["shifts_nodes"][0]),
            grip_strength=float(single["grip_strength"][0]),
            friction_share=float(single["friction_share"][0]),
        )


def shortest_rest_lengths(
    model: SpringMassModel, parameters: SimulationParameters
) -> Float[ndarray, " spring"]:
    """Give the least rest length that each spring may get after a restart [m]."""
    rest = model.rest_length.astype(np.float64)
    floor = np.full_like(rest, parameters.virtual_rest_length_floor)
    floor[: model.object_spring_count] = parameters.rest_length_floor
    return np.maximum(SHORTEST_SHARE * rest, np.minimum(rest, floor))


def rests_on(
    model: SpringMassModel, ground_height: float | None, position: Float[ndarray, "node 3"]
) -> Bool[ndarray, " node"]:
    """Say which nodes lie on the ground."""
    if ground_height is None:
        return np.zeros(model.node_count, bool)
    return position[:, 2] - ground_height - model.clearance < TOUCHING
