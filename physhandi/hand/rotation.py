"""Rotations as torch tensors."""

import torch
from jaxtyping import Float
from torch import Tensor


def rotation_offset(rotation_vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Compute ``R - I`` by Rodrigues' formula; exactly zero for a zero vector, smooth there.

    Args:
        rotation_vector: Axis times angle [rad].

    Returns:
        The rotation matrix less the identity.
    """
    cross = _cross_matrix(rotation_vector)
    squared = (rotation_vector**2).sum(-1)[..., None, None]
    is_small = squared < 1e-4
    angle = torch.where(is_small, torch.ones_like(squared), squared).sqrt()
    sine = torch.where(is_small, 1 - squared / 6 + squared**2 / 120, angle.sin() / angle)
    cosine = torch.where(
        is_small, 0.5 - squared / 24 + squared**2 / 720, (1 - angle.cos()) / angle**2
    )
    return sine * cross + cosine * (cross @ cross)


def _cross_matrix(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Compute the matrices that multiply another vector by the cross product."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1)
    return cross.reshape(*vector.shape[:-1], 3, 3)


def left_jacobian(rotation_vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Compute how a rotation turns on as its rotation vector changes.

    Args:
        rotation_vector: Axis times angle [rad].

    Returns:
        Column i is the rotation vector, per radian, of the turn that follows the rotation if
        component i grows.
    """
    cross = _cross_matrix(rotation_vector)
    squared = (rotation_vector**2).sum(-1)[..., None, None]
    is_small = squared < 1e-4
    angle = torch.where(is_small, torch.ones_like(squared), squared).sqrt()
    once = torch.where(is_small, 0.5 - squared / 24, (1 - angle.cos()) / angle**2)
    twice = torch.where(is_small, 1 / 6 - squared / 120, (angle - angle.sin()) / angle**3)
    return torch.eye(3).to(cross) + once * cross + twice * (cross @ cross)


def rotation_matrix(rotation_vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Compute the rotation matrix of a rotation vector [rad]."""
    offset = rotation_offset(rotation_vector)
    return offset + torch.eye(3, dtype=offset.dtype, device=offset.device)


def quaternion_matrix(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Compute the rotation matrix of a quaternion (x, y, z, w) of any length but zero."""
    x, y, z, w = (quaternion / quaternion.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
        2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
        2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).reshape(*quaternion.shape[:-1], 3, 3)
