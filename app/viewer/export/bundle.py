"""Everything that a picture of a scene shows, in one ZIP archive that explains itself."""

import json
import logging
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import yaml

from app.viewer.content.content import Content
from app.viewer.content.session_state import Pose
from app.viewer.export.snapshot import Snapshot, snapshot_ply
from physhandi import __version__
from physhandi.data.exporters.table import csv_bytes, npz_bytes, rounded
from physhandi.data.files import plain, without_non_finite, zip_bytes
from physhandi.errors import MissingInputError
from physhandi.object_rollout import ObjectRollout

logger = logging.getLogger(__name__)

_NODES = ("side", "node", "x_m", "y_m", "z_m", "force_x_N", "force_y_N", "force_z_N")
_CONTROLS = ("side", "control", "x_m", "y_m", "z_m", "holds_springs")
_SPRINGS = (
    *("side", "spring", "kind", "node", "other_node_or_control", "length_m", "rest_length_m"),
    *("strain", "stiffness_N", "damping_Ns_per_m"),
)
_FORCES = ("side", "spring", "node", "control", "force_x_N", "force_y_N", "force_z_N")


@dataclass(frozen=True, kw_only=True, eq=False)
class Screenshot:
    """A picture of the scene."""

    content: bytes
    """The PNG file."""
    pose: Pose
    """Pose of the camera."""
    width: int
    """Width [px]."""
    height: int
    """Height [px]."""

    @classmethod
    def of(cls, content: bytes, pose: Pose) -> "Screenshot":
        """Read the size from a PNG file."""
        width, height = (int.from_bytes(content[at : at + 4], "big") for at in (16, 20))
        return cls(content=content, pose=pose, width=width, height=height)


def bundle(snapshot: Snapshot, picture: Screenshot) -> bytes:
    """Collect pictures, geometry, springs, forces, parameters, cameras and the link of a view.

    Args:
        snapshot: What is shown.
        picture: How it looks.

    Returns:
        The ZIP archive. The same view gives the same bytes.
    """
    files: dict[str, bytes] = {"picture.png": picture.content}
    files |= dict(_views(snapshot))
    sides = _sides(snapshot)
    if sides:
        files |= _tables(sides)
        files["frame.npz"] = _arrays(sides, snapshot)
        files["parameters.yaml"] = _parameters(sides)
    try:
        files["frame.ply"] = snapshot_ply(snapshot)
    except MissingInputError:
        logger.info("no geometry is in the archive: the recording shows images alone")
    files["camera.json"] = _json(_camera(picture, snapshot))
    if snapshot.link:
        files["permalink.txt"] = f"{snapshot.link}\n".encode()
    files["README.txt"] = _readme(snapshot, files).encode()
    names = sorted(files, key=lambda name: (name != "README.txt", name))
    return zip_bytes((name, files[name]) for name in names)


def _sides(snapshot: Snapshot) -> dict[str, tuple[ObjectRollout, int]]:
    """Name the rollouts that are shown, each with its frame."""
    if snapshot.compared is not None:
        return dict(snapshot.compared)
    return {} if snapshot.rollout is None else {"shown": (snapshot.rollout, snapshot.rollout_frame)}


def _tables(sides: dict[str, tuple[ObjectRollout, int]]) -> dict[str, bytes]:
    nodes: list[list[Any]] = []
    controls: list[list[Any]] = []
    springs: list[list[Any]] = []
    forces: list[list[Any]] = []
    for side, (rollout, frame) in sides.items():
        model, first = rollout.model_in(frame), rollout.model.object_spring_count
        position, control = np.asarray(rollout.position[frame]), np.asarray(rollout.control[frame])
        for node, (place, force) in enumerate(zip(position, rollout.forces(frame), strict=True)):
            nodes.append([side, node, *rounded(place), *rounded(force)])
        ends = np.sort(model.spring_nodes, axis=1)
        acting = ends[first:][rollout.model.acts_in(frame)[first:]]
        held = np.bincount(acting[:, 1] - model.node_count, minlength=len(control))
        for number, place in enumerate(control):
            controls.append([side, number, *rounded(place), int(held[number])])
        strain = rollout.strains(frame)
        for number, (node, other) in enumerate(ends.tolist()):
            is_virtual = number >= first
            rest = float(model.rest_length[number])
            stiffness = rollout.parameters.stiffness_scale * float(model.stiffness[number])
            about = [(1 + strain[number]) * rest, rest, strain[number], stiffness]
            kind = "virtual" if is_virtual else "object"
            end = other - model.node_count if is_virtual else other
            texts = rounded([*about, float(model.damping[number])])
            springs.append([side, number, kind, node, end, *texts])
        for number, force in enumerate(rollout.spring_forces(frame), first):
            node, other = ends[number].tolist()
            forces.append([side, number, node, other - model.node_count, *rounded(force)])
    return {
        "nodes.csv": csv_bytes(_NODES, nodes),
        "controls.csv": csv_bytes(_CONTROLS, controls),
        "springs.csv": csv_bytes(_SPRINGS, springs),
        "forces.csv": csv_bytes(_FORCES, forces),
    }


def _arrays(sides: dict[str, tuple[ObjectRollout, int]], snapshot: Snapshot) -> bytes:
    arrays: dict[str, Any] = {}
    for side, (rollout, frame) in sides.items():
        prefix = "" if side == "shown" else f"{side}_"
        arrays |= {
            f"{prefix}position": np.asarray(rollout.position[frame]),
            f"{prefix}control": np.asarray(rollout.control[frame]),
            f"{prefix}force": rollout.forces(frame),
            f"{prefix}virtual_spring_force": rollout.spring_forces(frame),
        }
        model = rollout.model_in(frame).to_tensors()
        arrays |= {f"{prefix}{name}": array for name, array in model.items()}
    for hand in snapshot.content.hands:
        vertex = hand.vertex[min(snapshot.frame, len(hand.vertex) - 1)]
        arrays[f"hand_{hand.side}_vertex"] = np.asarray(vertex)
        if hand.face is not None:
            arrays[f"hand_{hand.side}_face"] = np.asarray(hand.face)
    return npz_bytes(arrays)


def _parameters(sides: dict[str, tuple[ObjectRollout, int]]) -> bytes:
    content = {side: rollout.parameters.to_dict() for side, (rollout, _) in sides.items()}
    return yaml.safe_dump(plain(content.get("shown", content)), sort_keys=False).encode()


def _views(snapshot: Snapshot) -> Iterator[tuple[str, bytes]]:
    """Give the cameras' images of the frame."""
    for view in snapshot.content.views:
        if view.has_color:
            image = view.color(snapshot.frame)
            is_written, content = cv2.imencode(".png", image[..., ::-1])
            if is_written:
                yield f"views/{view.name}.png", content.tobytes()


def _camera(picture: Screenshot, snapshot: Snapshot) -> dict[str, Any]:
    pose = picture.pose
    camera = pose.camera(picture.width, picture.height)
    own = {
        "width": picture.width,
        "height": picture.height,
        "position": pose.position,
        "look_at": pose.look_at,
        "up": pose.up,
        "vertical_field_of_view_deg": float(np.degrees(pose.fov)),
        "K": camera.K,
        "T_world_camera": camera.T_world_camera,
    }
    recorded = {
        view.name: {
            "width": view.camera.width,
            "height": view.camera.height,
            "K": view.camera.K,
            "T_world_camera": view.camera.T_world_camera,
            "distortion": view.camera.distortion,
        }
        for view in snapshot.content.views
    }
    return {"picture": own, "views": recorded}


def _readme(snapshot: Snapshot, files: dict[str, bytes]) -> str:
    content, run = snapshot.content, snapshot.run
    unit = content.length_unit
    layers = {} if snapshot.layers is None else vars(snapshot.layers)
    there = _layers_there(content)
    shown = ", ".join(name for name, on in layers.items() if on is True and name in there)
    named = "metres" if content.is_metric else f"{unit}s, which have no metric scale"
    units = [f"Lengths are in {named}, times in seconds."]
    if content.fitted is not None:
        units.append("Forces are in newtons of the model, each node of which weighs 1 kg.")
        mass = snapshot.mass
        if mass is not None:
            factor = mass.force_factor(content.fitted.model.node_count)
            units.append(
                f"For an object of {mass.text} ({mass.source}), as on the screen, multiply forces, "
                f"stiffness and damping by {factor:.4g}."
            )
    color = layers.get("color", "plain")
    about = [line for name, line in _ABOUT if any(file.startswith(name) for file in files)]
    return "\n".join(
        [
            f"{content.title}: sequence {content.sequence_name}, frame {snapshot.frame}",
            f"Saved by PhysHanDI {__version__}" + (f" from run {run.id}." if run else "."),
            "",
            *units,
            "The world has z up. Cameras have x right, y down, z ahead.",
            *([f"Shown were: {shown}."] if shown else []),
            *([f"Colors tell: {color}."] if color != "plain" else []),
            "",
            *about,
            "",
            *(_COLUMNS if content.fitted is not None else ()),
        ]
    )


def _layers_there(content: Content) -> set[str]:
    """Name the layers that have anything in them."""
    there = {"ground"}
    if content.hands or content.skeletons:
        there.add("hands")
    if content.fitted is not None:
        there |= {"nodes", "surface", "virtual_springs", "object_springs", "forces", "all_controls"}
    if content.splats is not None:
        there.add("splats")
    if content.control is not None:
        there.add("controls")
    if content.observed is not None:
        there.add("observed")
    return there | ({"cameras"} if content.views else set())


_COLUMNS = (
    "Column 'side': 'shown', or the sides of a comparison: 'ours' and 'phystwin', or 'a' and",
    "'b'. Numbers of nodes, controls and springs start at 0.",
    "",
)
_ABOUT = (
    ("picture.png", "picture.png      the view"),
    ("views/", "views/*.png      what the recording's cameras saw in this frame, if there are any"),
    ("frame.ply", "frame.ply        nodes, hands and virtual springs (edges) of this frame"),
    ("nodes.csv", "nodes.csv        object nodes: place, and force of the hands"),
    ("controls.csv", "controls.csv     control nodes: place, springs that they hold"),
    ("springs.csv", "springs.csv      all springs: ends, length, rest length, strain, stiffness"),
    ("forces.csv", "forces.csv       force of each virtual spring on its object node"),
    (
        "frame.npz",
        "frame.npz        the same as arrays, without rounding, with the hands' surfaces",
    ),
    ("parameters.yaml", "parameters.yaml  what the object was simulated with"),
    (
        "camera.json",
        "camera.json      cameras of the picture and of the recording: K, T_world_camera",
    ),
    (
        "permalink.txt",
        "permalink.txt    opens this view again, put behind the address of the same server",
    ),
)


def _json(content: Any) -> bytes:
    return (json.dumps(without_non_finite(plain(content)), indent=1) + "\n").encode()
