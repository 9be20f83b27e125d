"""A discrete elastic rod in float64: energies whose differences are the forces of a rope.

Axes are turned from edge to edge by rotation matrices, and twist minimises the energy, so nothing
of `kernels.rod` is used: neither its slopes nor its elimination.
"""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy import ndarray
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation


def axes(node: ndarray, arm: ndarray, angle: ndarray) -> tuple[ndarray, ndarray]:
    """Tangents, and the first material axis of each edge.

    Args:
        node: Vertices [m].
        arm: Way from the first vertex to the point that holds the axes there [m].
        angle: Turn of each edge's axes away from those that are carried without twist [rad].
    """
    edge = np.diff(node, axis=0)
    tangent = edge / np.linalg.norm(edge, axis=1, keepdims=True)
    held = arm - (arm @ tangent[0]) * tangent[0]
    carried = [held / np.linalg.norm(held)]
    for before, now in pairwise(tangent):
        normal = np.cross(before, now)
        sine, cosine = np.linalg.norm(normal), before @ now
        turn = np.arctan2(sine, cosine) * normal / max(sine, 1e-300)
        carried.append(Rotation.from_rotvec(turn).apply(carried[-1]))
    other = np.cross(tangent, carried)
    return tangent, np.cos(angle)[:, None] * carried + np.sin(angle)[:, None] * other


def curvature(node: ndarray, arm: ndarray, angle: ndarray) -> ndarray:
    """Curvature of each vertex that is not an end, about both of its axes."""
    tangent, first = axes(node, arm, angle)
    second = np.cross(tangent, first)
    scale = 1.0 + (tangent[:-1] * tangent[1:]).sum(axis=1)
    binormal = 2.0 * np.cross(tangent[:-1], tangent[1:]) / scale[:, None]
    mean_1, mean_2 = (0.5 * (each[:-1] + each[1:]) for each in (first, second))
    return np.stack([(binormal * mean_2).sum(axis=1), -(binormal * mean_1).sum(axis=1)], axis=1)


class ElasticRod:
    """Energy of a rope that is held at its first edge."""

    def __init__(
        self, length: ndarray, natural: ndarray, stiffness: float, twist_stiffness: float
    ) -> None:
        """Args are those of `physhandi.simulation.rod.Rod`, ends left out."""
        self.length, self.natural = length, natural
        self.stiffness, self.twist_stiffness = stiffness, twist_stiffness

    def energy(self, node: ndarray, arm: ndarray, angle: ndarray) -> float:
        """Energy of bending and twist at given angles, of all edges but the first [J]."""
        whole = np.concatenate([[0.0], angle])
        bent = curvature(node, arm, whole) - self.length[:, None] * self.natural
        bending = 0.5 * self.stiffness * (bent**2 / self.length[:, None]).sum()
        return bending + 0.5 * self.twist_stiffness * (np.diff(whole) ** 2 / self.length).sum()

    def balanced(self, node: ndarray, arm: ndarray) -> ndarray:
        """Angles at which the energy is least, from no twist on."""
        start = np.zeros(len(node) - 2)
        found = minimize(
            lambda angle: self.energy(node, arm, angle), start, method="BFGS", tol=1e-9
        )
        return found.x

    def force(self, node: ndarray, arm: ndarray) -> ndarray:
        """Force on each vertex [N]; what turns the held axes is borne by the gripper."""
        angle = self.balanced(node, arm)
        return -gradient(lambda moved: self.energy(moved, arm, angle), node)


def gradient(function: Callable[[ndarray], float], at: ndarray, step: float = 1e-6) -> ndarray:
    """Central differences of a function."""
    slope = np.zeros_like(at)
    for place in np.ndindex(at.shape):
        change = np.zeros_like(at)
        change[place] = step
        slope[place] = (function(at + change) - function(at - change)) / (2 * step)
    return slope
