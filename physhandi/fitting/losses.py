"""The terms that compare a simulated object with what the cameras saw of it."""

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor


def chamfer_loss(
    observed: Float[Tensor, "frame point 3"],
    is_observed: Bool[Tensor, "frame point"],
    node: Float[Tensor, "frame node 3"],
    *,
    count: Float[Tensor, " frame"] | None = None,
) -> Float[Tensor, " frame"]:
    """Measure how far observed points lie from the nearest node, one way, squared [m²].

    The nearest node is held fixed in the gradient (physics.md §4.1; PhysTwin's Chamfer term).

    Args:
        observed: Observed points, padded to one length [m].
        is_observed: Which of them are real.
        node: Simulated object nodes [m].
        count: What to divide by instead of the number of points of each frame.

    Returns:
        Mean squared distance of each frame; 0 where a frame saw nothing.
    """
    nearest = _nearest(observed, is_observed, node)
    chosen = torch.gather(node, 1, nearest[..., None].expand(-1, -1, 3))
    squared = ((torch.nan_to_num(observed) - chosen) ** 2).sum(dim=2) * is_observed
    divisor = is_observed.sum(dim=1) if count is None else count
    return squared.sum(dim=1) / divisor.clamp(min=1)


def track_loss(
    observed: Float[Tensor, "frame track 3"],
    is_valid: Bool[Tensor, "frame track"],
    predicted: Float[Tensor, "frame track 3"],
    *,
    count: Float[Tensor, " frame"] | None = None,
) -> Float[Tensor, " frame"]:
    """Measure how far followed surface points are from where the simulation carried them [m²].

    PhysTwin's smooth L1 with β = 1 m, averaged over coordinates, is one sixth of this value.

    Args:
        observed: Observed tracks [m].
        is_valid: Where a track can be trusted.
        predicted: The same surface points, carried by the simulated nodes [m].
        count: What to divide by instead of the number of valid tracks of each frame.

    Returns:
        Mean squared distance of each frame; 0 where a frame has no valid track.
    """
    squared = ((torch.nan_to_num(observed) - predicted) ** 2).sum(dim=2) * is_valid
    divisor = is_valid.sum(dim=1) if count is None else count
    return squared.sum(dim=1) / divisor.clamp(min=1)


def acceleration_loss(
    velocity: Float[Tensor, "frame node 3"],
) -> Float[Tensor, " frame"]:
    """Measure how abruptly frame-to-frame changes of velocity differ, half-squared [m²/s²].

    PhysTwin's regulariser of the zeroth-order stage: smooth L1 with β = 1 of the difference of
    two successive velocity changes, averaged over nodes and coordinates.

    Args:
        velocity: Node velocities at the frames [m/s].

    Returns:
        One value a frame, 0 for the first two.
    """
    change = velocity[1:] - velocity[:-1]
    jerk = change[1:] - change[:-1]
    value = torch.nn.functional.smooth_l1_loss(jerk, torch.zeros_like(jerk), reduction="none")
    return torch.cat([velocity.new_zeros(2), value.mean(dim=(1, 2))])[: velocity.shape[0]]


def _nearest(
    observed: Float[Tensor, "frame point 3"],
    is_observed: Bool[Tensor, "frame point"],
    node: Float[Tensor, "frame node 3"],
) -> Int[Tensor, "frame point"]:
    """Find the nearest node of each observed point, by a tree: all distances would take longer."""
    nearest = torch.zeros(is_observed.shape, dtype=torch.int64)
    for frame, nodes in enumerate(node.detach().cpu().numpy()):
        seen = is_observed[frame].cpu()
        if len(nodes) and seen.any():
            _, found = KDTree(nodes).query(observed[frame].cpu()[seen].numpy())
            nearest[frame, seen] = torch.from_numpy(found)
    return nearest.to(node.device)
