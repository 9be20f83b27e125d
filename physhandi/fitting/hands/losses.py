"""The terms of the loss that stage 1 descends, and costs of single frames."""

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from physhandi.fitting.hands.observed import DepthTarget, FreeSpace, KeypointTarget
from physhandi.hand.model import HandModel

_KNUCKLE = ((-1.7, 0.6), (-0.4, 0.4), (-0.25, 0.25))
_MIDDLE = ((-2.0, 0.2), (-0.08, 0.08), (-0.08, 0.08))
_LAST = ((-1.5, 0.4), (-0.08, 0.08), (-0.08, 0.08))
_THUMB = (
    ((-0.9, 0.9), (-0.9, 0.9), (-0.6, 0.6)),
    ((-1.2, 0.6), (-0.4, 0.4), (-0.3, 0.3)),
    ((-1.6, 0.6), (-0.15, 0.15), (-0.15, 0.15)),
)
JOINT_LIMIT = np.array([*_THUMB, *([_KNUCKLE, _MIDDLE, _LAST] * 4)])
"""Lower and upper bound of each joint's rotation vector, for a right hand [rad]."""
_CANDIDATES = 8
"""Nearest vertices among which a measured point looks for one that faces the camera."""
REFRESH = 10
"""Evaluations of the depth loss between two searches for corresponding vertices."""
DEPTH_DOUBT = 3.0
"""Depth errors beyond this many standard deviations lose their pull (Cauchy's loss)."""
_ASIDE = 0.1
"""Share of a way along the surface, squared, that counts as distance from it."""
_SKIN = 0.003
"""Least depth of a keypoint under the hand's surface [m]."""
_EDGE = 0.03
"""A keypoint that is farther than this before what was measured is at an edge in the image [m]."""


def reprojection_loss(
    point: Float[Tensor, "frame 21 3"], target: KeypointTarget, breadth: float
) -> Float[Tensor, ""]:
    """Compare projected with observed keypoints: sum over keypoints, mean over frames.

    Args:
        point: Keypoints in the world frame.
        target: Observed keypoints.
        breadth: ``c`` of `keypoint_costs`.
    """
    return keypoint_costs(point, target, breadth).sum() / point.shape[0]


def keypoint_costs(
    point: Float[Tensor, "frame 21 3"], target: KeypointTarget, breadth: float
) -> Float[Tensor, "view frame 21"]:
    """Compare each projected with its observed keypoint.

    Cauchy's robust loss ``c² log(1 + (r / c)²)`` of the distance ``r`` in units of the expected
    noise, so that gross outliers have almost no gradient.

    Args:
        point: Keypoints in the world frame.
        target: Observed keypoints.
        breadth: ``c``, in units of noise.
    """
    _, _, squared = _seen(point, target)
    return target.weight * _cauchy(squared, breadth)


def reprojection_curvature(
    point: Float[Tensor, "frame 21 3"], target: KeypointTarget, breadth: float
) -> Float[Tensor, "frame 21 3 3"]:
    """Compute the curvature of `reprojection_loss` in the place of each keypoint.

    As Gauss and Newton have it: where Cauchy's loss pulls less, it bends less.
    """
    pixel, depth, squared = _seen(point, target)
    pull = target.weight * _cauchy_pull(squared, breadth) / target.noise[:, None, None] ** 2
    row = target.projection[:, None, None, :, :3]
    rate = (row[..., :2, :] - pixel[..., None] * row[..., 2:, :]) / depth[..., None]
    weighted = 2.0 / point.shape[0] * pull[..., None, None] * rate
    return torch.einsum("vfkai,vfkaj->fkij", weighted, rate)


def _seen(
    point: Float[Tensor, "frame 21 3"], target: KeypointTarget
) -> tuple[
    Float[Tensor, "view frame 21 2"],
    Float[Tensor, "view frame 21 1"],
    Float[Tensor, "view frame 21"],
]:
    """Project keypoints: pixels, depth above zero, and squared errors in units of noise."""
    projected = _projected(point, target.projection)
    depth = projected[..., 2:]
    nearest = 1e-3 * depth.detach().abs().median()
    depth = depth.clamp(min=float(nearest) + 1e-9)
    pixel = projected[..., :2] / depth
    squared = ((pixel - target.pixel) ** 2).sum(-1) / target.noise[:, None, None] ** 2
    return pixel, depth, squared


def _projected(
    point: Float[Tensor, "frame point 3"], projection: Float[Tensor, "view 3 4"]
) -> Float[Tensor, "view frame point 3"]:
    """Project points of the world: pixels times depth, and depth."""
    homogeneous = torch.cat([point, torch.ones_like(point[..., :1])], -1)
    return torch.einsum("vij,fkj->vfki", projection, homogeneous)


def _cauchy(squared: Tensor, breadth: float) -> Tensor:
    """Let squared errors beyond a breadth lose their pull."""
    return breadth**2 * torch.log1p(squared / breadth**2)


def _cauchy_pull(squared: Tensor, breadth: float) -> Tensor:
    """Give the slope of `_cauchy`."""
    return 1 / (1 + squared / breadth**2)


def limit_loss(articulation: Float[Tensor, "frame 15 3"], model: HandModel) -> Float[Tensor, ""]:
    """Sum the squared violations of the joint limits, averaged over frames [rad²]."""
    return limit_costs(articulation, model).sum() / articulation.shape[0]


def limit_costs(
    articulation: Float[Tensor, "frame 15 3"], model: HandModel
) -> Float[Tensor, "frame 15 3"]:
    """Square how far each joint is beyond its limits [rad²]."""
    mirror = torch.tensor([1.0, -1.0, -1.0] if model.side == "left" else [1.0, 1.0, 1.0])
    limit = torch.tensor(JOINT_LIMIT, dtype=articulation.dtype)
    turned = articulation * mirror
    beyond = (limit[..., 0] - turned).relu() + (turned - limit[..., 1]).relu()
    return beyond**2


def limit_curvature(
    articulation: Float[Tensor, "frame 15 3"], model: HandModel
) -> Float[Tensor, "frame 15 3"]:
    """Compute the curvature of `limit_loss` in each number of the joints."""
    return 2.0 / articulation.shape[0] * (limit_costs(articulation, model) > 0)


def hand_acceleration_loss(point: Float[Tensor, "frame 21 3"]) -> Float[Tensor, ""]:
    """Sum the squared second differences of the keypoints over time, averaged over frames."""
    if point.shape[0] < 3:
        return point.sum() * 0
    second = point[2:] - 2 * point[1:-1] + point[:-2]
    return (second**2).sum() / point.shape[0]


def velocity_loss(point: Float[Tensor, "frame joint 3"]) -> Float[Tensor, ""]:
    """Sum the squared differences from frame to frame, averaged over frames."""
    return ((point[1:] - point[:-1]) ** 2).sum() / point.shape[0]


def depth_loss(
    vertex: Float[Tensor, "frame vertex 3"],
    faces: Tensor,
    target: DepthTarget,
    noise: float,
) -> Float[Tensor, ""]:
    """Measure how far points lie from the surface, mostly along its normal (Cauchy's loss).

    Args:
        vertex: The hand's surface in the world frame [m].
        faces: Its triangles.
        target: Measured points; every tenth call updates the vertices they correspond to.
        noise: Expected error of a measurement [m].

    Returns:
        Mean over points, then frames, in units of the noise, squared.
    """
    normal = vertex_normals_torch(vertex, faces)
    if target.vertex is None or target.age >= REFRESH:
        target.vertex, target.age = correspond(vertex.detach(), normal.detach(), target), 0
    target.age += 1
    index = target.vertex[..., None].expand(-1, -1, 3)
    offset = target.point - vertex.gather(1, index)
    return distance_loss(offset, normal.gather(1, index), target.weight, noise)


def distance_loss(
    offset: Float[Tensor, "frame point 3"],
    normal: Float[Tensor, "frame point 3"],
    weight: Float[Tensor, "frame point"],
    noise: float,
) -> Float[Tensor, ""]:
    """Measure distances from a surface, mostly along its normal (Cauchy's loss).

    Args:
        offset: Way from the surface to each point [m].
        normal: Normal of the surface there.
        weight: Share of each point in its frame; zero on padding.
        noise: Expected error of a point [m].

    Returns:
        Mean over points, then frames, in units of the noise, squared.
    """
    return distance_costs(offset, normal, weight, noise).sum() / _measured_frames(weight)


def distance_costs(
    offset: Float[Tensor, "frame point 3"],
    normal: Float[Tensor, "frame point 3"],
    weight: Float[Tensor, "frame point"],
    noise: float,
) -> Float[Tensor, "frame point"]:
    """Measure each point's distance as `distance_loss` does, times its weight."""
    return weight * _cauchy(_surface_distance(offset, normal) / noise**2, DEPTH_DOUBT)


def distance_curvature(
    offset: Float[Tensor, "frame point 3"],
    normal: Float[Tensor, "frame point 3"],
    weight: Float[Tensor, "frame point"],
    noise: float,
) -> Float[Tensor, "frame point 3 3"]:
    """Compute the curvature of `distance_loss` in the place of each point, by Gauss and Newton."""
    pull = weight * _cauchy_pull(_surface_distance(offset, normal) / noise**2, DEPTH_DOUBT)
    across = (1 - _ASIDE) * normal[..., :, None] * normal[..., None, :]
    pull = 2.0 / _measured_frames(weight) * pull / noise**2
    return pull[..., None, None] * (across + _ASIDE * torch.eye(3))


def _surface_distance(
    offset: Float[Tensor, "frame point 3"], normal: Float[Tensor, "frame point 3"]
) -> Float[Tensor, "frame point"]:
    """Square distances from a surface; ways along it count for a part [m²]."""
    along = (offset * normal).sum(-1)
    aside = ((offset**2).sum(-1) - along**2).clamp(min=0)
    return along**2 + _ASIDE * aside


def _measured_frames(weight: Float[Tensor, "frame point"]) -> int:
    """Count the frames in which a point was measured; 1 if there is none."""
    return max(int((weight.sum(1) > 0).sum()), 1)


def vertex_normals_torch(
    vertex: Float[Tensor, "frame vertex 3"], faces: Tensor
) -> Float[Tensor, "frame vertex 3"]:
    """Compute unit normals of vertices, the area-weighted mean of their triangles'."""
    a, b, c = (vertex.index_select(1, faces[:, corner]) for corner in range(3))
    normal = torch.cross(b - a, c - a, dim=-1)
    total = torch.zeros_like(vertex)
    for corner in range(3):
        total = total.index_add(1, faces[:, corner], normal)
    return total / total.norm(dim=-1, keepdim=True).clamp(min=1e-12)


def correspond(vertex: Tensor, normal: Tensor, target: DepthTarget) -> Tensor:
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


def free_space_loss(
    point: Float[Tensor, "frame 21 3"], space: FreeSpace, noise: float
) -> Float[Tensor, ""]:
    """Push keypoints away from where a camera looked through: behind the surface it measured.

    What lies behind it may be hidden, and costs nothing. Far behind is another thing, at whose edge
    a keypoint appears that is a pixel off: that costs nothing either.

    Args:
        point: Keypoints in the world frame [m].
        space: What cameras measured around the hand.
        noise: Expected error of a measurement [m].

    Returns:
        Sum over keypoints and views, mean over frames, in units of the noise, squared.
    """
    squared = _in_free_space(point, space) ** 2 / noise**2
    return _cauchy(squared, DEPTH_DOUBT).sum() / point.shape[0]


def free_space_curvature(
    point: Float[Tensor, "frame 21 3"], space: FreeSpace, noise: float
) -> Float[Tensor, "frame 21 3 3"]:
    """Compute the curvature of `free_space_loss` in each keypoint's place, by Gauss and Newton."""
    before = _in_free_space(point, space)
    pull = (before > 0) * _cauchy_pull(before**2 / noise**2, DEPTH_DOUBT) / noise**2
    sight = space.projection[:, 2, :3]
    return 2.0 / point.shape[0] * torch.einsum("vfk,vi,vj->fkij", pull, sight, sight)


def _in_free_space(
    point: Float[Tensor, "frame 21 3"], space: FreeSpace
) -> Float[Tensor, "view frame 21"]:
    """Compute how far keypoints are before where they may be [m]."""
    projected = _projected(point, space.projection)
    depth = projected[..., 2]
    with torch.no_grad():
        pixel = projected[..., :2] / depth[..., None].clamp(min=1e-3)
        cell = (pixel - space.corner[:, :, None]) / space.step[:, :, None, None]
        cell = cell.round().clamp(-1, space.depth.shape[-1])
        is_known = ((cell >= 0) & (cell < space.depth.shape[-1])).all(-1)
        column, row = cell.long().clamp(0, space.depth.shape[-1] - 1).unbind(-1)
        view, frame = (torch.arange(count) for count in space.depth.shape[:2])
        measured = space.depth[view[:, None, None], frame[None, :, None], row, column]
        is_known &= (measured > 0) & (measured - depth < _EDGE)
    return torch.where(is_known, measured + _SKIN - depth, 0.0).relu()
