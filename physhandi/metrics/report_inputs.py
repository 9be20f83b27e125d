"""What a run is scored against, gathered from its files and its sequence."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from physhandi.data.atomic import read_array, read_tensors
from physhandi.data.sequence import Sequence
from physhandi.data.truth import read_truth
from physhandi.errors import RunError
from physhandi.metrics.contact import (
    THRESHOLDS,
    ContactReference,
    joined_nodes,
    proximity_labels,
    true_labels,
    true_proximity_labels,
)
from physhandi.metrics.hand_shape import held_where_missing
from physhandi.metrics.topology import radius_deviation, resolution
from physhandi.metrics.truth_metrics import TrueSurface, true_surface


@dataclass(frozen=True, eq=False, kw_only=True)
class Reference:
    """What a rollout is compared with; any part may be absent."""

    object_node: Float[ndarray, "node 3"]
    """Object nodes in frame 0 [m]."""
    surface_count: int | None = None
    """Leading nodes that lie on the surface, which alone enter Chamfer distances; None: all."""
    point: Float[ndarray, "frame track 3"] | None = None
    """Observed tracks [m]; NaN where not visible."""
    is_visible: Bool[ndarray, "frame track"] | None = None
    """Whether a track is visible."""
    node_of_track: Int[ndarray, " track"] | None = None
    """Node that each track observes; None lets the nodes around it carry it."""
    validation: Float[ndarray, "frame validation 3"] | None = None
    """Annotated points that no fit saw [m]; NaN where not annotated. They replace the tracks where
    tracks are scored."""
    cloud: tuple[Float[ndarray, "_ 3"], ...] = ()
    """Observed points per frame [m]; none takes the visible tracks."""
    marker: Float[ndarray, "frame marker 3"] | None = None
    """Identified points [m]; NaN where not seen."""
    marker_node: Int[ndarray, " marker"] | None = None
    """Node that each marker observes."""
    controlled_markers: tuple[int, ...] = ()
    """Markers that are not scored because they move with the controls."""
    true_surface: TrueSurface | None = None
    """Where the object really was."""
    contact: ContactReference | None = None
    """What contacts are judged by."""


def read_reference(
    folder: Path, sequence: Sequence, rollout: Float[ndarray, "frame node 3"] | None
) -> Reference | None:
    """Collect what a run and its sequence know; None if there is no object to score.

    Args:
        folder: The run's folder of this sequence.
        sequence: The sequence.
        rollout: What the run simulated.

    Raises:
        RunError: If a file of the run is damaged.
        SequenceError: If the sequence tells a true surface that cannot be one.
    """
    point = read(folder / "observation" / "point.npy")
    is_visible = read(folder / "observation" / "is_visible.npy")
    node_of_track = read(folder / "observation" / "node_of_track.npy")
    node = read(folder / "object_node.npy")
    if node is None:
        node = sequence.object_node if rollout is None else rollout[0]
    if node is None or (point is None and sequence.marker is None):
        return None
    if sequence.marker is not None and point is not None and is_visible is not None:
        free = [m for m in range(point.shape[1]) if m not in sequence.controlled_markers]
        point, is_visible = point[:, free], is_visible[:, free]
        node_of_track = None if node_of_track is None else node_of_track[free]
    return Reference(
        object_node=node,
        surface_count=sequence.surface_node_count,
        point=point,
        is_visible=is_visible,
        node_of_track=node_of_track,
        validation=sequence.validation_track,
        cloud=tuple(read_split(folder / "observation", "cloud") or ()),
        marker=sequence.marker,
        marker_node=sequence.marker_node,
        controlled_markers=sequence.controlled_markers,
        true_surface=true_surface(read_truth(sequence.folder)),
        contact=_contact(folder, sequence, node, point, is_visible),
    )


def read_topology(out: Path, object_node: Float[ndarray, "node 3"]) -> dict[str, Any] | None:
    """Relate the fitted connection radii to the resolution; None if there is no fitted object.

    Args:
        out: Output folder of the run; its rest shape has the resolution that counts.
        object_node: Nodes that stand in where the run stores no rest shape [m].

    Raises:
        RunError: If a file of the run is damaged.
    """
    path = out / "object" / "parameters.yaml"
    node = read(out / "object" / "rest_node.npy")
    node = object_node if node is None else node
    if not path.is_file() or len(node) < 2:
        return None
    try:
        parameters = yaml.safe_load(path.read_text(encoding="utf-8"))
        radius, virtual = (
            float(parameters[name]) for name in ("connection_radius", "virtual_connection_radius")
        )
    except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError) as error:
        raise RunError(f"{path} does not tell the connection radii: {error}.") from error
    spacing = resolution(node.astype(np.float64))
    return {
        "resolution": spacing,
        "connection_radius": radius,
        "virtual_connection_radius": virtual,
        "rrd_object": radius_deviation(radius, spacing),
        "rrd_virtual": radius_deviation(virtual, spacing),
    }


def read(path: Path) -> Any:
    """Read an array of a run; None if it is not there.

    Raises:
        RunError: If it is damaged.
    """
    if not path.is_file():
        return None
    try:
        return read_array(path)
    except (ValueError, OSError) as error:
        raise RunError(f"{path} is not a readable array: {error}.") from error


def read_split(folder: Path, name: str) -> list[ndarray] | None:
    """Read point sets that are stored one after the other, with where each of them ends."""
    points, end = read(folder / f"{name}.npy"), read(folder / f"{name}_end.npy")
    return None if points is None or end is None else np.split(points, end.reshape(-1)[:-1])


def _contact(
    folder: Path,
    sequence: Sequence,
    node: Float[ndarray, "node 3"],
    point: ndarray | None,
    is_visible: ndarray | None,
) -> ContactReference | None:
    """Prepare the judgement of contacts; None without hands or without springs to judge."""
    vertices = [read(folder / f"hand_{side}_vertex.npy") for side in sequence.hands]
    whole = [held_where_missing(vertex)[0] for vertex in vertices if vertex is not None]
    known = [vertex for vertex in whole if vertex is not None]
    path = folder / "model.safetensors"
    if not known or not path.is_file():
        return None
    try:
        tensors = read_tensors(path)
        virtual = tensors["spring_nodes"][int(tensors["object_spring_count"][0]) :]
    except Exception as error:  # safetensors has no common class of errors
        raise RunError(f"{path} is not a readable model: {error}.") from error
    hand = np.concatenate(known, axis=1).astype(np.float64)
    start = node.astype(np.float64)
    told = read_truth(sequence.folder)
    truth = true_labels(told, start)
    if truth is not None:
        labels = dict.fromkeys(THRESHOLDS, truth)
    else:
        seen = None if point is None else point.astype(np.float64)
        labels = proximity_labels(start, hand, seen, is_visible)
    return ContactReference(
        hand=hand,
        is_joined=joined_nodes(virtual, len(node)),
        kind="proximity" if truth is None else "true",
        labels=labels,
        true_proximity=true_proximity_labels(told, start, sequence.hands),
    )
