"""The object that a run fitted: simulated again with other parameters, or in another recording."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from jaxtyping import Float
from numpy import ndarray

from physhandi.data.exporters.scene_data import MovingSurface, SceneData, read_scene
from physhandi.data.layout import MATERIAL_FILE, SequenceFiles
from physhandi.data.run import RunFolder
from physhandi.data.run_folder import reading
from physhandi.data.sequence import Sequence as Recording
from physhandi.errors import MissingInputError, RunError, UsageError
from physhandi.fitting.stored_take import keeps_springs
from physhandi.object_rollout import ObjectRollout, load_fitted, load_surface
from physhandi.progress import Progress, Watcher, watched
from physhandi.settings import changes as changed_settings
from physhandi.simulation.contact_intervals import ContactIntervals, always
from physhandi.simulation.edits import (
    Edit,
    Edits,
    apply_edits,
    checked_edits,
    keeps_what_is_joined,
)
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.object_surface import ObjectSurface
from physhandi.simulation.parameters import (
    SimulationParameters,
    changed_parameters,
    parameter_names,
)
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.stability import (
    largest_stable_step,
    stable_substeps,
    with_stable_substeps,
)
from physhandi.simulation.topology import retopologize, virtual_floor, virtual_springs

if TYPE_CHECKING:
    from torch import Tensor

    from physhandi.fitting.placement import PlacedObject

_MATERIAL = parameter_names("material")
_BUILT_IN = parameter_names("material", "topology")
"""Parameters that are built into the model; the others are read by the simulator."""
_STEP = parameter_names("step")


ROLLOUT = "rollout"
"""Stage name of an object's simulation in progress reports."""

Frame = tuple[int, Float[ndarray, "node 3"], Float[ndarray, "node 3"]]


class FittedObject:
    """A fitted object in one of its sequences; everything that simulates a stored run does it here.

    `simulate` is for scripts. What shows frames as they come calls `begin` and then `fill`.
    """

    def __init__(
        self,
        fitted: ObjectRollout,
        *,
        attachment: Float[ndarray, "control 3"] | None = None,
        rest_node: Float[ndarray, "node 3"] | None = None,
        contacts: ContactIntervals | None = None,
        keeps_springs: bool = False,
        run: RunFolder | None = None,
        sequence: str = "",
    ) -> None:
        """Hold an object.

        Args:
            fitted: Its springs, parameters and control nodes; the motion may be missing.
            attachment: Where the control nodes were when the virtual springs were laid [m];
                frame 0 of the control nodes, unless refinement has moved the hands since.
            rest_node: Its rest shape [m]; frame 0 if left out.
            contacts: What the control nodes hold, and when; if left out, what is near them at
                frame 0, always.
            keeps_springs: Whether its springs cannot be laid anew, since they were edited before
                it was steered.
            run: Run that it was fitted in.
            sequence: Name of the sequence.
        """
        self.fitted = fitted
        """The rollout that was fitted: springs, parameters, controls and motion."""
        self.run = run
        self.sequence = sequence
        self.rest_node = rest_node
        self.contacts = contacts
        self._keeps_springs = keeps_springs
        self.placement: PlacedObject | None = None
        """Placement of the object in a recording that it was not fitted in."""
        self._unedited = fitted.model if fitted.unedited is None else fitted.unedited
        everything = np.ascontiguousarray(fitted.control, dtype=np.float32)
        self._all_controls = np.ascontiguousarray(everything[:, : self._unedited.control_count])
        self._control = self._all_controls
        self._all_attached = self._all_controls[0] if attachment is None else attachment
        self._attached = self._all_attached
        self._chosen: tuple[int, ...] | None = None
        self._latest: tuple[tuple[float, ...], SpringMassModel] | None = None
        self._edited: tuple[SpringMassModel, Edits, SpringMassModel] | None = None
        self._simulator: Simulator | None = None
        self._limit: tuple[SpringMassModel, tuple[float, float], float] | None = None

    @classmethod
    def of(cls, run: RunFolder | Path | str, sequence: str | None = None) -> "FittedObject":
        """Load the object of a run.

        Args:
            run: The run, or its folder.
            sequence: One of the run's sequences; the first one if left out.

        Raises:
            MissingInputError: If the run has no fitted object for that sequence.
            RunError: If it is no run, or a file is missing or damaged.
        """
        folder = run if isinstance(run, RunFolder) else RunFolder.open(run)
        name = folder.sequence_names[0] if sequence is None else sequence
        fitted = load_fitted(folder, name)
        if fitted is None:
            raise MissingInputError(
                f"Run '{folder.name}' has no fitted object for sequence '{name}' to simulate."
            )
        wrong = np.argwhere(~np.isfinite(fitted.control))
        if len(wrong):
            raise RunError(
                f"{folder.out / SequenceFiles(name).control} is not finite at frame {wrong[0][0]}, "
                f"control {wrong[0][1]}. Run it again."
            )
        attachment = SequenceFiles(name).attachment
        rest = folder.tensors(MATERIAL_FILE) if folder.has(MATERIAL_FILE) else {}
        contacts = None
        if folder.has(file := SequenceFiles(name).contacts):
            with reading(folder.out / file):
                contacts = ContactIntervals.from_tensors(folder.tensors(file))
        loaded = cls(
            fitted,
            attachment=folder.array(attachment) if folder.has(attachment) else None,
            rest_node=rest.get("rest_node"),
            contacts=contacts,
            keeps_springs=keeps_springs(folder),
            run=folder,
            sequence=name,
        )
        fitted.scene, fitted.surface = loaded.scene, loaded.surface
        return loaded

    def __repr__(self) -> str:
        count = self.fitted.model.node_count, len(self.fitted.model.spring_nodes)
        return f"FittedObject({self.sequence!r}, {count[0]} nodes, {count[1]} springs)"

    @property
    def parameters(self) -> SimulationParameters:
        """The fitted parameters, in the world of the sequence."""
        return self.fitted.parameters

    @property
    def model(self) -> SpringMassModel:
        """The fitted nodes and springs; each spring has a stiffness and a damping of its own."""
        return self.fitted.model

    @property
    def edits(self) -> Edits:
        """Edits of single springs and nodes of the model, in their order."""
        return self.fitted.edits

    def begin(
        self,
        parameters: SimulationParameters,
        *,
        controls: Sequence[int] | None = None,
        automatic_substeps: bool = False,
        edits: Edits | None = None,
    ) -> ObjectRollout:
        """Prepare a rollout with other parameters: springs are built anew, scaled, or kept.

        Args:
            parameters: What to simulate with.
            controls: Numbers of the control nodes that hold the object; none for all. With some
                of them the object's own springs stay as fitted, whatever the parameters say.
            automatic_substeps: Whether to choose as few substeps as are stable and fine enough.
            edits: All that is done to single springs and nodes, in the place of the object's own
                edits; left out, it is these.

        Returns:
            A rollout of which no frame is ready; see `fill`. It restarts where the fitted one
            does: in the same observed state, with rest lengths that keep its own strain. It does
            not if edits change what is joined or held.

        Raises:
            UsageError: If an edit cannot be made (says which), or hands shall push that have no
                surface.
        """
        if parameters.hand_pushes and not len(self._unedited.hand_face):
            raise UsageError(
                "hand_pushes needs the surface of a hand, but the control nodes of this object are "
                "single points. Leave it off."
            )
        self._choose_controls(controls)
        edits = self.edits if edits is None else edits
        unedited = self._model(parameters)
        model = self._with_edits(unedited, parameters, edits)
        control = model.with_pins(self._control)
        if automatic_substeps:
            parameters = with_stable_substeps(parameters, model, control[0])
        fitted = self.fitted
        restart = fitted.restart if keeps_what_is_joined(edits) else None
        rollout = ObjectRollout.empty(model, parameters, control, restart, fitted.start)
        if edits:
            rollout.edits, rollout.unedited = edits, unedited
        rollout.scene, rollout.surface = self.fitted.scene, self.fitted.surface
        return rollout

    def fill(self, rollout: ObjectRollout, device: str = "cpu") -> Iterator[Frame]:
        """Simulate a rollout that `begin` prepared.

        Args:
            rollout: Its frames are filled one after the other.
            device: Warp device.

        Returns:
            Gives each frame when it is ready: its number, positions [m] and velocities [m/s];
            frame 0 is the initial state.

        Raises:
            SimulationDivergedError: If the motion runs away.
        """
        return _filled(rollout, self._placed(rollout.model, rollout.parameters, device))

    def needed_substeps(self, rollout: ObjectRollout) -> int:
        """Estimate the fewest substeps a frame that a rollout survives, without any margin."""
        model, parameters = rollout.model, rollout.parameters
        push = parameters.push_stiffness if parameters.hand_pushes else 0.0
        latest, loads = self._limit, (parameters.stiffness_scale, push)
        if latest is None or latest[0] is not model or latest[1] != loads:
            step = largest_stable_step(model, parameters, rollout.control[0])
            latest = self._limit = (model, loads, step)
        return max(1, math.ceil(1.0 / (parameters.simulated_frame_rate * latest[2])))

    def simulate(
        self,
        *,
        sequence: Recording | None = None,
        device: str = "cpu",
        progress: Watcher = None,
        edits: Sequence[Edit] | None = None,
        **changes: Any,
    ) -> ObjectRollout:
        """Simulate all frames, with some parameters changed or in another recording.

        Args:
            sequence: A recording of the same object; its hands are reconstructed and the object is
                laid into its first frame. Left out, it is the one that the object was fitted in,
                where predicted frames start from the observed state if those of the run do.
            device: Warp device, such as ``"cuda:0"``.
            progress: True shows a bar, a callable is given stage, iteration, total, loss and
                message.
            edits: What is done to single springs and nodes (`physhandi.simulation.edits`), in the
                place of the object's own edits; left out, it is these.
            changes: New values of simulation parameters (`SimulationParameters`), such as
                ``stiffness_scale=0.3``; ``substeps_per_frame="auto"`` chooses as few as are stable.

        Returns:
            The motion: ``position`` [m], ``velocity`` [m/s], ``forces(frame)`` [N], ``export``.

        Raises:
            UsageError: If a parameter is unknown or out of bounds, or leaves no spring.
            MissingInputError: If the recording lacks what moves or shows the object.
            SimulationDivergedError: If the motion runs away.
        """
        with watched(progress) as watch:
            target = self if sequence is None else self.placed_in(sequence, watch)
            rollout = target.changed(changes, edits)
            for frame, _, _ in target.fill(rollout, device):
                watch.check_cancelled()
                watch.report(ROLLOUT, frame + 1, rollout.frame_count)
        return rollout

    def changed(
        self, changes: Mapping[str, Any], edits: Sequence[Edit] | None = None
    ) -> ObjectRollout:
        """Prepare a rollout with some parameters changed; see `simulate`.

        Raises:
            UsageError: If a parameter is unknown or out of bounds, or leaves no spring, or an edit
                cannot be made.
        """
        from physhandi.fitting.object_reconstruction import check_springs

        parameters, is_automatic = changed_parameters(self.parameters, changes)
        wanted = self.edits if edits is None else checked_edits(edits)
        if self.placement is not None:
            self._refuse_of_recording(wanted)
        rollout = self.begin(parameters, automatic_substeps=is_automatic, edits=wanted)
        rest = self.model.object_node if self.rest_node is None else self.rest_node
        laid = rollout.model if rollout.unedited is None else rollout.unedited
        check_springs(self.sequence, laid, parameters, self._attached, rest, self.contacts)
        if self.placement is not None and "substeps_per_frame" not in changes:
            needed = stable_substeps(rollout.model, parameters, rollout.control[0])
            count = max(needed, parameters.substeps_per_frame)
            rollout.parameters = parameters.replace(substeps_per_frame=count)
        return rollout

    def placed_in(self, sequence: Recording, progress: Progress) -> "FittedObject":
        """Lay the object into another recording; see `simulate`.

        The fit's substeps are kept there if they are stable, and raised to what is if not.
        """
        from physhandi.fitting.placement import place_object

        if self.run is None:
            raise RunError("The object belongs to no run, so its settings are not known.")
        if self.run.holds(sequence):
            return self if sequence.name == self.sequence else self.of(self.run, sequence.name)
        rest = self.model.object_node if self.rest_node is None else self.rest_node
        fitted = self._unedited, self.parameters, rest
        placed = place_object(self.run, sequence, fitted, progress)
        empty = ObjectRollout.empty(placed.model, placed.parameters, placed.control)
        empty.scene = partial(_scene_of, sequence, placed, empty)
        empty.surface = self.fitted.surface
        empty.edits, empty.unedited = self.edits, placed.model
        other = FittedObject(empty, rest_node=rest, run=self.run, sequence=sequence.name)
        other.placement = placed
        return other

    def rollout(
        self,
        *,
        log_stiffness: "Tensor | None" = None,
        log_virtual_stiffness: "Tensor | None" = None,
        log_damping: "Tensor | None" = None,
        control: "Tensor | None" = None,
        device: str = "cpu",
        **values: Any,
    ) -> "Tensor":
        """Simulate the fitted springs so that PyTorch can differentiate the motion.

        What is left out has its fitted value, so that ``rollout(log_stiffness=log(x))`` moves as
        ``simulate(stiffness=x)`` does, but it does not restart: all frames follow from the initial
        state. To predict, give `initial_position`, `initial_velocity` and the control nodes from a
        frame after ``fitted.restart.frame`` on, all as ``fitted.going_on(frame)`` tells, and
        ``friction`` of ``fitted.parameters_in(frame + 1)`` to a `FittedObject` of the model that it
        gives.

        Args:
            log_stiffness: Natural logarithm of the stiffness [log N]. One number is that of
                ``parameters.stiffness``: each object spring keeps its ratio to it. One number a
                spring, in the order of ``model.spring_nodes``, is the stiffness of each.
            log_virtual_stiffness: The same for ``parameters.virtual_stiffness`` and the virtual
                springs; one number.
            log_damping: Natural logarithm of the damping [log N·s/m], of ``parameters.damping`` or
                of each spring.
            control: Control nodes in every frame [m]; fewer frames make a shorter rollout.
            device: Warp device; the result is where `control` is, else on the CPU.
            values: ``drag``, ``restitution``, ``friction``, ``self_restitution``,
                ``self_friction``, ``initial_position``, ``initial_velocity``, ``window`` and
                ``memory`` of `physhandi.simulation.differentiable.rollout`.

        Returns:
            Object node positions in every frame [m].

        Raises:
            SimulationDivergedError: If the motion runs away.
            UsageError: If a value does not fit the object.
        """
        import torch

        from physhandi.simulation import differentiable

        model, parameters = self.model, self.parameters
        own, total = model.object_spring_count, len(model.stiffness)
        stiffness = _logarithms(
            "log_stiffness", log_stiffness, model.stiffness, slice(0, own), parameters.stiffness
        )
        virtual = _logarithms(
            "log_virtual_stiffness",
            log_virtual_stiffness,
            model.stiffness,
            slice(own, total),
            parameters.virtual_stiffness,
        )
        if stiffness is not None and virtual is not None:
            stiffness = torch.cat([stiffness[:own], virtual[own:]])
        elif virtual is not None:
            stiffness = virtual
        damping = _logarithms(
            "log_damping", log_damping, model.damping, slice(0, total), parameters.damping
        )
        try:
            position, _ = differentiable.rollout(
                model,
                parameters,
                torch.tensor(model.with_pins(self._all_controls)) if control is None else control,
                log_stiffness=stiffness,
                damping=None if damping is None else damping.exp(),
                device=device,
                **values,
            )
        except (TypeError, ValueError) as error:
            raise UsageError(f"The rollout cannot be simulated: {error}.") from error
        return position

    def scene(self) -> SceneData:
        """Read the hands and names of the sequence, which are exported with a motion.

        Raises:
            RunError: If the object belongs to no run, or a file is damaged.
        """
        if self.run is None:
            raise RunError("The object belongs to no run, so nothing is known of its hands.")
        return read_scene(self.run, self.sequence)

    def surface(self) -> ObjectSurface | None:
        """Lay the object's smooth surface, in the colors of its recording if that is still there.

        Returns:
            None if the object belongs to no run, or its nodes have no surface.
        """
        run = self.run
        if run is None:
            return None
        recording = Path(run.sequences[run.sequence_names.index(self.sequence)])
        return load_surface(run, self.fitted, recording)

    def _refuse_of_recording(self, edits: Edits) -> None:
        """Refuse edits that belong to the recording in which they were made."""
        for number, edit in enumerate(edits, start=1):
            if edit.is_of_recording:
                raise UsageError(
                    f"Edit {number} ({edit.title}) belongs to the recording in which it was made, "
                    f"and '{self.sequence}' is another one. Leave it out."
                )

    def _with_edits(
        self, model: SpringMassModel, parameters: SimulationParameters, edits: Edits
    ) -> SpringMassModel:
        """Apply edits to a model, unless that was done just now; stored ones are applied once."""
        fitted = self.fitted
        if not edits:
            return model
        if model is self._unedited and edits == fitted.edits and self.placement is None:
            return fitted.model
        latest = self._edited
        if latest is None or latest[0] is not model or latest[1] != edits:
            edited = apply_edits(model, edits, parameters, self.rest_node)
            latest = self._edited = (model, edits, edited)
        return latest[2]

    def _choose_controls(self, chosen: Sequence[int] | None) -> None:
        wanted = None if chosen is None else tuple(chosen)
        if wanted != self._chosen:
            self._chosen, self._latest = wanted, None
            everything = self._all_controls
            self._control = everything if wanted is None else everything[:, list(wanted)].copy()
            attached = self._all_attached
            self._attached = attached if wanted is None else attached[list(wanted)].copy()

    def _model(self, parameters: SimulationParameters) -> SpringMassModel:
        """Build the springs for other parameters, keeping what was fitted."""
        key = tuple(getattr(parameters, name) for name in _BUILT_IN)
        if self._latest is None or self._latest[0] != key:
            self._latest = (key, self._build(parameters))
        return self._latest[1]

    def _build(self, parameters: SimulationParameters) -> SpringMassModel:
        fitted, model = self.parameters, self._unedited
        is_changed = set(_BUILT_IN) & set(changed_settings(fitted, parameters))
        if self._keeps_springs and (self._chosen is not None or not is_changed <= set(_MATERIAL)):
            raise UsageError(
                "Springs or nodes of this object were edited before it was steered, so that its "
                "springs cannot be laid anew: leave radii and neighbors as they are, or change "
                "them in the run that was steered."
            )
        if self._chosen is not None:
            return _hold_anew(model, parameters, self._attached, self._chosen)
        if is_changed <= set(_MATERIAL):
            return _scale_material(model, fitted, parameters) if is_changed else model
        return retopologize(
            model,
            parameters,
            self._attached,
            fitted=fitted,
            rest_node=self.rest_node,
            contacts=self.contacts,
        )

    def _placed(
        self, model: SpringMassModel, parameters: SimulationParameters, device: str
    ) -> Simulator:
        """Place a model on the device, or use it again if it is there already."""
        latest = self._simulator
        if (
            latest is not None
            and latest.model is model
            and latest.device == wp.get_device(device)
            and not set(_STEP) & set(changed_settings(latest.parameters, parameters))
        ):
            latest.set_parameters(parameters)
            return latest
        self._simulator = Simulator(model, parameters, device=device)
        return self._simulator


def _filled(rollout: ObjectRollout, simulator: Simulator) -> Iterator[Frame]:
    for frame, position, velocity in simulator.frames(
        rollout.control, rollout.restart, rollout.start
    ):
        rollout.position[frame] = position
        if rollout.velocity is not None:
            rollout.velocity[frame] = velocity
        rollout.ready = frame + 1
        yield frame, position, velocity


def _logarithms(
    name: str, given: "Tensor | None", fitted: ndarray, part: slice, reference: float
) -> "Tensor | None":
    """Give the logarithm for each spring of a value for all of them, or for each.

    Args:
        name: What the user calls it.
        given: What the user gave.
        fitted: Value of each spring.
        part: Springs that one value is about.
        reference: Value for all of them that the fitted ones belong to.
    """
    import torch

    if given is None:
        return None
    if given.ndim == 0:
        least = np.finfo(np.float32).tiny
        log = torch.tensor(np.log(np.maximum(fitted, least)), device=given.device)
        offset = torch.zeros_like(log)
        offset[part] = 1.0
        if reference > 0.0:
            return log + offset * (given - math.log(reference))
        return torch.where(offset > 0.0, given, log)
    if name == "log_virtual_stiffness" or given.shape != fitted.shape:
        each = "" if name == "log_virtual_stiffness" else f", or one for each of {len(fitted)}"
        raise UsageError(f"{name} has shape {tuple(given.shape)}; expected one number{each}.")
    return given


def _scene_of(sequence: Recording, placed: "PlacedObject", rollout: ObjectRollout) -> SceneData:
    """Describe a recording, with its hands, for the export of a motion in it."""
    from physhandi.hand.loading import load_hand_model
    from physhandi.hand.skin import hand_skin

    motions = () if placed.hands is None else placed.hands.motions
    models = {motion.side: load_hand_model(motion.side, motion.model) for motion in motions}
    return SceneData(
        sequence=sequence.name,
        frame_rate=sequence.frame_rate,
        length_unit=sequence.length_unit,
        rollout=rollout.position,
        control=rollout.control,
        spring_nodes=rollout.model.spring_nodes,
        object_spring_count=rollout.model.object_spring_count,
        hands={
            m.side: MovingSurface(
                vertex=m.vertices(models[m.side]).astype(np.float32),
                face=np.asarray(models[m.side].faces, np.int32),
            )
            for m in motions
        },
        joints={m.side: m.keypoints(models[m.side]).astype(np.float32) for m in motions},
        skins={m.side: hand_skin(models[m.side], m).to_tensors() for m in motions},
    )


def _scale_material(
    model: SpringMassModel, fitted: SimulationParameters, parameters: SimulationParameters
) -> SpringMassModel:
    """Scale stiffness and damping of the springs as the parameters for all of them changed."""

    def scaled(value: ndarray, field: str) -> ndarray:
        was, now = getattr(fitted, field), getattr(parameters, field)
        if was == now:
            return value
        return value * np.float32(now / was) if was > 0 else np.full_like(value, now)

    own, virtual = np.split(model.stiffness, [model.object_spring_count])
    stiffness = [scaled(own, "stiffness"), scaled(virtual, "virtual_stiffness")]
    return replace(
        model,
        stiffness=np.concatenate(stiffness),
        damping=scaled(model.damping, "damping"),
    )


def _hold_anew(
    model: SpringMassModel,
    parameters: SimulationParameters,
    control_0: Float[ndarray, "control 3"],
    chosen: tuple[int, ...],
) -> SpringMassModel:
    """Join an object to some of its control nodes: its own springs stay, the virtual ones are new.

    They are laid at frame 0, for all frames. A rope bends only if the node that says how it is held
    is among them.
    """
    rod = model.rod
    if rod is not None:
        is_held = rod.held_by in chosen
        rod = replace(rod, held_by=chosen.index(rod.held_by)) if is_held else None
    springs, length = virtual_springs(
        control_0.astype(np.float64),
        model.object_node.astype(np.float64),
        parameters.virtual_connection_radius,
        parameters.virtual_max_neighbors,
    )
    floor = virtual_floor(parameters)
    own = slice(0, model.object_spring_count)

    def joined(fitted: ndarray, new: ndarray | float) -> ndarray:
        extra = np.broadcast_to(np.asarray(new, dtype=np.float32), (len(springs),))
        return np.concatenate([fitted[own], extra])

    return replace(
        model,
        spring_nodes=np.concatenate([model.spring_nodes[own], springs]),
        rest_length=joined(model.rest_length, np.maximum(length, floor)),
        stiffness=joined(model.stiffness, parameters.virtual_stiffness),
        damping=joined(model.damping, parameters.damping),
        control_count=len(control_0),
        attached=always(len(springs)),
        hand_face=model.hand_face_of(np.array(chosen, np.int64)),
        rod=rod,
    )
