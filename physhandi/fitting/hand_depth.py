"""The depth of a hand: measured points against the side of its surface that the camera sees."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from physhandi.data.sequence import Sequence
from physhandi.hand.model import Side
from physhandi.perception.lifting import HAND_LABEL, surface_points

_CANDIDATES = 8
_REFRESH = 10
_DOUBT = 3.0


@dataclass(eq=False)
class DepthTarget:
    """Points that the views measured on one hand, and the vertices they belong to."""

    point: Float[Tensor, "frame point 3"]
    """Measured points; zero where a frame has fewer [m]."""
    towards_camera: Float[Tensor, "frame point 3"]
    """Unit vector from each point to the camera that measured it."""
    weight: Float[Tensor, "frame point"]
    """One divided by the frame's number of points; zero where there is none."""
    vertex: Tensor | None = None
    """Vertex that each point is compared with, renewed now and then."""
    age: int = 0
    """Uses since it was renewed."""


def depth_target(sequence: Sequence, side: Side, point_count: int) -> DepthTarget | None:
    """Collect the measured points of one hand from all views with depth and masks.

    Args:
        sequence: The recording.
        side: Which hand.
        point_count: Most points kept in a frame, evenly spread over the image.

    Returns:
        The points; None if no view has depth and masks of this hand.
    """
    views = [view for view in sequence.views if view.has_depth and view.has_mask]
    frames = []
    for frame in range(sequence.frame_count):
        point, camera = np.zeros((0, 3)), np.zeros((0, 3))
        for view in views:
            is_hand = view.mask(frame) == HAND_LABEL[side]
            seen = surface_points(view, view.depth(frame), is_hand)
            point = np.concatenate([point, seen])
            camera = np.concatenate([camera, view.camera.T_world_camera[:3, 3] - seen])
        chosen = np.linspace(0, len(point) - 1, min(point_count, len(point))).round().astype(int)
        frames.append((point[chosen], camera[chosen]))
    if not any(len(point) for point, _ in frames):
        return None
    shape = (len(frames), point_count, 3)
    point, ray, weight = np.zeros(shape), np.zeros(shape), np.zeros(shape[:2])
    for frame, (seen, camera) in enumerate(frames):
        count = len(seen)
        if count:
            point[frame, :count] = seen
            ray[frame, :count] = camera / np.linalg.norm(camera, axis=1, keepdims=True)
            weight[frame, :count] = 1 / count
    return DepthTarget(
        point=torch.tensor(point, dtype=torch.float32),
        towards_camera=torch.tensor(ray, dtype=torch.float32),
        weight=torch.tensor(weight, dtype=torch.float32),
    )


def depth_loss(
    vertex: Float[Tensor, "frame vertex 3"],
    faces: Tensor,
    target: DepthTarget,
    noise: float,
) -> Float[Tensor, ""]:
    """Compare measured points with the surface, along its normal (one way, Cauchy's robust loss).

    Args:
        vertex: The hand's surface in the world frame [m].
        faces: Its triangles.
        target: The measured points; the vertices they belong to are renewed every tenth call.
        noise: Expected error of a measurement [m].

    Returns:
        Mean over points, then frames, in units of the noise, squared.
    """
    normal = vertex_normals(vertex, faces)
    if target.vertex is None or target.age >= _REFRESH:
        target.vertex, target.age = _correspond(vertex.detach(), normal.detach(), target), 0
    target.age += 1
    index = target.vertex[..., None].expand(-1, -1, 3)
    offset = target.point - vertex.gather(1, index)
    along = (offset * normal.gather(1, index)).sum(-1)
    aside = ((offset**2).sum(-1) - along**2).clamp(min=0)
    squared = (along**2 + 0.1 * aside) / noise**2
    robust = _DOUBT**2 * torch.log1p(squared / _DOUBT**2)
    return (target.weight * robust).sum() / max(int((target.weight.sum(1) > 0).sum()), 1)


def vertex_normals(
    vertex: Float[Tensor, "frame vertex 3"], faces: Tensor
) -> Float[Tensor, "frame vertex 3"]:
    """Compute unit normals of vertices, the area-weighted mean of their triangles'."""
    a, b, c = (vertex[:, faces[:, corner]] for corner in range(3))
    normal = torch.cross(b - a, c - a, dim=-1)
    total = torch.zeros_like(vertex)
    for corner in range(3):
        total = total.index_add(1, faces[:, corner], normal)
    return total / total.norm(dim=-1, keepdim=True).clamp(min=1e-12)


def _correspond(vertex: Tensor, normal: Tensor, target: DepthTarget) -> Tensor:
    """Find for each point the nearest vertex among its neighbours that faces the camera."""
    chosen = torch.zeros(target.weight.shape, dtype=torch.int64)
    for frame in range(len(vertex)):
        count = int((target.weight[frame] > 0).sum())
        if not count:
            continue
        tree = KDTree(vertex[frame].numpy())
        near = np.asarray(tree.query(target.point[frame, :count].numpy(), k=_CANDIDATES)[1])
        facing = normal[frame][near] * target.towards_camera[frame, :count, None]
        first = (facing.sum(-1) > 0).numpy().argmax(axis=1)
        chosen[frame, :count] = torch.from_numpy(
            np.take_along_axis(near, first[:, None], axis=1)[:, 0]
        )
    return chosen
