"""One rollout of the object: the fitted one, or one that is being simulated now."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from physhandi.appearance.texture import colored_surface
from physhandi.data.exporters.export import export_scene
from physhandi.data.exporters.scene_data import SceneData
from physhandi.data.hand_surface import stored_faces
from physhandi.data.layout import PARAMETERS_FILE, SHAPE_FILE, SequenceFiles
from physhandi.data.run import RunFolder
from physhandi.data.run_folder import reading
from physhandi.data.sequence import Sequence as Recording
from physhandi.data.view import View
from physhandi.errors import PhysHandiError, UsageError
from physhandi.fitting.stored_edits import read_edits
from physhandi.simulation.edits import Edits
from physhandi.simulation.forces import (
    push_forces,
    spring_strains,
    spring_tensions,
    virtual_forces,
    virtual_spring_forces,
)
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.object_surface import ObjectSurface, lay_surface
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.restart import (
    NodeState,
    Restart,
    shortest_rest_lengths,
    start_from_tensors,
)

logger = logging.getLogger(__name__)

_FORMATS = {".glb": "gltf", ".usd": "usd", ".npz": "npz", ".csv": "csv", ".ply": "ply", "": "ply"}

Measure = Callable[..., ndarray]
"""Measures something of a model, its parameters and a state, as `spring_tensions` does."""
_FEWEST_STOPS = 8


@dataclass(eq=False, kw_only=True)
class ObjectRollout:
    """Object motion under one set of parameters; frames become ready one after the other."""

    model: SpringMassModel
    """Topology and material; see `model_in` for the frames after a restart."""
    parameters: SimulationParameters
    """Simulation parameters of the object."""
    control: Float[ndarray, "frame control 3"]
    """Control node positions [m]."""
    position: Float[ndarray, "frame node 3"]
    """Object node positions [m]; meaningless from frame `ready` on."""
    velocity: Float[ndarray, "frame node 3"] | None = None
    """Object node velocities [m/s]; None if they are to be differences of positions."""
    ready: int = 0
    """Number of frames that have been simulated."""
    error: str | None = None
    """Why the simulation ended early, if it did."""
    start: NodeState | None = None
    """Positions and velocities in frame 0 [m, m/s], if they are not those of the model."""
    restart: Restart | None = None
    """State from which the frames after `restart.frame` start, in place of the rollout's own."""
    hand_shift: Float[ndarray, "control 3"] | None = None
    """Shift that a restart gives to the control nodes [m]; computed when it is needed."""
    edits: Edits = ()
    """Edits of single springs and nodes of the model."""
    unedited: SpringMassModel | None = None
    """The model without its edits; None if it has none."""
    scene: Callable[[], SceneData] | None = None
    """Reads the hands and names that `export` writes beside the motion, if they are known."""
    surface: Callable[[], ObjectSurface | None] | None = None
    """Lays the surface that `export` writes, if it is known what the object looks like."""
    _continued: dict[int, SpringMassModel] = field(default_factory=dict, init=False, repr=False)
    """Springs on the way to frames after the restart, whether they are attached or not."""

    @classmethod
    def empty(
        cls,
        model: SpringMassModel,
        parameters: SimulationParameters,
        control: Float[ndarray, "frame control 3"],
        restart: Restart | None = None,
        start: NodeState | None = None,
    ) -> "ObjectRollout":
        """Make room for a rollout of which no frame is ready."""
        shape = (len(control), model.node_count, 3)
        return cls(
            model=model,
            parameters=parameters,
            control=control,
            position=np.zeros(shape, np.float32),
            velocity=np.zeros(shape, np.float32),
            start=start,
            restart=restart,
        )

    @property
    def frame_count(self) -> int:
        """Number of frames when all are ready."""
        return len(self.position)

    @property
    def is_complete(self) -> bool:
        """Whether every frame is ready."""
        return self.ready >= self.frame_count

    def model_in(self, frame: int) -> SpringMassModel:
        """Get the model of a frame: after a restart rest lengths and clearances are others.

        Springs that are not attached in the frame have no stiffness and no damping.
        """
        return self._springs(frame).held_in(frame)

    def _springs(self, frame: int) -> SpringMassModel:
        """Get the springs on the way to a frame, whether they are attached then or not."""
        restart = self.restart
        if restart is None or frame <= restart.frame:
            return self.model
        if restart.grip_strength == 0.0:  # They are the same from the restart on.
            frame = restart.frame + 1
        if not self._continued:
            strained = self._strained(restart)
            first = restart.continued(self.model, self.parameters, *strained)
            self._continued[restart.frame + 1] = first
        for reached in range(max(each for each in [*self._continued] if each <= frame), frame):
            before = self._continued[reached]
            state = self.sprung_nodes(reached), self.held_control(reached)
            rest = restart.slipped(self.model, self.parameters, before.rest_length, reached, *state)
            after = before if rest is before.rest_length else replace(before, rest_length=rest)
            self._continued[reached + 1] = after
        return self._continued[frame]

    def parameters_in(self, frame: int) -> SimulationParameters:
        """Get the parameters on the way to a frame: a restart may leave less friction."""
        restart = self.restart
        if restart is None or frame <= restart.frame:
            return self.parameters
        return restart.parameters_after(self.parameters)

    def going_on(self, frame: int) -> tuple[SpringMassModel, NodeState]:
        """Get what is needed to go on from a frame in another way.

        Returns:
            The model, whose springs have the strain that they have in the frame, and those that are
            attached on the way to the next frame for good; positions and velocities of the nodes
            [m, m/s]. Where velocities are not known, they are differences of positions. With
            `parameters_in` of the next frame it goes on as this does.
        """
        restart = self.restart
        is_own = restart is None or frame <= restart.frame
        whole = self.model if is_own else self._springs(frame + 1)
        place, velocity, control, _ = self.state(frame)
        if frame == 0:
            velocity = self.model.initial_velocity if self.start is None else self.start[1]
        position, velocity = (
            np.array(each, np.float32) for each in (self.position[frame], velocity)
        )
        if self._node_shift(frame) is not None:
            # Springs are to have the strain here that they have beside.
            seen = Restart(frame=frame, position=position, velocity=velocity)
            lower = replace(whole, clearance=self.model.clearance)
            whole = seen.continued(lower, self.parameters, place[None], control[None])
        return whole.held_in(frame + 1), (position, velocity)

    def held_control(self, frame: int) -> Float[ndarray, "control 3"]:
        """Give where virtual springs end: after a restart that moves hands not where these are."""
        control, restart = np.asarray(self.control[frame]), self.restart
        if restart is None or frame <= restart.frame:
            return control
        shift = self.shift_of_hands()
        return control if shift is None else control + shift

    def shift_of_hands(self) -> Float[ndarray, "control 3"] | None:
        """Give what is added to control nodes after a restart [m]; None for nothing."""
        restart = self.restart
        if self.hand_shift is None and restart is not None and restart.frame < self.ready:
            own = np.asarray(self.position[restart.frame])
            self.hand_shift = restart.hand_shift(self.model, own)
        return self.hand_shift

    def sprung_nodes(self, frame: int) -> Float[ndarray, "node 3"]:
        """Give where springs have the nodes: beside where they are seen after some restarts."""
        position, shift = np.asarray(self.position[frame]), self._node_shift(frame)
        return position if shift is None else position - shift

    def _node_shift(self, frame: int) -> Float[ndarray, "node 3"] | None:
        """Give what a restart has added to the nodes of a frame [m]; None for nothing."""
        restart = self.restart
        if restart is None or frame <= restart.frame:
            return None
        return restart.node_shift(np.asarray(self.position[restart.frame]))

    def _restart_before(self, frame: int) -> Restart | None:
        """Give the restart if the frame is the first one after it."""
        restart = self.restart
        return restart if restart is not None and frame == restart.frame + 1 else None

    def _strained(self, restart: Restart) -> tuple[ndarray, ndarray]:
        """Give object and control nodes in the frames whose strain a restart keeps [m]."""
        frames = slice(restart.strained_frames.start, restart.strained_frames.stop)
        return np.asarray(self.position[frames]), np.asarray(self.control[frames])

    def restart_arrays(self) -> dict[str, ndarray]:
        """Give what an export needs to tell springs after a restart from those before it.

        Returns:
            ``restart_frame``, the last frame before it; ``restart_position`` and
            ``restart_velocity`` of the object nodes, from which the next frame starts [m, m/s];
            ``restart_hand_shift`` of every control node from then on [m], if hands are moved;
            ``restart_node_shift`` [m], if springs have the nodes that far from where they are seen;
            ``restart_rest_length`` of every spring and ``restart_clearance`` of every node from
            then on [m], and, if grips slip, ``restart_shortest`` of every spring, the least rest
            length that it may have [m]. Nothing if no frame that is ready comes after a restart.
        """
        if self.restart is None or self.restart.frame >= self.ready:
            return {}
        state = {f"restart_{name}": array for name, array in self.restart.to_tensors().items()}
        model = self.model_in(self.restart.frame + 1)
        shift = self.shift_of_hands()
        if shift is not None:
            state["restart_hand_shift"] = shift
        beside = self._node_shift(self.restart.frame + 1)
        if beside is not None:
            state["restart_node_shift"] = beside
        if self.restart.grip_strength > 0.0:
            state["restart_shortest"] = shortest_rest_lengths(self.model, self.parameters)
        return state | {
            "restart_rest_length": model.rest_length,
            "restart_clearance": model.clearance,
        }

    def forces(self, frame: int) -> Float[ndarray, "node 3"]:
        """Compute the force of the hands on each object node [N].

        It is the sum of its virtual springs' forces and, with `hand_pushes`, of `pushes`.
        """
        return self._hand_forces(frame, *self.state(frame))

    def _hand_forces(self, frame: int, *state: ndarray) -> Float[ndarray, "node 3"]:
        """Compute the force of the hands on each node at a moment on the way to a frame [N]."""
        pull = virtual_forces(self.model_in(frame), self.parameters, *state)
        return pull + self._pushes(frame, *state)[1] if self.is_pushed else pull

    @property
    def is_pushed(self) -> bool:
        """Whether the surface of the hands pushes nodes."""
        return self.parameters.hand_pushes and len(self.model.hand_face) > 0

    def pushes(self, frame: int) -> tuple[Int[ndarray, " node"], Float[ndarray, "node 3"]]:
        """Compute how the surface of the hands pushes each object node; see `push_forces`.

        Returns:
            Triangle of the hands that pushes each node, -1 for none, and forces [N].
        """
        return self._pushes(frame, *self.state(frame))

    def _pushes(
        self, frame: int, *state: ndarray
    ) -> tuple[Int[ndarray, " node"], Float[ndarray, "node 3"]]:
        """Compute the push at a moment on the way to a frame."""
        position, velocity, control, control_velocity = state
        before, restart = max(frame - 1, 0), self._restart_before(frame)
        first = self.sprung_nodes(before)
        first = first if restart is None else restart.start_of_springs(first)
        hand = control + (np.asarray(self.control[frame]) - self.held_control(frame))
        return push_forces(
            self.model_in(frame),
            self.parameters,
            (position, velocity, control, control_velocity),
            hand,
            (np.asarray(first), np.asarray(self.control[before])),
        )

    def spring_forces(self, frame: int) -> Float[ndarray, "virtual 3"]:
        """Compute the force of each virtual spring on its object node [N]."""
        return virtual_spring_forces(self.model_in(frame), self.parameters, *self.state(frame))

    def strains(self, frame: int) -> Float[ndarray, " spring"]:
        """Measure how much longer each spring is than at rest, as a part of its rest length."""
        position, control = self.sprung_nodes(frame), self.held_control(frame)
        return spring_strains(self.model_in(frame), position, control)

    def tensions(self, frame: int) -> Float[ndarray, " spring"]:
        """Compute how hard each spring pulls its ends together [N]."""
        return spring_tensions(self.model_in(frame), self.parameters, *self.state(frame))

    def mean_tensions(self, device: str = "cpu") -> Float[ndarray, "frame spring"]:
        """Average the tension of each spring over the substeps on the way to each frame [N].

        Springs oscillate faster than frames show, so `tensions` of single moments jitter from frame
        to frame; curves over time are better plotted of these. See `frame_means`.
        """
        return self.frame_means(spring_tensions, device)

    def mean_forces(self, device: str = "cpu") -> Float[ndarray, "frame node 3"]:
        """Average the force of the hands on each node over the way to each frame [N].

        As `mean_tensions`, for `forces`.
        """
        return self._frame_means(self._hand_forces, device)

    def frame_means(self, measure: Measure, device: str = "cpu") -> Float[ndarray, "frame ..."]:
        """Average what is measured of model and state over the substeps on the way to each frame.

        Simulates the frames that are ready once more, with the same substeps, and stops at least
        eight times on the way to each (at all of its substeps, if they are fewer).

        Args:
            measure: Takes the model of a frame, the parameters and, at one moment, positions and
                velocities of the object nodes and of the control nodes [m, m/s].
            device: Warp device.

        Returns:
            Means by the trapezoidal rule; of frame 0, on whose way nothing is, the value itself.

        Raises:
            SimulationDivergedError: If the motion runs away.
        """

        def measured(frame: int, *state: Any) -> ndarray:
            return measure(self.model_in(frame), self.parameters, *state)

        return self._frame_means(measured, device)

    def _frame_means(
        self, measure: Callable[..., ndarray], device: str
    ) -> Float[ndarray, "frame ..."]:
        """Average as `frame_means` what is measured of a frame and the state at a moment."""
        from physhandi.simulation.simulator import Simulator

        given = self.parameters
        count, each = _stops(given.substeps_per_frame)
        duration = 1.0 / (given.simulated_frame_rate * count)
        finer = given.replace(frame_duration=duration, substeps_per_frame=each)
        simulator = Simulator(self.model, finer, device)
        simulator.reset(*(self.start or ()))
        means = [np.asarray(measure(0, *self.state(0)), np.float64)]
        for frame in range(1, self.ready):
            restart = self._restart_before(frame)
            if restart is not None:
                simulator.continue_from(restart, *self._strained(restart))
            _, _, end, moving = self.state(frame)
            begin = end - (self.control[frame] - self.control[frame - 1])
            mean, before = np.zeros_like(means[0]), begin
            for stop in range(count + 1):
                place = begin + np.float32(stop / count) * (end - begin)
                if stop > 0:
                    simulator.step_frame(frame, before, place, goes_on=stop > 1)
                state = simulator.position.numpy(), simulator.velocity.numpy(), place, moving
                weight = (0.5 if stop in {0, count} else 1.0) / count
                mean = mean + weight * np.asarray(measure(frame, *state), np.float64)
                before = place
            means.append(mean)
        return np.stack(means)

    def state(self, frame: int) -> tuple[ndarray, ndarray, ndarray, ndarray]:
        """Collect positions and velocities of object nodes, then of control nodes [m, m/s].

        They are those that springs act with (`sprung_nodes`, `held_control`).
        """
        given = self.velocity
        velocity = self._mean_velocity(frame) if given is None else given[frame]
        return (
            self.sprung_nodes(frame),
            np.asarray(velocity),
            self.held_control(frame),
            _difference(self.control, frame, self.parameters.frame_rate),
        )

    def _mean_velocity(self, frame: int) -> Float[ndarray, "node 3"]:
        """Velocity of the nodes during the frame's substeps, from their positions [m/s]."""
        restart, rate = self._restart_before(frame), self.parameters.frame_rate
        if restart is None:
            return _difference(self.position, frame, rate)
        return _difference(np.stack([restart.position, self.position[frame]]), 1, rate)

    def export(
        self, path: Path | str, *, frame: int | None = None, overwrite: bool = False
    ) -> Path:
        """Write the frames that are ready, with the control nodes, the springs and the hands.

        Args:
            path: File to write; its suffix says how: ``.glb`` or ``.usd`` (skinned hands, nodes
                and surface, moving), ``.npz``, ``.csv`` or, for one frame, ``.ply``. A name without
                suffix is a folder of PLY files, one a frame.
            frame: The frame (PLY).
            overwrite: Whether to replace what is there.

        Returns:
            What was written.

        Raises:
            UsageError: If the suffix or frame does not exist, or the path is in use.
        """
        out = Path(path)
        if out.suffix not in _FORMATS:
            raise UsageError(
                f"{out.name} names no format; expected one of {', '.join(filter(None, _FORMATS))}, "
                "or no suffix for a folder of PLY files."
            )
        return export_scene(
            self.scene_data(), _FORMATS[out.suffix], out, frame=frame, overwrite=overwrite
        )

    def scene_data(self) -> SceneData:
        """Collect the frames that are ready with what `scene` knows of their surroundings."""
        count = self.ready
        motion = {
            "rollout": np.asarray(self.position[:count]),
            "control": np.asarray(self.control[:count]),
            "spring_nodes": self.model.spring_nodes,
            "object_spring_count": self.model.object_spring_count,
            "model": self.model.to_tensors() | self.restart_arrays(),
            "parameters": self.parameters.to_dict(),
            "dt": self.parameters.dt,
            "lay_surface": self.surface,
            "forces": self.forces,
        }
        if self.scene is None:
            rate = self.parameters.frame_rate
            return SceneData(sequence="", frame_rate=rate, length_unit="m", hands={}, **motion)
        scene = self.scene()
        return replace(
            scene,
            hands={
                side: replace(hand, vertex=hand.vertex[:count])
                for side, hand in scene.hands.items()
            },
            joints={side: joint[:count] for side, joint in scene.joints.items()},
            **motion,
        )

    def frame_distance(self, other: "ObjectRollout", frame: int) -> float:
        """Measure how far the nodes of a frame are from another rollout's, on average [m]."""
        offset = np.asarray(self.position[frame]) - np.asarray(other.position[frame])
        return float(np.linalg.norm(offset, axis=-1).mean())

    def mean_distance(self, other: "ObjectRollout") -> float:
        """Measure how far the ready frames are from another rollout, averaged over nodes [m]."""
        count = min(self.ready, other.ready)
        if count == 0 or self.position.shape[1:] != other.position.shape[1:]:
            return float("nan")
        offset = np.asarray(self.position[:count]) - np.asarray(other.position[:count])
        return float(np.linalg.norm(offset, axis=-1).mean())


def load_fitted(run: RunFolder, sequence_name: str) -> ObjectRollout | None:
    """Load the fitted rollout of a run with its model; None if the run has no object."""
    files = SequenceFiles(sequence_name)
    needed = files.rollout, files.control, files.model
    if not all(run.has(name) for name in needed):
        return None
    position = run.array(files.rollout)
    parameters = SimulationParameters.from_dict(run.yaml(PARAMETERS_FILE))
    if run.has(files.meta):
        # As the rollout was simulated: what is stored of the world is the profile's, not this one.
        meta = run.recording(sequence_name)
        parameters = parameters.in_world(
            frame_rate=float(meta["frame_rate"]),
            ground_height=meta.get("ground_height"),
            gravity=float(meta.get("gravity", parameters.gravity)),
        )
    with reading(run.out / files.model):
        model = SpringMassModel.from_tensors(run.tensors(files.model))
    start, restart = None, None
    if run.has(files.start):
        with reading(run.out / files.start):
            start = start_from_tensors(run.tensors(files.start), model.node_count)
    if run.has(files.restart):
        with reading(run.out / files.restart):
            restart = Restart.from_tensors(run.tensors(files.restart))
            restart.check_nodes(model.node_count)
    edits, unedited = (), None
    if run.has(files.edits):
        with reading(run.out / files.edits):
            edits = read_edits(run.out / files.edits)
        with reading(run.out / files.unedited):
            unedited = SpringMassModel.from_tensors(run.tensors(files.unedited))
    if not len(model.hand_face):
        # Runs that were stored before hands could push have the hands' surface beside the model.
        faces = stored_faces(run.out, sequence_name, model.control_count - model.pin_count)
        model = replace(model, hand_face=faces)
        unedited = None if unedited is None else replace(unedited, hand_face=faces)
    return ObjectRollout(
        model=model,
        parameters=parameters,
        control=run.array(files.control)[: len(position)],
        position=position,
        ready=len(position),
        start=start,
        restart=restart,
        edits=edits,
        unedited=unedited,
    )


def load_surface(
    run: RunFolder, fitted: ObjectRollout, views: Sequence[View] | Path
) -> ObjectSurface | None:
    """Lay the smooth surface of a run's object through its nodes, in the colors of frame 0.

    Args:
        run: Says what kind of object it is; without that the nodes tell.
        fitted: Rollout of its nodes.
        views: Views of the recording, or its folder, which may be gone; those with color and masks
            lend their colors.

    Returns:
        The surface, without colors if no view has any; None if the nodes have no surface.
    """
    shape = run.yaml(SHAPE_FILE) if run.has(SHAPE_FILE) else {}
    kind, width = shape.get("shape"), shape.get("thickness")
    surface = lay_surface(
        fitted.model.object_node,
        kind=kind if isinstance(kind, str) else None,
        thickness=width if isinstance(width, float) and width > 0.0 else None,
    )
    if surface is None:
        return None
    try:
        seen = Recording.load(views).views if isinstance(views, Path) else views
        return colored_surface(surface, fitted.position[0], seen)
    except PhysHandiError as error:  # What can be told of the object does not need a recording.
        logger.info("the surface of the object has no colors: %s", error)
        return surface


def _stops(substeps: int) -> tuple[int, int]:
    """Divide a frame's substeps into at least eight equal parts: how many, and substeps of each."""
    each = next((n for n in range(substeps // _FEWEST_STOPS, 1, -1) if substeps % n == 0), 1)
    return substeps // each, each


def _difference(
    point: Float[ndarray, "frame point 3"], frame: int, rate: float
) -> Float[ndarray, "point 3"]:
    """Velocity during the frame's substeps: from the frame before to this one [m/s]."""
    before, after = max(frame - 1, 0), max(frame, 1)
    after = min(after, len(point) - 1)
    return ((np.asarray(point[after]) - np.asarray(point[before])) * np.float32(rate)).astype(
        np.float32
    )
