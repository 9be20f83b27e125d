"""The interface of articulated hands: pose and shape in, vertices and keypoints out."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor

from physhandi.hand.names import HandKind, HandSide
from physhandi.hand.skinning import place

SHAPE_COUNT = 10
JOINT_COUNT = 15
PARENT_BONE = [0 if joint % 3 == 0 else joint for joint in range(JOINT_COUNT)]
"""Bone that each joint hangs on: bone 0 is the palm, bone j + 1 the one that joint j moves."""
KEYPOINT_BONE = [0, *(bone for j in range(1, 16, 3) for bone in (0, j, j + 1, j + 2))]
"""Bone that carries each keypoint: a joint's rides on the bone before it, a tip's on the last."""


@dataclass(frozen=True)
class HandPose:
    """A posed hand, differentiable with respect to shape and pose."""

    vertex: Float[Tensor, "batch vertex 3"]
    """Vertices of the surface [length unit of the sequence; m when metric]."""
    keypoint: Float[Tensor, "batch 21 3"]
    """Keypoints in MediaPipe's order [as the vertices]."""


class HandModel(ABC):
    """One hand whose shape is constant and whose articulation changes from frame to frame."""

    kind: HandKind
    """Which model it is, as `load_hand_model` names it."""
    side: HandSide
    """Which hand it is."""
    faces: Int[ndarray, "face 3"]
    """Vertices of each triangle, counter-clockwise from outside."""
    vertex_count: int
    """Vertices of the surface."""
    template: Float[ndarray, "vertex 3"]
    """The unposed surface of shape zero, relative to the wrist [m]."""
    weight: Float[ndarray, "vertex 16"]
    """Skinning weights of each vertex: the palm, then the bones that `JOINT_NAMES` move."""
    joint_position: Float[ndarray, "15 3"]
    """The unposed joints of shape zero, relative to the wrist [m]."""
    joint_axes: Float[ndarray, "15 3 3"]
    """Axes, as columns, in which each joint's rotation vector is expressed."""
    keypoint_position: Float[ndarray, "21 3"]
    """The unposed keypoints of shape zero, relative to the wrist [m]."""
    shape_count: int = SHAPE_COUNT
    """Shape coefficients; all zero is the template, each about one standard deviation per unit."""
    joint_count: int = JOINT_COUNT
    """Joints that articulate, in the order of `JOINT_NAMES`."""

    @abstractmethod
    def __call__(
        self,
        shape: Float[Tensor, " 10"],
        articulation: Float[Tensor, "batch 15 3"],
        wrist_rotation: Float[Tensor, "batch 3"],
        wrist_translation: Float[Tensor, "batch 3"],
        scale: float | Float[Tensor, ""] = 1.0,
    ) -> HandPose:
        """Pose the hand: ``scale * (R(wrist_rotation) hand + wrist_translation)``.

        Args:
            shape: Shape coefficients.
            articulation: Rotation vector of every joint in its bone's own frame [rad].
            wrist_rotation: Rotation vector of the whole hand about the wrist [rad].
            wrist_translation: Position of the wrist [m].
            scale: Length units of the sequence per metre; 1 when it is metric.

        Returns:
            Vertices and keypoints in the world frame.
        """

    @abstractmethod
    def chosen_vertices(
        self,
        index: Int[Tensor, "batch point"],
        shape: Float[Tensor, " 10"],
        articulation: Float[Tensor, "batch 15 3"],
    ) -> Float[Tensor, "batch point 3"]:
        """Pose some vertices of each surface alone, relative to the wrist and not turned [m].

        Args:
            index: Vertices of each surface; they may repeat.
            shape: Shape coefficients.
            articulation: Rotation vector of every joint in its bone's own frame [rad].
        """

    @abstractmethod
    def bone_origins(self, shape: Float[Tensor, " 10"]) -> Float[Tensor, "16 3"]:
        """Compute where the bones begin in the unposed hand: the wrist, then the 15 joints [m]."""

    @abstractmethod
    def local_vertices(
        self, shape: Float[Tensor, " 10"], articulation: Float[Tensor, "batch 15 3"]
    ) -> Float[Tensor, "batch vertex 3"]:
        """Compute the surface alone, in the wrist's frame [m, before scale]."""

    @abstractmethod
    def local_keypoints(
        self, shape: Float[Tensor, " 10"], articulation: Float[Tensor, "batch 15 3"]
    ) -> Float[Tensor, "batch 21 3"]:
        """Compute the keypoints alone, in the wrist's frame [m, before scale]."""

    def keypoints(
        self,
        shape: Float[Tensor, " 10"],
        articulation: Float[Tensor, "batch 15 3"],
        wrist_rotation: Float[Tensor, "batch 3"],
        wrist_translation: Float[Tensor, "batch 3"],
        scale: float | Float[Tensor, ""] = 1.0,
    ) -> Float[Tensor, "batch 21 3"]:
        """Compute the keypoints alone, as `__call__` does but without the surface."""
        keypoint = self.local_keypoints(shape, articulation)
        return place(keypoint, wrist_rotation, wrist_translation, scale)
