"""Hands that a fit moves: what it changes of them, where that puts them, and how it descends."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from physhandi.adam import Adam
from physhandi.fitting.hands.losses import vertex_normals_torch
from physhandi.hand.model import HandModel
from physhandi.hand.rotation import quaternion_matrix

_RATES = {"shape": 2.0, "articulation": 1.0, "rotation": 0.3, "translation": 0.1, "log_scale": 0.1}
"""Step size of each parameter, as a share of that of the joints."""
NARROWS = 0.6
"""Share of the updates of a descent over which errors that far off still pull become fewer."""


@dataclass(frozen=True, eq=False)
class PosedHands:
    """Hands of one shape: that of each frame, or of several starts of each."""

    model: HandModel
    """Model of the hand."""
    parameters: Mapping[str, Tensor]
    """Before it is bounded, ``shape`` of all; ``articulation``, ``rotation`` (quaternion x, y, z,
    w) and ``translation`` [m] of each."""

    def shape(self) -> Float[Tensor, " 10"]:
        """Compute the shape's components, which stay within three standard deviations."""
        return 3 * torch.tanh(self.parameters["shape"] / 3)

    def rotation(self) -> Float[Tensor, "hand 3 3"]:
        """Compute the wrists' rotations."""
        return quaternion_matrix(self.parameters["rotation"])

    def keypoints(self) -> Float[Tensor, "hand 21 3"]:
        """Pose the keypoints [m, before scale]."""
        articulation = self.parameters["articulation"]
        return self._placed(self.model.local_keypoints(self.shape(), articulation))

    def surface(self) -> Float[Tensor, "hand vertex 3"]:
        """Pose the surfaces' vertices [m, before scale]."""
        articulation = self.parameters["articulation"]
        return self._placed(self.model.local_vertices(self.shape(), articulation))

    def normals(self, surface: Float[Tensor, "hand vertex 3"]) -> Float[Tensor, "hand vertex 3"]:
        """Compute the unit normals of posed surfaces."""
        return vertex_normals_torch(surface, torch.from_numpy(self.model.faces))

    def vertices(self, index: Int[Tensor, "hand point"]) -> Float[Tensor, "hand point 3"]:
        """Pose some vertices of each hand, by their numbers [m, before scale]."""
        articulation = self.parameters["articulation"]
        return self._placed(self.model.chosen_vertices(index, self.shape(), articulation))

    def _placed(self, local: Float[Tensor, "hand point 3"]) -> Float[Tensor, "hand point 3"]:
        turn = self.rotation().transpose(-1, -2)
        return local @ turn + self.parameters["translation"][:, None]


def hand_optimizer(parameters: Mapping[str, Tensor], rate: float) -> Adam:
    """Prepare the descent of hands.

    Args:
        parameters: What is changed, by name.
        rate: First step size of the joints [rad].
    """
    groups = [(value.requires_grad_(), rate * _RATES[name]) for name, value in parameters.items()]
    return Adam(groups, betas=(0.9, 0.99))


def step_share(iteration: int, iterations: int) -> float:
    """Tell how long a step is, as a share of the first one: a half cosine down to a twentieth."""
    return 0.05 + 0.475 * (1 + math.cos(math.pi * iteration / iterations))


def doubt_breadth(doubt: float, iteration: int, narrowing: float) -> float:
    """Tell from which keypoint error on the pull falls.

    Args:
        doubt: In the end, in units of the expected error; in the beginning ten times as much.
        iteration: Updates that were made.
        narrowing: Updates until the end.
    """
    return doubt * 10 ** (1 - min(iteration / narrowing, 1.0))
