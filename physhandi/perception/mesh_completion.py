"""Completes what a sequence shows of its object in frame 0 by a mesh of the whole of it."""

import dataclasses
import hashlib
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

import physhandi
from physhandi.data.arrays import write_array
from physhandi.data.files import write_yaml
from physhandi.data.importers.mesh import read_mesh
from physhandi.data.sequence import Sequence
from physhandi.data.sequence_meta import FILE
from physhandi.data.view import View
from physhandi.errors import FitError, MissingInputError, UsageError
from physhandi.perception.lifting import OBJECT_LABEL, VOXEL, fuse, surface_points
from physhandi.perception.mesh_alignment import Alignment, SeenSpace, align_mesh
from physhandi.perception.object_points import (
    CALIBRATION_MARGIN,
    object_points,
    silhouette_test,
)
from physhandi.perception.shape_class import cell_size
from physhandi.triangles import is_closed, vertex_normals

LEAST_SEEN = 100
"""Points of the object that frame 0 must show."""
_SEEN_DEPTH = 0.01
"""A corner is seen if it is no farther than this from what depth measured at its pixel [m]."""
_FACING = 0.2
"""Cosine of the angle from which a view sees the surface too flat to tell its color."""
_FILES = ("mesh_vertex.npy", "mesh_face.npy", "mesh_color.npy")


@dataclasses.dataclass(frozen=True)
class RoughPose:
    """About how a mesh lies in the world."""

    rotation: Rotation
    """Turns axes of the mesh into those of the world."""
    middle: Float[ndarray, " 3"] | None = None
    """Where the middle of its extent is [m]; None for where the object was seen."""

    @classmethod
    def parse(cls, text: str) -> "RoughPose":
        """Read turns about the world's x, y and z [degrees], in this order, and maybe a place [m].

        Raises:
            UsageError: If the text holds neither three nor six finite numbers.
        """
        try:
            numbers = np.array([float(part) for part in text.split(",")])
        except ValueError:
            numbers = np.zeros(0)
        if len(numbers) not in {3, 6} or not np.isfinite(numbers).all():
            raise UsageError(
                f"The pose {text!r} is none; write three turns in degrees, like 90,0,-30, or these "
                "and the place of the middle in metres, like 90,0,-30,0.1,0,0.05."
            )
        turn = Rotation.from_euler("xyz", numbers[:3], degrees=True)
        return cls(turn, numbers[3:] if len(numbers) == 6 else None)


def complete_shape(
    folder: Path | str,
    mesh_file: Path | str,
    *,
    scale: float | None = None,
    pose: RoughPose | None = None,
) -> Alignment:
    """Lay a mesh onto the object in frame 0, color it, and store it with the sequence.

    A mesh that is there is replaced. ``provenance.mesh`` in ``sequence.yaml`` says where it comes
    from and how well it fits.

    Args:
        folder: Folder of a sequence whose views have depth and masks.
        mesh_file: Mesh of the whole object, in about the shape that it has in frame 0.
        scale: Metres for one unit of the mesh; None to find it.
        pose: About how it lies; None to find it.

    Raises:
        UsageError: If the mesh cannot be read, or the scale makes no sense.
        MissingInputError: If no view has depth and masks, or frame 0 shows too little.
        FitError: If the mesh fits nowhere; nothing is written.
    """
    if scale is not None and not (np.isfinite(scale) and scale > 0):
        raise UsageError(f"A scale of {scale} makes no sense; give metres for one unit.")
    sequence = Sequence.load(Path(folder))
    views = sequence.depth_views
    cloud = _first_cloud(sequence, views)
    mesh = read_mesh(mesh_file)
    rotation, middle = (None, None) if pose is None else (pose.rotation, pose.middle)
    space = SeenSpace([view for view in sequence.views if view.has_mask], 0)
    try:
        alignment = align_mesh(
            mesh.vertex, mesh.faces, cloud, space, scale=scale, start=rotation, middle=middle
        )
    except FitError as error:
        raise FitError(f"Sequence '{sequence.name}', mesh {mesh_file}: {error}") from None
    vertex = alignment.apply(mesh.vertex)
    faces = _seen_from_outside(vertex, mesh.faces)
    color = paint_mesh(vertex, faces, sequence.views, own=mesh.color)
    _store(sequence, Path(mesh_file), alignment, (vertex, faces, color))
    return alignment


def _first_cloud(sequence: Sequence, views: list[View]) -> Float[ndarray, "point 3"]:
    """Fuse what all views see of the object in frame 0, without what is beside it [m]."""
    if not views:
        raise MissingInputError(
            f"Sequence '{sequence.name}' has no view with both depth and masks, so it is unknown "
            "where the object is. Make masks by physhandi annotate."
        )
    cloud = fuse(
        [surface_points(view, view.depth(0), view.mask(0) == OBJECT_LABEL) for view in views]
    ).astype(np.float64)
    if len(cloud) >= LEAST_SEEN:
        masked = [view for view in sequence.views if view.has_mask]
        is_object, _ = object_points(
            cloud,
            cell_size(cloud, VOXEL),
            is_possible=lambda point: silhouette_test(masked, 0, point, margin=CALIBRATION_MARGIN),
        )
        cloud = cloud[is_object]
    if len(cloud) < LEAST_SEEN:
        raise MissingInputError(
            f"Sequence '{sequence.name}' shows only {len(cloud)} points of the object in frame 0; "
            f"at least {LEAST_SEEN} are needed to lay a mesh onto it. Check depth and masks of "
            "that frame."
        )
    return cloud


def _seen_from_outside(
    vertex: Float[ndarray, "vertex 3"], faces: Int[ndarray, "face 3"]
) -> Int[ndarray, "face 3"]:
    """Turn triangles so that a closed surface is seen from outside."""
    a, b, c = (vertex[faces[:, corner]] - vertex.mean(axis=0) for corner in range(3))
    volume = np.einsum("fd,fd->", a, np.cross(b, c))
    return faces[:, ::-1] if is_closed(faces) and volume < 0 else faces


def paint_mesh(
    vertex: Float[ndarray, "vertex 3"],
    faces: Int[ndarray, "face 3"],
    views: tuple[View, ...],
    *,
    own: UInt8[ndarray, "vertex 3"] | None = None,
) -> UInt8[ndarray, "vertex 3"] | None:
    """Color the corners of a mesh as views see them in frame 0.

    Views are averaged, the more the straighter they look at the surface. What none sees keeps the
    mesh's own color, or takes that of the nearest corner that is seen.

    Args:
        vertex: Corners in the world [m].
        faces: Triangles, seen from outside.
        views: Views of the object; those with color, depth and masks count.
        own: Color that the mesh brings along.

    Returns:
        Colors, or None if there are none at all.
    """
    normal = vertex_normals(vertex, faces)
    total, weights = np.zeros((len(vertex), 3)), np.zeros(len(vertex))
    for view in views:
        if not (view.has_color and view.has_depth and view.has_mask):
            continue
        camera = view.camera
        towards = camera.T_world_camera[:3, 3] - vertex
        facing = (towards * normal).sum(axis=1) / np.linalg.norm(towards, axis=1)
        pixel = np.nan_to_num(camera.project(vertex), nan=-1e6).round().astype(np.int64)
        is_inside = (pixel >= 0).all(axis=1) & (facing > _FACING)
        is_inside &= (pixel[:, 0] < camera.width) & (pixel[:, 1] < camera.height)
        seen = np.flatnonzero(is_inside)
        column, row = pixel[seen].T
        measured = view.depth(0)[row, column]
        is_near = np.abs(measured - camera.camera_depth(vertex[seen])) < _SEEN_DEPTH
        is_near &= (measured > 0) & (view.mask(0)[row, column] == OBJECT_LABEL)
        seen, row, column = seen[is_near], row[is_near], column[is_near]
        total[seen] += facing[seen, None] * view.color(0)[row, column]
        weights[seen] += facing[seen]
    is_seen = weights > 0
    if not is_seen.any():
        return own
    color = total / np.maximum(weights, 1e-9)[:, None]
    if own is not None:
        color[~is_seen] = own[~is_seen]
    elif not is_seen.all():
        nearest = KDTree(vertex[is_seen]).query(vertex[~is_seen])[1]
        color[~is_seen] = color[is_seen][nearest]
    return color.round().astype(np.uint8)


def _store(
    sequence: Sequence,
    mesh_file: Path,
    alignment: Alignment,
    mesh: tuple[ndarray, ndarray, ndarray | None],
) -> None:
    """Replace the mesh of a sequence; one that is half there is no valid sequence."""
    for name in _FILES:
        (sequence.folder / name).unlink(missing_ok=True)
    vertex, faces, color = mesh
    write_array(sequence.folder / "mesh_vertex.npy", vertex.astype(np.float32))
    write_array(sequence.folder / "mesh_face.npy", np.ascontiguousarray(faces, np.int32))
    if color is not None:
        write_array(sequence.folder / "mesh_color.npy", color)
    about = {
        "source": mesh_file.name,
        "sha256": hashlib.sha256(mesh_file.read_bytes()).hexdigest(),
        **alignment.to_dict(),
        "version": physhandi.__version__,
    }
    meta = dataclasses.replace(sequence.meta, provenance={**sequence.provenance, "mesh": about})
    write_yaml(sequence.folder / FILE, meta.to_dict())
