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
    x, y, z = rotation_vector.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1)
    cross = cross.reshape(*rotation_vector.shape[:-1], 3, 3)
    squared = (rotation_vector**2).sum(-1)[..., None, None]
    is_small = squared < 1e-4
    angle = torch.where(is_small, torch.ones_like(squared), squared).sqrt()
    sine = torch.where(is_small, 1 - squared / 6 + squared**2 / 120, angle.sin() / angle)
    cosine = torch.where(
        is_small, 0.5 - squared / 24 + squared**2 / 720, (1 - angle.cos()) / angle**2
    )
    return sine * cross + cosine * (cross @ cross)


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
