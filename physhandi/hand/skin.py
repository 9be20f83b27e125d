"""A moving hand as a skinned skeleton, for glTF and other animation formats."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial.transform import Rotation

from physhandi.hand.model import JOINT_COUNT, HandModel
from physhandi.hand.motion import HandMotion
from physhandi.hand.names import JOINT_NAMES
from physhandi.rotations import without_jumps

BONES_PER_VERTEX = 4
"""Most bones of one vertex; viewers read no more."""
PARENT = tuple(-1 if bone == 0 else 0 if bone % 3 == 1 else bone - 1 for bone in range(16))
"""Parent of each bone: -1 for the wrist, the wrist for knuckles."""


@dataclass(frozen=True, kw_only=True, eq=False)
class HandSkin:
    """Skeleton, skin and motion of one hand; bone 0 is the wrist, then come `JOINT_NAMES`.

    In the rest pose every bone's axes are the hand's. A vertex is at
    ``sum_b w_b T_world_bone T_bone_hand vertex``.
    """

    names: tuple[str, ...]
    """Name of each bone."""
    parent: Int[ndarray, " bone"]
    """Parent of each bone, -1 for the wrist."""
    T_bone_hand: Float[ndarray, "bone 4 4"]
    """Inverse bind matrices: map the rest pose to each bone [length unit of the sequence]."""
    vertex: Float[ndarray, "vertex 3"]
    """Surface in the rest pose [length unit of the sequence]."""
    faces: Int[ndarray, "face 3"]
    """Vertices of each triangle, counter-clockwise from outside."""
    vertex_bone: Int[ndarray, "vertex 4"]
    """Bones of each vertex."""
    vertex_weight: Float[ndarray, "vertex 4"]
    """Skinning weight of each of them; rows sum to one."""
    translation: Float[ndarray, "frame bone 3"]
    """Origin of each bone in its parent's axes, the wrist's in the world [length unit]."""
    rotation: Float[ndarray, "frame bone 4"]
    """Rotation of each bone against its parent: quaternion x, y, z, w without jumps of sign."""

    def to_tensors(self) -> dict[str, ndarray]:
        """Describe the skin as arrays, as a run's ``hand_<side>_skin.safetensors`` holds it."""
        return {
            "name": np.frombuffer("\n".join(self.names).encode(), np.uint8),
            "parent": self.parent.astype(np.int32),
            "T_bone_hand": self.T_bone_hand.astype(np.float32),
            "vertex": self.vertex.astype(np.float32),
            "faces": self.faces.astype(np.int32),
            "vertex_bone": self.vertex_bone.astype(np.uint8),
            "vertex_weight": self.vertex_weight.astype(np.float32),
            "translation": self.translation.astype(np.float32),
            "rotation": self.rotation.astype(np.float32),
        }


def hand_skin(model: HandModel, motion: HandMotion) -> HandSkin:
    """Convert a hand's motion to a skinned skeleton.

    Exact for the open hand. MANO's pose blend shapes, which move vertices by millimetres where
    joints bend, cannot be expressed by a skin and are left out.

    Args:
        model: The hand.
        motion: Its motion.

    Raises:
        ValueError: If the motion is not of this model.
    """
    if (model.side, model.kind) != (motion.side, motion.model):
        raise ValueError(
            f"the motion of the {motion.side} hand '{motion.model}' was given the {model.side} "
            f"hand '{model.kind}'"
        )
    shape = torch.from_numpy(motion.shape.astype(np.float64))
    still = torch.zeros(1, 3, dtype=torch.float64)
    flat = torch.zeros(1, JOINT_COUNT, 3, dtype=torch.float64)
    vertex = model(shape, flat, still, still).vertex[0].numpy() * motion.scale
    origin = model.bone_origins(shape).numpy() * motion.scale
    T_bone_hand = np.tile(np.eye(4), (len(origin), 1, 1))
    T_bone_hand[:, :3, 3] = -origin
    bone, weight = _strongest(model.weight)

    frames = motion.frame_count
    turn = np.einsum("jca,fja->fjc", model.joint_axes, motion.articulation)
    turn = np.concatenate([motion.wrist_rotation[:, None], turn], axis=1)
    rotation = Rotation.from_rotvec(turn.reshape(-1, 3)).as_quat().reshape(frames, -1, 4)
    translation = np.tile(origin - origin[list(PARENT)], (frames, 1, 1))
    translation[:, 0] = motion.scale * motion.wrist_translation
    return HandSkin(
        names=("wrist", *JOINT_NAMES),
        parent=np.array(PARENT),
        T_bone_hand=T_bone_hand,
        vertex=vertex,
        faces=model.faces,
        vertex_bone=bone,
        vertex_weight=weight,
        translation=translation,
        rotation=without_jumps(rotation),
    )


def _strongest(
    weight: Float[ndarray, "vertex bone"],
) -> tuple[Int[ndarray, "vertex 4"], Float[ndarray, "vertex 4"]]:
    """Keep the strongest bones of each vertex and normalise their weights."""
    bone = np.argsort(-weight, axis=1, kind="stable")[:, :BONES_PER_VERTEX]
    share = np.take_along_axis(weight, bone, axis=1).clip(min=0)
    return bone, share / share.sum(axis=1, keepdims=True)
