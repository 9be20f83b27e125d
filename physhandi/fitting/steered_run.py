"""Files of a take of steered hands, in a run and in a recording.

A run of kind ``simulation`` that holds a take simulates that in the place of a recording, which is
made of it first: control points and markers, one at each object node, with its provenance.
"""

from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray
from scipy.spatial.transform import Rotation

from physhandi.data.attempt import Attempt
from physhandi.data.layout import SequenceFiles
from physhandi.data.run import RunFolder
from physhandi.data.sequence import Sequence
from physhandi.data.sequence_meta import SequenceMeta, Side
from physhandi.data.sequence_writer import write_sequence
from physhandi.fitting import artefacts
from physhandi.fitting.stored_take import StoredTake
from physhandi.hand.curl import (
    BONE_OF_KEYPOINT,
    blended,
    curl_motion,
    curled_rotations,
    weight_of_joints,
)
from physhandi.hand.loading import load_hand_model
from physhandi.hand.motion import HandMotion
from physhandi.progress import Progress
from physhandi.rotations import without_jumps
from physhandi.simulation.contact_intervals import ContactIntervals, acts_in, always
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.steering import SteeredHand, turn_on


def record_take(
    source: RunFolder, stored: StoredTake, folder: Path, progress: Progress, *, device: str
) -> None:
    """Simulate a take and write it as a recording, unless it is there already.

    Args:
        source: Run whose object was steered.
        stored: The take.
        folder: Where the recording shall appear.
        progress: Told about every frame.
        device: Warp device.

    Raises:
        SimulationDivergedError: If the motion runs away.
        SequenceError: If the folder is in use by something else.
    """
    take = stored.take
    provenance = {
        "origin": "steered by hand in the viewer",
        "run": source.id,
        "sequence": stored.sequence,
        "frame": stored.frame,
        "hands": [hand.name for hand in take.hands],
    }
    if folder.is_dir() and Sequence.load(folder).meta.provenance == provenance:
        return
    position: list[ndarray] = []
    for node, _ in take.simulate(device):
        progress.check_cancelled()
        position.append(node)
        progress.report("recording", len(position), take.frame_count)
    about = source.recording(stored.sequence)
    parameters = take.parameters
    meta = SequenceMeta(
        name=folder.name,
        description=f"Steered by hand from frame {stored.frame} of '{stored.sequence}' on, with "
        f"the object of the run '{source.name}'.",
        frame_rate=parameters.frame_rate,
        frame_count=take.frame_count,
        metric=bool(about.get("metric", True)),
        length_unit=str(about.get("length_unit", "m")),
        ground_height=parameters.ground_height,
        gravity=parameters.gravity,
        mass=about.get("mass"),
        provenance=provenance,
    )
    arrays = {
        "control.npy": take.controls(),
        "marker.npy": np.stack(position),
        "marker_node.npy": np.arange(take.model.node_count, dtype=np.int32),
        "object_node.npy": take.start[0],
        "rest_node.npy": artefacts.load_rest_node(source.out),
    }
    write_sequence(folder, meta, arrays)


def contacts_from(contacts: ContactIntervals | None, frame: int) -> ContactIntervals | None:
    """Keep the contacts that hold when hands begin to be steered, for good.

    Args:
        contacts: What was found over time; None if contact was not looked for.
        frame: Last frame before.
    """
    if contacts is None:
        return None
    holds = acts_in(contacts.interval, frame + 1)
    part = {field.name: getattr(contacts, field.name)[holds] for field in fields(contacts)}
    return ContactIntervals(**part | {"interval": always(int(holds.sum()))})


def contacts_in(model: SpringMassModel) -> ContactIntervals:
    """Write down what control nodes hold in a model: the pairs that virtual springs join, for good.

    Args:
        model: Springs of a take in which something was gripped or let go.
    """
    virtual = np.arange(model.object_spring_count, len(model.spring_nodes))
    virtual = virtual[model.stiffness[virtual] > 0.0]
    ends = np.sort(model.spring_nodes[virtual], axis=1)
    control, distance = ends[:, 1] - model.node_count, model.rest_length[virtual]
    order = np.lexsort((distance, control))
    first = np.searchsorted(control[order], control[order], side="left")
    rank = np.empty(len(order), np.int32)
    rank[order] = np.arange(len(order)) - first
    return ContactIntervals(
        node=ends[:, 0].astype(np.int32),
        control=control.astype(np.int32),
        distance=distance.astype(np.float32),
        rank=rank,
        interval=always(len(virtual)),
    )


def with_points(
    attachment: Float[ndarray, "attached 3"], model: SpringMassModel
) -> Float32[ndarray, "control 3"]:
    """Add to where control nodes are attached in frame 0 the points that are held by themselves.

    Args:
        attachment: Where those of hands are attached [m].
        model: Springs of the take; the control nodes after those of hands are points.
    """
    points = np.arange(len(attachment), model.control_count)
    contacts = contacts_in(model)
    above = np.zeros((len(points), 3), np.float32)
    for row, point in enumerate(points):
        nearest = np.flatnonzero((contacts.control == point) & (contacts.rank == 0))
        if len(nearest):
            above[row] = model.object_node[contacts.node[nearest[0]]]
            above[row, 2] += contacts.distance[nearest[0]]
    return np.concatenate([np.asarray(attachment, np.float32), above])


def store_hands(source: RunFolder, stored: StoredTake, name: str, attempt: Attempt) -> None:
    """Store the steered hands: surfaces, joints, skins and motions, as they were moved.

    Args:
        source: Run whose hands were steered.
        stored: The take.
        name: Name of its recording.
        attempt: Where they go.
    """
    sides: tuple[Side, Side] = ("right", "left")
    for number, hand in enumerate(stored.take.hands):
        if hand.name in sides:
            _store_hand(source, stored, (name, hand.name), (number, hand), attempt)


def _store_hand(
    source: RunFolder,
    stored: StoredTake,
    place: tuple[str, Side],
    which: tuple[int, SteeredHand],
    attempt: Attempt,
) -> None:
    (name, side), (number, hand) = place, which
    was, now = SequenceFiles(stored.sequence), SequenceFiles(name)
    pose = stored.take.pose[:, number]
    skin = source.tensors(was.hand_skin(side)) if source.has(was.hand_skin(side)) else None
    bones, rotation, bend = None, None, pose[:, 7:]
    if skin is not None and hand.curls is not None and pose[:, 6:].any():
        rotation = curled_rotations(skin, side, stored.frame, pose[:, 6], bend)
        # The last one tells where points are without any curl.
        bones = curl_motion(skin, side, stored.frame, np.append(pose[:, 6], 0.0))

    def save_moved(old: str, new: str, bone: ndarray, weight: ndarray) -> None:
        if not source.has(old):
            return
        point = _in_frame(source.array(old), stored.frame)
        points = np.repeat(point[None], len(pose), axis=0)
        if bones is not None:
            curled = blended(bones, bone, weight, point)
            points += curled[:-1] - curled[-1]
        if hand.fingers is not None and bend.any():
            fingers = replace(hand.fingers, weight=weight_of_joints(bone, weight))
            points = np.stack(
                [fingers.bent(*its) for its in zip(points, pose[:, 6], bend, strict=True)]
            )
        moved = np.stack([hand.moved(*its) for its in zip(points, pose, strict=True)])
        attempt.save_array(new, moved.astype(np.float32))

    bone = np.array(BONE_OF_KEYPOINT)[:, None]
    weight = np.ones(bone.shape)
    save_moved(was.hand_keypoint(side), now.hand_keypoint(side), bone, weight)
    if skin is not None:
        bone, weight = skin["vertex_bone"], skin["vertex_weight"]
    save_moved(was.hand_vertex(side), now.hand_vertex(side), bone, weight)
    if source.has(was.hand_face(side)):
        attempt.save_array(now.hand_face(side), source.array(was.hand_face(side)))
    if skin is not None:
        moved_skin = _moved_skin(skin, stored.frame, hand, pose, rotation)
        attempt.save_tensors(now.hand_skin(side), moved_skin)
    if source.has(was.hand_motion(side)):
        motion = HandMotion.from_tensors(source.tensors(was.hand_motion(side)))
        moved = _moved_motion(motion, stored.frame, hand, pose, rotation)
        attempt.save_tensors(now.hand_motion(side), moved.to_tensors())


def _in_frame(array: ndarray, frame: int) -> ndarray:
    """Give the value of a frame, or of the last one that there is."""
    return np.array(array[min(frame, len(array) - 1)], np.float64)


def _moved_skin(
    skin: Mapping[str, ndarray],
    frame: int,
    hand: SteeredHand,
    pose: ndarray,
    curled: Float[ndarray, "frame bone 4"] | None,
) -> dict[str, ndarray]:
    """Let the wrist move; other bones stay as they are in a frame, unless they are bent."""
    translation = np.repeat(_in_frame(skin["translation"], frame)[None], len(pose), axis=0)
    rotation = np.repeat(_in_frame(skin["rotation"], frame)[None], len(pose), axis=0)
    if curled is not None:
        rotation[:, 1:] = curled[:, 1:]
    wrist = Rotation.from_quat(rotation[0, 0])
    for number, its in enumerate(pose):
        translation[number, 0] = hand.moved(translation[number, :1], its)[0]
        rotation[number, 0] = (Rotation.from_rotvec(its[3:6]) * wrist).as_quat()
    moved = {"translation": translation, "rotation": without_jumps(rotation)}
    return {**skin, **{name: value.astype(np.float32) for name, value in moved.items()}}


def _moved_motion(
    motion: HandMotion,
    frame: int,
    hand: SteeredHand,
    pose: ndarray,
    curled: Float[ndarray, "frame bone 4"] | None,
) -> HandMotion:
    """Let the wrist of a hand move, which keeps the articulation of a frame unless it is bent."""
    turn, place = (
        _in_frame(value, frame) for value in (motion.wrist_rotation, motion.wrist_translation)
    )
    wrist = motion.scale * place[None]
    articulation = np.repeat(_in_frame(motion.articulation, frame)[None], len(pose), axis=0)
    if curled is not None:
        axes = load_hand_model(motion.side, motion.model).joint_axes
        turned = Rotation.from_quat(curled[:, 1:].reshape(-1, 4)).as_rotvec()
        articulation = np.einsum("jca,fjc->fja", axes, turned.reshape(articulation.shape))
    return replace(
        motion,
        articulation=articulation,
        wrist_rotation=np.stack([turn_on(turn, its[3:6]) for its in pose]),
        wrist_translation=np.stack([hand.moved(wrist, its)[0] / motion.scale for its in pose]),
    )
