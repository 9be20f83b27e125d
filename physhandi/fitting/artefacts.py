"""Writes and reads the files that the stages store in a run.

Paths are relative to the output folder of one attempt; docs/formats.md lists them.
"""

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar, get_args

import msgspec
import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from safetensors.numpy import load_file

from physhandi.appearance.splats import Splats
from physhandi.data.arrays import read_array
from physhandi.data.attempt import Attempt
from physhandi.data.files import named_fields, parse_yaml
from physhandi.data.layout import (
    MATERIAL_FILE,
    PARAMETERS_FILE,
    SEARCH_FILE,
    SHAPE_FILE,
    SPLATS_FILE,
    SequenceFiles,
)
from physhandi.data.observation import ObjectObservation, thinned
from physhandi.data.run import RunFolder
from physhandi.data.run_folder import reading
from physhandi.data.sequence import Sequence
from physhandi.data.sequence_meta import ShapeClass
from physhandi.errors import RunError
from physhandi.hand.loading import load_hand_model
from physhandi.hand.motion import HandMotion
from physhandi.hand.skin import hand_skin
from physhandi.perception.lifting import hand_points
from physhandi.progress import Progress
from physhandi.simulation.contact_intervals import ContactIntervals
from physhandi.simulation.edits import Edits
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.restart import Restart

Stored = TypeVar("Stored")
STORED_CLOUD = 500
"""Most points of one frame's cloud that a run stores, evenly picked, unless they are markers."""
STORED_HAND = 300
"""Most points of one hand in one frame that a run stores, evenly picked."""


def save_sequence_meta(output: Attempt, sequence: Sequence) -> None:
    """Store what a viewer needs of a sequence, so that a run can be shown without the recording.

    A file that a finished stage of an earlier attempt stored is not replaced: other content, such
    as of another version of this program, would make that stage count as damaged.
    """
    file = SequenceFiles(sequence.name).meta
    if (output.out / file).is_file():
        return
    output.save_yaml(
        file,
        {
            "name": sequence.name,
            "frame_rate": sequence.frame_rate,
            "frame_count": sequence.frame_count,
            "metric": sequence.metric,
            "length_unit": sequence.length_unit,
            "ground_height": sequence.ground_height,
            "gravity": sequence.gravity,
            "hands": list(sequence.hands),
            "reconstruction_frames": len(sequence.reconstruction_frames),
            "fingerprint": sequence.content_fingerprint(),
            **({} if sequence.mass is None else {"mass": sequence.mass}),
        },
    )


def save_observation(output: Attempt, name: str, observation: ObjectObservation) -> None:
    """Store the observation of the object."""
    file_of = SequenceFiles(name).observation
    output.save_array(file_of("point"), observation.point.astype(np.float32))
    output.save_array(file_of("is_visible"), observation.is_visible)
    output.save_array(file_of("is_motion_valid"), observation.is_motion_valid)
    if observation.node_of_track is not None:
        output.save_array(file_of("node_of_track"), observation.node_of_track.astype(np.int32))
    if observation.late is not None:
        # Most of them are seen in few frames.
        seen = np.argwhere(np.isfinite(observation.late).all(axis=2))
        output.save_array(file_of("late_point"), observation.late[tuple(seen.T)].astype(np.float32))
        output.save_array(file_of("late_seen"), seen.astype(np.int32))
    if observation.cloud:
        # Losses and metrics are defined on all points of a cloud of markers.
        identified = 0 if observation.node_of_track is None else observation.track_count
        most = max(STORED_CLOUD, identified)
        clouds = [thinned(cloud, most) for cloud in observation.cloud]
        end = np.cumsum([len(cloud) for cloud in clouds]).astype(np.int64)
        output.save_array(file_of("cloud"), np.concatenate(clouds))
        output.save_array(file_of("cloud_end"), end)


def load_array(path: Path) -> ndarray:
    """Read an array of a run.

    Raises:
        RunError: If the file is missing or damaged.
    """
    with reading(path):
        return read_array(path)


def load_observation(out: Path, name: str) -> ObjectObservation:
    """Read an observation that `save_observation` stored."""
    files = SequenceFiles(name)

    def read(part: str) -> ndarray | None:
        path = out / files.observation(part)
        return load_array(path) if path.exists() else None

    cloud, cloud_end = read("cloud"), read("cloud_end")
    clouds: tuple[ndarray, ...] = ()
    if cloud is not None and cloud_end is not None:
        clouds = tuple(np.split(cloud, cloud_end[:-1]))
    with reading(out / files.folder / "observation"):
        point = load_array(out / files.observation("point"))
        return ObjectObservation(
            point=point,
            is_visible=load_array(out / files.observation("is_visible")),
            is_motion_valid=load_array(out / files.observation("is_motion_valid")),
            cloud=clouds,
            node_of_track=read("node_of_track"),
            late=_dense(read("late_point"), read("late_seen"), len(point)),
        )


def _dense(
    point: ndarray | None, seen: ndarray | None, frame_count: int
) -> Float[ndarray, "frame late 3"] | None:
    """Give late tracks their places in the frames that show them; NaN elsewhere."""
    if point is None or seen is None:
        return None
    count = int(seen[:, 1].max()) + 1 if len(seen) else 0
    if seen.shape != (len(point), 2) or seen.min(initial=0) < 0 or count > len(seen):
        raise ValueError("late_seen does not name a frame and a track for each late_point")
    late = np.full((frame_count, count, 3), np.nan, np.float32)
    late[tuple(seen.T)] = point
    return late


def lifted_hand_points(
    sequence: Sequence, progress: Progress | None = None
) -> tuple[Float[ndarray, "point 3"], Int[ndarray, "hand frame"]] | None:
    """Lift the hands' depth pixels of all views, thinned as a run stores them.

    Returns:
        The points of the first hand's frames, then those of the next hand [m], and the end of each
        frame's points; None without hands, or if no view has both depth and masks.
    """
    if not sequence.hands or not any(view.has_depth and view.has_mask for view in sequence.views):
        return None
    points = [
        [thinned(cloud, STORED_HAND) for cloud in frames]
        for frames in hand_points(sequence, progress)
    ]
    count = np.array([[len(cloud) for cloud in frames] for frames in points], dtype=np.int64)
    end = np.cumsum(count).reshape(count.shape)
    return np.concatenate([cloud for frames in points for cloud in frames]), end


def save_hand_points(output: Attempt, sequence: Sequence, progress: Progress) -> None:
    """Store the measured points of the hands for scoring, if there are any."""
    stored = lifted_hand_points(sequence, progress)
    if stored is not None:
        file_of = SequenceFiles(sequence.name).observation
        output.save_array(file_of("hand_point"), stored[0])
        output.save_array(file_of("hand_point_end"), stored[1])


def save_motions(output: Attempt, name: str, motions: tuple[HandMotion, ...]) -> None:
    """Store the fitted motion of each hand."""
    for motion in motions:
        output.save_tensors(SequenceFiles(name).hand_motion(motion.side), motion.to_tensors())


def save_refinement(
    output: Attempt,
    name: str,
    before: tuple[HandMotion, ...],
    attachment: Float[ndarray, "control 3"],
    after: tuple[HandMotion, ...],
) -> None:
    """Store refined hands, the hands before, and the latter's control nodes at frame 0."""
    files = SequenceFiles(name)
    for motion in before:
        output.save_tensors(files.hand_motion(motion.side, is_initial=True), motion.to_tensors())
    output.save_array(files.attachment, attachment.astype(np.float32))
    save_motions(output, name, after)


def load_attachment(out: Path, name: str) -> Float[ndarray, "control 3"]:
    """Read the control nodes to which a sequence's virtual springs were attached [m].

    That is frame 0 of the control nodes, unless refinement has moved the hands since.
    """
    path = out / SequenceFiles(name).attachment
    if path.exists():
        return load_array(path)
    return load_control(out, name)[0].copy()


def load_control(out: Path, name: str) -> Float[ndarray, "frame control 3"]:
    """Read the control nodes of one sequence [m].

    Raises:
        RunError: If the file is missing or damaged, or a position is not finite.
    """
    path = out / SequenceFiles(name).control
    control = load_array(path)
    wrong = np.argwhere(~np.isfinite(control))
    if len(wrong):
        frame, node = wrong[0][:2]
        raise RunError(f"{path} is not finite at frame {frame}, control {node}. Run it again.")
    return control


def load_motions(out: Path, name: str) -> tuple[HandMotion, ...]:
    """Read the hand motions of one sequence, the right hand first."""
    files = SequenceFiles(name)
    paths = [out / files.hand_motion(side) for side in ("right", "left")]
    motions = []
    for path in paths:
        if path.exists():
            with reading(path):
                motions.append(HandMotion.from_tensors(load_file(path)))
    return tuple(motions)


def save_object(
    output: Attempt,
    parameters: SimulationParameters,
    model: SpringMassModel,
    rest_node: Float[ndarray, "node 3"],
) -> None:
    """Store the object without controls: rest shape, object springs and global parameters."""
    count = model.object_spring_count
    output.save_yaml(PARAMETERS_FILE, parameters.to_dict())
    output.save_tensors(
        MATERIAL_FILE,
        {
            "rest_node": rest_node.astype(np.float32),
            "object_spring_nodes": model.spring_nodes[:count].copy(),
            "object_rest_length": model.rest_length[:count].copy(),
            "stiffness": model.stiffness[:count].copy(),
            "damping": model.damping[:count].copy(),
        },
    )


def load_parameters(out: Path) -> SimulationParameters:
    """Read the global parameters of a run."""
    path = out / PARAMETERS_FILE
    with reading(path):
        content = named_fields(parse_yaml(path.read_text(encoding="utf-8")))
        if content is None:
            raise ValueError("it must hold named fields")
        return SimulationParameters.from_dict(content)


def load_runners_up(out: Path) -> list[SimulationParameters]:
    """Read the next best parameters of a run's search; none in runs of earlier versions."""
    path = out / SEARCH_FILE
    if not path.is_file():
        return []
    with reading(path):
        content = named_fields(parse_yaml(path.read_text(encoding="utf-8"))) or {}
        return [SimulationParameters.from_dict(each) for each in content.get("runners_up") or ()]


def load_shape(out: Path) -> tuple[ShapeClass, float]:
    """Read the kind of a run's object and its local thickness [m]."""
    path = out / SHAPE_FILE
    with reading(path):
        content = named_fields(parse_yaml(path.read_text(encoding="utf-8"))) or {}
        kind = next((kind for kind in get_args(ShapeClass) if kind == content.get("shape")), None)
        thickness = content.get("thickness")
        if kind is None or not isinstance(thickness, int | float):
            raise ValueError("it must name a shape and its thickness")
        return kind, float(thickness)


def load_rest_node(out: Path) -> Float[ndarray, "node 3"]:
    """Read the rest shape of a run's object [m]."""
    path = out / MATERIAL_FILE
    with reading(path):
        return load_file(path)["rest_node"]


def load_splats(out: Path) -> Splats | None:
    """Read what the object looks like; None if that was not fitted.

    Raises:
        RunError: If the file is damaged.
    """
    return _read_if_there(out / SPLATS_FILE, Splats.from_tensors)


def _read_if_there(path: Path, read: Callable[[dict[str, ndarray]], Stored]) -> Stored | None:
    """Read the arrays of a file that not every run has; None if it is not there."""
    if not path.is_file():
        return None
    with reading(path):
        return read(load_file(path))


def save_model(output: Attempt, name: str, model: SpringMassModel) -> None:
    """Store the springs of one sequence, object springs and virtual springs."""
    tensors = {key: np.ascontiguousarray(value) for key, value in model.to_tensors().items()}
    output.save_tensors(SequenceFiles(name).model, tensors)


def save_edits(output: Attempt, name: str, edits: Edits, unedited: SpringMassModel) -> None:
    """Store what was done to single springs and nodes of one sequence, and its springs without."""
    files = SequenceFiles(name)
    output.save_json(files.edits, msgspec.to_builtins(edits))
    tensors = {key: np.ascontiguousarray(value) for key, value in unedited.to_tensors().items()}
    output.save_tensors(files.unedited, tensors)


def load_model(out: Path, name: str) -> SpringMassModel:
    """Read the springs of one sequence."""
    path = out / SequenceFiles(name).model
    with reading(path):
        return SpringMassModel.from_tensors(load_file(path))


def load_contacts(out: Path, name: str) -> ContactIntervals | None:
    """Read what hands hold and when; None if springs are laid at frame 0 for all frames.

    Raises:
        RunError: If the file is damaged.
    """
    return _read_if_there(out / SequenceFiles(name).contacts, ContactIntervals.from_tensors)


def load_restart(out: Path, name: str) -> Restart | None:
    """Read the state from which the predicted frames of a sequence start; None for the rollout's.

    Raises:
        RunError: If the file is damaged.
    """
    return _read_if_there(out / SequenceFiles(name).restart, Restart.from_tensors)


def save_hand_observation(
    output: Attempt, name: str, keypoint: Float[ndarray, "view frame hand 21 3"]
) -> None:
    """Store the keypoints that stage 1 fitted the hands to [px]."""
    output.save_array(SequenceFiles(name).keypoint, keypoint.astype(np.float32))


def copy_hand_observation(source: RunFolder, name: str, output: Attempt) -> None:
    """Take over what another run keeps of what the views saw of the hands."""
    files = SequenceFiles(name)
    hands = (files.observation(part) for part in ("hand_point", "hand_point_end"))
    for file in (files.keypoint, *hands):
        if source.has(file):
            output.save_array(file, source.array(file))


def save_hand_vertices(output: Attempt, name: str) -> None:
    """Store mesh, joints and skin of every hand, for viewers, exports and metrics."""
    files = SequenceFiles(name)
    for motion in load_motions(output.out, name):
        model = load_hand_model(motion.side, motion.model)
        side = motion.side
        output.save_array(files.hand_vertex(side), motion.vertices(model).astype(np.float32))
        output.save_array(files.hand_face(side), np.asarray(model.faces, np.int32))
        output.save_array(files.hand_keypoint(side), motion.keypoints(model).astype(np.float32))
        output.save_tensors(files.hand_skin(side), hand_skin(model, motion).to_tensors())


def copy_hand_vertices(source: RunFolder, name: str, output: Attempt) -> None:
    """Take over what `save_hand_vertices` stored in another run, which needs no hand model."""
    files = SequenceFiles(name)
    for motion in load_motions(output.out, name):
        side = motion.side
        for file in (files.hand_vertex(side), files.hand_face(side), files.hand_keypoint(side)):
            if source.has(file):
                output.save_array(file, source.array(file))
        if source.has(files.hand_skin(side)):
            output.save_tensors(files.hand_skin(side), source.tensors(files.hand_skin(side)))
