"""Semi-implicit Euler rollouts of a spring-mass model; one launch or graph replay a frame."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
import warp as wp
from jaxtyping import Float, Float32
from numpy import ndarray

from physhandi.devices import start_warp
from physhandi.errors import SimulationDivergedError
from physhandi.simulation.engines.cpu import CpuEngine
from physhandi.simulation.engines.cuda import CudaEngine
from physhandi.simulation.engines.graph import LaunchGraph, SpringSums
from physhandi.simulation.engines.rod_force import RodForce
from physhandi.simulation.hand_contact import HandContact
from physhandi.simulation.kernels.integration import integrate_nodes
from physhandi.simulation.kernels.springs import pull_springs
from physhandi.simulation.kernels.world import World
from physhandi.simulation.model import SpringMassModel, checked_control
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.restart import NodeState, Restart
from physhandi.simulation.rod import Rod
from physhandi.simulation.self_collision import SelfCollision
from physhandi.simulation.stability import explain_divergence

NO_DIVERGENCE = np.iinfo(np.int32).max
"""Value of `Simulator.first_divergence` as long as no node has diverged."""
_WORLD: Any = World


@dataclass(frozen=True)
class Rollout:
    """The simulated motion of the object nodes; frame 0 is the initial state."""

    position: Float32[ndarray, "frame node 3"]
    """Positions in the world frame [m]."""
    velocity: Float32[ndarray, "frame node 3"]
    """Velocities in the world frame [m/s]."""


class Simulator:
    """Simulates one model; holds model and state on a device.

    An engine advances a frame in one launch; with self-collision, with hands that push, for a rope
    that bends, or where the engine does not fit, a frame is captured as a graph of two to five
    kernels a substep.
    Everything tunable lives in device arrays, so that both see changes. The same input gives the
    same bits, run after run.
    """

    def __init__(
        self, model: SpringMassModel, parameters: SimulationParameters, device: str = "cpu"
    ) -> None:
        """Place a model on a device.

        Args:
            model: Nodes, springs and material; not modified.
            parameters: Global parameters; radii and floors are already part of the model.
            device: Warp device to run on, for example ``"cuda:0"``.
        """
        start_warp()
        self.model = model
        self.parameters = parameters
        self.device = wp.get_device(device)
        self.rest_length = self.array(model.rest_length, wp.float32)
        self.stiffness = self.array(model.stiffness, wp.float32)
        self.damping = self.array(model.damping, wp.float32)
        self.clearance = self.array(model.clearance, wp.float32)
        self.world = wp.zeros(1, dtype=_WORLD, device=self.device)
        self.position = self.array(model.object_node, wp.vec3)
        self.velocity = self.array(model.initial_velocity, wp.vec3)
        self.control_start = wp.zeros(model.control_count, dtype=wp.vec3, device=self.device)
        self.control_end = wp.zeros(model.control_count, dtype=wp.vec3, device=self.device)
        self.first_divergence = self.array(np.array([NO_DIVERGENCE]), wp.int32)
        self._held: ndarray | None = None
        self._restart: Restart | None = None
        """What the simulation went on from, whose rules hold until it is reset."""
        self._no_tape = wp.zeros(0, dtype=wp.vec3, device=self.device)
        self._candidates = 0
        self._collision: SelfCollision | None = None
        self._hand_contact: HandContact | None = None
        self._recordings = {
            laws: LaunchGraph(self._launch_frame, self.device)
            for laws in product((False, True), repeat=2)
        }
        self.set_parameters(parameters)

    def set_parameters(self, parameters: SimulationParameters) -> None:
        """Change drag, contacts, ground, gravity, stiffness scale or control velocity.

        Args:
            parameters: The new values. Radii, floors, `stiffness` and `damping` belong to
                the model and are ignored.

        Raises:
            ValueError: If the length of a substep differs; build another simulator then.
        """
        old = self.parameters
        if (parameters.simulated_frame_rate, parameters.substeps_per_frame) != (
            old.simulated_frame_rate,
            old.substeps_per_frame,
        ):
            raise ValueError(
                "frame_rate and substeps_per_frame are fixed in a simulator; build a new one."
            )
        self.parameters = parameters
        restart = self._restart
        now = parameters if restart is None else restart.parameters_after(parameters)
        self.world.assign(world_array([now]))

    def override_world(self, **values: float) -> None:
        """Set fields of the kernels' `World` directly, bounds unchecked, until the next change."""
        world: Any = self.world.numpy()
        for name, value in values.items():
            world[name] = value
        self.world.assign(world)

    def set_material(
        self,
        *,
        stiffness: Float[ndarray, " spring"] | None = None,
        damping: Float[ndarray, " spring"] | None = None,
    ) -> None:
        """Change the stiffness [N] or damping [N·s/m] of every spring."""
        for name, value in (("stiffness", stiffness), ("damping", damping)):
            if value is None:
                continue
            if np.shape(value) != self.model.rest_length.shape:
                raise ValueError(
                    f"{name} has shape {np.shape(value)}; expected one value for each "
                    f"of the {len(self.model.rest_length)} springs."
                )
            changed: dict[str, Any] = {name: np.asarray(value, dtype=np.float32)}
            getattr(self, name).assign(changed[name])
            self._held = None
            self.model = replace(self.model, **changed)

    def set_rod(self, rod: Rod) -> None:
        """Change how a rope bends: its stiffness, its damping and its natural curvature."""
        if self.rod is None:
            raise ValueError("The model has no rod.")
        self.model = replace(self.model, rod=rod)
        self.rod.assign(rod)

    def reset(
        self,
        position: Float[ndarray, "node 3"] | None = None,
        velocity: Float[ndarray, "node 3"] | None = None,
    ) -> None:
        """Go back to the initial state, or to a given one, and to the model's rest lengths."""
        position = self.model.object_node if position is None else position
        velocity = self.model.initial_velocity if velocity is None else velocity
        self.position.assign(np.asarray(position, dtype=np.float32))
        self.velocity.assign(np.asarray(velocity, dtype=np.float32))
        self.rest_length.assign(self.model.rest_length)
        self.clearance.assign(self.model.clearance)
        self.first_divergence.fill_(NO_DIVERGENCE)
        self._follow(None)
        if self.hand_contact is not None:
            self.hand_contact.shift(None)
        if self.rod is not None:
            self.rod.reset()

    def continue_from(
        self,
        restart: Restart,
        position: Float[ndarray, "strained node 3"],
        control: Float[ndarray, "strained control 3"],
    ) -> tuple[Float32[ndarray, "control 3"] | None, Float32[ndarray, "node 3"] | None]:
        """Replace the state by another one, in which every spring is strained as it was until now.

        Args:
            restart: The state; its frame is the one that has been reached.
            position: Object nodes in its `strained_frames`, the last ones as they are now [m].
            control: Control nodes in them [m].

        Returns:
            What to add from now on to the control nodes, before they are given, and to the object
            nodes, to have where they are seen [m]; None for nothing.

        Raises:
            ValueError: If it is a state of another number of nodes.
        """
        restart.check_nodes(self.model.node_count)
        model = restart.continued(self.model, self.parameters, position, control)
        hand_shift = restart.hand_shift(self.model, position[-1])
        self.reset(restart.start_of_springs(position[-1]), restart.velocity)
        self.rest_length.assign(model.rest_length)
        self.clearance.assign(model.clearance)
        self._follow(restart)
        if self.hand_contact is not None:
            self.hand_contact.shift(hand_shift)
        return hand_shift, restart.node_shift(position[-1])

    def _follow(self, restart: Restart | None) -> None:
        """Have the rules of a restart hold from now on, or none."""
        before, self._restart = self._restart, restart
        if any(each is not None and each.friction_share != 1.0 for each in (before, restart)):
            self.set_parameters(self.parameters)

    def _let_grips_slip(self, frame: int, control: Float[ndarray, "control 3"]) -> None:
        """Change rest lengths as a restart lets grips slip at the end of a frame after its own.

        Args:
            frame: The frame that has been reached.
            control: Where virtual springs end now [m].
        """
        restart = self._restart
        if restart is None or restart.grip_strength == 0.0 or frame <= restart.frame:
            return
        before, now = self.rest_length.numpy(), self.position.numpy()
        after = restart.slipped(self.model, self.parameters, before, frame, now, control)
        if after is not before:
            self.rest_length.assign(after)

    def step_frame(
        self,
        frame: int,
        control_start: Float[ndarray, "control 3"],
        control_end: Float[ndarray, "control 3"],
        *,
        goes_on: bool = False,
    ) -> None:
        """Advance the state by one frame while the control nodes move on straight lines.

        Args:
            frame: Number of the frame that this reaches, which decides what is attached.
            control_start: Where the control nodes are at the start [m].
            control_end: Where they are at the end [m].
            goes_on: Whether this is a later part of what was begun, in which the nodes and
                triangles may touch that were near each other when it began.

        Raises:
            SimulationDivergedError: If a node is not finite or faster than `speed_limit`.
        """
        if self.model.control_count:
            self.control_start.assign(np.ascontiguousarray(control_start, dtype=np.float32))
            self.control_end.assign(np.ascontiguousarray(control_end, dtype=np.float32))
        if not goes_on:
            self._let_grips_slip(frame - 1, control_start)
        self.hold(frame)
        self.replay_frame(goes_on=goes_on)
        self.check_divergence(frame)

    def hold(self, frame: int) -> None:
        """Let the virtual springs act that are attached on the way to a frame, and no others."""
        if self.model.is_always_attached:
            return
        acts = self.model.acts_in(frame)
        if self._held is None or not np.array_equal(acts, self._held):
            self._held = acts
            self.stiffness.assign(self.model.stiffness * acts)
            self.damping.assign(self.model.damping * acts)

    def frames(
        self,
        control: Float[ndarray, "frame control 3"],
        restart: Restart | None = None,
        start: NodeState | None = None,
    ) -> Iterator[tuple[int, Float32[ndarray, "node 3"], Float32[ndarray, "node 3"]]]:
        """Simulate frame by frame from the initial state.

        Args:
            control: Positions of the control nodes in every frame [m]; its length decides how
                many frames there are, also when there are no control nodes.
            restart: State from which the frames after its own are simulated; see `continue_from`.
                Without one they follow from the initial state, as those up to it always do.
            start: The initial state, if it is not the model's.

        Yields:
            Frame, positions [m] and velocities [m/s]; frame 0 is the initial state.

        Raises:
            SimulationDivergedError: If a node is not finite or faster than `speed_limit`.
            ValueError: If the control nodes or the restart do not fit the model.
        """
        control = self.checked_control(control)
        if restart is not None:
            restart.check_nodes(self.model.node_count)
        self.reset(*(start or ()))
        hand_shift: ndarray | None = None
        node_shift: ndarray | None = None
        strained = range(0) if restart is None else restart.strained_frames
        own: list[ndarray] = []
        for frame in range(len(control)):
            if frame > 0:
                way = control[frame - 1 : frame + 1]
                self.step_frame(frame, *(way if hand_shift is None else way + hand_shift))
            position = self.position.numpy().copy()
            if frame in strained:
                own.append(position)
            if node_shift is not None:
                position += node_shift
            yield frame, position, self.velocity.numpy().copy()
            if restart is not None and frame == restart.frame:
                strain = np.stack(own), control[strained]
                hand_shift, node_shift = self.continue_from(restart, *strain)

    def rollout(
        self, control: Float[ndarray, "frame control 3"], restart: Restart | None = None
    ) -> Rollout:
        """Simulate all frames of a control trajectory; see `frames`."""
        control = self.checked_control(control)
        shape = (len(control), self.model.node_count, 3)
        position = np.empty(shape, dtype=np.float32)
        velocity = np.empty(shape, dtype=np.float32)
        for frame, frame_position, frame_velocity in self.frames(control, restart):
            position[frame] = frame_position
            velocity[frame] = frame_velocity
        return Rollout(position, velocity)

    def checked_control(self, control: Float[ndarray, "frame control 3"]) -> ndarray:
        """Return the control trajectory, or raise `ValueError` if it does not fit the model."""
        return checked_control(control, self.model.control_count)

    def replay_frame(self, *, goes_on: bool = False) -> None:
        """Advance the state on the device by one frame, with the controls on the device.

        Args:
            goes_on: As for `step_frame`.
        """
        if not self.has_contacts and self.engine is not None:
            state = self.position, self.velocity
            self.engine.advance(state, state)
            return
        # Arrays of the launches cannot be allocated during capture.
        _ = self.sums, self.rod
        if not goes_on:
            self._candidates = self.find_candidates(self.position)
        laws = self.collision is not None, self.hand_contact is not None
        self._recordings[laws].replay(self._candidates)

    @property
    def has_contacts(self) -> bool:
        """Whether nodes collide with each other or with hands, which no engine computes."""
        return self.collision is not None or self.hand_contact is not None

    @cached_property
    def engine(self) -> CudaEngine | CpuEngine | None:
        """Engine for frames without such contacts, if one fits; built on first use."""
        if self.model.rod is not None:
            return None
        return CudaEngine.of(self) or CpuEngine.of(self)

    @cached_property
    def sums(self) -> SpringSums:
        """Springs as the captured kernels read them; built on first use."""
        return SpringSums(self.model, self.device)

    @cached_property
    def rod(self) -> RodForce | None:
        """Bending forces of the object, if it is a rope; built on first use."""
        return None if self.model.rod is None else RodForce(self.model, self.device)

    @property
    def material(self) -> tuple[wp.array, wp.array, wp.array]:
        """Rest length, stiffness and damping of every spring."""
        return self.rest_length, self.stiffness, self.damping

    @property
    def controls(self) -> tuple[wp.array, wp.array]:
        """Positions of the control nodes at the start and the end of the frame [m]."""
        return self.control_start, self.control_end

    @property
    def collision(self) -> SelfCollision | None:
        """Self-collision of the object nodes; None while it is switched off."""
        if not self.parameters.self_collision:
            return None
        if self._collision is None:
            self._collision = SelfCollision(self.model.object_node, self.clearance, self.world)
        return self._collision

    @property
    def hand_contact(self) -> HandContact | None:
        """Surface of the hands that pushes nodes; None while off, or if there is no surface."""
        if not self.parameters.hand_pushes or not len(self.model.hand_face):
            return None
        if self._hand_contact is None:
            rate = self.parameters.simulated_frame_rate
            self._hand_contact = HandContact(self.model, self.world, rate)
        return self._hand_contact

    def find_candidates(self, position: wp.array) -> int:
        """Find which nodes may collide in the frame that starts at `position`, and with what.

        Returns:
            A number that changes when launches on the candidates must be recorded again.

        Raises:
            SimulationError: If there are too many.
        """
        if self.hand_contact is not None:
            self.hand_contact.find(position, self.control_start, self.stiffness)
        collision = self.collision
        if collision is None:
            return 0
        return collision.find(position, self.parameters.collision_distance)

    def spring_inputs(self, fraction: float, state: tuple[wp.array, wp.array]) -> list[Any]:
        """List the inputs of a spring kernel, a `fraction` of a frame after its start."""
        model = [self.world, self.sums.spring_nodes, *self.material]
        return [fraction, *model, *state, *self.controls]

    def launch_substep(
        self,
        substep: int,
        before: tuple[wp.array, wp.array],
        after: tuple[wp.array, wp.array],
        free_velocity: wp.array | None = None,
        contact_velocity: wp.array | None = None,
    ) -> None:
        """Launch the kernels of one substep, from one state (position, velocity) to another.

        Args:
            substep: Its number in the frame.
            before: NodeState at its start.
            after: Receives the state at its end; with self-collision, in another position array.
            free_velocity: Receives the velocity before all contacts, for the adjoint.
            contact_velocity: Receives the velocity after self-collision and before the ground;
                used with self-collision only.
        """
        fraction = (substep + 1) / self.parameters.substeps_per_frame
        rows = self.launch_springs(fraction, before)
        if self.hand_contact is not None:
            rows = self.hand_contact.launch_push(fraction, rows, before, self.controls)
        start, entry, value = rows
        collision = self.collision
        if collision is not None:
            collision.launch_free(start, entry, before[1], value, free_velocity)
            tape = self._no_tape if contact_velocity is None else contact_velocity
            outputs = [tape, *after, self.first_divergence]
            collision.launch_collide(substep, before[0], free_velocity, outputs)
            return
        tape = self._no_tape if free_velocity is None else free_velocity
        wp.launch(
            integrate_nodes,
            dim=self.model.node_count,
            inputs=[substep, self.world, self.clearance, start, entry, *before, value],
            outputs=[tape, *after, self.first_divergence],
            device=self.device,
        )

    def launch_springs(
        self, fraction: float, state: tuple[wp.array, wp.array]
    ) -> tuple[wp.array, wp.array, wp.array]:
        """Launch the forces of springs, and of a rope that bends, a `fraction` of a frame on.

        Returns:
            Sums of the forces, as arguments of `spring_sum`.
        """
        wp.launch(
            pull_springs,
            dim=len(self.model.spring_nodes),
            inputs=self.spring_inputs(fraction, state),
            outputs=[self.sums.pull],
            device=self.device,
        )
        if self.rod is not None:
            self.rod.launch(fraction, self.world, [*state, *self.controls], self.sums.pull)
        return self.sums.of(self.sums.pull, self.sums.row_pull)

    def check_divergence(self, frame: int) -> None:
        """Raise `SimulationDivergedError` if the last frame recorded a divergence."""
        first = int(self.first_divergence.numpy()[0])
        if first == NO_DIVERGENCE:
            return
        substep, node = divmod(first, self.model.node_count)
        material = {
            name: getattr(self, name).numpy() for name in ("rest_length", "stiffness", "damping")
        }
        model = replace(self.model, **material)
        raise SimulationDivergedError(
            f"Simulation diverged at frame {frame}, substep {substep}: node {node} is not finite "
            f"or faster than {self.parameters.speed_limit:g} m/s. "
            + explain_divergence(model, self.parameters, node),
            frame=frame,
            substep=substep,
            node=node,
        )

    def array(self, value: ndarray, dtype: Any) -> wp.array:
        """Copy an array to the device."""
        return wp.array(np.ascontiguousarray(value), dtype=dtype, device=self.device)

    def _launch_frame(self) -> None:
        # Colliding nodes read each other's positions, so the new ones need another array.
        collision = self.collision
        places = (self.position, self.position if collision is None else collision.position)
        count = self.parameters.substeps_per_frame
        for substep in range(count):
            before, after = places[substep % 2], places[(substep + 1) % 2]
            self.launch_substep(substep, (before, self.velocity), (after, self.velocity))
        if places[count % 2] is not self.position:
            wp.copy(self.position, places[count % 2])


def world_array(parameters: Sequence[SimulationParameters]) -> ndarray:
    """Give the kernels' `World` of each simulation."""
    worlds: Any = np.zeros(len(parameters), dtype=_WORLD.numpy_dtype())
    for index, each in enumerate(parameters):
        height, rate = each.ground_height, each.simulated_frame_rate
        values: dict[str, float] = {
            "dt": each.dt,
            "velocity_loss": each.velocity_loss(),
            "gravity": each.gravity,
            "has_ground": height is not None,
            "ground_height": 0.0 if height is None else height,
            "restitution": each.restitution,
            "friction": each.friction,
            "stiffness_scale": each.stiffness_scale,
            "control_rate": rate if each.use_control_velocity else 0.0,
            "collision_distance": each.collision_distance,
            "self_restitution": each.self_restitution,
            "self_friction": each.self_friction,
            "collides_rest_neighbors": each.collides_rest_neighbors,
            "push_stiffness": each.push_stiffness,
            "hand_friction": each.hand_friction,
            "speed_limit": each.speed_limit,
        }
        for name, value in values.items():
            worlds[name][index] = value
    return worlds
