"""An object whose hands somebody steers: frame by frame, from any state on, or as one motion.

A steered hand moves about its wrist and bends its fingers, and else keeps the shape that it had;
what it holds at the start of a motion it holds throughout. A hand that lets go or grips anew, and
a point of the object that is held by itself, begin another motion. A motion is the poses of its
hands over the frames beside the state that it begins in, so that simulating it again gives the same
bits. Pages and the files of runs call it a take.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from numpy import ndarray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from physhandi.errors import UsageError
from physhandi.rotations import without_jumps
from physhandi.simulation.contact_intervals import always
from physhandi.simulation.fingers import BENDS, CURLS, Fingers, curled
from physhandi.simulation.forces import virtual_spring_forces
from physhandi.simulation.model import SpringMassModel, checked_control
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.restart import NodeState, start_from_tensors, start_to_tensors
from physhandi.simulation.stability import stable_substeps
from physhandi.simulation.topology import virtual_floor, virtual_springs

_ARRAYS = {"control", "hand_of_control", "hand_name", "wrist", "pose", "is_edited", "is_regripped"}
"""Arrays of a stored take besides those of its model and its start."""
_SHAPES = "curls_"
"""Prefix of the arrays that hold `SteeredHand.curls`, by the hand's number."""
_FINGERS = "fingers_"
"""Prefix of the arrays that hold `SteeredHand.fingers`: the hand's number and their own name."""


POSE = 7 + BENDS
"""Numbers of a hand's pose: how far its wrist has moved [m], the rotation vector about it [rad],
how far its fingers are closed (1 for a fist, 0 for as they were, -1 for open), and how far each of
them is bent on top of that [rad]; see `Fingers`."""
_WITHOUT_BENDS = 7
"""Numbers of a pose in takes that were stored before fingers could be bent one by one."""


def turn_on(rotation: Float[ndarray, " 3"], by: Float[ndarray, " 3"]) -> Float[ndarray, " 3"]:
    """Turn what is turned already by another rotation vector, about the world's axes [rad]."""
    return (Rotation.from_rotvec(by) * Rotation.from_rotvec(rotation)).as_rotvec()


def turn_between(start: Float[ndarray, " 3"], end: Float[ndarray, " 3"]) -> Float[ndarray, " 3"]:
    """Give the rotation vector by which one rotation becomes another [rad]."""
    return (Rotation.from_rotvec(end) * Rotation.from_rotvec(start).inv()).as_rotvec()


def to_quaternion(rotation: Float[ndarray, " 3"]) -> Float[ndarray, " 4"]:
    """Convert a rotation vector [rad] to a quaternion w, x, y, z."""
    return Rotation.from_rotvec(rotation).as_quat()[[3, 0, 1, 2]]


def from_quaternion(wxyz: Float[ndarray, " 4"]) -> Float[ndarray, " 3"]:
    """Convert a quaternion w, x, y, z of any length but zero to a rotation vector [rad]."""
    return Rotation.from_quat(np.asarray(wxyz)[[1, 2, 3, 0]]).as_rotvec()


def nearest_surface(
    point: Float[ndarray, "point 3"], surfaces: Sequence[Float[ndarray, "_ 3"]]
) -> Int[ndarray, " point"]:
    """Tell for each point which of some surfaces has the nearest vertex."""
    distance = [KDTree(vertex).query(point)[0] for vertex in surfaces]
    return np.argmin(distance, axis=0)


@dataclass(frozen=True, kw_only=True, eq=False)
class HandSurface:
    """Vertices of a hand in the frame from which it is steered, and how its fingers move them."""

    shapes: Float[ndarray, "curl vertex 3"]
    """The vertices for each of `CURLS`, or one row for a hand whose fingers do not move [m]."""
    fingers: Fingers | None = None
    """Its fingers, whose points are the vertices; None if they do not bend one by one."""

    def at(self, pose: Float[ndarray, " pose"]) -> Float[ndarray, "vertex 3"]:
        """Give the vertices in a pose of the fingers, the wrist being in that of zero [m]."""
        point = curled(self.shapes, pose[6])
        if self.fingers is None or not pose[7:].any():
            return point
        return self.fingers.bent(point, pose[6], pose[7:])


@dataclass(frozen=True, kw_only=True, eq=False)
class SteeredHand:
    """Control nodes that move with a wrist, and with the fingers of a hand that has bones."""

    name: str
    """Name: ``right``, ``left``, or ``controls`` where there are no hands."""
    control: Int[ndarray, " own"]
    """Numbers of its control nodes."""
    wrist: Float[ndarray, " 3"]
    """Point about which it turns, in its pose of zero [m]."""
    curls: Float32[ndarray, "curl own 3"] | None = None
    """Its control nodes for each of `CURLS`, the rest of the pose zero [m]; None if its fingers do
    not move."""
    fingers: Fingers | None = None
    """Its fingers, whose points are its control nodes; None if they do not bend one by one."""

    @classmethod
    def of_surface(
        cls,
        name: str,
        hand: HandSurface,
        *,
        control: Int[ndarray, " own"],
        recorded: Float[ndarray, "all 3"],
        place: Float32[ndarray, "all 3"],
        wrist: Float[ndarray, " 3"] | None,
    ) -> "SteeredHand":
        """Let control nodes move as the vertices of a hand's surface that are nearest to them.

        Args:
            name: What the hand is called.
            hand: The surface.
            control: Numbers of its control nodes.
            recorded: Where all control nodes are on the surface [m].
            place: Where they are simulated [m].
            wrist: Point about which it turns [m]; the middle of the surface if left out.
        """
        shapes, surface, curls, fingers = hand.shapes, curled(hand.shapes, 0.0), None, None
        if len(shapes) > 1:
            nearest = np.asarray(KDTree(surface).query(recorded[control])[1])
            curls = place[control] + (shapes[:, nearest] - surface[nearest])
            curls = curls.astype(np.float32)
            fingers = None if hand.fingers is None else hand.fingers.of_points(nearest)
        middle = surface.mean(axis=0) if wrist is None else wrist
        return cls(name=name, control=control, wrist=middle, curls=curls, fingers=fingers)

    def moved(
        self, point: Float[ndarray, "point 3"], pose: Float[ndarray, " pose"]
    ) -> Float[ndarray, "point 3"]:
        """Move points with the wrist of the hand.

        Args:
            point: Points in the hand's pose of zero, but for its fingers [m].
            pose: Its pose.
        """
        turn = Rotation.from_rotvec(pose[3:6]).as_matrix()
        return (np.asarray(point, np.float64) - self.wrist) @ turn.T + (self.wrist + pose[:3])

    def moved_control(
        self, control: Float32[ndarray, "control 3"], pose: Float[ndarray, " pose"]
    ) -> Float[ndarray, "own 3"]:
        """Give its control nodes.

        Args:
            control: All control nodes where all poses are zero [m].
            pose: Its pose.
        """
        shapes = control[self.control][None] if self.curls is None else self.curls
        return self.moved(HandSurface(shapes=shapes, fingers=self.fingers).at(pose), pose)

    def tip(self, finger: int, pose: Float[ndarray, " pose"]) -> Float[ndarray, " 3"]:
        """Tell where the tip of one of its `FINGERS` is in a pose [m].

        Raises:
            UsageError: If its fingers do not bend.
        """
        tips = self._bending().tips(pose[6], pose[7:])
        return self.moved(tips[finger][None], pose)[0]

    def follow(
        self, finger: int, target: Float[ndarray, " 3"], pose: Float[ndarray, " pose"]
    ) -> Float[ndarray, " bend"]:
        """Tell how its fingers are bent when the tip of one follows a target; its wrist stays.

        Args:
            finger: Which of `FINGERS`.
            target: Where the tip shall be [m].
            pose: The hand's pose now.

        Raises:
            UsageError: If its fingers do not bend, or the target is not finite.
        """
        place = np.asarray(target, np.float64)
        if not np.isfinite(place).all():
            raise UsageError("A fingertip needs a place of finite numbers.")
        turn = Rotation.from_rotvec(pose[3:6]).as_matrix()
        still = (place - self.wrist - pose[:3]) @ turn + self.wrist
        return self._bending().follow(finger, still, pose[6], pose[7:])

    def _bending(self) -> Fingers:
        if self.fingers is None:
            raise UsageError(f"{self.name} has no fingers that bend one by one.")
        return self.fingers


@dataclass(frozen=True, kw_only=True, eq=False)
class SteeredMotion:
    """Poses of hands over some frames, and the state of the object that they begin with."""

    model: SpringMassModel
    """The object, its springs and what is held."""
    start: NodeState
    """Positions and velocities of the nodes in the first frame [m, m/s]."""
    parameters: SimulationParameters
    """Simulation parameters."""
    control: Float32[ndarray, "control 3"]
    """Control nodes where all poses are zero [m]."""
    hands: tuple[SteeredHand, ...]
    """The hands; control nodes of none of them, such as those that nodes are pinned to, stay where
    they are."""
    pose: Float[ndarray, "frame hand pose"] = field(default_factory=lambda: np.zeros((1, 1, POSE)))
    """Poses of the hands (`POSE`); where they are zero, control nodes are as in `control`."""
    is_edited: bool = False
    """Whether single springs or nodes were edited, so that its springs cannot be laid anew."""
    is_regripped: bool = False
    """Whether something was gripped or let go since the rollout from which the hands are steered,
    so that what they hold is written in `model` alone."""

    def __post_init__(self) -> None:
        checked_control(self.control[None], self.model.control_count)
        expected = (len(self.pose), len(self.hands), POSE)
        if self.pose.shape != expected or not len(self.pose) or not len(self.hands):
            raise ValueError(
                f"pose has shape {self.pose.shape}; expected at least one frame, "
                f"{len(self.hands)} hands and {POSE} numbers."
            )
        wrong = np.argwhere(~np.isfinite(self.pose))
        if len(wrong):
            frame, hand = (int(index) for index in wrong[0][:2])
            raise ValueError(f"pose is not finite at frame {frame}, hand {hand}.")
        for hand in self.hands:
            expected = (len(CURLS), len(hand.control), 3)
            if hand.curls is not None and (
                hand.curls.shape != expected or not np.isfinite(hand.curls).all()
            ):
                raise ValueError(
                    f"curls of {hand.name} has shape {hand.curls.shape} or values that are not "
                    f"finite; expected {expected}."
                )
            if hand.fingers is not None and len(hand.fingers.weight) != len(hand.control):
                raise ValueError(
                    f"fingers of {hand.name} move {len(hand.fingers.weight)} points; expected one "
                    f"for each of its {len(hand.control)} control nodes."
                )
        number = np.concatenate([hand.control for hand in self.hands])
        moving = self.model.control_count - self.model.pin_count
        if len(np.unique(number)) != len(number) or np.any((number < 0) | (number >= moving)):
            raise ValueError("hands must name different control nodes that there are and can move.")

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return len(self.pose)

    def control_at(self, pose: Float[ndarray, "hand pose"]) -> Float32[ndarray, "control 3"]:
        """Give the control nodes while the hands have these poses [m]."""
        moved = np.array(self.control, np.float32)
        for hand, its in zip(self.hands, pose, strict=True):
            moved[hand.control] = hand.moved_control(self.control, its)
        return moved

    def controls(self) -> Float32[ndarray, "frame control 3"]:
        """Give the control nodes of all frames [m]."""
        return np.stack([self.control_at(pose) for pose in self.pose])

    def depth_below_ground(self, hand: int, pose: Float[ndarray, " pose"]) -> float:
        """Tell how much too low a hand would be.

        Args:
            hand: Number of the hand.
            pose: Its pose.

        Returns:
            How far its lowest control node is below the ground, or below where the lowest one is
            in the pose of zero if that is lower [m]; negative above, and for no ground.
        """
        ground, its = self.parameters.ground_height, self.hands[hand]
        if ground is None or not len(its.control):
            return -math.inf
        lowest = its.moved_control(self.control, pose)[:, 2].min()
        return float(min(ground, self.control[its.control, 2].min()) - lowest)

    def simulate(self, device: str = "cpu") -> Iterator[NodeState]:
        """Simulate the frames one after the other; the first is the state in `start`.

        Args:
            device: Warp device.

        Raises:
            SimulationDivergedError: If the motion runs away.
        """
        steered = SteeredSimulation(self, device)
        yield steered.state
        for pose in self.pose[1:]:
            yield steered.step(pose)

    def holds(self, hand: int) -> bool:
        """Whether a virtual spring joins a hand to the object."""
        return bool(self._springs_of(hand).any())

    def let_go(
        self, hand: int, state: NodeState, pose: Float[ndarray, "hand pose"]
    ) -> "SteeredMotion":
        """Begin another motion, in which a hand holds nothing.

        Args:
            hand: Number of the hand.
            state: Where the object is then, and how fast [m, m/s].
            pose: Poses of the hands then.
        """
        return self._rejoined(~self._springs_of(hand), state, pose)

    def grip(
        self, hand: int, state: NodeState, pose: Float[ndarray, "hand pose"]
    ) -> "SteeredMotion":
        """Begin another motion, in which a hand holds what is near its control nodes.

        The arguments are those of `let_go`. Nodes are near that are nearer than
        ``virtual_connection_radius``, at most ``virtual_max_neighbors`` for each control node.

        Returns:
            The motion; in it the hand holds nothing if nothing is near.
        """
        own, parameters = self.hands[hand].control, self.parameters
        control = self.control_at(pose)
        springs, length = virtual_springs(
            control[own].astype(np.float64),
            np.asarray(state[0], np.float64),
            parameters.virtual_connection_radius,
            parameters.virtual_max_neighbors,
        )
        first = self.model.node_count
        springs[:, 1] = first + own[springs[:, 1] - first]
        return self._rejoined(~self._springs_of(hand), state, pose, (springs, length))

    def hold_point(
        self, node: int, state: NodeState, pose: Float[ndarray, "hand pose"], name: str
    ) -> "SteeredMotion":
        """Begin another motion, in which a hand of its own holds the object at one more point.

        The hand is one control node a little above the object node, joined to that and to what is
        near it, as control nodes of real hands are.

        Args:
            node: Object node.
            state: Where the object is then, and how fast [m, m/s].
            pose: Poses of the other hands then.
            name: What the hand is called.

        Returns:
            The motion; its last hand is the new one, in the pose of zero.
        """
        model, parameters = self.model, self.parameters
        own = model.control_count - model.pin_count  # Control nodes that never move are the last.
        position = np.asarray(state[0], np.float64)
        radius = parameters.virtual_connection_radius
        springs, _ = virtual_springs(
            position[node][None], position, radius, max(parameters.virtual_max_neighbors, 1)
        )
        point = position[node] + [0.0, 0.0, 0.5 * radius]
        springs[:, 1] += own
        control = np.insert(self.control, own, point.astype(np.float32), axis=0)
        hand = SteeredHand(name=name, control=np.array([own]), wrist=point)
        ends = model.spring_nodes
        more = replace(
            self,
            model=replace(
                model,
                control_count=model.control_count + 1,
                hand_face=model.hand_face + np.int32(model.hand_face >= own),
                spring_nodes=ends + np.int32(ends >= model.node_count + own),
            ),
            control=control,
            hands=(*self.hands, hand),
            pose=np.zeros((1, len(self.hands) + 1, POSE)),
        )
        length = np.linalg.norm(position[springs[:, 0]] - control[own], axis=1)
        every = np.ones(len(ends), bool)
        held = np.concatenate([pose, np.zeros((1, POSE))])
        return more._rejoined(every, state, held, (springs, length))  # noqa: SLF001  # its own class

    def without_point(
        self, hand: int, state: NodeState, pose: Float[ndarray, "hand pose"]
    ) -> "SteeredMotion":
        """Begin another motion, in which a point is held no more; the arguments are `let_go`'s."""
        free = self.let_go(hand, state, pose)
        gone, model = self.hands[hand].control, free.model
        remaining = np.setdiff1d(np.arange(model.control_count), gone)
        place = np.zeros(model.node_count + model.control_count, np.int32)
        place[: model.node_count] = np.arange(model.node_count)
        place[model.node_count + remaining] = model.node_count + np.arange(len(remaining))
        others = [number for number in range(len(self.hands)) if number != hand]
        return replace(
            free,
            model=replace(
                model,
                spring_nodes=place[model.spring_nodes],
                control_count=len(remaining),
                hand_face=model.hand_face_of(remaining),
            ),
            control=self.control[remaining],
            hands=tuple(
                replace(its, control=place[model.node_count + its.control] - model.node_count)
                for its in (self.hands[number] for number in others)
            ),
            pose=free.pose[:, others],
        )

    def _springs_of(self, hand: int) -> Bool[ndarray, " spring"]:
        """Mark the virtual springs of a hand that act."""
        model = self.model
        control = model.spring_nodes.max(axis=1) - model.node_count
        return np.isin(control, self.hands[hand].control) & (model.stiffness > 0.0)

    def _rejoined(
        self,
        stays: Bool[ndarray, " spring"],
        state: NodeState,
        pose: Float[ndarray, "hand pose"],
        joined: tuple[Int[ndarray, "new 2"], Float[ndarray, " new"]] | None = None,
    ) -> "SteeredMotion":
        """Begin another motion with other virtual springs, and with more substeps if they need it.

        Args:
            stays: Springs that stay.
            state: Where the object is then, and how fast [m, m/s].
            pose: Poses of the hands then.
            joined: Nodes and lengths of new virtual springs [m].
        """
        model, parameters = self.model, self.parameters
        ends, length = (np.zeros((0, 2), np.int32), np.zeros(0)) if joined is None else joined

        def spread(old: ndarray, new: ndarray | float) -> ndarray:
            return np.concatenate([old[stays], np.broadcast_to(new, len(ends)).astype(old.dtype)])

        damping = parameters.damping if parameters.virtual_stiffness > 0.0 else 0.0
        model = replace(
            model,
            spring_nodes=np.concatenate([model.spring_nodes[stays], ends]).astype(np.int32),
            rest_length=spread(model.rest_length, np.maximum(length, virtual_floor(parameters))),
            stiffness=spread(model.stiffness, parameters.virtual_stiffness),
            damping=spread(model.damping, damping),
            attached=np.concatenate(
                [model.attached[stays[model.object_spring_count :]], always(len(ends))]
            ),
        )
        taken = replace(
            self, model=model, start=state, pose=np.array(pose)[None], is_regripped=True
        )
        if len(ends):
            moved = replace(model, object_node=np.asarray(state[0], np.float32))
            needed = stable_substeps(moved, parameters, taken.control_at(pose))
            if needed > parameters.substeps_per_frame:
                taken = replace(taken, parameters=parameters.replace(substeps_per_frame=needed))
        return taken

    def part(self, first: int, last: int, state: NodeState) -> "SteeredMotion":
        """Keep some frames.

        Args:
            first: First frame that is kept.
            last: Last one.
            state: NodeState of the object in the first one.
        """
        if not 0 <= first <= last < self.frame_count:
            raise ValueError(f"frames {first} to {last} are not among the {self.frame_count}.")
        return replace(self, start=state, pose=self.pose[first : last + 1].copy())

    def smoothed(self, seconds: float) -> "SteeredMotion":
        """Take jitter out of the poses; the first one, to which the object's state belongs, stays.

        Args:
            seconds: Standard deviation of the Gaussian that poses are averaged with over time [s].
        """
        if seconds <= 0.0:
            return self
        from scipy.ndimage import gaussian_filter1d  # Takes long to import; servers rarely smooth.

        width = seconds * self.parameters.frame_rate
        count, hands = self.pose.shape[:2]
        turn = Rotation.from_rotvec(self.pose[..., 3:6].reshape(-1, 3)).as_quat()
        turn = without_jumps(turn.reshape(count, hands, 4))
        values = np.concatenate([self.pose[..., :3], self.pose[..., 6:], turn], axis=-1)
        # Reflected about the first frame, whose pose is a point of symmetry and stays.
        before = 2.0 * values[:1] - values[:0:-1]
        both: ndarray = np.concatenate([before, values])
        smooth = gaussian_filter1d(both, width, axis=0, mode="nearest")[count - 1 :]
        rotation = Rotation.from_quat(smooth[..., -4:].reshape(-1, 4)).as_rotvec()
        rotation = rotation.reshape(count, hands, 3)
        pose = np.concatenate([smooth[..., :3], rotation, smooth[..., 3:-4]], axis=-1)
        pose[0] = self.pose[0]
        return replace(self, pose=pose)

    def to_tensors(self) -> dict[str, ndarray]:
        """Return model, controls, hands and poses as arrays; parameters are not among them."""
        owner = np.full(self.model.control_count, -1, np.int32)
        for number, hand in enumerate(self.hands):
            owner[hand.control] = number
        names = "\n".join(hand.name for hand in self.hands).encode()
        return {
            **{f"model_{name}": value for name, value in self.model.to_tensors().items()},
            **{f"start_{name}": value for name, value in start_to_tensors(self.start).items()},
            "control": self.control,
            "hand_of_control": owner,
            "hand_name": np.frombuffer(names, np.uint8),
            "wrist": np.stack([np.asarray(hand.wrist, np.float64) for hand in self.hands]),
            "pose": np.asarray(self.pose, np.float64),
            "is_edited": np.array([self.is_edited], np.uint8),
            "is_regripped": np.array([self.is_regripped], np.uint8),
            **{
                f"{_SHAPES}{number}": hand.curls
                for number, hand in enumerate(self.hands)
                if hand.curls is not None
            },
            **{
                f"{_FINGERS}{number}_{name}": value
                for number, hand in enumerate(self.hands)
                if hand.fingers is not None
                for name, value in hand.fingers.to_tensors().items()
            },
        }

    @classmethod
    def from_tensors(
        cls, tensors: Mapping[str, ndarray], parameters: SimulationParameters
    ) -> "SteeredMotion":
        """Rebuild it from the arrays of `to_tensors`.

        Raises:
            ValueError: If an array is missing, unknown or inconsistent.
        """
        model, start, rest = (_named(tensors, prefix) for prefix in ("model_", "start_", ""))
        shapes, fingers = (
            {name: rest.pop(name) for name in list(rest) if name.startswith(prefix)}
            for prefix in (_SHAPES, _FINGERS)
        )
        if set(rest) != _ARRAYS:
            raise ValueError(
                f"A take needs the arrays {', '.join(sorted(_ARRAYS))}, a start and a model; "
                f"got {', '.join(sorted(tensors))}."
            )
        springs = SpringMassModel.from_tensors(model)
        names = bytes(np.asarray(rest["hand_name"], np.uint8)).decode().split("\n")
        owner = np.asarray(rest["hand_of_control"])
        wrist: Any = np.asarray(rest["wrist"], np.float64)
        if wrist.shape != (len(names), 3) or not np.all(np.isfinite(wrist)):
            raise ValueError(f"wrist has shape {wrist.shape}; expected ({len(names)}, 3).")
        hands = tuple(
            SteeredHand(
                name=name,
                control=np.flatnonzero(owner == number),
                wrist=wrist[number],
                curls=shapes.get(f"{_SHAPES}{number}"),
                fingers=_fingers(fingers, f"{_FINGERS}{number}_"),
            )
            for number, name in enumerate(names)
        )
        pose = np.asarray(rest["pose"], np.float64)
        if pose.ndim == 3 and pose.shape[2] == _WITHOUT_BENDS:
            pose = np.pad(pose, ((0, 0), (0, 0), (0, BENDS)))
        return cls(
            model=springs,
            start=start_from_tensors(start, springs.node_count),
            parameters=parameters,
            control=np.asarray(rest["control"], np.float32),
            hands=hands,
            pose=pose,
            is_edited=bool(np.any(rest["is_edited"])),
            is_regripped=bool(np.any(rest["is_regripped"])),
        )


def _fingers(tensors: Mapping[str, ndarray], prefix: str) -> Fingers | None:
    """Give the fingers of one hand, if it has any."""
    own = {
        name.removeprefix(prefix): value
        for name, value in tensors.items()
        if name.startswith(prefix)
    }
    return Fingers.from_tensors(own) if own else None


def _named(tensors: Mapping[str, ndarray], prefix: str) -> dict[str, ndarray]:
    """Give the arrays of a part by their own names; those of no part without a prefix."""
    parts = ("model_", "start_")
    return {
        name.removeprefix(prefix): value
        for name, value in tensors.items()
        if (name.startswith(prefix) if prefix else not name.startswith(parts))
    }


class SteeredSimulation:
    """An object that goes on from the state of a motion, a frame for each pose that it is given."""

    def __init__(self, motion: SteeredMotion, device: str = "cpu") -> None:
        """Place the object on a device, in the first frame of a motion.

        Args:
            motion: Its model, control nodes and first poses.
            device: Warp device.
        """
        from physhandi.simulation.simulator import Simulator  # Whoever shows a motion runs no Warp.

        self._motion = motion
        self._simulator = Simulator(motion.model, motion.parameters, device=device)
        self._simulator.reset(*motion.start)
        self._control = motion.control_at(motion.pose[0])
        self._control_velocity = np.zeros_like(self._control)
        ends = motion.model.spring_nodes[motion.model.object_spring_count :].max(axis=1)
        self._springs = [
            np.isin(ends - motion.model.node_count, hand.control) for hand in motion.hands
        ]
        self.frame = 0
        """Frames that have been simulated."""

    @property
    def state(self) -> NodeState:
        """Positions [m] and velocities [m/s] of the object nodes now."""
        simulator = self._simulator
        return simulator.position.numpy().copy(), simulator.velocity.numpy().copy()

    def step(self, pose: Float[ndarray, "hand pose"]) -> NodeState:
        """Simulate a frame while the hands move to their next poses.

        Raises:
            SimulationDivergedError: If a node is not finite or too fast.
        """
        control = self._motion.control_at(pose)
        self.frame += 1
        self._simulator.step_frame(self.frame, self._control, control)
        rate = self._motion.parameters.simulated_frame_rate
        self._control_velocity = rate * (control - self._control)
        self._control = control
        return self.state

    def pulls(self, state: NodeState) -> Float[ndarray, "hand 3"]:
        """Compute how the object pulls at each hand: the sum of its virtual springs' forces [N].

        Args:
            state: The newest state, as `step` gives it.
        """
        motion, moved = self._motion, self._control_velocity
        force = virtual_spring_forces(motion.model, motion.parameters, *state, self._control, moved)
        return np.stack([-force[own].sum(axis=0) for own in self._springs])
