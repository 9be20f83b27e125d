"""Places a fitted object and its control nodes in a recording.

`place_object` does so in a recording that the object was not fitted in; the pipeline uses the parts
for the recordings of a run.
"""

from collections.abc import Sequence as Listing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Int32
from numpy import ndarray

from physhandi.data.attempt import Attempt
from physhandi.data.checkpoint import Checkpointer
from physhandi.data.hand_surface import joined_faces
from physhandi.data.layout import SequenceFiles
from physhandi.data.observation import ObjectObservation
from physhandi.data.run import RunFolder
from physhandi.data.sequence import Sequence
from physhandi.data.view import View
from physhandi.errors import FitError, MissingInputError, RunError
from physhandi.fitting import artefacts
from physhandi.fitting.config import PipelineConfig
from physhandi.fitting.hand_reconstruction import HandFit, reconstruct_hands
from physhandi.fitting.hand_refinement import RefinedHands, RefinementProblem, refine_hands
from physhandi.fitting.hands.agreement import believed_keypoints
from physhandi.fitting.hands.observed import keypoint_target
from physhandi.fitting.hands.wrist_guess import template_keypoints
from physhandi.fitting.object_problem import ObjectProblem, initial_velocity
from physhandi.fitting.rest_state import hold_still, rest_in_place, resting_clearance
from physhandi.fitting.rope.bending import gripped
from physhandi.hand.loading import load_hand_model
from physhandi.hand.model import HandModel
from physhandi.hand.motion import HandMotion, control_trajectory
from physhandi.perception.lifting import observe_object
from physhandi.perception.registration import bend_object, lay_object
from physhandi.perception.shape import ObjectShape, shape_of_nodes, shape_of_observation
from physhandi.progress import Progress
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.topology import retopologize
from physhandi.triangles import vertex_normals

LEAST_CLOUD = 10
"""Object points that frame 0 must show for the object to be located."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacedObject:
    """A known object in a recording that it was not fitted in."""

    hands: HandFit | None
    """The hands of the recording; None if it shows none."""
    observation: ObjectObservation
    """Observation of the object."""
    control: Float[ndarray, "frame control 3"]
    """Control nodes [m]."""
    model: SpringMassModel
    """The object at frame 0, with its fitted springs and new virtual ones."""
    parameters: SimulationParameters
    """The fitted ones, in the world of the recording."""


def settings_of_fit(run: RunFolder) -> PipelineConfig:
    """Read the settings of the fit that a run is, or that it simulates again.

    Raises:
        RunError: If one of the runs in between is gone or damaged, or it simulates itself.
        SettingsError: If they are those of another version of the program.
    """
    seen: set[Path] = set()
    while run.kind == "simulation":
        if run.folder in seen:
            raise RunError(f"{run.folder} is damaged: run '{run.id}' simulates itself.")
        seen.add(run.folder)
        run = RunFolder.open(Path(run.asked("source", str)))
    return PipelineConfig.from_dict(run.asked("profile", dict[str, Any]))


def place_object(
    run: RunFolder,
    sequence: Sequence,
    fitted: tuple[SpringMassModel, SimulationParameters, Float[ndarray, "node 3"]],
    progress: Progress,
) -> PlacedObject:
    """Reconstruct the hands of another recording and find a known object in its frame 0.

    Args:
        run: Run that fitted the object; its settings are used.
        sequence: The other recording.
        fitted: The object in a sequence of the run, its parameters, and its nodes at rest [m].
        progress: Receives reports of the stages.

    Raises:
        MissingInputError: If the recording lacks hands, controls or observations of the object.
        FitError: If it shows another object, or its hands too poorly.
        RunError: If the run's settings or the kind of its object cannot be read.
    """
    config = settings_of_fit(run)
    hands = reconstruct_hands(sequence, config.hand, progress) if sequence.hands else None
    observation = observe_object(sequence, progress)
    fitted_model, parameters, rest_node = fitted
    node, _, _ = object_nodes_of(
        sequence, observation, config, (fitted_model.object_node, rest_node)
    )
    is_bent = config.object_.bends_into_place and sequence.object_node is None
    if is_bent:
        node = bend_object(node, _first_cloud(sequence, observation), sequence.ground_height)
    velocity = np.zeros_like(node)
    if not config.object_.starts_at_rest:
        velocity = initial_velocity(observation, node, sequence.frame_rate)
    clearance = fitted_model.clearance
    if config.object_.rests_where_seen:
        # Heights in another pose: here nodes rest where they are seen here.
        kind, thickness = artefacts.load_shape(run.out)
        clearance = resting_clearance(node, sequence.ground_height, kind, thickness=thickness)
    motions = () if hands is None else hands.motions
    control = control_trajectory_of(sequence, motions, config, is_rod=fitted_model.rod is not None)
    world = parameters.in_world(
        frame_rate=sequence.frame_rate,
        ground_height=sequence.ground_height,
        gravity=sequence.gravity,
    )
    laid = replace(
        fitted_model,
        object_node=node,
        initial_velocity=velocity,
        clearance=clearance,
        hand_face=joined_faces((), 0),
    )
    model = retopologize(laid, world, control[0], fitted=parameters, rest_node=rest_node)
    model = replace(model, hand_face=hand_faces(motions, control.shape[1]))
    model = gripped(model)
    if is_bent and np.array_equal(rest_node, fitted_model.object_node):
        # The shape at frame 0 was its rest shape, in which springs carried it; so here.
        model = rest_in_place(model, world)
        if config.object_.holds_still:
            model = hold_still(model, control[0], world)
    return PlacedObject(
        hands=hands,
        observation=observation,
        control=control,
        model=model,
        parameters=world,
    )


def object_nodes_of(
    sequence: Sequence,
    observation: ObjectObservation,
    config: PipelineConfig,
    template: tuple[ndarray, ndarray] | None,
) -> tuple[Float[ndarray, "node 3"], Float[ndarray, "node 3"], ObjectShape | None]:
    """Find the object nodes at frame 0, their rest shape [m], and the kind of object.

    Args:
        sequence: Recording in which the object is placed.
        observation: Observation of the object in it.
        config: How far apart, and how many, nodes are that are sampled from the observation.
        template: Nodes and rest shape in the first sequence, if the object is known already; then
            its kind is not looked for again.

    Raises:
        FitError: If the sequence has another number of object nodes than the template, or the
            object would get too many.
        MissingInputError: If frame 0 shows too little of the object.
    """
    if sequence.object_node is not None:
        node = np.asarray(sequence.object_node, np.float32)
        rest = node if sequence.rest_node is None else np.asarray(sequence.rest_node, np.float32)
        if template is not None and len(template[0]) != len(node):
            raise FitError(
                f"Sequence '{sequence.name}' has {len(node)} object nodes (object_node.npy), but "
                f"the object has {len(template[0])}: it is another object, or refined differently."
            )
        if template is not None:
            return node, template[1], None
        return node, rest, shape_of_nodes(node, sequence)
    if template is None:
        shape = shape_of_observation(
            observation, config.node_spacing, sequence, most_nodes=config.most_nodes
        )
        return shape.node, shape.node, shape
    return lay_object(template[0], _first_cloud(sequence, observation)), template[1], None


def _first_cloud(sequence: Sequence, observation: ObjectObservation) -> Float[ndarray, "point 3"]:
    """Get what frame 0 shows of an object [m]."""
    cloud = observation.cloud[0] if observation.cloud else observation.point[0]
    cloud = cloud[np.isfinite(cloud).all(axis=1)]
    if len(cloud) < LEAST_CLOUD:
        raise MissingInputError(
            f"Sequence '{sequence.name}' shows only {len(cloud)} object points in frame 0; at "
            f"least {LEAST_CLOUD} are needed to find the object. Check its depth and masks."
        )
    return cloud


def control_trajectory_of(
    sequence: Sequence,
    motions: tuple[HandMotion, ...],
    config: PipelineConfig,
    *,
    is_rod: bool = False,
) -> Float[ndarray, "frame control 3"]:
    """Compute the control nodes of a sequence over all frames [m].

    Args:
        sequence: The recording.
        motions: Its hands.
        config: Which vertices of the hands are control nodes.
        is_rod: Whether the object is a rope that bends; its held point is the last control node.

    Raises:
        MissingInputError: If the sequence has neither hands nor point controllers, or a rope that
            bends has no held point.
    """
    if is_rod:
        if sequence.held_point is None or sequence.control is None:
            raise MissingInputError(
                f"Sequence '{sequence.name}' has no held_point.npy, which says how the rope is "
                "turned in its grip; the rope was fitted with it. Import the recording again."
            )
        held = np.asarray(sequence.held_point, np.float32)[:, None]
        return np.concatenate([np.asarray(sequence.control, np.float32), held], axis=1)
    if sequence.control is not None:
        return np.asarray(sequence.control, np.float32)
    if not motions:
        raise MissingInputError(
            f"Sequence '{sequence.name}' has neither hands nor control.npy: nothing moves its "
            "object."
        )
    models = _hand_models(motions)
    vertex = control_trajectory(motions, models)
    chosen = _chosen_vertices(sequence, vertex[0], models, config)
    return vertex if chosen is None else vertex[:, chosen]


def hand_faces(motions: tuple[HandMotion, ...], control_count: int) -> Int32[ndarray, "all_face 3"]:
    """Give the triangles of hands by control nodes; see `joined_faces`."""
    surfaces = [(model.vertex_count, model.faces) for model in _hand_models(motions)]
    return joined_faces(surfaces, control_count)


def bends_as_rod(sequences: Listing[Sequence], config: PipelineConfig) -> bool:
    """Tell whether the object is a rope that is fitted as an elastic rod (`fitting.rope`).

    Its recordings say how it is held, and every node is a marker: a rod with more nodes than that
    would need many more substeps, and its curvature at rest could not be seen.
    """
    return config.object_.bends_ropes and all(_shows_bending(each) for each in sequences)


def _shows_bending(sequence: Sequence) -> bool:
    node, marker = sequence.object_node, sequence.marker_node
    is_complete = node is not None and marker is not None and len(node) == len(np.unique(marker))
    return is_complete and sequence.held_point is not None


def _hand_models(motions: tuple[HandMotion, ...]) -> tuple[HandModel, ...]:
    return tuple(load_hand_model(motion.side, motion.model) for motion in motions)


def _chosen_vertices(
    sequence: Sequence,
    vertex: Float[ndarray, "vertex 3"],
    models: tuple[HandModel, ...],
    config: PipelineConfig,
) -> Int[ndarray, " control"] | None:
    """Choose control nodes among all hands' vertices of frame 0; None for all."""
    if config.control_nodes == "all":
        return None
    offset, visible = 0, []
    for model in models:
        surface = vertex[offset : offset + model.vertex_count]
        visible.append(visible_vertices(sequence.views, surface, model.faces) + offset)
        offset += model.vertex_count
    candidates = np.concatenate(visible)
    return candidates[farthest_points(vertex[candidates], config.control_count)]


def visible_vertices(
    views: Listing[View], vertex: Float[ndarray, "vertex 3"], faces: Int[ndarray, "face 3"]
) -> Int[ndarray, " visible"]:
    """Find the hand vertices whose surface faces at least one camera.

    Occlusion by the object or by other fingers is not considered.
    """
    normal = vertex_normals(vertex, faces)
    is_visible = np.zeros(len(vertex), bool)
    for view in views:
        eye = view.camera.T_world_camera[:3, 3]
        is_visible |= ((eye - vertex) * normal).sum(axis=1) > 0
    return np.flatnonzero(is_visible)


def farthest_points(point: Float[ndarray, "point 3"], count: int) -> Int[ndarray, " chosen"]:
    """Sample indices of points that are far from each other, beginning with the first one."""
    chosen = [0]
    distance = np.linalg.norm(point - point[0], axis=1)
    while len(chosen) < min(count, len(point)):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(point - point[chosen[-1]], axis=1))
    return np.array(chosen)


def refine_sequence(
    output: Attempt,
    sequence: Sequence,
    problem: ObjectProblem,
    config: PipelineConfig,
    progress: Progress,
    *,
    device: str,
    checkpointer: Checkpointer | None = None,
) -> RefinedHands:
    """Run stage 3 on the stored hands and the stored object of a sequence."""
    motions = artefacts.load_motions(output.out, sequence.name)
    models = _hand_models(motions)
    vertex = control_trajectory(motions, models)
    keypoint = artefacts.load_array(output.out / SequenceFiles(sequence.name).keypoint)
    cameras = [view.camera for view in sequence.views]
    fitted_keypoint = keypoint[:, : problem.frame_count]
    return refine_hands(
        RefinementProblem(
            object_=problem,
            model=artefacts.load_model(output.out, sequence.name),
            parameters=artefacts.load_parameters(output.out),
            motions=motions,
            hand_models=models,
            chosen=_chosen_vertices(sequence, vertex[0], models, config),
            targets=tuple(
                keypoint_target(cameras, seen, config.hand.keypoint_noise)
                for seen in _keypoints_of_hands(sequence, fitted_keypoint, models, config)
            ),
        ),
        config.refinement,
        progress,
        device=device,
        checkpointer=checkpointer,
    )


def _keypoints_of_hands(
    sequence: Sequence,
    keypoint: Float[ndarray, "view frame hand 21 3"],
    models: Listing[HandModel],
    config: PipelineConfig,
) -> list[Float[ndarray, "view frame 21 3"]]:
    """Take out each hand's keypoints, as far as stage 1 believed them."""
    seen = [keypoint[:, :, sequence.hands.index(model.side)] for model in models]
    if not config.hand.judges_keypoints:
        return seen
    return [
        believed_keypoints(sequence.views, one, template_keypoints(model), sequence.frame_rate)
        for one, model in zip(seen, models, strict=True)
    ]


def store_refined(
    output: Attempt, sequence: Sequence, problem: ObjectProblem, refined: RefinedHands
) -> None:
    """Replace the stored hands by the corrected ones.

    The previous hands remain as ``hand_<side>_initial``, and their control nodes of frame 0 as
    ``attachment``, because a topology that is rebuilt must attach its springs there.
    """
    motions = artefacts.load_motions(output.out, sequence.name)
    artefacts.save_refinement(output, sequence.name, motions, problem.control[0], refined.motions)
    output.save_array(SequenceFiles(sequence.name).control, refined.control.astype(np.float32))
