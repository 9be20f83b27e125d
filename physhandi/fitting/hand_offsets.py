"""Small corrections of fitted hands: the parameters of stage 3."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial.transform import Rotation
from torch import Tensor

from physhandi.hand.model import HandModel, HandPose
from physhandi.hand.motion import HandMotion
from physhandi.hand.rotation import rotation_matrix

Offset = dict[str, Tensor]
"""A correction of one hand, frames first: of its joints (``articulation``, added to their rotation
vectors [rad]), of the wrist's ``rotation`` (in the hand's own frame [rad]) and of its
``translation`` [m]."""

BETA_1 = 0.9
"""Decay of the first moment."""
FLAT = 1e-12
"""A step that changes the loss by less than a square micrometre is not worth taking [m²]."""


class HandOffsets:
    """Corrections of one hand in the frames that are fitted; all zero is the hand as it was."""

    def __init__(self, motion: HandMotion, model: HandModel, frame_count: int) -> None:
        """Begin with no correction.

        Args:
            motion: The hand as stage 1 found it, over all frames.
            model: Its model.
            frame_count: Frames to correct, counted from 0.
        """
        self.before = motion
        self.model = model
        self.frame_count = frame_count
        shapes = {"articulation": (15, 3), "rotation": (3,), "translation": (3,)}
        self.value: Offset = {
            name: torch.zeros(frame_count, *shape, requires_grad=True)
            for name, shape in shapes.items()
        }
        self._shape = _tensor(motion.shape)
        self._articulation = _tensor(motion.articulation[:frame_count])
        self._rotation = rotation_matrix(_tensor(motion.wrist_rotation[:frame_count]))
        self._translation = _tensor(motion.wrist_translation[:frame_count])
        with torch.no_grad():
            self._vertex = self.pose().vertex

    def pose(self) -> HandPose:
        """Pose the corrected hand in the frames to fit."""
        offset = self.value
        still = torch.zeros_like(self._translation)
        hand = self.model(self._shape, self._articulation + offset["articulation"], still, still)
        turn = (self._rotation @ rotation_matrix(offset["rotation"])).transpose(-1, -2)
        place = (self._translation + offset["translation"])[:, None]
        scale = self.before.scale
        return HandPose(
            scale * (hand.vertex @ turn + place), scale * (hand.keypoint @ turn + place)
        )

    def displacement(self, pose: HandPose) -> Float[Tensor, "frame vertex 3"]:
        """Tell how far the surface has moved from where stage 1 had it [m]."""
        return pose.vertex - self._vertex

    def copy(self) -> Offset:
        """Copy the correction, to come back to it later."""
        return {name: tensor.detach().clone() for name, tensor in self.value.items()}

    def forget_gradient(self) -> None:
        """Drop the gradient of the last evaluation."""
        for tensor in self.value.values():
            tensor.grad = None

    def restore(self, offset: Offset) -> None:
        """Go back to a copied correction."""
        with torch.no_grad():
            for name, tensor in self.value.items():
                tensor.copy_(offset[name])

    def motion(self, carried: float) -> HandMotion:
        """Give the corrected motion over all frames.

        Frames after the fitted ones cannot tell their own correction: they get the last one,
        fading, so that the hand neither jumps nor keeps for ever what one frame said.

        Args:
            carried: Frames in which a carried correction falls to 1/e; 0 carries nothing.
        """
        before = self.before
        offset = {
            name: _carry(tensor.detach().double().numpy(), before.frame_count, carried)
            for name, tensor in self.value.items()
        }
        turned = (
            Rotation.from_rotvec(before.wrist_rotation) * Rotation.from_rotvec(offset["rotation"])
        ).as_rotvec()
        wrist_rotation = _nearer_vector(turned, before.wrist_rotation)
        return replace(
            before,
            articulation=(before.articulation + offset["articulation"]).astype(np.float32),
            wrist_rotation=wrist_rotation.astype(np.float32),
            wrist_translation=(before.wrist_translation + offset["translation"]).astype(np.float32),
        )


class OffsetDescent:
    """Adam on the corrections of one hand, in units of each kind's step.

    Adam gives every number a step of about the same size, however little hangs on it: joints
    whose effect on the object is almost nil turn as far as those that hold it. Here all numbers
    of a frame share one second moment instead, so that a frame moves along its gradient, in units
    of what each kind of correction is expected to need, and by one step in all. `by_parameter`
    gives Adam as it is, as the paper uses it.
    """

    def __init__(
        self, hand: HandOffsets, rates: dict[str, float], beta_2: float, *, by_parameter: bool
    ) -> None:
        """Begin with no momentum.

        Args:
            hand: The corrections to update.
            rates: Step of every kind [rad, rad, m].
            beta_2: Decay of the second moment.
            by_parameter: Whether every number has its own second moment.
        """
        self.hand = hand
        self.rates = rates
        self.beta_2 = beta_2
        self.by_parameter = by_parameter
        self.count = 0
        self.first = {name: torch.zeros_like(value) for name, value in hand.value.items()}
        self.second = {name: torch.zeros_like(value) for name, value in hand.value.items()}

    def step(self, share: float) -> None:
        """Update the corrections by their gradient.

        Args:
            share: How long this step is, beside a whole one.
        """
        self.count += 1
        gradient = {
            name: self.rates[name] * (torch.zeros_like(v) if v.grad is None else v.grad)
            for name, v in self.hand.value.items()
        }
        squared = {name: value**2 for name, value in gradient.items()}
        if not self.by_parameter:
            frame = torch.stack([value.flatten(1).sum(1) for value in squared.values()]).sum(0)
            squared = {
                name: frame.reshape(-1, *[1] * (value.ndim - 1)).expand_as(value)
                for name, value in squared.items()
            }
        with torch.no_grad():
            for name, offset in self.hand.value.items():
                self.first[name].lerp_(gradient[name], 1 - BETA_1)
                self.second[name].lerp_(squared[name], 1 - self.beta_2)
                mean = self.first[name] / (1 - BETA_1**self.count)
                size = (self.second[name] / (1 - self.beta_2**self.count)).sqrt()
                offset.sub_(share * self.rates[name] * mean / (size + FLAT))


def control_nodes(
    vertices: Sequence[Float[Tensor, "frame _ 3"]], chosen: Int[ndarray, " control"] | None
) -> Float[Tensor, "frame control 3"]:
    """Join the vertices of all hands, and keep those that are control nodes.

    Args:
        vertices: Surface of each hand, in the order of the sequence's hands.
        chosen: Which of the joined vertices are control nodes; all of them if None.
    """
    joined = torch.cat(list(vertices), dim=1)
    return joined if chosen is None else joined[:, torch.from_numpy(chosen.astype(np.int64))]


def _carry(
    offset: Float[ndarray, "frame ..."], frame_count: int, carried: float
) -> Float[ndarray, "all_frame ..."]:
    """Append the last correction to the frames that have none, ever weaker."""
    later = np.arange(1, frame_count - len(offset) + 1)
    share = np.exp(-later / carried) if carried > 0 else np.zeros(len(later))
    faded = share.reshape(-1, *[1] * (offset.ndim - 1)) * offset[-1:]
    return np.concatenate([offset, faded])


def _nearer_vector(
    vector: Float[ndarray, "frame 3"], to: Float[ndarray, "frame 3"]
) -> Float[ndarray, "frame 3"]:
    """Describe each rotation by whichever of its two vectors is nearer to a given one."""
    angle = np.linalg.norm(vector, axis=1, keepdims=True)
    other = vector * (1 - 2 * np.pi / np.maximum(angle, 1e-9))
    near, far = (np.linalg.norm(v - to, axis=1, keepdims=True) for v in (vector, other))
    return np.where((far < near) & (angle > 1e-3), other, vector)


def _tensor(array: ndarray) -> Tensor:
    return torch.from_numpy(np.array(array, dtype=np.float32))
