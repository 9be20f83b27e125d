"""A tube about a moving line, so that a rod can be drawn and filmed."""

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

ROUND = 8
"""Vertices on the circle about each node."""


def tube_faces(node_count: int) -> Int[ndarray, "face 3"]:
    """Connect the circles about the nodes of a line to a closed tube, seen from outside.

    Args:
        node_count: Nodes of the line.
    """
    ring, corner = np.meshgrid(np.arange(node_count - 1), np.arange(ROUND), indexing="ij")
    a = (ring * ROUND + corner).ravel()
    b = (ring * ROUND + (corner + 1) % ROUND).ravel()
    side = np.concatenate([np.stack([a, b, b + ROUND], 1), np.stack([a, b + ROUND, a + ROUND], 1)])
    fan = np.arange(1, ROUND - 1)
    start = np.stack([np.zeros_like(fan), fan + 1, fan], 1)
    last = (node_count - 1) * ROUND
    end = last + np.stack([np.zeros_like(fan), fan, fan + 1], 1)
    return np.concatenate([side, start, end]).astype(np.int64)


def tube_vertices(
    position: Float[ndarray, "frame node 3"], radius: float
) -> Float[ndarray, "frame vertex 3"]:
    """Place the circles about the nodes of a line in each frame.

    The circles of the first frame do not twist along the line; from then on each circle turns with
    the line about it and never about its own axis, so a point of the skin keeps its side.

    Args:
        position: Nodes of the line in each frame [m].
        radius: Radius of the tube [m].
    """
    tangent = np.gradient(position, axis=1)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=-1, keepdims=True), 1e-12)
    normal = np.empty_like(tangent)
    normal[0] = _untwisted(tangent[0])
    for frame in range(1, len(position)):
        normal[frame] = _across(normal[frame - 1], tangent[frame])
    binormal = np.cross(tangent, normal)
    angle = 2 * np.pi * np.arange(ROUND) / ROUND
    circle = (
        np.cos(angle)[:, None] * normal[:, :, None] + np.sin(angle)[:, None] * binormal[:, :, None]
    )
    return (position[:, :, None] + radius * circle).reshape(len(position), -1, 3)


def _untwisted(tangent: Float[ndarray, "node 3"]) -> Float[ndarray, "node 3"]:
    """Transport one normal along a line."""
    normal = np.empty_like(tangent)
    least = np.eye(3)[np.argmin(np.abs(tangent[0]))]
    normal[0] = _across(least, tangent[0])
    for node in range(1, len(tangent)):
        normal[node] = _across(normal[node - 1], tangent[node])
    return normal


def _across(
    vector: Float[ndarray, "*batch 3"], tangent: Float[ndarray, "*batch 3"]
) -> Float[ndarray, "*batch 3"]:
    """Normalise the component of a vector that is perpendicular to a unit tangent."""
    across = vector - (vector * tangent).sum(axis=-1, keepdims=True) * tangent
    return across / np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-12)
