"""Snapshot of what is on the screen, for everything that saves it."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from app.viewer.content.content import Content
from app.viewer.content.layers import GREEN, RED, SKIN, Layers
from physhandi.data.exporters.gltf import scene_to_gltf
from physhandi.data.exporters.mesh import frame_files, frame_to_ply, ply_bytes
from physhandi.data.exporters.scene_data import MovingSurface, SceneData, read_skins
from physhandi.data.exporters.table import csv_bytes, npz_bytes, rounded
from physhandi.data.files import zip_bytes
from physhandi.data.object_mass import ObjectMass, given_mass
from physhandi.errors import MissingInputError
from physhandi.object_rollout import ObjectRollout
from physhandi.run import Run

if TYPE_CHECKING:
    import viser  # Files are made by processes that show nothing.

_MEAN_COLUMNS = "frame", "time_s", "mean_x", "mean_y", "mean_z", "force_x", "force_y", "force_z"
_COMPARISON_COLUMNS = (
    *("side", "frame", "kind", "node", "control"),
    *("x_m", "y_m", "z_m", "force_x_N", "force_y_N", "force_z_N", "length_m", "rest_length_m"),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Snapshot:
    """State of the screen at one moment."""

    content: Content
    """Content of the scene."""
    frame: int
    """The frame."""
    rollout: ObjectRollout | None
    """The object's rollout."""
    rollout_frame: int
    """Frame of the rollout."""
    compared: Mapping[str, tuple[ObjectRollout, int]] | None = None
    """Rollouts of a comparison by the names of its sides, each with its frame; None outside."""
    picture: "Callable[[viser.ClientHandle], dict[str, Any]] | None" = None
    """Finds another camera than the client's for a picture; None if the client's will do."""
    run: Run | None = None
    """The run, if it is one that is shown."""
    layers: Layers | None = None
    """Shown layers, if they are to be saved."""
    link: str = ""
    """Address on this server that shows the same; empty if there is none."""

    @property
    def mass(self) -> ObjectMass | None:
        """Mass of the object as shown; None if unknown."""
        given = None if self.layers is None else self.layers.mass
        return self.content.mass if given is None else given_mass(given)


def scene_data(snapshot: Snapshot) -> SceneData:
    """Collect the motion that a snapshot belongs to: the rollout's frames that are ready.

    Args:
        snapshot: What is on the screen.

    Raises:
        MissingInputError: If it is a recording, in which nothing was reconstructed.
    """
    content, rollout, run = snapshot.content, snapshot.rollout, snapshot.run
    if rollout is None and not content.hands:
        raise MissingInputError("There is no rollout to save; this is a recording only.")
    count = content.frame_count
    nothing = np.zeros((count, 0, 3), np.float32)
    hands_alone = SceneData(
        sequence=content.sequence_name,
        frame_rate=content.frame_rate,
        length_unit=content.length_unit,
        rollout=nothing,
        control=nothing if content.control is None else content.control[:count],
        spring_nodes=np.zeros((0, 2), np.int32),
        object_spring_count=0,
        hands={
            hand.side: MovingSurface(vertex=hand.vertex, face=hand.face) for hand in content.hands
        },
        joints={hand.side: hand.joint for hand in content.hands if hand.joint is not None},
        run="" if run is None else run.id,
        mass=snapshot.mass,
        skins={} if run is None else read_skins(run, content.sequence_name),
    )
    if rollout is None:
        return hands_alone
    surface = content.surface
    return replace(rollout, scene=lambda: hands_alone, surface=lambda: surface).scene_data()


def snapshot_ply(snapshot: Snapshot) -> bytes:
    """Write the frame: the object with its controls and hands, or else what is there of them."""
    content, rollout = snapshot.content, snapshot.rollout
    if rollout is not None:
        return frame_to_ply(scene_data(snapshot), snapshot.rollout_frame)
    frame = snapshot.frame
    parts: list[tuple[Any, tuple[int, int, int]]]
    parts = [(hand.vertex[frame], SKIN[hand.side]) for hand in content.hands]
    if not parts and content.control is not None:
        parts.append((content.control[frame], RED))
    if content.observed is not None:
        parts.append((content.observed.points(frame), GREEN))
    if not parts:
        raise MissingInputError("This frame shows no geometry to save.")
    color = [np.tile(np.array(color, np.uint8), (len(point), 1)) for point, color in parts]
    return ply_bytes(
        np.concatenate([np.asarray(point, np.float32) for point, _ in parts]),
        np.concatenate(color),
        np.zeros((0, 3), np.int32),
        np.zeros((0, 2), np.int32),
    )


def snapshot_plys(snapshot: Snapshot) -> bytes:
    """Write all frames that are ready as PLY files in a ZIP archive."""
    return zip_bytes(frame_files(scene_data(snapshot)))


def snapshot_gltf(snapshot: Snapshot) -> bytes:
    """Write all frames that are ready as one binary glTF file, as they are on the screen."""
    return scene_to_gltf(scene_data(snapshot))


def snapshot_npz(snapshot: Snapshot) -> bytes:
    """Write all frames: rollout, springs and controls, as they are on the screen.

    Of a comparison all frames of both sides, as in ``ours_…`` and ``phystwin_…`` or ``a_…`` and
    ``b_…``: ``position`` "frame node 3" and ``control`` "frame control 3" [m], ``spring_nodes``,
    ``rest_length`` [m], ``stiffness`` [N], ``object_spring_count``, ``force`` "frame node 3" [N],
    that of the hands on each object node, and ``frame``, the frame on the screen; of a
    rollout that restarts also what `ObjectRollout.restart_arrays` gives, and of one whose virtual
    springs do not always act ``attached`` "virtual 2", the frame in whose state each is attached
    and the last one before it lets go.
    """
    content = snapshot.content
    arrays: dict[str, Any] = {}
    if snapshot.compared is not None:
        for name, (rollout, frame) in snapshot.compared.items():
            values = _motion_arrays(rollout) | {
                "stiffness": rollout.parameters.stiffness_scale * rollout.model.stiffness,
                "force": np.stack([rollout.forces(ready) for ready in range(rollout.ready)]),
                "frame": np.int64(frame),
            }
            arrays |= {f"{name}_{key}": value for key, value in values.items()}
        return npz_bytes(arrays)
    if snapshot.rollout is not None:
        arrays = _motion_arrays(snapshot.rollout)
    elif content.control is not None:
        arrays["control"] = content.control
    for hand in content.hands:
        arrays[f"hand_{hand.side}_vertex"] = hand.vertex
    if not arrays:
        raise MissingInputError("There is no rollout to save; this is a recording only.")
    return npz_bytes(arrays)


def snapshot_csv(snapshot: Snapshot) -> bytes:
    """Write a table with one row a frame: mean position [m], and sum of the forces [N].

    Of a comparison the frame on the screen of both sides: a row of kind ``node`` has an object
    node's position and the sum of the forces on it; one of kind ``virtual_spring`` has its control
    node's position, its force on the object node, its length and its rest length.
    """
    if snapshot.compared is not None:
        sides = snapshot.compared.items()
        rows = (row for name, (rollout, frame) in sides for row in _side_rows(name, rollout, frame))
        return csv_bytes(_COMPARISON_COLUMNS, rows)
    rollout = _rollout(snapshot)
    return csv_bytes(_MEAN_COLUMNS, (_mean_row(rollout, frame) for frame in range(rollout.ready)))


def snapshot_yaml(snapshot: Snapshot) -> bytes:
    """Write the parameters of the rollout that is on the screen."""
    return yaml.safe_dump(_rollout(snapshot).parameters.to_dict(), sort_keys=False).encode()


def _motion_arrays(rollout: ObjectRollout) -> dict[str, Any]:
    return rollout.restart_arrays() | {
        "position": rollout.position[: rollout.ready],
        "control": rollout.control[: rollout.ready],
        "spring_nodes": rollout.model.spring_nodes,
        "rest_length": rollout.model.rest_length,
        "stiffness": rollout.model.stiffness,
        "object_spring_count": np.int64(rollout.model.object_spring_count),
        **({} if rollout.model.is_always_attached else {"attached": rollout.model.attached}),
    }


def _mean_row(rollout: ObjectRollout, frame: int) -> list[Any]:
    mean = np.asarray(rollout.position[frame]).mean(axis=0)
    force = rollout.forces(frame).sum(axis=0)
    return [frame, *rounded([frame / rollout.parameters.frame_rate, *mean, *force])]


def _side_rows(name: str, rollout: ObjectRollout, frame: int) -> Iterator[list[Any]]:
    position, control = np.asarray(rollout.position[frame]), np.asarray(rollout.control[frame])
    for node, (place, force) in enumerate(zip(position, rollout.forces(frame), strict=True)):
        yield [name, frame, "node", node, "", *rounded([*place, *force]), "", ""]
    first = rollout.model.object_spring_count
    springs = np.sort(rollout.model.spring_nodes[first:], axis=1)
    rest = rollout.model_in(frame).rest_length[first:]
    length = rest * (1.0 + rollout.strains(frame)[first:])
    rows = zip(springs, rollout.spring_forces(frame), length, rest, strict=True)
    for ends, force, *lengths in rows:
        node, holder = int(ends[0]), int(ends[1]) - rollout.model.node_count
        numbers = rounded([*control[holder], *force, *lengths])
        yield [name, frame, "virtual_spring", node, holder, *numbers]


def _rollout(snapshot: Snapshot) -> ObjectRollout:
    if snapshot.rollout is None:
        raise MissingInputError("There is no simulated object here to save.")
    return snapshot.rollout
