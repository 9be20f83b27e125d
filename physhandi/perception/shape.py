"""The object in the first frame: what of the cloud it is, what kind of object, and its nodes."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.spatial import KDTree

from physhandi.data.observation import ObjectObservation
from physhandi.data.sequence import Sequence
from physhandi.data.sequence_meta import DIMENSION, ShapeClass
from physhandi.errors import FitError, MissingInputError
from physhandi.perception.node_sampling import (
    flat_sheet_nodes,
    is_flat,
    meshed_solid_nodes,
    rope_nodes,
    solid_nodes,
    surface_nodes,
    unseen_surface_nodes,
)
from physhandi.perception.object_points import (
    CALIBRATION_MARGIN,
    Removal,
    object_points,
    removal,
    silhouette_test,
)
from physhandi.perception.shape_class import (
    LEAST_LAYERS,
    FoundClass,
    HiddenTest,
    cell_size,
    find_class,
)
from physhandi.triangles import SurfaceSamples, is_closed, sample_surface, triangle_areas

_GROUND_HEIGHT = 0.006
"""Most that a point beside an object may be above the ground to belong to the ground [m]."""
_GROUND_SHARE = 0.25
"""The same, as a share of the object's thickness."""
_FEW = 0.01
"""Share of removed points that is not worth a warning, if they are near."""
_FAR = 0.05
"""Distance at which a single removed point is worth one [m]."""
_SPACING_STEP = 0.0005
_LEAST_SPACING = 1e-4
_SAMPLE_SPACING = 0.25
"""Distance between samples of a mesh, in distances between nodes."""
_MOST_SAMPLES = 60_000
_WARNING_CODE = "object_points_removed"


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectShape:
    """The nodes of an object and what they were decided by."""

    kind: ShapeClass
    """Kind of object."""
    is_given: bool
    """Whether ``sequence.yaml`` says so."""
    thickness: float
    """Median local thickness of what was seen; see `FoundClass` [m]."""
    reason: str
    """Reason for the kind, in one line."""
    spacing: float
    """Distance between neighbouring nodes that was asked for [m]."""
    point_count: int
    """Points of the first frame that are the object's."""
    removed: tuple[Removal, ...]
    """Points of the first frame that are not."""
    node: Float[ndarray, "node 3"]
    """Nodes in the world frame, in a fixed order [m]."""

    @property
    def warnings(self) -> list[dict[str, str]]:
        """Warnings for the user: ``code`` and ``message`` of each.

        A few points beside the object are no reason; masks are never exact.
        """
        count = sum(part.count for part in self.removed)
        farthest = max((part.distance for part in self.removed), default=0.0)
        if count < _FEW * (count + self.point_count) and farthest < _FAR:
            return []
        texts = ", ".join(str(part) for part in self.removed)
        message = (
            f"{count} of {count + self.point_count} points that the masks of frame 0 call the "
            f"object are not part of it and got no nodes: {texts}."
        )
        return [{"code": _WARNING_CODE, "message": message}]

    def __str__(self) -> str:
        """Describe the shape in one line."""
        how = "as sequence.yaml says" if self.is_given else self.reason
        said = [f"{self.kind} ({how})", f"{len(self.node)} nodes"]
        if self.removed:
            said.append("removed " + " and ".join(str(part) for part in self.removed))
        return "; ".join(said)

    def to_dict(self) -> dict[str, Any]:
        """Give everything but the nodes, in plain data."""
        return {
            "shape": self.kind,
            "is_given": self.is_given,
            "reason": self.reason,
            "thickness": round(self.thickness, 6),
            "node_count": len(self.node),
            "node_spacing": self.spacing,
            "point_count": self.point_count,
            "removed": [
                {"reason": part.reason, "count": part.count, "distance": round(part.distance, 6)}
                for part in self.removed
            ],
            "warnings": self.warnings,
        }


def shape_of_observation(
    observation: ObjectObservation,
    spacing: float,
    sequence: Sequence | None = None,
    *,
    most_nodes: int | None = None,
) -> ObjectShape:
    """Find the shape of an object in the first frame of an observation.

    Args:
        observation: What was seen of the object; its fused cloud of frame 0 is used.
        spacing: Distance between neighbouring nodes [m].
        sequence: Recording that the observation came from. With it nodes stand on its ground, a
            hidden part is filled exactly where no view sees past the object, and the kind of object
            is the one that it names, if it names one.
        most_nodes: Most nodes that the object may get; None for any number.

    Raises:
        MissingInputError: If the first frame shows no object points.
        FitError: If the object would get more nodes; names a spacing that fits.
    """
    where = "" if sequence is None else f"Sequence '{sequence.name}': "
    if not observation.cloud or len(observation.cloud[0]) == 0:
        raise MissingInputError(
            f"{where}The first frame shows no points of the object, so its shape is unknown. "
            "Add depth and masks of frame 0, or object_node.npy."
        )
    cloud = observation.cloud[0]
    if sequence is None:
        shape = object_shape(cloud, spacing)
    else:
        views = [view for view in sequence.views if view.has_mask]
        shape = object_shape(
            cloud,
            spacing,
            ground_height=sequence.ground_height,
            is_hidden=(lambda point: silhouette_test(views, 0, point)) if views else None,
            is_possible=(
                (lambda point: silhouette_test(views, 0, point, margin=CALIBRATION_MARGIN))
                if views
                else None
            ),
            kind=sequence.shape,
            mesh=sequence.mesh,
        )
    if most_nodes is not None and len(shape.node) > most_nodes:
        factor = (len(shape.node) / most_nodes) ** (1.0 / DIMENSION[shape.kind])
        fits = _SPACING_STEP * np.ceil(1.02 * spacing * factor / _SPACING_STEP)
        raise FitError(
            f"{where}The object would get {len(shape.node)} nodes as a {shape.kind} at a "
            f"node_spacing of {spacing:g} m, and {most_nodes} are allowed (most_nodes). A "
            f"node_spacing of {fits:g} m fits. If it is no {shape.kind}, say 'shape: …' in "
            "sequence.yaml; if its masks show other things too, mend them."
        )
    return shape


def shape_of_nodes(node: Float[ndarray, "node 3"], sequence: Sequence) -> ObjectShape:
    """Find the kind of an object whose nodes are given.

    Args:
        node: Nodes at frame 0 [m].
        sequence: Recording that they belong to; it may name the kind.
    """
    place = node.astype(np.float64)
    near = KDTree(place).query(place, k=min(2, len(place)))[0].reshape(len(place), -1)[:, -1]
    spacing = max(float(np.median(near)), _LEAST_SPACING)
    guess = find_class(place, spacing, ground_height=sequence.ground_height)
    kind, reason = guess.kind, guess.reason
    if (sequence.surface_node_count or len(node)) < len(node):
        kind, reason = "solid", "it has nodes that are not on its surface"
    return ObjectShape(
        kind=sequence.shape or kind,
        is_given=sequence.shape is not None,
        thickness=guess.thickness,
        reason=reason,
        spacing=spacing,
        point_count=len(node),
        removed=(),
        node=node,
    )


def object_shape(
    cloud: Float[ndarray, "point 3"],
    spacing: float,
    *,
    ground_height: float | None = None,
    is_hidden: HiddenTest | None = None,
    is_possible: HiddenTest | None = None,
    kind: ShapeClass | None = None,
    mesh: tuple[Float[ndarray, "vertex 3"], Int[ndarray, "face 3"]] | None = None,
) -> ObjectShape:
    """Clean the cloud of an object, tell what kind of object it is, and sample its nodes.

    Args:
        cloud: Points on the seen surface in the world frame, z up [m].
        spacing: Distance between neighbouring nodes [m].
        ground_height: Height below which there is nothing [m].
        is_hidden: Where the object may continue unseen.
        is_possible: The same, with room for errors of masks and cameras.
        kind: Kind of object, if it is known.
        mesh: Corners [m] and triangles of its whole surface, where it is in this frame.

    Returns:
        The same for the same cloud.

    Raises:
        ValueError: If the cloud is empty or the spacing is not positive.
    """
    if len(cloud) == 0 or not spacing > 0:
        raise ValueError(f"need points and a positive spacing, not {len(cloud)} and {spacing}")
    seen = cloud.astype(np.float64)
    is_object, removed = object_points(seen, cell_size(seen, spacing), is_possible=is_possible)
    seen = seen[is_object]
    guess = find_class(seen, spacing, ground_height=ground_height, is_possible=is_possible)
    samples = None if mesh is None else _samples(*mesh, spacing, ground_height)
    if samples is not None and mesh is not None and is_closed(mesh[1]):
        guess = _with_mesh(guess, samples, spacing)
    kind_used = kind or guess.kind
    thickness = guess.thickness
    if ground_height is not None and kind_used in {"solid", "rope"}:
        thickness = min(thickness, float(np.percentile(seen[:, 2], 80)) - ground_height)
        is_ground = _is_ground(seen, cell_size(seen, spacing), ground_height, thickness)
        if is_ground.any():
            removed = (*removed, removal("ground", seen, is_ground, ~is_ground))
            seen = seen[~is_ground]
    node = _nodes(
        kind_used,
        seen,
        spacing,
        ground_height,
        thickness=thickness,
        is_hidden=is_hidden,
        mesh=samples,
    )
    if ground_height is not None:
        node[:, 2] = np.maximum(node[:, 2], ground_height)
    return ObjectShape(
        kind=kind_used,
        is_given=kind is not None,
        thickness=guess.thickness,
        reason=guess.reason,
        spacing=spacing,
        point_count=len(seen),
        removed=removed,
        node=node.astype(np.float32),
    )


def _nodes(
    kind: ShapeClass,
    seen: Float[ndarray, "point 3"],
    spacing: float,
    ground_height: float | None,
    *,
    thickness: float,
    is_hidden: HiddenTest | None,
    mesh: SurfaceSamples | None,
) -> Float[ndarray, "node 3"]:
    """Sample the nodes of an object of a known kind."""
    if kind == "solid":
        if mesh is not None:
            return meshed_solid_nodes(seen, spacing, ground_height, mesh)
        return solid_nodes(seen, spacing, ground_height)
    if kind == "rope":
        node = rope_nodes(seen, spacing, thickness, is_hidden)
    elif kind == "sheet" and is_flat(seen, spacing):
        node = flat_sheet_nodes(seen, spacing, is_hidden)
    else:
        node = surface_nodes(seen, spacing, is_hidden)
    if mesh is None:
        return node
    return np.concatenate([node, unseen_surface_nodes(node, mesh, spacing)])


def _samples(
    vertex: Float[ndarray, "vertex 3"],
    faces: Int[ndarray, "face 3"],
    spacing: float,
    ground_height: float | None,
) -> SurfaceSamples:
    """Sample a mesh much more densely than nodes lie; what is in the ground comes onto it."""
    area = float(triangle_areas(vertex, faces).sum())
    count = int(np.clip(area / (_SAMPLE_SPACING * spacing) ** 2, 1000, _MOST_SAMPLES))
    samples = sample_surface(vertex, faces, count)
    if ground_height is not None:
        samples.point[:, 2] = np.maximum(samples.point[:, 2], ground_height)
    return samples


def _with_mesh(guess: FoundClass, mesh: SurfaceSamples, spacing: float) -> FoundClass:
    """Correct the kind of a body that was seen from one side only, which looks like a sheet."""
    if guess.kind != "sheet" or mesh.thickness < LEAST_LAYERS * spacing:
        return guess
    reason = f"its mesh encloses a body that is {1e3 * mesh.thickness:.0f} mm thick on average"
    return FoundClass(kind="solid", thickness=mesh.thickness, reason=reason)


def _is_ground(
    cloud: Float[ndarray, "point 3"], cell: float, ground_height: float, thickness: float
) -> Bool[ndarray, " point"]:
    """Mark the points on the ground that have nothing of the object above or right beside them."""
    height = cloud[:, 2] - ground_height
    limit = min(_GROUND_HEIGHT, _GROUND_SHARE * thickness)
    is_low, is_high = height < limit, height > 2.0 * limit
    if limit <= 0 or not is_high.any():
        return np.zeros(len(cloud), dtype=bool)
    return is_low & (KDTree(cloud[is_high, :2]).query(cloud[:, :2])[0] > 2.0 / 3.0 * cell)
