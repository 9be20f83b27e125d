"""Places a fitted object and its control nodes in a recording.

`place_object` does so in a recording that the object was not fitted in; the pipeline uses the parts
for the recordings of a run.
"""

from collections.abc import Sequence as Listing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from physhandi.data.attempt import Attempt
from physhandi.data.layout import SequenceFiles
from physhandi.data.observation import ObjectObservation
from physhandi.data.run import RunFolder
from physhandi.data.sequence import Sequence
from physhandi.data.view import View
from physhandi.errors import FitError, MissingInputError
from physhandi.fitting import artefacts
from physhandi.fitting.config import PipelineConfig
from physhandi.fitting.hand_reconstruction import HandFit, keypoint_target, reconstruct_hands
from physhandi.fitting.hand_refinement import RefinedHands, RefinementProblem, refine_hands
from physhandi.fitting.object_problem import ObjectProblem, initial_velocity
from physhandi.hand.loading import load_hand_model
from physhandi.hand.model import HandModel
from physhandi.hand.motion import HandMotion, control_trajectory
from physhandi.perception.lifting import observe_object
from physhandi.perception.shape import ObjectShape, shape_of_nodes, shape_of_observation
from physhandi.progress import Progress
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
    node: Float[ndarray, "node 3"]
    """Object nodes at frame 0 [m]."""
    velocity: Float[ndarray, "node 3"]
    """Their velocities at frame 0 [m/s]."""
    control: Float[ndarray, "frame control 3"]
    """Control nodes [m]."""


def place_object(
    run: RunFolder,
    sequence: Sequence,
    template: tuple[Float[ndarray, "node 3"], Float[ndarray, "node 3"]],
    progress: Progress,
) -> PlacedObject:
    """Reconstruct the hands of another recording and locate a known object in its frame 0.

    Args:
        run: Run that fitted the object; its settings are used.
        sequence: The other recording.
        template: Nodes in a sequence of the run, and at rest [m].
        progress: Receives reports of the stages.

    Raises:
        MissingInputError: If the recording lacks hands, controls or observations of the object.
        FitError: If it shows another object, or its hands too poorly.
        RunError: If the run's settings cannot be read.
    """
    while run.kind == "simulation":
        run = RunFolder.open(Path(run.config["source"]))
    config = PipelineConfig.from_dict(run.config["profile"])
    hands = reconstruct_hands(sequence, config.hand, progress) if sequence.hands else None
    observation = observe_object(sequence, progress)
    node, _, _ = object_nodes_of(sequence, observation, config, template)
    velocity = np.zeros_like(node)
    if not config.object_.starts_at_rest:
        velocity = initial_velocity(observation, node, sequence.frame_rate)
    motions = () if hands is None else hands.motions
    return PlacedObject(
        hands=hands,
        observation=observation,
        node=node,
        velocity=velocity,
        control=control_trajectory_of(sequence, motions, config),
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
    cloud = observation.cloud[0] if observation.cloud else observation.point[0]
    cloud = cloud[np.isfinite(cloud).all(axis=1)]
    if len(cloud) < LEAST_CLOUD:
        raise MissingInputError(
            f"Sequence '{sequence.name}' shows only {len(cloud)} object points in frame 0; at "
            f"least {LEAST_CLOUD} are needed to find the object. Check its depth and masks."
        )
    return lay_object(template[0], cloud), template[1], None


def lay_object(
    template: Float[ndarray, "node 3"], cloud: Float[ndarray, "point 3"], *, iterations: int = 40
) -> Float[ndarray, "node 3"]:
    """Move a known object rigidly onto the cloud of another sequence's frame 0.

    Point-to-point ICP from eight headings around the vertical; the best result wins. It assumes
    that the object starts in about the shape in which it was first reconstructed.

    Args:
        template: Nodes of the object in the sequence that it was fitted on [m].
        cloud: Object points at frame 0 of the other sequence [m].
        iterations: Alignment steps from each heading.
    """
    tree = KDTree(cloud)
    best, best_error = template, np.inf
    for turn in np.arange(8) * np.pi / 4:
        heading = Rotation.from_euler("z", turn).as_matrix()
        node = (template - template.mean(axis=0)) @ heading.T + cloud.mean(axis=0)
        for _ in range(iterations):
            target = cloud[tree.query(node)[1]]
            centred = node - node.mean(axis=0)
            rotation = Rotation.align_vectors(target - target.mean(axis=0), centred)[0]
            node = rotation.apply(centred) + target.mean(axis=0)
        error = float(
            np.mean(tree.query(node)[0] ** 2) + np.mean(KDTree(node).query(cloud)[0] ** 2)
        )
        if error < best_error:
            best, best_error = node, error
    return best.astype(np.float32)


def control_trajectory_of(
    sequence: Sequence, motions: tuple[HandMotion, ...], config: PipelineConfig
) -> Float[ndarray, "frame control 3"]:
    """Compute the control nodes of a sequence over all frames [m].

    Raises:
        MissingInputError: If the sequence has neither hands nor point controllers.
    """
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
                keypoint_target(
                    cameras,
                    fitted_keypoint[:, :, sequence.hands.index(motion.side)],
                    config.hand.keypoint_noise,
                )
                for motion in motions
            ),
        ),
        config.refinement,
        progress,
        device=device,
    )


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
