"""What is on the screen now, for everything that saves it."""

import csv
import io
import shutil
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import viser
import yaml

from app.viewer.content.content import Content
from app.viewer.content.layers import GREEN, RED, SKIN, Layers
from physhandi.data.exporters import export_scene
from physhandi.data.exporters.mesh import frame_to_ply, ply_bytes
from physhandi.data.exporters.scene_data import HandSurface, SceneData, read_skins
from physhandi.errors import MissingInputError
from physhandi.object_rollout import ObjectRollout
from physhandi.run import Run

_COMPARISON_COLUMNS = (
    *("side", "frame", "kind", "node", "control"),
    *("x_m", "y_m", "z_m", "force_x_N", "force_y_N", "force_z_N", "length_m", "rest_length_m"),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Snapshot:
    """What is on the screen now."""

    content: Content
    """What is shown."""
    frame: int
    """The frame."""
    rollout: ObjectRollout | None
    """The object's rollout."""
    rollout_frame: int
    """Frame of the rollout."""
    compared: Mapping[str, tuple[ObjectRollout, int]] | None = None
    """Rollouts of a comparison by the names of its sides, each with its frame; None outside."""
    picture: Callable[[viser.ClientHandle], dict[str, Any]] | None = None
    """Finds another camera than the client's for a picture; None if the client's will do."""
    run: Run | None = None
    """The run, if it is one that is shown."""
    layers: Layers | None = None
    """Which layers are shown, if that is to be told."""
    link: str = ""
    """Address on this server that shows the same; empty if there is none."""


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
    count = content.frame_count if rollout is None else rollout.ready
    nothing = np.zeros((count, 0, 3), np.float32)
    control = content.control if rollout is None else rollout.control
    return SceneData(
        sequence=content.sequence_name,
        frame_rate=content.frame_rate,
        length_unit=content.length_unit,
        rollout=nothing if rollout is None else np.asarray(rollout.position[:count]),
        control=nothing if control is None else np.asarray(control[:count]),
        spring_nodes=np.zeros((0, 2), np.int32) if rollout is None else rollout.model.spring_nodes,
        object_spring_count=0 if rollout is None else rollout.model.object_spring_count,
        hands={
            hand.side: HandSurface(vertex=hand.vertex[:count], face=hand.face)
            for hand in content.hands
        },
        joints={hand.side: hand.joint[:count] for hand in content.hands if hand.joint is not None},
        run="" if run is None else run.id,
        model={} if rollout is None else rollout.model.to_tensors(),
        skins={} if run is None else read_skins(run, content.sequence_name),
    )


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


def snapshot_npz(snapshot: Snapshot) -> bytes:
    """Write all frames: rollout, springs and controls, as they are on the screen."""
    rollout, content = snapshot.rollout, snapshot.content
    arrays: dict[str, Any] = {}
    if rollout is not None:
        arrays = {
            "position": rollout.position[: rollout.ready],
            "control": rollout.control[: rollout.ready],
            "spring_nodes": rollout.model.spring_nodes,
            "rest_length": rollout.model.rest_length,
            "stiffness": rollout.model.stiffness,
            "object_spring_count": np.int64(rollout.model.object_spring_count),
        }
    elif content.control is not None:
        arrays["control"] = content.control
    for hand in content.hands:
        arrays[f"hand_{hand.side}_vertex"] = hand.vertex
    if not arrays:
        raise MissingInputError("There is no rollout to save; this is a recording only.")
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def snapshot_csv(snapshot: Snapshot) -> bytes:
    """Write a table with one row a frame: mean position and force, largest speed."""
    rollout = _rollout(snapshot)
    stream = io.StringIO()
    table = csv.writer(stream)
    table.writerow(
        ["frame", "time_s", "mean_x", "mean_y", "mean_z", "force_x", "force_y", "force_z"]
    )
    for frame in range(rollout.ready):
        mean = np.asarray(rollout.position[frame]).mean(axis=0)
        force = rollout.forces(frame).sum(axis=0)
        seconds = frame / rollout.parameters.frame_rate
        table.writerow([frame, f"{seconds:.6g}", *(f"{v:.6g}" for v in (*mean, *force))])
    return stream.getvalue().encode()


def snapshot_yaml(snapshot: Snapshot) -> bytes:
    """Write the parameters of the rollout that is on the screen."""
    return yaml.safe_dump(_rollout(snapshot).parameters.to_dict(), sort_keys=False).encode()


def comparison_npz(compared: Mapping[str, tuple[ObjectRollout, int]]) -> bytes:
    """Write all frames of both sides of a comparison.

    For each side, as in ``ours_…`` and ``phystwin_…`` or ``a_…`` and ``b_…``: ``position``
    "frame node 3" and ``control`` "frame control 3" [m], ``spring_nodes``, ``rest_length`` [m],
    ``stiffness`` [N], ``object_spring_count``, ``force`` "frame node 3" [N], the sum over virtual
    springs on each object node, and ``frame``, the frame on the screen.

    Args:
        compared: Rollouts and frames of the sides by their names.
    """
    arrays: dict[str, Any] = {}
    for name, (rollout, frame) in compared.items():
        values = {
            "position": rollout.position[: rollout.ready],
            "control": rollout.control[: rollout.ready],
            "spring_nodes": rollout.model.spring_nodes,
            "rest_length": rollout.model.rest_length,
            "stiffness": rollout.parameters.stiffness_scale * rollout.model.stiffness,
            "object_spring_count": np.int64(rollout.model.object_spring_count),
            "force": np.stack([rollout.forces(ready) for ready in range(rollout.ready)]),
            "frame": np.int64(frame),
        }
        arrays |= {f"{name}_{key}": value for key, value in values.items()}
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def comparison_csv(compared: Mapping[str, tuple[ObjectRollout, int]]) -> bytes:
    """Write the frame on the screen of both sides of a comparison as one table.

    A row of kind ``node`` has an object node's position and the sum of the forces on it; one of
    kind ``virtual_spring`` has its control node's position, its force on the object node, its
    length and its rest length.

    Args:
        compared: Rollouts and frames of the sides by their names.
    """
    stream = io.StringIO()
    table = csv.writer(stream)
    table.writerow(_COMPARISON_COLUMNS)
    for name, (rollout, frame) in compared.items():
        table.writerows(_comparison_rows(name, rollout, frame))
    return stream.getvalue().encode()


def _comparison_rows(name: str, rollout: ObjectRollout, frame: int) -> list[list[Any]]:
    position, control = np.asarray(rollout.position[frame]), np.asarray(rollout.control[frame])
    rows: list[list[Any]] = []
    for node, (place, force) in enumerate(zip(position, rollout.forces(frame), strict=True)):
        rows.append([name, frame, "node", node, "", *_texts(place), *_texts(force), "", ""])
    first = rollout.model.object_spring_count
    springs = np.sort(rollout.model.spring_nodes[first:], axis=1)
    rest = rollout.model.rest_length[first:]
    for ends, force, length in zip(springs, rollout.spring_forces(frame), rest, strict=True):
        node, holder = int(ends[0]), int(ends[1]) - rollout.model.node_count
        stretched = float(np.linalg.norm(control[holder] - position[node]))
        texts = [*_texts(control[holder]), *_texts(force), *_texts([stretched, length])]
        rows.append([name, frame, "virtual_spring", node, holder, *texts])
    return rows


def _texts(values: Any) -> list[str]:
    return [f"{float(value):.7g}" for value in values]


def _rollout(snapshot: Snapshot) -> ObjectRollout:
    if snapshot.rollout is None:
        raise MissingInputError("There is no simulated object here to save.")
    return snapshot.rollout


def snapshot_gltf(snapshot: Snapshot) -> bytes:
    """Write all frames that are ready as one binary glTF file, as they are on the screen."""
    with tempfile.TemporaryDirectory(prefix="physhandi-export-") as folder:
        return export_scene(scene_data(snapshot), "gltf", Path(folder) / "x.glb").read_bytes()


def snapshot_plys(snapshot: Snapshot) -> bytes:
    """Write all frames that are ready as PLY files in a ZIP archive."""
    with tempfile.TemporaryDirectory(prefix="physhandi-export-") as folder:
        frames = export_scene(scene_data(snapshot), "ply", Path(folder) / "frames")
        return Path(shutil.make_archive(str(frames), "zip", frames)).read_bytes()
